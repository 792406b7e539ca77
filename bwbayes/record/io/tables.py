"""Several tables of numbers in one file: where they are in a text, and which one is meant."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from bwbayes.errors import InputError, one_line
from bwbayes.record.io.layout import SEPARATORS, cells_of

_NUMBER = r"[+-]?(?:nan|inf|[.,]?\d[\d.,]*(?:[eEdD][+-]?\d+)?)"
# A row begins with a number, a date, or an empty cell before one.
_ROW = re.compile(rf"[\s\"',;|]*(?:[+-]?[.,]?\d|{_NUMBER}(?![^\s\"',;|]))", re.IGNORECASE)
_CELL = re.compile(_NUMBER, re.IGNORECASE)
# Fewer rows below a header are no table.
_FEWEST = 3


def tables_of(lines: Sequence[str]) -> list[tuple[range, str]]:
    """Return the lines of each table in a text, with those above its header, and its title.

    A table ends where a header follows its rows: a line of words, as many as the cells of the
    three rows or more below it. The same header once more, as after a pause of the logger, ends it
    only if the first column does not go on.
    """
    tables: list[tuple[int, str]] = []
    between: list[int] = []
    header, separator, rows, last = "", "", 0, 0
    for index, line in enumerate(lines):
        if not line.strip() or line[0] in "#%":
            continue
        if not _ROW.match(line) or separator not in line:
            between = between if rows < _FEWEST else []
            between.append(index)
            rows = 0
            continue
        rows += 1
        if rows == _FEWEST and between:
            separator = next(mark for mark in SEPARATORS if mark in line or mark == " ")
            heads = [lines[i] for i in between if _is_header(lines[i], line, separator)]
            is_pause = heads[:1] == [header] and len(heads) == len(between)
            if heads and not (is_pause and _goes_on(lines[last], line, separator)):
                tables.append((between[0], one_line(lines[between[0]])[:40]))
                header = heads[0]
            between = []
        last = index if rows >= _FEWEST else last
    starts = [0, *(start for start, _ in tables[1:]), len(lines)]
    titles = [title for _, title in tables] or [""]
    return [(range(*starts[i : i + 2]), title) for i, title in enumerate(titles)]


def index_of(path: Path, titles: Sequence[str], table: int | str | None) -> int:
    """Return the index of the table that is meant, by its number from 1 on or its title.

    Raises
    ------
    InputError
        There is none, or there are several and nothing says which is meant.
    """
    if table is None and len(titles) == 1:
        return 0
    if table in titles:
        return titles.index(str(table))
    if str(table).isdecimal() and 1 <= int(str(table)) <= len(titles):
        return int(str(table)) - 1
    listed = ", ".join(f"{i} {title!r}" for i, title in enumerate(titles, start=1))
    if table is None:
        raise InputError(
            f"{path}: {len(titles)} tables with numbers: {listed}; choose one, as `table=1`"
        )
    raise InputError(f"{path}: no table {table!r}; choose from {listed}")


def _is_header(line: str, row: str, separator: str) -> bool:
    names, values = (cells_of(text.rstrip(f"{separator} \t"), separator) for text in (line, row))
    is_number = any(_CELL.fullmatch(name) for name in names)
    return len(names) == len(values) and len({*names} - {""}) > 1 and not is_number


def _goes_on(last: str, row: str, separator: str) -> bool:
    """Tell whether a row's first cell is a larger number than that of the last row before it."""
    with suppress(ValueError):
        first = (next(filter(None, cells_of(line, separator)), "") for line in (last, row))
        before, after = (float(cell.replace(",", ".")) for cell in first)
        return before < after
    return True
