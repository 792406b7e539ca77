"""Text files: columns of numbers, with a header above them or without one.

Commas, semicolons, tabs, bars or blanks separate the columns; where it is not a comma, numbers may
have decimal commas. The numbers are looked for, and the line above them names the columns; a second
line may hold their units. What stands above the header is skipped with a remark, but for lines
``# key: value`` of which ``voltage`` (command or output), ``origin``, ``interval_s`` and
``time_offset_s`` are understood. An empty cell or ``nan`` in the displacement is a missing reading.
A line that cannot be read is named with its number.
"""

from __future__ import annotations

import csv
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from charset_normalizer import from_bytes
from numpy.typing import NDArray

from bwbayes.errors import InputError, InputWarning, one_line
from bwbayes.record.io.columns import QUANTITIES, power_of
from bwbayes.record.io.labview import is_lvm, plain_lvm
from bwbayes.record.io.series import Series, Source
from bwbayes.record.record import Record

__all__ = ["read_text", "write_text"]

_NUMBER = re.compile(
    r"[+-]?(\d+[.,]?\d*|[.,]\d+|\d{1,3}(\.\d{3})+,\d*|\d{1,3}(,\d{3})+\.\d*)([eEdD][+-]?\d+)?"
    r"|[+-]?nan|[+-]?inf",
    re.IGNORECASE,
)
_CLOCK = re.compile(r".*\d:\d\d")
_SEPARATORS = ("\t", ";", ",", "|", " ")
_EXAMPLE = "time_s,voltage_V,displacement_um"

# Lines that show how a file is laid out, lines of numbers that end a header, and lines above the
# numbers that may be one.
_PROBED, _IN_A_ROW, _ABOVE = 60, 3, 6

# What text is written in that is not UTF-8, as far as its bytes can tell.
_ENCODINGS = ["cp1252", "cp932", "gb18030", "cp1251", "utf_16_le", "utf_16_be"]
_MICRO = re.compile(rb"\xb5[msV]")  # as Windows writes a unit in cp1252


class _Layout(NamedTuple):
    """How the numbers stand in a text: separator, fields of a line, and the first line's index."""

    separator: str
    fields: int
    first: int


def read_text(path: Path) -> Source:
    """Return the columns of a text file.

    Raises
    ------
    InputError
        It is not text, holds no numbers, or a line has another number of fields; the text names
        the line.

    Warns
    -----
    InputWarning
        If lines above the header are skipped.
    """
    text = _decoded(path)
    notes: dict[str, str] = {}
    if is_lvm(text):
        text, notes = plain_lvm(path, text)
    lines = text.split("\n")
    while lines and not lines[-1].strip():
        lines.pop()
    layout = _layout(path, lines)
    names, units, header = _header(path, lines, layout)
    above = lines[: layout.first if header is None else header]
    for line in above:
        key, colon, value = line.strip(" #").partition(":")
        if line.startswith("#") and colon:
            key = key.strip().lower()
            notes["voltage_is" if key == "voltage" else key] = value.strip()
    skipped = [line for line in above if line.strip() and not line.startswith("#")]
    if skipped:
        plural = "s" if len(skipped) > 1 else ""
        remark = f"{path}:1: {len(skipped)} line{plural} above the header skipped"
        warnings.warn(one_line(remark), InputWarning, stacklevel=4)
    body = lines[layout.first :]
    if not text.endswith("\n") and _is_cut(body, layout.separator):
        raise InputError(f"{path}:{len(lines)}: the last line is cut off; remove it")
    _check_fields(path, body, layout, len(names))
    frame, decimal = _parsed(path, body, layout)
    series = [
        Series(
            name,
            len(body),
            partial(_numbers, path, frame[column], decimal, name, layout.first + 1),
            # Dates and times of day have no unit, and become seconds.
            "s" if _CLOCK.match(str(frame[column].iloc[0])) else unit,
        )
        for column, (name, unit) in enumerate(zip(names, units, strict=True))
        if column < layout.fields
    ]
    interval = notes.pop("dt", None)
    return Source(
        path,
        tuple(series),
        {"": notes},
        layout.first + 1,
        None if interval is None else float(interval),
    )


def write_text(record: Record, path: Path) -> None:
    """Write a record as text, all floats with the shortest digits that give them back exactly."""
    columns = {"time_s": record.time, "voltage_V": record.voltage}
    if record.displacement is not None:
        columns["displacement_um"] = record.displacement
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f"# voltage: {record.voltage_is}\n")
        if record.origin:
            file.write(f"# origin: {record.origin}\n")
        file.write(f"# interval_s: {record.interval!r}\n")
        if record.time_offset:
            file.write(f"# time_offset_s: {record.time_offset!r}\n")
        pd.DataFrame(columns).to_csv(file, index=False, lineterminator="\n")


def _decoded(path: Path) -> str:
    """Return a file's text with line ends as on Unix, whatever its encoding is."""
    data = path.read_bytes()
    if not data.strip():
        raise InputError(f"{path}: the file is empty; write {_EXAMPLE} and a line a sample")
    try:
        encoding = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
        text = data.decode(encoding)
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        # The part that is not numbers tells the encoding, and stands at the beginning.
        best = from_bytes(data[:4000], cp_isolation=_ENCODINGS).best()
        encoding = "cp1252" if _MICRO.search(data[:4000]) else best.encoding if best else "ascii"
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            raise InputError(
                f"{path}: neither text nor HDF5, MATLAB or TDMS; export it as CSV"
            ) from None
        if encoding == "cp1252" and "\0" in text:
            raise InputError(f"{path}: neither text nor HDF5, MATLAB or TDMS; export it as CSV")
    return text.lstrip("\ufeff").replace("\r\n", "\n").replace("\r", "\n")


def _cells(line: str, separator: str) -> list[str]:
    """Split a line."""
    if separator == " ":
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]


def _layout(path: Path, lines: Sequence[str]) -> _Layout:
    """Find how the numbers stand in a text: most lines in its middle and at its end are such."""
    center = len(lines) // 2
    probed = [*lines[center : center + _PROBED], *lines[-_PROBED:]]
    rows = [line for line in probed if line.strip() and not line.startswith("#")]
    best, layout = 0.0, ("", 0, np.zeros(0, dtype=np.int64))
    for separator in _SEPARATORS:
        split = [_cells(line, separator) for line in rows]
        fields = Counter(map(len, split)).most_common(1)[0][0] if split else 0
        if fields < 2:
            continue
        regular = [cells for cells in split if len(cells) == fields]
        numeric = np.array([[bool(_NUMBER.fullmatch(cell)) for cell in cells] for cells in regular])
        share = float(numeric.mean()) * len(regular) / len(split)
        columns = np.flatnonzero(numeric.mean(axis=0) > 0.5)
        if share > best and columns.size:
            best, layout = share, (separator, fields, columns)
    separator, fields, columns = layout
    run: list[int] = []
    for index, line in enumerate(lines if best > 0 else []):
        if not line.strip():
            continue
        cells = _cells(line, separator)
        numbers = [bool(_NUMBER.fullmatch(cells[c])) for c in columns if c < len(cells)]
        run = [*run, index] if sum(numbers) > len(columns) / 2 else []
        if len(run) == _IN_A_ROW:
            break
    if not run:
        raise InputError(f"{path}: no columns of numbers in it; write {_EXAMPLE} above such")
    return _Layout(separator, fields, run[0])


def _header(
    path: Path, lines: Sequence[str], layout: _Layout
) -> tuple[list[str], list[str], int | None]:
    """Return the columns' names and units, and the index of the header's first line."""
    rows = [(i, line) for i, line in enumerate(lines[: layout.first]) if line.strip()]
    names, units, header = [], [""] * layout.fields, None
    for index, line in reversed(rows[-_ABOVE:]):
        cells = next(_split_header(line, layout), None)
        if cells is None:
            if layout.separator == "," and 2 * len(line.split(",")) == layout.fields:
                raise InputError(
                    f"{path}:{layout.first + 1}: decimal commas, {layout.fields} fields for "
                    f"{layout.fields // 2} columns; separate them by semicolons, or write 1.5"
                )
            continue
        bare = [cell.strip("[]() ") for cell in cells]
        if header is None and all(_is_unit(cell) for cell in bare if cell):
            units, header = bare, index
            continue
        names, header = cells, index
        break
    fields = max(layout.fields, len(names))
    units += [""] * (fields - len(units))
    names += [""] * (fields - len(names))
    named = [name or f"column {i}" for i, name in enumerate(names, start=1)]
    twice = {name for name, count in Counter(named).items() if count > 1}
    named = [f"{n} (column {i})" if n in twice else n for i, n in enumerate(named, start=1)]
    return named, units, header


def _split_header(line: str, layout: _Layout) -> Iterator[list[str]]:
    """Yield the cells of a line, by any separator that gives as many as the numbers have."""
    bare = line.lstrip("#%").strip(" ") if line.startswith(("#", "%")) else line
    ways = [_cells(bare, separator) for separator in (layout.separator, *_SEPARATORS)]
    for number, fields in enumerate([*ways, re.split(r"\s{2,}|\t", bare.strip())]):
        cells = [cell.strip().strip('"') for cell in fields]
        more = any(cells[layout.fields :]) and number > 0
        if len(cells) < layout.fields or more or not any(cells):
            continue
        if not any(_NUMBER.fullmatch(cell) for cell in cells):
            yield cells


def _is_unit(text: str) -> bool:
    return any(power_of(text, quantity) is not None for quantity in QUANTITIES)


def _check_fields(path: Path, body: Sequence[str], layout: _Layout, names: int) -> None:
    """Refuse a line that has fewer fields than the others, or more than the header."""
    separator, fields = layout.separator, layout.fields
    for number, line in enumerate(body, start=layout.first + 1):
        count = len(line.split()) if separator == " " else line.count(separator) + 1
        if count == fields:
            continue
        where, cells = f"{path}:{number}", _cells(line, separator)
        if not line.strip():
            raise InputError(f"{where}: empty line; remove it")
        if line.startswith("#"):
            raise InputError(f"{where}: comment among the samples; move it above the header")
        counts = f"{len(cells)} fields for {fields} columns"
        if len(cells) < fields:
            if number == layout.first + len(body):
                raise InputError(f"{where}: the last line is cut off ({counts}); remove it")
            others = [s for s in _SEPARATORS[:-1] if s != separator and s in line]
            advice = "separate the fields as above" if others else "complete the line or remove it"
            raise InputError(f"{where}: missing field, {counts}; {advice}")
        if any(cells[max(fields, names) :]):
            halves = [a.lstrip("+-").isdecimal() and b.isdecimal() for a, b in pairwise(cells)]
            if separator == "," and any(halves):
                problem = f"decimal comma or extra field, {counts}; write 1.5 instead of 1,5"
                raise InputError(f"{where}: {problem}")
            raise InputError(f"{where}: extra field {cells[-1][:30]!r}, {counts}; remove it")


def _parsed(path: Path, body: Sequence[str], layout: _Layout) -> tuple[pd.DataFrame, str]:
    """Return the cells, as numbers where a whole column is, and the decimal mark."""
    # Fortran writes 1.5D+00.
    text = re.sub(r"(?<=[\d.])[dD](?=[+-]?\d)", "e", "\n".join(body))
    frames = []
    for decimal in "." if layout.separator == "," else ".,":
        try:
            frame = pd.read_csv(
                StringIO(text),
                sep=r"\s+" if layout.separator == " " else layout.separator,
                decimal=decimal,
                thousands=_thousands(text, decimal, layout.separator),
                header=None,
                names=range(layout.fields),
                usecols=range(layout.fields),
                index_col=False,
                skip_blank_lines=False,
                skipinitialspace=True,
                low_memory=False,
            )
        except (ValueError, OverflowError) as error:
            raise InputError(f"{path}: {one_line(str(error))[:200]}; write it again") from None
        frames.append((frame, decimal))
        if "," not in text:
            break
    return max(frames, key=lambda read: read[0].select_dtypes("number").shape[1])


def _thousands(text: str, decimal: str, separator: str) -> str | None:
    """Return the mark between thousands, as in 1.234,5, if there are any."""
    mark = "." if decimal == "," else ","
    match = mark != separator and re.search(rf"\d\{mark}\d{{3}}\{decimal}\d", text)
    return mark if match else None


def _numbers(path: Path, column: Any, decimal: str, name: str, first_line: int) -> NDArray[Any]:
    """Return a column's numbers; dates and times of day in seconds.

    Raises
    ------
    InputError
        A cell is none; the text names its line.
    """
    if column.dtype.kind in "iuf":
        values: NDArray[Any] = column.to_numpy()
        return values
    text = column.astype(str)
    numbers = pd.to_numeric(text.str.replace(decimal, "."), errors="coerce")
    wrong = np.flatnonzero(numbers.isna() & column.notna() & (text.str.lower() != "nan"))
    if not wrong.size:
        return np.asarray(numbers, dtype=np.float64)
    moments = _moments(text) if ":" in text.iloc[0] else None
    if moments is not None:
        return moments
    cell = str(column.iloc[wrong[0]])
    shown = repr(cell if len(cell) <= 30 else f"{cell[:30]}...")
    raise InputError(
        f"{path}:{first_line + wrong[0]}: {name}: {shown} is not a number; write it like 1.5, or "
        "nothing where a reading is missing"
    )


def _moments(text: Any) -> NDArray[Any] | None:
    """Return dates or times of day in seconds; None if they are none."""
    for parse in (pd.to_timedelta, partial(pd.to_datetime, format="mixed", utc=True)):
        try:
            moments = parse(text)
        except (ValueError, OverflowError):
            continue
        zero = pd.Timestamp(0, tz="UTC") if hasattr(moments.iloc[0], "tz") else pd.Timedelta(0)
        seconds: NDArray[Any] = ((moments - zero) / pd.Timedelta(1, "s")).to_numpy()
        return seconds
    return None


def _is_cut(body: Sequence[str], separator: str) -> bool:
    """Tell whether the last number has fewer decimals than all the numbers above it have alike."""
    cells = [line.rpartition(separator)[2].strip() for line in body[-50:]]
    if not cells[-1] or len(cells) < 6 or any("e" in cell.lower() for cell in cells):
        return not cells[-1] and all(cells[:-1])
    decimals = [len(re.split("[.,]", cell)[-1]) for cell in cells if cell]
    return len(set(decimals[:-1])) == 1 and decimals[-1] < decimals[0]
