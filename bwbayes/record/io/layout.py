"""How the numbers stand in a text: between which separators, from which line on, below which names.

Commas, semicolons, tabs, bars or blanks separate the columns. The line above the numbers names the
columns; a second line may hold their units.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bwbayes.errors import InputError, NoNumbersError
from bwbayes.record.io.units import QUANTITIES, power_of

_NUMBER = re.compile(
    r"[+-]?(\d+[.,]?\d*|[.,]\d+|\d{1,3}(\.\d{3})+(,\d*)?|\d{1,3}(,\d{3})+(\.\d*)?)"
    r"([eEdD][+-]?\d+)?"
    r"|[+-]?nan|[+-]?inf",
    re.IGNORECASE,
)
_SEPARATORS = ("\t", ";", ",", "|", " ")
EXAMPLE = "time_s,voltage_V,displacement_um"


class Layout(NamedTuple):
    """How the numbers stand in a text: separator, fields of a line, and the first line's index."""

    separator: str
    fields: int
    first: int


def cells_of(line: str, separator: str) -> list[str]:
    """Return the cells of a line, without blanks around them and quotes."""
    if separator == " ":
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]


def find_layout(path: Path, lines: Sequence[str]) -> Layout:
    """Find how the numbers stand in a text: most lines in its middle and at its end are such."""
    center, sample = len(lines) // 2, 60
    probed = [*lines[center : center + sample], *lines[-sample:]]
    rows = [line for line in probed if line.strip() and not line.startswith("#")]
    best, separator, fields = 0.0, "", 0
    columns: list[int] = []
    whole_columns: list[int] = []
    for candidate in _SEPARATORS if rows else ():
        split = [cells_of(line, candidate) for line in rows]
        width = Counter(map(len, split)).most_common(1)[0][0]
        if width < 2:
            continue
        whole = [row for row in split if len(row) == width]
        numeric = np.array([[bool(_NUMBER.fullmatch(cell)) for cell in row] for row in whole])
        # An empty cell speaks for no separator, nor against one.
        filled = sum(bool(cell) for row in whole for cell in row)
        share = float(numeric.sum()) / max(filled, 1) * len(whole) / len(split)
        numeric_columns = np.flatnonzero(numeric.mean(axis=0) > 0.5).tolist()
        if share > best and numeric_columns:
            best, separator, fields, columns = share, candidate, width, numeric_columns
            whole_columns = np.flatnonzero(numeric.all(axis=0)).tolist()
    in_a_row: list[int] = []
    for index, line in enumerate(lines if columns else []):
        if not line.strip():
            continue
        cells = cells_of(line, separator)
        numbers = {c for c in columns if c < len(cells) and _NUMBER.fullmatch(cells[c])}
        is_row = len(numbers) > len(columns) / 2 and numbers.issuperset(whole_columns)
        in_a_row = [*in_a_row, index] if is_row else []
        if len(in_a_row) == 3:
            break
    if not in_a_row:
        raise NoNumbersError(f"{path}: no columns of numbers in it; write {EXAMPLE} above such")
    return Layout(separator, fields, in_a_row[0])


def find_header(
    path: Path, lines: Sequence[str], layout: Layout
) -> tuple[list[str], list[str], int | None]:
    """Return the columns' names and units, and the index of the header's first line."""
    rows: list[tuple[int, list[str]]] = []
    unit_row: int | None = None
    values = cells_of(lines[layout.first], layout.separator)
    above = [(i, line) for i, line in enumerate(lines[: layout.first]) if line.strip()]
    for index, line in reversed(above[-6:]):
        cells = split_header(line, layout)
        if not cells:
            commas = layout.separator == "," and not rows
            if commas and 2 * len(line.split(",")) == layout.fields:
                raise InputError(
                    f"{path}:{layout.first + 1}: decimal commas, {layout.fields} fields for "
                    f"{layout.fields // 2} columns; separate them by semicolons, or write 1.5"
                )
            continue
        bare = [cell.strip("[]() ") for cell in cells]
        # Times of day have their form in place of a unit.
        is_unit = [
            re.fullmatch("h+:m+(:s+)?([.,]f+)?", cell.lower())
            or any(power_of(cell, q) is not None for q in QUANTITIES)
            for cell, value in zip_longest(bare, values, fillvalue="")
            if cell and value
        ]
        if unit_row is None and is_unit and all(is_unit):
            unit_row = len(rows)
            cells = bare
        rows.append((index, cells))
    # From the numbers upwards: comments, units and names, or names alone.
    used = rows[:1]
    if unit_row is not None:
        used = rows[unit_row : unit_row + 2] if rows[unit_row + 1 :] else rows[: unit_row + 1][-2:]
    units = rows[unit_row][1] if unit_row is not None else []
    names = next((cells for _, cells in used[::-1] if cells is not units), [])
    first = used[-1][0] if used else None
    fields = max(layout.fields, len(names))
    units += [""] * (fields - len(units))
    names += [""] * (fields - len(names))
    named = [name or f"column {i}" for i, name in enumerate(names, start=1)]
    count = Counter(named)
    named = [f"{n} (column {i})" if count[n] > 1 else n for i, n in enumerate(named, start=1)]
    return named, units, first


def split_header(line: str, layout: Layout) -> list[str]:
    """Return the cells of a line, by any separator that gives as many as the numbers have."""
    bare = line.lstrip("#%").strip(" ") if line.startswith(("#", "%")) else line
    ways = [cells_of(bare, separator) for separator in (layout.separator, *_SEPARATORS)]
    for number, fields in enumerate([*ways, re.split(r"\s{2,}|\t", bare.strip())]):
        cells = [cell.strip().strip('"') for cell in fields]
        more = any(cells[layout.fields :]) and number > 0
        is_name = any(cells) and not any(_NUMBER.fullmatch(cell) for cell in cells)
        if len(cells) >= layout.fields and not more and is_name:
            return cells
    return []
