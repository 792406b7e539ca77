"""Layout of a text: its tables, their separator and first line, and what stands above the numbers.

Commas, semicolons, tabs, bars or blanks separate the columns, if there are several. The line above
the numbers names the columns; a second line may hold their units. Instruments write notes, units,
rate and settings above that.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bwbayes.errors import InputError, NoNumbersError, one_line
from bwbayes.record.io.recognition import (
    QUANTITIES,
    is_other_unit,
    is_time_form,
    scale_of,
    unit_in,
    unit_in_brackets,
)
from bwbayes.record.io.series import NOTES, RATES, Clock, Source

_NUMBER = re.compile(
    r"[+-]?(\d+[.,]?\d*|[.,]\d+|\d{1,3}(\.\d{3})+(,\d*)?|\d{1,3}(,\d{3})+(\.\d*)?)"
    r"([eEdD][+-]?\d+)?"
    r"|[+-]?nan|[+-]?inf",
    re.IGNORECASE,
)
_DATE = re.compile(r"\d+[/.:-]\d+[/.:-]\d+")
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


def without_frame(lines: Sequence[str]) -> list[str]:
    """Return the lines of a table in Markdown without the bars at either end; others as they are.

    The rule below its header shows that it is one.
    """
    if not any(re.fullmatch(r"\|[\s:|]*-[\s:|-]*\|\s*", line) for line in lines):
        return [*lines]
    return [re.sub(r"^\|(.*)\|\s*$", r"\1", line) for line in lines]


_WITH_UNIT = re.compile(r"([+-]?[\d.,]*\d(?:[eE][+-]?\d+)?) ?([^\W\d_]*)|")


def without_units(lines: Sequence[str]) -> list[str]:
    """Move the unit behind each number of a column, as in ``1.5 V``, to the column's name.

    Lines without names, or with different units in a column, stay as they are.
    """
    split = {mark: cells_of(lines[-1], mark) for mark in SEPARATORS[:-1] if mark in lines[-1]}
    ways = [mark for mark, cells in split.items() if all(map(_WITH_UNIT.fullmatch, cells))]
    if not ways or not any(_WITH_UNIT.sub(r"\2", cell) for cell in split[ways[0]]):
        return [*lines]
    separator, last = ways[0], split[ways[0]]
    cells = [[_WITH_UNIT.fullmatch(cell) for cell in cells_of(line, separator)] for line in lines]
    rows = {i: row for i, row in enumerate(cells) if len(row) == len(last) and all(row)}
    first = min(rows, default=0) - 1
    while first > 0 and not re.search(r"\w", lines[first]):  # a rule below the names
        first -= 1
    names = cells_of(lines[first], separator) if first >= 0 else []
    columns = zip(*rows.values(), strict=True)
    units = [{cell[2] for cell in column if cell and cell[0]} for column in columns]
    if len(names) != len(last) or any(len(of_column) != 1 for of_column in units):
        return [*lines]
    moved = [*lines]
    named = [
        f"{name} ({unit})" if unit else name for name, (unit,) in zip(names, units, strict=True)
    ]
    moved[first] = separator.join(named)
    for index, row in rows.items():
        numbers = [cell[1] or "" for cell in row if cell]
        moved[index] = separator.join(
            f'"{number}"' if separator in number else number for number in numbers
        )
    return moved


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
        pairs = [row for row in split if len(row) == 2]
        # Decimal commas of a single column: a second number that begins with 0.
        has_zeros = candidate == "," and any(re.fullmatch(r"0\d+", row[1]) for row in pairs)
        if width < 2 or (has_zeros and len(pairs) > 0.5 * len(split)):
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
        # Settings may stand before the first numbers, in lines as long as the others; numbers of
        # settings stand above other lines of them.
        has_setting = any("".join(cells[c : c + 1]) for c in empty_columns)
        is_row &= len(cells) >= fields or not has_setting
        in_a_row = [*in_a_row, index] if is_row else []
        if len(in_a_row) >= 3 and not has_setting:
            break
    if not in_a_row:
        raise NoNumbersError(f"{path}: no columns of numbers in it; write {EXAMPLE} above such")
    below = [cells_of(line, separator) for line in lines[in_a_row[0] : in_a_row[0] + sample]]
    if _is_numbering(below):
        del in_a_row[0], below[0]
    empty = frozenset(i for i in range(fields) if not "".join(below[0][i : i + 1]))
    return Layout(separator, fields, in_a_row[0], empty)


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
        if re.fullmatch("h(orizontal)?[ _]?units?", cells[0].lower()):  # not the channels'
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
    bracketed = [[unit_in_brackets(cell) or "" for cell in cells] for _, cells in rows]
    stating = [sum(any(scale_of(u, q) for q in QUANTITIES) for u in row) for row in bracketed]
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
    # Fortran programs comment by an exclamation mark, MATLAB by a percent sign.
    bare = re.sub(r"^ *[#%!]+", "", line).strip(" ") if re.match(" *[#%!]", line) else line
    ways = [cells_of(bare, separator) for separator in (layout.separator, *SEPARATORS)]
    between_names = (r"\s{2,}|\t", r"(?<=[\])])\s+", r"\s+(?![\[(/])(?<!/ )")
    ways += [re.split(pattern, bare.strip()) for pattern in between_names]
    needed = 1 + max(set(range(layout.fields)) - layout.empty, default=0)
    for number, fields in enumerate(ways):
        cells = [cell.strip().strip('"').rstrip(",") for cell in fields]
        more = any(cells[layout.fields :]) and (number > 0 or layout.separator == " ")
        filled = [c for i, c in enumerate(cells[: layout.fields]) if i not in layout.empty]
        # A rule of dashes, as below the names of tables that are drawn, is none.
        is_name = any(re.search(r"\w", cell) for cell in filled)
        is_name &= not any(_NUMBER.fullmatch(cell) or _DATE.match(cell) for cell in filled)
        if len(cells) >= needed and not more and is_name:
            return cells
    return []


# A row begins with a number, a date, or an empty cell before one.
_CELL = re.compile(r"[+-]?(?:nan|inf|[.,]?\d[\d.,]*(?:[eEdD][+-]?\d+)?)", re.IGNORECASE)
_ROW = re.compile(rf"[\s\"',;|]*(?:[+-]?[.,]?\d|{_CELL.pattern}(?![^\s\"',;|]))", re.IGNORECASE)


class TextTable(NamedTuple):
    """A table in a text: its lines, with those above its header, its title and its header."""

    lines: range
    title: str
    header: str


def tables_of(lines: Sequence[str]) -> list[TextTable]:
    """Return the tables in a text.

    A table ends where a header follows its rows: a line of words, as many as the cells of the
    three rows or more below it. The same header once more, as after a pause of the logger, ends it
    only if the first column does not go on. An empty line ends a table, too, if a first column that
    rose all the way begins again below it where it began, or before.
    """
    tables: list[tuple[int, str, str]] = []
    between: list[int] = []
    header, separator, rows, last = "", "", 0, 0
    first, is_gap = 0, False
    for index, line in enumerate(lines):
        if not line.strip() or line[0] in "#%":
            is_gap |= not line.strip()
            continue
        if not _ROW.match(line) or separator not in line:
            between = between if rows < 3 else []
            between.append(index)
            rows = 0
            continue
        if is_gap and rows >= 3 and _begins_again(lines[first : last + 1], line):
            tables += [] if tables else [(first, f"line {first + 1}", "")]
            tables.append((index, f"line {index + 1}", header))
            rows = 0
        rows += 1
        first = index if rows == 1 else first
        is_gap = False
        if rows == 3 and between:
            separator = _separator(line)
            heads = [lines[i] for i in between if _is_header(lines[i], line, separator)]
            is_pause = heads[:1] == [header] and len(heads) == len(between)
            if heads and not (is_pause and _goes_on(lines[last], line, separator)):
                header = heads[0]
                tables.append((between[0], one_line(lines[between[0]])[:40], header))
            between = []
        last = index if rows >= 3 else last
    starts = [0, *(start for start, *_ in tables[1:]), len(lines)]
    named = [(title, header) for _, title, header in tables] or [("", "")]
    return [TextTable(range(*starts[i : i + 2]), *names) for i, names in enumerate(named)]


def describe_tables(tables: Sequence[TextTable], lines: Sequence[str]) -> list[str]:
    """Describe each of several tables by its number of rows and its header."""
    rows = [sum(map(bool, map(_ROW.match, lines[t.lines.start : t.lines.stop]))) for t in tables]
    heads = [f" below {t.header[:60]!r}" * (t.header not in ("", t.title)) for t in tables]
    return [f" ({n} rows{head})" for n, head in zip(rows, heads, strict=True)]


def index_of(
    path: Path, titles: Sequence[str], table: int | str | None, said: Sequence[str] = ()
) -> int:
    """Return the index of the table that is meant, by its number from 1 on or its title.

    The error lists the tables with their titles and descriptions, ``said``.

    Raises InputError: there is none, or there are several and nothing says which is meant.
    """
    if table is None and len(titles) == 1:
        return 0
    if table in titles:
        return titles.index(str(table))
    if str(table).isdecimal() and 1 <= int(str(table)) <= len(titles):
        return int(str(table)) - 1
    labels = [f"{title!r}{more}" for title, more in zip_longest(titles, said, fillvalue="")]
    listed = ", ".join(f"{i} {text}" for i, text in enumerate(labels, start=1))
    if table is None:
        raise InputError(
            f"{path}: {len(titles)} tables with numbers: {listed}; choose one, as `table=1`"
        )
    raise InputError(f"{path}: no table {table!r}; choose from {listed}")


def _is_header(line: str, row: str, separator: str) -> bool:
    names, values = (cells_of(text.rstrip(f"{separator} \t"), separator) for text in (line, row))
    is_number = any(_CELL.fullmatch(name) for name in names)
    # A table in prose has lines that begin with a number, and words beside it.
    n_numbers = sum(bool(_CELL.fullmatch(cell) or _DATE.match(cell)) for cell in values)
    is_table = len(names) == len(values) and len({*names} - {""}) > 1 and n_numbers > 1
    return is_table and not is_number


def _separator(row: str) -> str:
    return next(mark for mark in SEPARATORS if mark in row or mark == " ")


def _begins_again(rows: Sequence[str], row: str) -> bool:
    """Tell whether a row's first cell is at most that of the first of rows that all rise."""
    mark = _separator(row)
    rows = [line for line in rows if _ROW.match(line)]
    if mark == " " and mark not in row.strip():  # a column alone
        return False
    return not _goes_on(rows[0], row, mark) and all(
        _goes_on(before, after, mark) for before, after in pairwise(rows)
    )


def _goes_on(last: str, row: str, separator: str) -> bool:
    """Tell whether a row's first cell is a larger number than that of the last row before it."""
    with suppress(ValueError):
        first = (next(filter(None, cells_of(line, separator)), "") for line in (last, row))
        before, after = (float(cell.replace(",", ".")) for cell in first)
        return before < after
    return True


def stated_above(lines: Sequence[str]) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Return the notes in the lines above a header, and the values they list for each channel."""
    notes: dict[str, str] = {}
    preamble: dict[str, list[str]] = {}
    for line in lines:
        key, sign, value, *_ = [*re.split(r"([:=,;\t])", line, maxsplit=1), "", ""]
        key = re.sub(r"\W+", "_", re.sub(r"\(.*", "", key)).strip("_").lower()
        if line.startswith("#") and sign in ("=", ":"):
            notes["voltage_is" if key == "voltage" else key] = value.strip()
        elif sign:
            preamble[key] = [cell.strip(' "') for cell in value.split(sign)]
    return notes | {key: cells[0] for key, cells in preamble.items() if key in RATES}, preamble


def clock_above(
    notes: Mapping[str, str], preamble: Mapping[str, list[str]], n_samples: int
) -> Clock | None:
    """Return the clock of a stated rate, if the stated number of samples is right, or None."""
    rate = Source(Path(), (), {"": notes}).stated_rate()
    is_confirmed = preamble.get("record_length", [""])[0] == str(n_samples)
    return Clock(1 / rate) if rate and is_confirmed else None


def with_units(
    names: Sequence[str], units: Sequence[str], preamble: Mapping[str, list[str]]
) -> list[str]:
    """Return the columns' units, with those that an oscilloscope's preamble states for channels.

    The time stands before the channels, if there is one column more than units. A name that stands
    twice gets a number behind its unit; the unit without that number is returned.
    """
    units = [*units]
    for column, name in enumerate(names):
        if names.count(name) > 1 and not units[column]:
            possible = (unit_in(name, quantity) for quantity in QUANTITIES)
            units[column] = next(filter(None, possible), "")
    channels = [unit for unit in preamble.get("vertical_units", []) if unit]
    time = preamble.get("horizontal_units", [""])[:1]
    stated = [*(time if len(channels) == len(units) - 1 else []), *channels]
    if not channels or len(stated) != len(units):
        return units
    return [unit or other for unit, other in zip(units, stated, strict=True)]


def settings_in(names: Sequence[str], units: Sequence[str]) -> tuple[Clock | None, dict[str, str]]:
    """Return the clock that an oscilloscope writes into the header, or None, and all settings.

    A setting is a number below its name, ``Increment``, or behind it, ``tInc = 1e-6``.
    """
    settings = {}
    for name, unit in zip(names, units, strict=True):
        key, _, value = name.partition("=")
        with suppress(ValueError):
            text = (value or unit).strip().removesuffix("s")
            settings[key.strip().lower()] = repr(float(text))
    rate = Source(Path(), (), {"": settings}).stated_rate()
    start = float(settings.get("start", settings.get("t0", "0")))
    return Clock(1 / rate, start) if rate else None, settings
