"""Text files: columns of numbers, with a header above them or without one.

Commas, semicolons, tabs, bars or blanks separate the columns; where it is not a comma, numbers may
have decimal commas. The whole may be packed by gzip. The numbers are looked for, and the line above
them names the columns; a second line may hold their units, or each number is followed by its own.
Lines above the header are skipped with a remark, as are empty lines, comments and headers among the
numbers, and words or a line that is cut off below them. Lines ``# key: value`` above them may hold
``voltage`` (command or output), ``origin``, ``interval_s`` and ``time_offset_s``; a sampling rate
or interval in any line above them counts as a guess. An empty cell or ``nan`` in the displacement
is a missing reading. An error names the number of a line that cannot be read. The sheets of a
workbook (``.xlsx``) are read as texts. LabVIEW's measurements (``.lvm``) have a header of their
own, and one for each segment of rows, with the channels' units and clocks: :func:`plain_lvm` makes
them the table that any other text is.
"""

from __future__ import annotations

import csv
import gzip
import math
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from charset_normalizer import from_bytes
from numpy.typing import NDArray

from bwbayes.errors import InputError, InputWarning, NoNumbersError, one_line
from bwbayes.record.io.binary import record_arrays, record_notes
from bwbayes.record.io.layout import (
    EXAMPLE,
    Layout,
    cells_of,
    clock_above,
    describe_tables,
    find_header,
    find_layout,
    index_of,
    settings_in,
    split_header,
    stated_above,
    tables_of,
    with_units,
    without_frame,
    without_units,
)
from bwbayes.record.io.series import Clock, Series, Source, in_seconds
from bwbayes.record.record import Record

type Marks = tuple[str, str | None]
"""The decimal mark of numbers, and their thousands separator or None."""

_OTHER_MARKS = "['\u2019\u00a0\u2009\u202f]"
_BLANKS = r"[+-]?[1-9]\d{0,2}(?: \d{3})+(?:[.,]\d*)?"


def read_text(path: Path, table: int | str | None = None) -> Source:
    """Return the columns of a text file, of one ``table`` if there are several.

    Raises InputError: it is not text, holds no numbers, or several tables of which none is chosen;
    or a line has another number of fields, and the text names the line.
    Warns InputWarning: if lines above the header are skipped.
    """
    return text_source(path, _decode(path), table)


def text_source(
    path: Path, text: str, table: int | str | None = None, *, is_whole: bool = False
) -> Source:
    """Return the columns of a text from a file; ``is_whole`` means that its end is not cut off.

    Raises and warns as :func:`read_text` does.
    """
    clocks: dict[int, Clock] = {}
    if text.startswith("LabVIEW Measurement"):
        text, clocks = plain_lvm(path, text)
    written = without_frame(text.split("\n"))
    if (longest := max(map(len, written))) > csv.field_size_limit():
        raise InputError(f"{path}: a line of {longest} characters; write a line a sample, as CSV")
    lines = without_units(_without_foot(written))
    is_whole |= len(lines) < len(written)
    tables = tables_of(lines)
    descriptions = describe_tables(tables, lines) if tables[1:] else ()
    chosen, _, shared = tables[index_of(path, [t.title for t in tables], table, descriptions)]
    is_whole |= chosen.stop < len(lines)
    # Replace the tables above by empty lines, so that the other lines keep their numbers; a block
    # below an empty line has the header of the one above.
    has_own = shared in lines[chosen.start : chosen.stop]
    above_it = ["" if has_own else shared][: chosen.start]
    lines = [""] * (chosen.start - 1) + above_it + lines[chosen.start : chosen.stop]
    while not lines[-1].strip():
        lines.pop()
    layout = find_layout(path, lines)
    names, units, header = find_header(path, lines, layout)
    above = lines[: layout.first if header is None else header]
    notes, preamble = stated_above(above)
    units = with_units(names, units, preamble)
    scope_clock, settings = settings_in(names, units)
    notes |= settings
    # Data recorders of PI state names of columns in this way.
    names = [notes.get(f"name{i}", name) for i, name in enumerate(names)]
    skipped = sum(bool(line.strip()) and not line.startswith("#") for line in above)
    if skipped:
        remark = f"{path}:1: {skipped} line{'s' * (skipped > 1)} above the header skipped"
        warnings.warn(one_line(remark), InputWarning, stacklevel=4)
    # A pause of the logger may leave an empty line, a comment, or the header once more.
    heading = {line for line in lines[header : layout.first] if split_header(line, layout)}
    numbered = [
        (number, line)
        for number, line in enumerate(lines[layout.first :], start=layout.first + 1)
        if line.strip(" ")
        and line not in heading
        and (line[0] not in "#%" or len(cells_of(line, layout.separator)) == layout.fields > 1)
    ]
    numbered = _samples(path, numbered, layout, len(names), is_whole=is_whole)
    numbers, body = [n for n, _ in numbered], [line for _, line in numbered]
    if skipped := len(lines) - layout.first - len(body):
        first = min(set(range(layout.first + 1, len(lines) + 1)) - set(numbers))
        remark = f"{path}:{first}: {skipped} line{'s' * (skipped > 1)} among the numbers skipped"
        warnings.warn(one_line(remark), InputWarning, stacklevel=4)
    scope_clock = scope_clock or clock_above(notes, preamble, len(body))
    frame, marks = _parse_cells(path, body, layout)
    names = _different(path, names, frame)
    series = []
    for column, (name, unit) in enumerate(zip(names, units, strict=True)):
        if column >= layout.fields:
            break
        # Dates, times of day and durations such as MATLAB's 0.5 sec have no unit; they become s.
        cell = str(frame[column].iloc[0])
        is_clock = bool(re.match(r".*\d:\d\d|[\d.]+ (sec|min|hr)$", cell))
        stated = "s" if is_clock else unit
        load = partial(_numbers, path, frame[column], marks, name, numbers, is_clock=is_clock)
        series.append(
            Series(
                *(name, len(body), load, stated),
                load_readings=partial(load, words=True),
                clock=clocks.get(column, scope_clock),
            )
        )
    return Source(path, tuple(series), {"": notes}, numbers)


def _different(path: Path, names: Sequence[str], frame: pd.DataFrame) -> list[str]:
    """Return names without repeats; the first of several columns with equal numbers keeps its name.

    Warns InputWarning: if there are such columns.
    """
    different = []
    for column, name in enumerate(names):
        others = [i for i, other in enumerate(names) if other == name and i in frame]
        is_copy = column in frame and all(frame[i].equals(frame[others[0]]) for i in others)
        if len(others) > 1 and is_copy and column == others[0]:
            listed = ", ".join(str(i + 1) for i in others)
            remark = f"{path}: columns {listed} are all {name!r} with equal numbers; the first is"
            warnings.warn(one_line(f"{remark} taken"), InputWarning, stacklevel=5)
        is_unique = names.count(name) == 1 or (is_copy and column == others[0])
        different.append(name if is_unique else f"{name} (column {column + 1})")
    return different


def write_text(record: Record, path: Path) -> None:
    """Write a record as text, all floats with the shortest digits that give them back exactly."""
    names = {"input": str(record.quantities.input), "output": str(record.quantities.output)}
    columns = {
        names.get(name, name): values
        for name, values in record_arrays(record).items()
        if values is not record.truth
    }
    with path.open("w", encoding="utf-8", newline="\n") as file:
        for name, value in record_notes(record).items():
            is_voltage = name == "voltage_is" and record.quantities.are_default
            file.write(f"# {'voltage' if is_voltage else name}: {value}\n")
        pd.DataFrame(columns).to_csv(file, index=False, lineterminator="\n")


def _decode(path: Path) -> str:
    """Return a file's text with line ends as on Unix, whatever its encoding is."""
    with path.open("rb") as file:
        is_packed = file.read(2) == b"\x1f\x8b"
    # Unpack no more than a record can hold.
    with gzip.open(path) if is_packed else path.open("rb") as file:
        data = file.read(2**31)
    if not data.strip():
        raise InputError(f"{path}: the file is empty; write {EXAMPLE} and a line a sample")
    try:
        encoding = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
        text = data.decode(encoding)
        if "\0" in text:
            raise UnicodeError("a zero in a text")
    except UnicodeError:
        # The part that is not numbers tells the encoding, and stands at the beginning.
        begin = data[:4000]
        encodings = ["cp1252", "cp932", "gb18030", "cp1251", "utf_16_le", "utf_16_be"]
        best = from_bytes(begin, cp_isolation=encodings).best()
        # Windows writes a micro sign before a unit as this byte.
        is_windows = re.search(rb"\xb5[msV]", begin) is not None
        encoding = "cp1252" if is_windows else best.encoding if best else "ascii"
        text = data.decode(encoding, errors="replace")
        if "\ufffd" in text or (encoding == "cp1252" and "\0" in text):
            raise InputError(
                f"{path}: neither text nor HDF5, MATLAB or TDMS; export it as CSV"
            ) from None
    text = text.replace("\ufeff", "").replace("\r\n", "\n").replace("\r", "\n")
    # Each pattern begins with the mark that it looks for: a search for that takes no time.
    # Replace C's marks of missing numbers, and thousands separators other than points and commas.
    if "1.#" in text:
        text = re.sub(r"-?1\.#(INF|IND|QNAN|SNAN)\d*", "nan", text)
    # Replace typographic minus signs, and the colon that Keysight's loggers set before ms.
    text = re.sub(r"[\u2010-\u2013\u2212\uff0d](?<![\w.].)(?=[\d.,])", "-", text)
    text = re.sub(r":(?<=\d:\d\d:\d\d:)(?=\d{3}(?!\d))", ".", text)
    # A blank separates thousands if semicolons or tabs separate the cells, and it makes one of them
    # a number.
    has_blanks = re.search("[;\t]", text) and re.search(r" (?<=\d )\d{3}", text)
    if has_blanks and re.search(rf"{_BLANKS}[;\t]|[;\t]{_BLANKS}(?![^\n])", text):
        cell = rf"(?<![^;\t\n]){_BLANKS}(?![^;\t\n])"
        text = re.sub(cell, lambda number: number[0].replace(" ", ""), text)
    if re.search(_OTHER_MARKS, text) is None:
        return text
    thousands = rf"(?<![\d.,])\d{{1,3}}({_OTHER_MARKS}\d{{3}})+(?!\d)"
    return re.sub(thousands, lambda number: re.sub(_OTHER_MARKS, "", number[0]), text)


def _without_foot(lines: Sequence[str]) -> Sequence[str]:
    """Return lines without those that programs write below the numbers, and that are no samples."""
    last = len(lines)
    while last > 1 and re.match(r"[#%]|[\s,;|\"]*$", lines[last - 1]):
        last -= 1
    return lines[:last]


def _samples(
    path: Path,
    numbered: Sequence[tuple[int, str]],
    layout: Layout,
    names: int,
    *,
    is_whole: bool,
) -> list[tuple[int, str]]:
    """Return the lines of samples, with their numbers, without lines at the end that are none.

    These are lines of words, lines of one cell, such as a time alone, and a last line that is cut
    off: with fewer fields than the others, or, unless the text ``is_whole``, without its last
    number or with fewer decimals in it than all lines above have alike.

    Raises InputError: another line has fewer fields than the others, or more than the header.
    """
    separator, fields = layout.separator, layout.fields
    samples, is_cut = list(numbered), False
    while len(samples) > 1:
        first, last = (cells_of(line, separator) for _, line in (samples[0], samples[-1]))
        is_short = len(last) < fields and (len(last) == 1 or not is_cut)
        begin, end = (next(filter(None, cells), "") for cells in (first, last))
        if not is_short and (re.search(r"\d", end) or not re.search(r"\d", begin)):
            break
        is_cut |= is_short
        samples.pop()
    column = [line.rpartition(separator)[2].strip() for _, line in samples[-50:]]
    if not column[-1] or len(column) < 6 or any("e" in cell.lower() for cell in column):
        is_half = not column[-1] and all(column[:-1])
    else:
        decimals = [len(re.split("[.,]", cell)[-1]) for cell in column if cell]
        is_half = len(set(decimals[:-1])) == 1 and decimals[-1] < decimals[0]
    if is_half and not is_whole and len(samples) == len(numbered):
        samples.pop()
    for number, line in samples:
        if (len(line.split()) if separator == " " else line.count(separator) + 1) == fields:
            continue
        cells = cells_of(line, separator)
        if len(cells) >= fields and not any(cells[max(fields, names) :]):
            continue
        advice = "complete the line, or remove it"
        if len(cells) > fields:
            advice = f"remove {cells[-1][:30]!r}, or write 1.5 where 1,5 is meant"
        count = f"{len(cells)} field{'s' * (len(cells) != 1)}"
        raise InputError(f"{path}:{number}: {count} for {fields} columns; {advice}")
    return samples


def _parse_cells(path: Path, body: Sequence[str], layout: Layout) -> tuple[pd.DataFrame, Marks]:
    """Return the cells, as numbers in columns that hold numbers alone, and their marks."""
    # Fortran writes 1.5D+00.
    text = re.sub(r"[dD](?<=[\d.].)(?=[+-]?\d)", "e", "\n".join(body))

    def read(decimal: str, thousands: str | None, kind: type | None = None) -> pd.DataFrame:
        return pd.read_csv(
            StringIO(text),
            sep=r"\s+" if layout.separator == " " else layout.separator,
            decimal=decimal,
            thousands=thousands,
            dtype=kind,
            header=None,
            names=range(layout.fields),
            usecols=range(layout.fields),
            index_col=False,
            skip_blank_lines=False,
            skipinitialspace=True,
            low_memory=False,
        )

    try:
        marks = _shown_marks(text, layout.separator)
        marks = marks or _likely_marks(path, read(".", None, str), layout.separator)
        frames = [(read(*pair), pair) for pair in marks]
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: {one_line(str(error))[:200]}; write it again") from None
    return max(frames, key=lambda frame: frame[0].select_dtypes("number").shape[1])


# Whole numbers whose thousands separator may be a decimal mark as well.
_GROUPED = r"[+-]?[1-9]\d{{0,2}}(?:\{0}\d{{3}})+"


def _shown_marks(text: str, separator: str) -> list[Marks]:
    """Return the decimal mark of the numbers in a text, and that of thousands if there is one.

    A number shows its decimals by a zero before them, by more or fewer digits than three, or by
    marks of thousands. If some numbers show the one mark and some the other, either is returned; if
    none shows any, and there are numbers that may have marks of thousands, nothing is.
    """
    shown, grouped = set[str](), []
    for mark, other in (".,", ",."):
        begin, end = rf'(?<![^\s"{separator}])', rf'(?![^\s"{separator}])'
        if mark == separator:  # within quotes
            begin, end = '(?<=")', '(?=")'
        grouped_number = f"{_GROUPED.format(mark)}{end}"
        digits = rf"(?:\d+|\d{{1,3}}(?:\{other}\d{{3}})+)"
        number = rf"[+-]?(?:{digits}\{mark}\d*|\{mark}\d+)(?:[eE][+-]?\d+)?{end}"
        several = rf"[+-]?[1-9]\d{{0,2}}(?:\{mark}\d{{3}}){{2,}}{end}"
        if mark not in text or (mark == separator and '"' not in text):
            continue
        if re.search(f"{begin}(?!{grouped_number}){number}", text):
            shown.add(mark)
        elif re.search(rf"{begin}{_GROUPED.format(mark)}(?:\{other}\d*)?{end}", text):
            grouped.append(mark)
            if re.search(f"{begin}{several}", text):
                shown.add(other)
    if len(shown) == 1:
        return [(shown.pop(), grouped[0] if grouped else None)]
    return [(mark, None) for mark in (".," if shown else "." * (not grouped))]


def _likely_marks(path: Path, cells: pd.DataFrame, separator: str) -> list[Marks]:
    """Return the decimal mark and that of thousands of numbers that show none.

    Decimals do not always have three digits: if a column has numbers below 1,000 without a mark,
    and none above, the mark separates thousands. Otherwise it is the decimal mark, as usual.

    Warns InputWarning: how a number is read, except for decimal points beside commas that separate
    columns.
    """
    columns = [column.dropna().str.strip() for _, column in cells.items()]
    read: tuple[str, str] | None = None
    taken: list[Marks] = [(".", None), (",", None)]
    for mark, other in (".,", ",."):
        for text in columns:
            is_grouped = text.str.fullmatch(_GROUPED.format(mark))
            is_small = text.str.fullmatch(r"[+-]?\d{1,3}")
            if not is_grouped.any() or not (is_grouped | is_small).all():
                continue
            example = text[is_grouped].iloc[0]
            if is_small.any():
                read, taken = (example, example.replace(mark, "")), [(other, mark)]
                break
            if (mark, separator) != (".", ","):
                read = read or (example, example.replace(mark, "."))
        if taken == [(other, mark)]:
            break
    if read is not None:
        remark = f"{path}: {read[0]} is read as {read[1]}"
        advice = "write numbers without marks between thousands if that is wrong"
        warnings.warn(one_line(f"{remark}; {advice}"), InputWarning, stacklevel=5)
    return taken


def _numbers(
    path: Path,
    column: Any,
    marks: Marks,
    name: str,
    lines: Sequence[int],
    *,
    is_clock: bool,
    words: bool = False,
) -> NDArray[Any]:
    """Return a column's numbers, nan for ``words``; dates and times of day in seconds.

    Raises InputError: a cell is no number, or only begins like one, or most are words; the text
    names its line.
    Warns InputWarning: if some cells are words.
    """
    if column.dtype.kind in "iuf":
        return np.asarray(column)
    text, (decimal, thousands) = column.astype(str), marks
    ungrouped = text.str.replace(thousands, "") if thousands else text
    numbers = pd.to_numeric(ungrouped.str.replace(decimal, "."), errors="coerce")
    wrong = np.flatnonzero(numbers.isna() & column.notna() & (text.str.lower() != "nan"))
    if not wrong.size:
        return np.asarray(numbers, dtype=np.float64)
    if is_clock:
        text = text.str.replace(r"(?<=\d),(?=\d)", ".", regex=True)
        # Minutes and seconds alone have a fraction, as Excel writes times.
        is_short = text.str.fullmatch(r"\d+:\d+\.\d+").all()
        with suppress(ValueError, OverflowError):
            durations = pd.to_timedelta("0:" + text if is_short else text)
            times = in_seconds(durations.to_numpy("m8[ns]"))
            # Times of day begin again at midnight, and minutes after an hour.
            period = 3600.0 if is_short else 86_400.0
            turns = np.cumsum(np.diff(times, prepend=times[:1]) < -period / 2)
            return np.asarray(times + period * turns)
        # Days come before months or behind them: take the order without a jump at midnight.
        dates = []
        for is_day_first in (False, True):
            with suppress(ValueError, OverflowError):
                parsed = pd.to_datetime(text, format="mixed", utc=True, dayfirst=is_day_first)
                dates.append(in_seconds(parsed.to_numpy("M8[ns]")))
        if dates:
            return min(dates, key=np.ptp)
    cell = str(column.iloc[wrong[0]])
    shown = repr(cell if len(cell) <= 30 else f"{cell[:30]}...")
    where = f"{path}:{lines[wrong[0]]}: {name}: {shown}"
    # A number with something behind it, as 1.5V, is mistyped; what begins otherwise is a word.
    is_number = text.iloc[wrong].str.contains(r"^[^\w#<>*]*\d|\0")
    if words and 2 * wrong.size < column.size and not is_number.any():
        # Loggers and spreadsheets write words where there is no reading: OVERLOAD, #DIV/0!, ---.
        cells = f"{wrong.size} cell{'s' * (wrong.size > 1)} without a number"
        warnings.warn(one_line(f"{where}: {cells}, taken as missing"), InputWarning, stacklevel=4)
        return np.asarray(numbers, dtype=np.float64)
    raise InputError(f"{where} is not a number; write it like 1.5, or nothing where it is missing")


def read_workbook(path: Path, table: int | str | None = None) -> Source:
    """Return the columns of the sheet with columns of numbers, or of ``table`` if several have.

    Raises InputError: openpyxl is not installed, no sheet has such columns, or several have and
    none is chosen.
    Warns InputWarning: if rows above the header are skipped.
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


def _texts(book: Any) -> dict[str, str]:
    """Return the sheets of a workbook as text, and close it."""
    # Read the numbers behind times, since openpyxl rounds times to milliseconds.
    styles, book._date_formats = book._date_formats, set()
    texts = {}
    for sheet in book.worksheets:
        sheet.reset_dimensions()  # the dimensions that programs write may be wrong
        cells = [[_cell(cell, book, styles) for cell in row] for row in sheet.iter_rows()]
        width = max(map(len, cells), default=0)
        text = StringIO()
        writer = csv.writer(text, delimiter="\t", lineterminator="\n")
        writer.writerows([*row, *[""] * (width - len(row))] for row in cells)
        texts[sheet.title] = text.getvalue()
    book.close()
    return texts


def _cell(cell: Any, book: Any, styles: Collection[int]) -> str:
    """Return a cell's text; one with the style of times becomes a date, or h:m:s.

    Excel keeps 15 digits of days: 10 us for a date of today, 1 ns for less than a day.
    """
    value = cell.value
    if value is None:
        return ""
    is_number = isinstance(value, int | float) and value >= 0
    if not is_number or cell._style_id not in styles:
        return " ".join(str(value).split())
    digits = 9 if value < 1 else min(9, 9 - math.floor(math.log10(value)))
    ns = round(value * 86400 * 10**digits) * 10 ** (9 - digits)
    if value < 1 or cell._style_id in book._timedelta_formats:
        minutes, ns = divmod(ns, 60 * 10**9)
        return f"{minutes // 60}:{minutes % 60:02}:{ns // 10**9:02}.{ns % 10**9:09}"
    return str(np.datetime64(book.epoch, "ns") + np.timedelta64(ns, "ns")).replace("T", " ")


def plain_lvm(path: Path, text: str) -> tuple[str, dict[int, Clock]]:
    """Return a measurement's rows below one header with units, and the clocks of its columns.

    Segments follow each other; the line numbers of the first one stay as they are, and its header
    counts.

    Raises InputError: there are no rows in it.
    """
    head, *parts = text.split("***End_of_Header***")
    separator = "," if "Comma" in _keys(head, ",").get("Separator", []) else "\t"
    settings = _keys(head, separator)
    x_columns, time_pref = ("".join(settings.get(key, [])) for key in ("X_Columns", "Time_Pref"))
    if len(parts) < 2:
        raise InputError(f"{path}: no segment of samples in it; export it again")
    keys, lines = _keys(parts[0], separator), [""] * f"{head}{parts[0]}".count("\n")
    stride = 2 if x_columns == "Multi" else 1
    # With several columns of times, the header's cells above them are empty or left out.
    stated = next((keys[key] for key in ("Samples", "Delta_X", "Y_Unit_Label") if key in keys), [])
    cells = [i for i, cell in enumerate(stated) if cell]
    channels = {
        1 + stride * number: {key: values[i] for key, values in keys.items() if i < len(values)}
        for number, i in enumerate(cells)
    }
    for number, segment in enumerate(parts[1:]):
        rows = segment.partition("\nChannels")[0].split("\n")[1:]
        names, *samples = [row for row in rows if row.strip(f" {separator}")]
        if number == 0:
            units = {i: channel.get("Y_Unit_Label") for i, channel in channels.items()}
            if channels.get(1, {}).get("X_Dimension", "Time") == "Time":
                units[0] = "s"
            columns = names.split(separator)
            named = [f"{n} [{units[i]}]" if units.get(i) else n for i, n in enumerate(columns)]
            # The first of several columns of times counts; the others get another name.
            for i in range(2, len(named) - 1, 2) if x_columns == "Multi" else ():
                named[i] += f" {i + 1}"
            lines += ["", separator.join(named)]
        lines += samples
    clocks = {i: clock for i, channel in channels.items() if (clock := _clock(channel, time_pref))}
    if x_columns == "No":  # the file has an empty column of times
        lines = [line.partition(separator)[2] for line in lines]
        clocks = {i - 1: clock for i, clock in clocks.items()}
    return "\n".join(lines) + "\n" * text.endswith("\n"), clocks


def _clock(channel: Mapping[str, str], time_pref: str) -> Clock | None:
    """Return the clock that a segment's header states for a channel, if it does."""
    try:
        interval, start = (float(channel[key].replace(",", ".")) for key in ("Delta_X", "X0"))
    except (KeyError, ValueError):
        return None
    if not 0 < interval < math.inf or channel.get("X_Dimension", "Time") != "Time":
        return None
    if time_pref == "Absolute":  # X0 is then a time of day or date
        return Clock(interval, start)
    zero = None
    with suppress(KeyError, ValueError):
        date, time = channel["Date"].replace("/", "-"), channel["Time"].replace(",", ".")
        zero = np.datetime64(f"{date}T{time[:18]}", "ns")  # to the nanosecond
    return Clock(interval, start, zero)


def _keys(header: str, separator: str) -> dict[str, list[str]]:
    """Return the cells of a header's rows behind their keys."""
    rows = [line.split(separator) for line in header.split("\n")]
    return {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows}
