"""Layout of the numbers in a text: their separator, their first line, and the names above them.

Commas, semicolons, tabs, bars or blanks separate the columns, if there are several. The line above
the numbers names the columns; a second line may hold their units.
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
from bwbayes.record.io.series import NOTES
from bwbayes.record.io.units import (
    QUANTITIES,
    is_other_unit,
    is_time_form,
    scale_of,
    unit_in_brackets,
)

_NUMBER = re.compile(
    r"[+-]?(\d+[.,]?\d*|[.,]\d+|\d{1,3}(\.\d{3})+(,\d*)?|\d{1,3}(,\d{3})+(\.\d*)?)"
    r"([eEdD][+-]?\d+)?"
    r"|[+-]?nan|[+-]?inf",
    re.IGNORECASE,
)
SEPARATORS = ("\t", ";", ",", "|", " ")
EXAMPLE = "time_s,voltage_V,displacement_um"


class Layout(NamedTuple):
    """Layout of the numbers in a text: separator, fields of a line, index of the first line.

    ``empty`` are the fields of the first line without a value.
    """

    separator: str
    fields: int
    first: int
    empty: frozenset[int] = frozenset()


def cells_of(line: str, separator: str) -> list[str]:
    """Return the cells of a line, without blanks around them and quotes."""
    if separator == " ":
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]


def find_layout(path: Path, lines: Sequence[str]) -> Layout:
    """Find the layout of the numbers in a text, from the lines in its middle and at its end."""
    center, sample = len(lines) // 2, 60
    probed = [*lines[center : center + sample], *lines[-sample:]]
    rows = [line for line in probed if line.strip() and not line.startswith("#")]
    best, separator, fields = 0.0, "", 0
    columns: list[int] = []
    whole_columns: list[int] = []
    empty_columns: list[int] = []
    for candidate in SEPARATORS if rows else ():
        split = [cells_of(line, candidate) for line in rows]
        width = Counter(map(len, split)).most_common(1)[0][0]
        if width < 2 or (candidate == "," and _is_one_with_decimals(split)):
            continue
        full_rows = [row for row in split if len(row) == width]
        numeric = np.array([[bool(_NUMBER.fullmatch(cell)) for cell in row] for row in full_rows])
        # An empty cell counts neither for a separator nor against it.
        filled = sum(bool(cell) for row in full_rows for cell in row)
        share = float(numeric.sum()) / max(filled, 1) * len(full_rows) / len(split)
        numeric_columns = np.flatnonzero(numeric.mean(axis=0) > 0.5).tolist()
        if share > best and numeric_columns:
            best, separator, fields, columns = share, candidate, width, numeric_columns
            whole_columns = np.flatnonzero(numeric.all(axis=0)).tolist()
            empty_columns = [i for i in range(width) if not any(row[i] for row in full_rows)]
    # A single column has no separator; a tab will do, since none of its cells holds one.
    alone = [_NUMBER.fullmatch(line.strip(' "')) is not None for line in rows]
    if not columns and np.mean([False, *alone]) > 0.5:
        separator, fields, columns = "\t", 1, [0]
    in_a_row: list[int] = []
    for index, line in enumerate(lines if columns else []):
        if not line.strip():
            continue
        cells = cells_of(line, separator)
        numbers = {c for c in columns if c < len(cells) and _NUMBER.fullmatch(cells[c])}
        is_row = len(numbers) > len(columns) / 2 and numbers.issuperset(whole_columns)
        # Settings may stand before the first numbers, in lines as long as the others.
        is_row &= len(cells) >= fields or not any("".join(cells[c : c + 1]) for c in empty_columns)
        in_a_row = [*in_a_row, index] if is_row else []
        if len(in_a_row) == 3:
            break
    if not in_a_row:
        raise NoNumbersError(f"{path}: no columns of numbers in it; write {EXAMPLE} above such")
    below = [cells_of(line, separator) for line in lines[in_a_row[0] : in_a_row[0] + sample]]
    if _is_numbering(below):
        del in_a_row[0], below[0]
    empty = frozenset(i for i in range(fields) if not "".join(below[0][i : i + 1]))
    return Layout(separator, fields, in_a_row[0], empty)


def _is_one_with_decimals(rows: Sequence[list[str]]) -> bool:
    """Tell whether commas are decimal commas of a single column: no second number begins with 0."""
    pairs = [row for row in rows if len(row) == 2]
    return len(pairs) > 0.5 * len(rows) and any(re.fullmatch(r"0\d+", row[1]) for row in pairs)


def _is_numbering(rows: Sequence[list[str]]) -> bool:
    """Tell whether the first of some rows numbers the columns, as pandas does without names.

    Such a row counts from 0 or 1 and cannot be a sample: it has no decimals where all other rows
    have equally many, or its step to the next row does not occur further down in the column.
    """
    first, *others = rows
    width = len(first)
    counts = [[str(i) for i in range(start, start + width)] for start in (0, 1)]
    others = [row for row in others if len(row) == width]
    if first not in counts or len(others) < 3:
        return False
    columns = [[cell.replace(",", ".") for cell in column] for column in zip(*others, strict=True)]
    decimals = [{len(cell.partition(".")[2]) for cell in column} for column in columns]
    if any(len(lengths) == 1 and lengths != {0} for lengths in decimals):
        return True
    for number, column in zip(first, columns, strict=True):
        if all(_NUMBER.fullmatch(cell) for cell in column):
            values = [float(number), *map(float, column)]
            step, *steps = np.diff(values).tolist()
            slack = 1e-9 * max(map(abs, values))
            if not min(steps) - slack <= step <= max(steps) + slack:
                return True
    return False


def find_header(
    path: Path, lines: Sequence[str], layout: Layout
) -> tuple[list[str], list[str], int | None]:
    """Return the columns' names and units, and the index of the header's first line."""
    rows: list[tuple[int, list[str]]] = []
    unit_row: int | None = None
    units: list[str] = []
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
        stated = [cell for cell, value in zip_longest(bare, values, fillvalue="") if cell and value]
        is_unit = [
            is_time_form(cell) or any(scale_of(cell, q) for q in QUANTITIES) for cell in stated
        ]
        others = [
            cell for cell, cell_is_unit in zip(stated, is_unit, strict=True) if not cell_is_unit
        ]
        if not any(is_unit) or not all(map(is_other_unit, others)):
            rows.append((index, cells))
        elif unit_row is None:
            unit_row, units = len(rows), bare
            rows.append((index, bare))
        else:
            # A second row of units leaves those open that differ.
            units = [_either(*pair) for pair in zip_longest(bare, units, fillvalue="")]
    # The rows go upwards from the numbers: comments, units and names, or names alone.
    # Rows below the names with their units may describe the columns, with other units.
    stating = [sum(_states_unit(cell) for cell in cells) for _, cells in rows]
    best = stating.index(max(stating)) if rows else 0
    used = rows[best : best + 1]
    if unit_row is not None:
        # Names stand above units as a file's first such line; below settings, beneath the units.
        is_below = unit_row > 0 and len(rows) != unit_row + 2
        used = rows[: unit_row + 1][-2:] if is_below else rows[unit_row : unit_row + 2]
    named = [row for row in used if unit_row is None or row is not rows[unit_row]]
    names = named[-1][1] if named else []
    first = used[-1][0] if used else None
    fields = max(layout.fields, len(names), len(units))
    units += [""] * (fields - len(units))
    names += [""] * (fields - len(names))
    return [name or f"column {i}" for i, name in enumerate(names, start=1)], units, first


def _states_unit(name: str) -> bool:
    """Tell whether a name has a unit of one of the quantities in brackets."""
    unit = unit_in_brackets(name)
    return unit is not None and any(scale_of(unit, q) for q in QUANTITIES)


def _either(unit: str, other: str) -> str:
    """Return the unit that two texts state; if they differ, both together, which is no unit."""
    scales = [[scale_of(text, q) for q in QUANTITIES] for text in (unit, other)]
    is_same = unit == other or (scales[0] == scales[1] and any(scales[0]))
    return f"{unit} or {other}" if unit and other and not is_same else other or unit


def split_header(line: str, layout: Layout) -> list[str]:
    """Return the cells of a line, by any separator that gives as many as the numbers have.

    Where blanks separate them, names may have several words before a unit in parentheses. Settings
    may stand above fields without numbers. A note that the package writes has no cells.
    """
    if line.startswith("# ") and line[2:].partition(":")[0] in NOTES:
        return []
    bare = line.lstrip("#%").strip(" ") if line.startswith(("#", "%")) else line
    ways = [cells_of(bare, separator) for separator in (layout.separator, *SEPARATORS)]
    between_names = (r"\s{2,}|\t", r"(?<=[\])])\s+", r"\s+(?![\[(/])(?<!/ )")
    ways += [re.split(pattern, bare.strip()) for pattern in between_names]
    needed = 1 + max(set(range(layout.fields)) - layout.empty, default=0)
    for number, fields in enumerate(ways):
        cells = [cell.strip().strip('"').rstrip(",") for cell in fields]
        more = any(cells[layout.fields :]) and (number > 0 or layout.separator == " ")
        filled = [cell for i, cell in enumerate(cells) if i not in layout.empty]
        # A rule of dashes, as below the names of tables that are drawn, is none.
        is_name = any(re.search(r"\w", cell) for cell in filled)
        is_name &= not any(_NUMBER.fullmatch(cell) for cell in filled)
        if len(cells) >= needed and not more and is_name:
            return cells
    return []
