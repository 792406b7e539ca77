"""Excel's workbooks (``.xlsx``): a sheet's cells are read as the rows of a text are."""

from __future__ import annotations

import csv
import warnings
from datetime import timedelta
from io import StringIO
from pathlib import Path
from typing import Any

from bwbayes.errors import InputError, InputWarning, NoNumbersError
from bwbayes.record.io.series import Source
from bwbayes.record.io.tables import index_of, tables_of
from bwbayes.record.io.text import text_source


def read_workbook(path: Path, table: int | str | None = None) -> Source:
    """Return the columns of the sheet that has columns of numbers, of several that of ``table``.

    Raises
    ------
    InputError
        openpyxl is not installed, no sheet has such columns, or several have and none is chosen.

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
    tables: dict[str, tuple[Source, list[str]]] = {}
    unread: dict[str, InputError] = {}
    for sheet in book.worksheets:
        sheet.reset_dimensions()  # what programs write of them may be wrong
        text = _text(sheet.iter_rows(values_only=True))
        titles = [title for _, title in tables_of(text.split("\n"))]
        for number, title in enumerate(titles, start=1):
            name = sheet.title if len(titles) == 1 else f"{sheet.title}: {title}"
            try:
                with warnings.catch_warnings(record=True) as remarks:
                    warnings.simplefilter("always", InputWarning)
                    source = text_source(path, text, number, is_whole=True)
            except InputError as error:
                unread[name] = error
                continue
            if any(series.size > 1 for series in source.series):  # else a number among words
                tables[name] = source, [str(remark.message) for remark in remarks]
    book.close()
    if str(table) in unread or not tables:
        nothing = NoNumbersError(f"{path}: no sheet has columns of numbers; give a row a sample")
        raise unread.get(str(table), nothing)
    source, said = [*tables.values()][index_of(path, [*tables], table)]
    for remark in said:
        warnings.warn(remark, InputWarning, stacklevel=4)
    return source


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
