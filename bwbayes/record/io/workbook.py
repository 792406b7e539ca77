"""Excel's workbooks (``.xlsx``), whose sheets are read as the rows of a text."""

from __future__ import annotations

import csv
import math
import warnings
from collections.abc import Collection
from datetime import datetime
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bwbayes.errors import InputError, InputWarning, NoNumbersError
from bwbayes.record.io.series import Source
from bwbayes.record.io.tables import index_of, tables_of
from bwbayes.record.io.text import text_source


def read_workbook(path: Path, table: int | str | None = None) -> Source:
    """Return the columns of the sheet with columns of numbers, or of ``table`` if several have.

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
    with warnings.catch_warnings():  # of styles and validations, which do not matter here
        warnings.filterwarnings("ignore", module="openpyxl")
        texts = _texts(load_workbook(path, read_only=True, data_only=True))
    tables: dict[str, tuple[Source, list[str]]] = {}
    unread: dict[str, InputError] = {}
    for sheet, text in texts.items():
        titles = [text_table.title for text_table in tables_of(text.split("\n"))]
        for number, title in enumerate(titles, start=1):
            name = sheet if len(titles) == 1 else f"{sheet}: {title}"
            try:
                with warnings.catch_warnings(record=True) as remarks:
                    warnings.simplefilter("always", InputWarning)
                    source = text_source(path, text, number, is_whole=True)
            except InputError as error:
                unread[name] = error
                continue
            if any(series.size > 1 for series in source.series):  # else a number among words
                tables[name] = source, [str(remark.message) for remark in remarks]
    if str(table) in unread or not tables:
        nothing = NoNumbersError(f"{path}: no sheet has columns of numbers; give a row a sample")
        raise unread.get(str(table), nothing)
    source, messages = [*tables.values()][index_of(path, [*tables], table)]
    for remark in messages:
        warnings.warn(remark, InputWarning, stacklevel=4)
    return source


class _Times(NamedTuple):
    """Day zero, and the styles of cells with dates or times of day and with durations."""

    epoch: datetime
    styles: Collection[int]
    durations: Collection[int]


def _texts(book: Any) -> dict[str, str]:
    """Return the sheets of a workbook as text, and close it."""
    # Read the numbers behind times, since openpyxl rounds times to milliseconds.
    times = _Times(book.epoch, book._date_formats, book._timedelta_formats)
    book._date_formats = set()
    texts = {}
    for sheet in book.worksheets:
        sheet.reset_dimensions()  # the dimensions that programs write may be wrong
        texts[sheet.title] = _text(sheet, times)
    book.close()
    return texts


def _text(sheet: Any, times: _Times) -> str:
    """Return a sheet's rows as text, with equally many cells in each row."""
    cells = [[_cell(cell, times) for cell in row] for row in sheet.iter_rows()]
    width = max(map(len, cells), default=0)
    text = StringIO()
    writer = csv.writer(text, delimiter="\t", lineterminator="\n")
    writer.writerows([*row, *[""] * (width - len(row))] for row in cells)
    return text.getvalue()


def _cell(cell: Any, times: _Times) -> str:
    """Return a cell's text; a time becomes a date, or hours, minutes and seconds.

    Excel keeps 15 digits of days: 10 us for a date of today, 1 ns for less than a day.
    """
    value = cell.value
    if value is None:
        return ""
    is_number = isinstance(value, int | float) and value >= 0
    if not is_number or cell._style_id not in times.styles:
        return " ".join(str(value).split())
    digits = 9 if value < 1 else min(9, 9 - math.floor(math.log10(value)))
    ns = round(value * 86400 * 10**digits) * 10 ** (9 - digits)
    if value < 1 or cell._style_id in times.durations:
        minutes, ns = divmod(ns, 60 * 10**9)
        return f"{minutes // 60}:{minutes % 60:02}:{ns // 10**9:02}.{ns % 10**9:09}"
    return str(np.datetime64(times.epoch, "ns") + np.timedelta64(ns, "ns")).replace("T", " ")
