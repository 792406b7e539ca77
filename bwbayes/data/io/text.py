"""Records as text: ``time_s,voltage_V,displacement_um``, one sample per line.

Lines ``# key: value`` may stand above the header; ``voltage`` (command or output), ``origin`` and
``interval_s`` are understood, others are comments. Where semicolons or tabs separate the columns of
the header, they do so below it too, and a comma there is a decimal comma. An empty cell or ``nan``
in the displacement is a missing reading; columns of other quantities are ignored, with a remark.
NumPy's C parser reads the numbers; only when it fails does a slow pass look for the line that is
wrong, and says what is wrong with it.
"""

from __future__ import annotations

import math
import re
import warnings
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.data.io.checks import AT_EVERY_SAMPLE, Column, Table
from bwbayes.data.io.columns import Naming, missing, recognised
from bwbayes.data.record import Record
from bwbayes.errors import InputError, InputWarning, one_line

__all__ = ["read_csv", "write_csv"]

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_INTEGER = re.compile(r"[+-]?\d+", re.ASCII)
_EXAMPLE = "time_s,voltage_V,displacement_um"
_SEPARATORS = {";": "semicolons", "\t": "tabs"}
# Lines below the first in which a header is looked for.
_MOST_ABOVE = 50


class _Header(NamedTuple):
    """A column's name, its quantity ("" if it is none that counts), power of ten, and sign."""

    name: str
    quantity: str
    power: int
    sign: int


def read_csv(path: Path, naming: Naming) -> Table:
    """Return the columns of a text file that ``naming`` says.

    Raises
    ------
    InputError
        If the file is not UTF-8 text with a header of known columns above lines of numbers; the
        text names the line and the column.
    """
    text = _decoded(path, path.read_bytes())
    header_line, header, body, notes = _header_and_body(path, text)
    _refuse_lines_above(path, header_line, header, body)
    separator = _separator(header)
    names = _cells(f"{path}:{header_line}:", header, separator)
    if separator != ",":
        body = body.translate({ord(","): ".", ord(separator): ","})
    try:
        naming = naming.completed(names)
    except ValueError as error:
        raise InputError(f"{path}:{header_line}: {error}") from None
    columns = _header_columns(f"{path}:{header_line}:", names, naming)
    ended = body.endswith("\n")
    body = body.rstrip("\n ")
    if not body:
        raise InputError(f"{path}:{header_line}: no samples below the header; add them")
    lines = body.split("\n")
    values = _numbers(lines, columns)
    if values is None:
        raise _fault(f"{path}:", lines, columns, header_line + 1, ended)
    if not ended and columns[-1].quantity and _looks_cut(lines):
        last = header_line + len(lines)
        name = columns[-1].name
        raise InputError(f"{path}:{last}: {name}: the last line is cut off; remove it")
    extra = [column.name for column in columns if not column.quantity]
    if extra:
        some = ", ".join(extra[:10]) + (", ..." if len(extra) > 10 else "")
        remark = f"{path}:{header_line}: ignored columns: {some}"
        warnings.warn(one_line(remark), InputWarning, stacklevel=4)
    known = [column for column in columns if column.quantity]
    return Table(
        path,
        {c.quantity: Column(c.name, values[:, i], c.power, c.sign) for i, c in enumerate(known)},
        notes,
        first_line=header_line + 1,
        names=tuple(names),
        naming=naming,
    )


def write_csv(record: Record, path: Path) -> None:
    """Write a record as text, all floats with the shortest digits that give them back exactly."""
    columns = {"time_s": record.time, "voltage_V": record.voltage}
    if record.displacement is not None:
        columns["displacement_um"] = record.displacement
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f"# voltage: {record.voltage_is}\n")
        if record.origin:
            file.write(f"# origin: {record.origin}\n")
        file.write(f"# interval_s: {record.interval!r}\n")
        file.write(",".join(columns) + "\n")
        texts = [map(_text, column.tolist()) for column in columns.values()]
        file.writelines(f"{','.join(row)}\n" for row in zip(*texts, strict=True))


def _text(value: float) -> str:
    return "" if math.isnan(value) else repr(value)


def _decoded(path: Path, data: bytes) -> str:
    """Return the text without a byte order mark and with line ends as on Unix."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path}: the text is UTF-16; save it as UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        byte = f"0x{data[error.start]:02x}"
        raise InputError(f"{path}:{line}: byte {byte} is not UTF-8; save it as UTF-8") from error
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise InputError(f"{path}:{line}: NUL byte; is the file binary or UTF-16? Save it as UTF-8")
    return text


def _header_and_body(path: Path, text: str) -> tuple[int, str, str, dict[str, str]]:
    """Return the header's line number, the header, the text below it, and the notes above it."""
    notes: dict[str, str] = {}
    offset = line = 0
    while offset < len(text):
        end = text.find("\n", offset)
        end = len(text) if end < 0 else end
        content = text[offset:end].strip(" ")
        offset, line = end + 1, line + 1
        if content.startswith("#"):
            key, _, value = content[1:].partition(":")
            key = key.strip().lower()
            notes["voltage_is" if key == "voltage" else key] = value.strip()
        elif content:
            return line, content, text[offset:], notes
    raise InputError(f"{path}: the file is empty; write {_EXAMPLE} and one line per sample")


def _separator(line: str) -> str:
    return next((one for one in _SEPARATORS if one in line), ",")


def _refuse_lines_above(path: Path, number: int, first: str, body: str) -> None:
    """Refuse text above the header, which many programs write: a title, a date, an operator."""
    below = body.split("\n", _MOST_ABOVE)[:_MOST_ABOVE]
    headers = [
        number + i
        for i, line in enumerate([first, *below])
        if len(recognised(line.split(_separator(line)))) > 1
    ]
    if headers and headers[0] > number:
        raise InputError(
            f"{path}:{number}: the header is in line {headers[0]}; remove the lines above it, or "
            "begin them with #"
        )


def _cells(where: str, header: str, separator: str) -> list[str]:
    """Return the names in a header."""
    if separator not in header and len(header.split()) > 1:
        raise InputError(f"{where} blanks separate the columns; separate them by commas")
    names = [cell.strip().strip('"') for cell in header.split(separator)]
    if all(_NUMBER.fullmatch(name.replace(",", ".")) for name in names):
        raise InputError(f"{where} the header is missing; write {_EXAMPLE} above the numbers")
    return names


def _header_columns(where: str, names: list[str], naming: Naming) -> list[_Header]:
    """Return what stands in the header; columns of other quantities only beside all that count."""
    columns: list[_Header] = []
    for number, name in enumerate(names, start=1):
        shown = _quoted(name)[1:-1] or f"column {number}"
        try:
            quantity, power, sign = naming.of(name)
        except ValueError as error:
            if name in naming.columns.values():
                raise InputError(f"{where} {shown}: {error}") from None
            quantity, power, sign = "", 0, 1
        if quantity == "truth":
            raise InputError(f"{where} {name}: unknown column; keep the truth in a .truth file")
        if quantity and quantity in [column.quantity for column in columns]:
            raise InputError(f"{where} {name}: second {quantity} column; remove one")
        columns.append(_Header(name if quantity else shown, quantity, power, sign))
    # A column of another quantity is most likely the missing one.
    quantities = [column.quantity for column in columns]
    rest = [column.name for column in columns if not column.quantity]
    for quantity in ("time", "voltage", "displacement"):
        if rest and quantity not in quantities:
            raise InputError(f"{where} {missing(quantity, rest)}")
    return columns


def _numbers(lines: list[str], columns: list[_Header]) -> FloatArray | None:
    """Return the numbers of the known columns, (samples, known).

    None if any is wrong, not finite, or missing where it may not be.
    """
    known = [number for number, column in enumerate(columns) if column.quantity]
    if any(line.count(",") != len(columns) - 1 for line in lines):
        return None
    try:
        values = _parsed(lines, known)
    except ValueError:
        places = [n for n in known if columns[n].quantity == "displacement"]
        try:
            values = _parsed([_with_nan(line, places) for line in lines], known)
        except ValueError:
            return None
    may_miss = np.array([columns[number].quantity == "displacement" for number in known])
    if (
        values.shape[0] != len(lines)
        or not (np.isfinite(values) | (np.isnan(values) & may_miss)).all()
    ):
        return None
    return values


def _parsed(lines: list[str], known: list[int]) -> FloatArray:
    values: FloatArray = np.loadtxt(lines, delimiter=",", comments=None, ndmin=2, usecols=known)
    return values


def _with_nan(line: str, places: list[int]) -> str:
    """Return the line with nan in the empty cells at these places."""
    cells = line.split(",")
    for place in places:
        cells[place] = cells[place].strip() or "nan"
    return ",".join(cells)


def _fault(
    where: str, lines: list[str], columns: list[_Header], first_line: int, ended: bool
) -> InputError:
    """Return the error that names the first line that cannot be read."""
    for number, line in enumerate(lines, start=first_line):
        fault = _fault_in_line(line, columns)
        if fault is None:
            continue
        column, problem = fault
        last = number == first_line + len(lines) - 1
        if last and (not ended or problem.startswith("missing")):
            problem = f"the last line is cut off ({problem.partition(';')[0]}); remove it"
        return InputError(f"{where}{number}: {column + ': ' if column else ''}{problem}")
    return InputError(f"{where} cannot be read as numbers; write it again")


def _fault_in_line(line: str, columns: list[_Header]) -> tuple[str, str] | None:
    """Return column and ``problem; what to do`` of a line, or None if nothing is wrong."""
    if not line.strip():
        return "", "empty line; remove it"
    if line.lstrip().startswith("#"):
        return "", "comment among the samples; move it above the header"
    cells = [cell.strip() for cell in line.split(",")]
    if len(cells) != len(columns):
        return _fault_in_fields(line, cells, [column.name for column in columns])
    for column, cell in zip(columns, cells, strict=True):
        problem = _fault_in_cell(cell, column.quantity)
        if problem:
            return column.name, problem
    return None


def _fault_in_fields(line: str, cells: list[str], names: list[str]) -> tuple[str, str]:
    for separator, words in _SEPARATORS.items():
        if separator in line:
            return "", f"{words} separate the fields; write commas, and points in numbers"
    counts = f"{len(cells)} fields for {len(names)} columns"
    if len(cells) < len(names):
        return names[len(cells)], f"missing field, {counts}; complete the line or remove it"
    halves = [bool(_INTEGER.fullmatch(a)) and b.isdecimal() for a, b in pairwise(cells)]
    if any(halves):
        column = names[min(halves.index(True), len(names) - 1)]
        sure = len(cells) == 2 * len(names) and all(halves[::2])
        problem = "decimal comma" if sure else "decimal comma or extra field"
        return column, f"{problem}, {counts}; write 1.5 instead of 1,5"
    return f"field {len(names) + 1}", f"extra field {_quoted(cells[-1])}, {counts}; remove it"


def _fault_in_cell(cell: str, quantity: str) -> str | None:
    not_a_number = cell.lstrip("+-").lower() == "nan"
    if not quantity or (quantity == "displacement" and (not cell or not_a_number)):
        return None
    if not cell:
        return f"empty cell; {AT_EVERY_SAMPLE}"
    if _NUMBER.fullmatch(cell):
        if math.isfinite(float(cell)):
            return None
        return f"{_quoted(cell)} is too large for a number; correct or remove the line"
    if not_a_number or cell.lstrip("+-").lower() in ("inf", "infinity"):
        return f"{_quoted(cell)} is not a finite number; {AT_EVERY_SAMPLE}"
    return f"{_quoted(cell)} is not a number; write it like 1.5 or 1.5e-3"


def _looks_cut(lines: list[str]) -> bool:
    """Whether the last number has fewer decimals than all the numbers above it have alike."""
    cells = [line.rpartition(",")[2].strip() for line in lines[-50:]]
    if not cells[-1]:
        return True
    cells = [cell for cell in cells if cell]
    if len(cells) < 6 or any("e" in cell.lower() for cell in cells):
        return False
    decimals = [len(cell.partition(".")[2]) for cell in cells]
    return len(set(decimals[:-1])) == 1 and decimals[-1] < decimals[0]


def _quoted(cell: str) -> str:
    """Return a cell as it may stand in a one-line message, or nothing for an empty one."""
    return repr(cell if len(cell) <= 30 else cell[:30] + "...") if cell else ""
