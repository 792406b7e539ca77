"""Excel's workbooks (``.xlsx``): a sheet's cells are read as the rows of a text are."""

from __future__ import annotations

import csv
from datetime import timedelta
from io import StringIO
from pathlib import Path
from typing import Any

from bwbayes.errors import InputError, NoNumbersError
from bwbayes.record.io.series import Source
from bwbayes.record.io.text import text_source


def read_workbook(path: Path) -> Source:
    """Return the columns of the one sheet that has columns of numbers.

    Raises
    ------
    InputError
        openpyxl is not installed, no sheet has such columns or several have, or a row is none.

    Warns
    -----
    InputWarning
        If rows above the header are skipped.
    """
    try:
        from openpyxl import load_workbook  # noqa: PLC0415  # an extra
    except ImportError:
        advice = "pip install 'bwbayes[xlsx]', or export it as CSV"
        raise InputError(f"{path}: reading a workbook needs openpyxl; {advice}") from None
    book = load_workbook(path, read_only=True, data_only=True)
    sources: dict[str, Source] = {}
    for sheet in book.worksheets:
        sheet.reset_dimensions()  # what programs write of them may be wrong
        try:
            text = _text(sheet.iter_rows(values_only=True))
            source = text_source(path, text, is_whole=True)
        except NoNumbersError:
            continue
        if any(series.size > 1 for series in source.series):  # else a number among words
            sources[sheet.title] = source
    book.close()
    if len(sources) == 1:
        return next(iter(sources.values()))
    if not sources:
        raise NoNumbersError(f"{path}: no sheet has columns of numbers; give a row a sample")
    names = ", ".join(map(repr, sources))
    raise InputError(f"{path}: several sheets have numbers, {names}; save one of them alone")


def _text(rows: Any) -> str:
    """Return a sheet's rows as text, of as many cells each."""
    cells = [[_cell(value) for value in row] for row in rows]
    width = max(map(len, cells), default=0)
    text = StringIO()
    writer = csv.writer(text, delimiter="\t", lineterminator="\n")
    writer.writerows([*row, *[""] * (width - len(row))] for row in cells)
    return text.getvalue()


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, timedelta):
        minutes, seconds = divmod(value.total_seconds(), 60)
        return f"{int(minutes // 60)}:{int(minutes % 60):02}:{seconds:09.6f}"
    return " ".join(str(value).split())
