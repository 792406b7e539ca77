"""Several tables of numbers in one file: their places in a text, and the choice of one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import NamedTuple

from bwbayes.errors import InputError, one_line
from bwbayes.record.io.layout import SEPARATORS, cells_of

_NUMBER = r"[+-]?(?:nan|inf|[.,]?\d[\d.,]*(?:[eEdD][+-]?\d+)?)"
# A row begins with a number, a date, or an empty cell before one.
_ROW = re.compile(rf"[\s\"',;|]*(?:[+-]?[.,]?\d|{_NUMBER}(?![^\s\"',;|]))", re.IGNORECASE)
_CELL = re.compile(_NUMBER, re.IGNORECASE)
# Smallest number of rows of a table below its header.
_FEWEST = 3


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
            between = between if rows < _FEWEST else []
            between.append(index)
            rows = 0
            continue
        if is_gap and rows >= _FEWEST and _begins_again(lines[first : last + 1], line):
            tables += [] if tables else [(first, f"line {first + 1}", "")]
            tables.append((index, f"line {index + 1}", header))
            rows = 0
        rows += 1
        first = index if rows == 1 else first
        is_gap = False
        if rows == _FEWEST and between:
            separator = _separator(line)
            heads = [lines[i] for i in between if _is_header(lines[i], line, separator)]
            is_pause = heads[:1] == [header] and len(heads) == len(between)
            if heads and not (is_pause and _goes_on(lines[last], line, separator)):
                header = heads[0]
                tables.append((between[0], one_line(lines[between[0]])[:40], header))
            between = []
        last = index if rows >= _FEWEST else last
    starts = [0, *(start for start, *_ in tables[1:]), len(lines)]
    named = [(title, header) for _, title, header in tables] or [("", "")]
    return [TextTable(range(*starts[i : i + 2]), *names) for i, names in enumerate(named)]


def described(tables: Sequence[TextTable], lines: Sequence[str]) -> list[str]:
    """Describe each of several tables by its number of rows and its header."""
    rows = [sum(map(bool, map(_ROW.match, lines[t.lines.start : t.lines.stop]))) for t in tables]
    heads = [f" below {t.header[:60]!r}" * (t.header not in ("", t.title)) for t in tables]
    return [f" ({n} rows{head})" for n, head in zip(rows, heads, strict=True)]


def index_of(
    path: Path, titles: Sequence[str], table: int | str | None, said: Sequence[str] = ()
) -> int:
    """Return the index of the table that is meant, by its number from 1 on or its title.

    The error lists the tables with their titles and descriptions, ``said``.

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
    return len(names) == len(values) and len({*names} - {""}) > 1 and not is_number


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
