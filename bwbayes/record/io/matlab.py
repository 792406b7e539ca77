"""Records in MATLAB files: variables ``time_s``, ``voltage_V``, ``displacement_um``, or others.

Version 7.3 is HDF5. Version 5 (MATLAB's ``save`` with ``-v6`` or ``-v7``) is read here: SciPy 1.18
takes the types of a file's elements on trust, and an unknown one ends the whole process. The rare
version 4 is refused. Vectors may be rows or columns; those in a struct are named by their path,
``log.Ux`` or ``log.Y(2).Data``, columns of a matrix ``log[2]``. ``voltage_is`` and ``origin`` are
character variables, ``interval_s`` and ``time_offset_s`` are numbers.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import scipy

from bwbayes.errors import InputError
from bwbayes.record.io.hdf5 import record_arrays, record_notes
from bwbayes.record.io.series import (
    MAXIMUM_SAMPLES,
    NOTES,
    Series,
    Source,
    note,
    pass_over_object,
    vectors,
    with_units_beside,
)
from bwbayes.record.record import Record

MatVersion = Literal["5", "7.3"]

# Types of elements that hold numbers or text, and of others; classes of arrays.
_TYPES = {
    **{1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"},
    **{12: "i8", 13: "u8", 16: "u1", 17: "u2", 18: "u4"},
}
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHAR, _OPAQUE = 1, 2, 4, 17
_NUMERIC = dict(enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), start=6))
_IS_LOGICAL, _IS_COMPLEX = 0x0200, 0x0800


def read_mat(path: Path) -> Source:
    """Return the series of a MATLAB file of version 5; a damaged file may raise any exception.

    Raises InputError: it is of another version.
    """
    data = path.read_bytes()
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise InputError(f"{path}: not a MATLAB file of version 5 or 7.3; save it with -v7")
    texts: dict[str, str] = {}
    series: list[Series] = []
    room = 16 * MAXIMUM_SAMPLES  # bytes that compressed elements may unpack to
    for kind, body in _elements(data[128:], order, padded=False):
        matrix = body
        if kind == _COMPRESSED:
            unpacked = zlib.decompressobj().decompress(body, room)
            room -= len(unpacked)
            ((kind, matrix),) = _elements(unpacked, order)  # noqa: PLW2901
        if kind != _MATRIX:
            raise ValueError(f"unknown element {kind}")
        flags, *inner = _elements(matrix, order)
        if struct.unpack_from(f"{order}I", flags[1])[0] & 0xFF == _OPAQUE:
            name, _, class_name = (text.decode("latin-1") for _, text in inner[:3])
            pass_over_object(path, name, class_name)
        elif inner[1][1]:  # MATLAB's own data about its objects has no name
            series += _series("", matrix, order, texts)
    notes = {name: text for name, text in texts.items() if name in NOTES}
    return Source(path, with_units_beside(series, texts), {"": notes})


def write_mat(record: Record, path: Path, version: MatVersion = "5") -> None:
    """Write a record as column vectors of a MATLAB file, every number exactly."""
    notes = record_notes(record).items()
    texts = {name: value for name, value in notes if isinstance(value, str)}
    numbers = {name: np.array([value]) for name, value in notes if name not in texts}
    arrays = record_arrays(record) | numbers
    if version == "5":
        scipy.io.savemat(path, arrays | texts, appendmat=False, oned_as="column")
        return
    content = BytesIO()  # in memory first: HDF5 does not survive a disk that is full
    with h5py.File(content, "w", userblock_size=512) as file:
        for name, values in arrays.items():
            # MATLAB stores dimensions in the reverse order: (1, samples) here is a column there.
            dataset = file.create_dataset(name, data=values[np.newaxis, :])
            dataset.attrs["MATLAB_class"] = np.bytes_("double")
        for name, text in texts.items():
            codes = np.frombuffer(text.encode("utf-16-le"), dtype="<u2")
            dataset = file.create_dataset(name, data=codes[:, np.newaxis])
            dataset.attrs["MATLAB_class"] = np.bytes_("char")
            dataset.attrs["MATLAB_int_decode"] = np.int32(2)
    # Text of 116 bytes, 8 bytes that stay zero, version 2.0, and the mark of little-endian files.
    header = b"MATLAB 7.3 MAT-file, written by bwbayes".ljust(116) + bytes(8) + b"\x00\x02IM"
    content.seek(0)
    content.write(header)
    path.write_bytes(content.getvalue())


def _series(path: str, matrix: bytes, order: str, texts: dict[str, str]) -> Iterator[Series]:
    """Yield the series in a variable, an element of a cell array, or a field of a struct.

    Texts are collected by their paths. Objects and sparse matrices are passed over.
    """
    flags, *inner = _elements(matrix, order)
    word = struct.unpack_from(f"{order}I", flags[1])[0]
    kind = word & 0xFF
    if kind not in {_CELL, _STRUCT, _CHAR, *_NUMERIC}:
        return
    shape = _values(inner[0], order).tolist()
    path = path or inner[1][1].decode("latin-1")
    content = inner[2:]
    if kind == _CHAR:
        if content and content[0][1]:
            codes = _values(content[0], order)
            encoding = "utf-8" if codes.itemsize == 1 else f"utf-{8 * codes.itemsize}-le"
            text = codes.astype(f"<u{codes.itemsize}").tobytes().decode(encoding, errors="replace")
            texts[path] = text
    elif kind in _NUMERIC:
        is_complex = bool(word & _IS_COMPLEX)
        dtype = np.dtype("?" if word & _IS_LOGICAL else "c16" if is_complex else _NUMERIC[kind])
        if len(content) != 1 + is_complex:
            raise ValueError("parts of an array are missing")

        def load() -> Any:
            return _values(content[0], order).astype(dtype).reshape(shape, order="F")

        if path in NOTES and math.prod(shape) > 0:
            texts[path] = note(load())
        else:
            group, dot, leaf = path.rpartition(".")
            yield from vectors(group + dot, leaf, shape, dtype, load)
    else:
        fields = [""]
        if kind == _STRUCT:
            (width,), names = _values(content[0], order), content[1][1]
            fields = [
                "." + names[at : at + width].partition(b"\0")[0].decode("latin-1")
                for at in range(0, len(names), width)
            ]
        matrices = [body for kind, body in content if kind == _MATRIX]
        for number, body in enumerate(matrices):
            index, field = divmod(number, len(fields))
            index_text = f"({index + 1})" if math.prod(shape) > 1 else ""
            if body:  # else an empty array
                yield from _series(f"{path}{index_text}{fields[field]}", body, order, texts)


def _values(element: tuple[int, bytes], order: str) -> Any:
    kind, body = element
    if kind not in _TYPES:
        raise ValueError(f"unknown type of data {kind}")
    return np.frombuffer(body, order + _TYPES[kind])


def _elements(data: bytes, order: str, padded: bool = True) -> Iterator[tuple[int, bytes]]:
    """Yield type and content of the elements that follow each other in `data`."""
    offset = 0
    while offset < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, offset)
        start = offset + 8
        if kind >> 16:  # a short element: size and type share four bytes, up to four follow
            kind, size, start = kind & 0xFFFF, kind >> 16, offset + 4
            offset += 8
        else:
            offset = start + (size + 7) // 8 * 8 if padded else start + size
        if start + size > len(data):
            raise ValueError("it ends within an element")
        yield kind, data[start : start + size]
