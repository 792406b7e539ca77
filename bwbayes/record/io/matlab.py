"""Records in MATLAB files: variables ``time_s``, ``voltage_V``, ``displacement_um``, or others.

Version 5 (MATLAB's ``save`` with ``-v6`` or ``-v7``) goes through SciPy, version 7.3 is HDF5; the
rare version 4 is refused. Vectors may be rows or columns; those in a struct are named by their
path, ``log.Ux`` or ``log.Y(2).Data``, columns of a matrix ``log[2]``. ``voltage_is`` and ``origin``
are character variables, ``interval_s`` and ``time_offset_s`` are numbers.
"""

from __future__ import annotations

import math
import struct
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import scipy

from bwbayes.errors import InputError
from bwbayes.record.io.hdf5 import read_hdf5, record_arrays
from bwbayes.record.io.series import MAXIMUM_SAMPLES, Series, Source, damaged, vectors
from bwbayes.record.record import Record

__all__ = ["MatVersion", "read_mat", "write_mat"]

MatVersion = Literal["5", "7.3"]

_TEXTS, _NUMBERS = ("voltage_is", "origin"), ("interval_s", "time_offset_s")
_USERBLOCK = 512  # bytes before the HDF5 part of a version 7.3 file

# Codes of the version 5 format: types of elements, and classes of arrays.
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS_AND_TEXT = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18}
_COMPLEX = 0x0800
_LARGEST_ELEMENT = 16 * MAXIMUM_SAMPLES  # bytes that a compressed element may unpack to
_PLAIN_CODES, _NESTED_CODES = {4, *range(6, 16)}, {1, 2}
_KINDS = {"double": "f8", "single": "f4", "char": "U1", "logical": "?"} | {
    f"{sign}int{bits}": f"{sign[:1] or 'i'}{bits // 8}"
    for sign in ("", "u")
    for bits in (8, 16, 32, 64)
}


def read_mat(path: Path) -> Source:
    """Return the series of numbers in a MATLAB file, version 5 or 7.3.

    Raises
    ------
    InputError
        It is of another version, or is damaged.
    """
    if h5py.is_hdf5(path):
        return replace(read_hdf5(path), notes={"": _notes_7_3(path)})
    try:
        return _read_5(path)
    except InputError:
        raise
    except Exception as error:
        raise damaged(path, error) from error


def write_mat(record: Record, path: Path, version: MatVersion = "5") -> None:
    """Write a record as column vectors of a MATLAB file, every number exactly."""
    texts = {"voltage_is": record.voltage_is, "origin": record.origin}
    arrays = record_arrays(record) | {"interval_s": np.array([record.interval])}
    if record.time_offset:
        arrays["time_offset_s"] = np.array([record.time_offset])
    if version == "5":
        scipy.io.savemat(path, arrays | texts, appendmat=False, oned_as="column")
    else:
        _write_7_3(path, arrays, texts)


def _read_5(path: Path) -> Source:
    if scipy.io.matlab.matfile_version(path, appendmat=False)[0] != 1:
        raise InputError(f"{path}: not a MATLAB file of version 5 or 7.3; save it with -v7")
    _check_elements(path.read_bytes())
    with warnings.catch_warnings():
        # SciPy warns of a variable that it cannot read or that comes twice; here that is an error.
        warnings.simplefilter("error", scipy.io.matlab.MatReadWarning)
        variables = scipy.io.whosmat(path, appendmat=False)

        def load(name: str) -> Any:
            return scipy.io.loadmat(path, appendmat=False, variable_names=[name])[name]

        series: list[Series] = []
        notes = {}
        for name, shape, kind in variables:
            if name in (*_TEXTS, *_NUMBERS) and math.prod(shape) > 0:
                notes[name] = _first(load(name))
            elif kind in ("struct", "cell"):
                series += _walked(name, load(name))
            elif kind in _KINDS:
                series += vectors("", name, shape, np.dtype(_KINDS[kind]), partial(load, name))
    return Source(path, tuple(series), {"": notes})


def _walked(path: str, value: Any) -> Iterator[Series]:
    """Yield the series of numbers in a struct or a cell array."""
    if not isinstance(value, np.ndarray):
        return
    if not value.dtype.hasobject:
        group, _, leaf = path.rpartition(".")
        group += "." * bool(group)
        yield from vectors(group, leaf, value.shape, value.dtype, lambda: value)
        return
    for number, element in enumerate(value.ravel(order="F"), start=1):
        element_path = f"{path}({number})" if value.size > 1 else path
        if value.dtype.names is None:
            yield from _walked(element_path, element)
        else:
            for name in value.dtype.names:
                yield from _walked(f"{element_path}.{name}", element[name])


def _check_elements(data: bytes) -> None:
    """Raise a ValueError unless all arrays consist of the elements that belong to them.

    SciPy 1.18 takes the types of elements on trust, and an unknown one ends the whole process.
    """
    order = {b"IM": "<", b"MI": ">"}[data[126:128]]
    for kind, body in _elements(data[128:], order, padded=False):
        if kind == _COMPRESSED:
            unpacked = zlib.decompressobj().decompress(body, _LARGEST_ELEMENT)
            ((kind, body),) = _elements(unpacked, order)  # noqa: PLW2901
        if kind != _MATRIX:
            raise ValueError(f"unknown element {kind}")
        _check_matrix(body, order)


def _check_matrix(body: bytes, order: str, *, nested: bool = False) -> None:
    inner = list(_elements(body, order))
    if not inner:  # an empty array in a struct
        return
    (flags,) = struct.unpack_from(f"{order}I", inner[0][1])
    if flags & 0xFF in _NESTED_CODES:
        contents = [content for kind, content in inner if kind == _MATRIX]
        if math.prod(np.frombuffer(inner[1][1], f"{order}i4").tolist()) > max(len(contents), 1):
            raise ValueError("elements of an array are missing")
        for content in contents:
            _check_matrix(content, order, nested=True)
    elif flags & 0xFF not in _PLAIN_CODES:
        if nested:  # it would be read with the struct that it is in
            raise ValueError("an object in a struct")
        return
    # Flags, dimensions, name and real part; an imaginary part if the flags say so.
    elif len(inner) != (5 if flags & _COMPLEX else 4):
        raise ValueError("parts of an array are missing")
    if not {kind for kind, _ in inner} - {_MATRIX} <= _NUMBERS_AND_TEXT:
        raise ValueError("unknown type of data")


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


def _first(values: Any) -> str:
    value = np.asarray(values).ravel()[0]
    return repr(float(value)) if np.asarray(value).dtype.kind in "iuf" else str(value)


def _notes_7_3(path: Path) -> dict[str, str]:
    notes = {}
    with h5py.File(path, "r") as file:
        for key in (*_TEXTS, *_NUMBERS):
            if not isinstance(file.get(key, getlink=True), h5py.HardLink):
                continue
            values = np.asarray(file[key][()])
            if key in _NUMBERS:
                notes[key] = _first(values)
            elif "MATLAB_empty" not in file[key].attrs and values.dtype.kind == "u":
                codes = values.astype("<u2").tobytes()
                notes[key] = codes.decode("utf-16-le", errors="replace")
    return notes


def _write_7_3(path: Path, arrays: dict[str, Any], texts: dict[str, str]) -> None:
    content = BytesIO()  # in memory first: HDF5 does not survive a disk that is full
    with h5py.File(content, "w", userblock_size=_USERBLOCK) as file:
        for name, values in arrays.items():
            # MATLAB counts dimensions the other way round: (1, samples) here is a column there.
            dataset = file.create_dataset(name, data=values[np.newaxis, :])
            dataset.attrs["MATLAB_class"] = np.bytes_("double")
        for name, text in texts.items():
            codes = np.frombuffer(text.encode("utf-16-le"), dtype="<u2")
            empty = codes.size == 0
            data = np.array([0, 0], dtype=np.uint64) if empty else codes[:, np.newaxis]
            dataset = file.create_dataset(name, data=data)
            dataset.attrs["MATLAB_class"] = np.bytes_("char")
            dataset.attrs["MATLAB_int_decode"] = np.int32(2)
            if empty:
                dataset.attrs["MATLAB_empty"] = np.uint8(1)
    # Text of 116 bytes, 8 bytes that stay zero, version 2.0, and the mark of little-endian files.
    header = b"MATLAB 7.3 MAT-file, written by bwbayes".ljust(116) + bytes(8) + b"\x00\x02IM"
    content.seek(0)
    content.write(header)
    path.write_bytes(content.getbuffer())
