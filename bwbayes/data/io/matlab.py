"""Records in MATLAB files: variables ``time_s``, ``voltage_V``, ``displacement_um``.

Version 5 (MATLAB's ``save`` with ``-v6`` or ``-v7``) goes through SciPy, version 7.3 is HDF5; the
rare version 4 is refused. Vectors may be rows or columns; ``voltage_is`` and ``origin`` are
character variables, ``interval_s`` is a number, and other variables are passed over unread.
"""

from __future__ import annotations

import math
import struct
import warnings
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import scipy.io
from scipy.io.matlab import MatReadWarning, matfile_version

from bwbayes.data.io.checks import MAXIMUM_SAMPLES, Table, named_table
from bwbayes.data.io.columns import Naming
from bwbayes.data.io.hdf5 import check_lists, datasets, group_table, record_arrays
from bwbayes.data.record import Record
from bwbayes.errors import InputError

__all__ = ["MatVersion", "read_mat", "write_mat"]

MatVersion = Literal["5", "7.3"]

_USERBLOCK = 512  # bytes before the HDF5 part of a version 7.3 file

# Codes of the version 5 format: types of elements, and classes of arrays.
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS_AND_TEXT = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18}
_COMPLEX = 0x0800
_LARGEST_ELEMENT = 16 * MAXIMUM_SAMPLES  # bytes that a compressed element may unpack to
_PLAIN_CODES = {4, *range(6, 16)}
_PLAIN_CLASSES = {"double", "single", "char", "logical"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}


def read_mat(path: Path, naming: Naming) -> Table:
    """Return the columns of a MATLAB file, version 5 or 7.3, that ``naming`` says.

    Raises
    ------
    InputError
        If it is not a MATLAB file, is damaged, or has variables other than real vectors.
    """
    try:
        return _read_7_3(path, naming) if h5py.is_hdf5(path) else _read_5(path, naming)
    except InputError:
        raise
    except Exception as error:  # a damaged file fails in whatever way the reader stumbles over it
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        problem = f"not a MATLAB file, damaged or cut off ({reason})"
        raise InputError(f"{path}: {problem}; save it again") from error


def write_mat(record: Record, path: Path, version: MatVersion = "5") -> None:
    """Write a record as column vectors of a MATLAB file, every number exactly."""
    texts = {"voltage_is": record.voltage_is, "origin": record.origin}
    arrays = record_arrays(record) | {"interval_s": np.array([record.interval])}
    if version == "5":
        scipy.io.savemat(path, arrays | texts, appendmat=False, oned_as="column")
    else:
        _write_7_3(path, arrays, texts)


def _read_5(path: Path, naming: Naming) -> Table:
    if matfile_version(path, appendmat=False)[0] != 1:
        raise InputError(f"{path}: not a MATLAB file of version 5 or 7.3; save it with -v7")
    _check_elements(path.read_bytes())
    with warnings.catch_warnings():
        # SciPy warns of a variable that it cannot read or that comes twice; here that is an error.
        warnings.simplefilter("error", MatReadWarning)
        variables = scipy.io.whosmat(path, appendmat=False)
        shapes = {name: shape for name, shape, _ in variables}
        classes = {name: kind for name, _, kind in variables}

        def load(name: str) -> Any:
            if classes[name] not in _PLAIN_CLASSES:
                raise InputError(f"{path}: {name}: is of class {classes[name]}; store real numbers")
            return scipy.io.loadmat(path, appendmat=False, variable_names=[name])[name]

        notes = {}
        for key in ("voltage_is", "origin", "interval_s"):
            if math.prod(shapes.get(key, (0,))) > 0:
                notes[key] = _first(load(key))
        names = tuple(shapes)
        return named_table(path, names, naming, lambda name: math.prod(shapes[name]), load, notes)


def _check_elements(data: bytes) -> None:
    """Raise a ValueError unless all plain arrays consist of the elements that belong to them.

    SciPy 1.18 takes the types of elements on trust, and an unknown one ends the whole process.
    """
    order = {b"IM": "<", b"MI": ">"}[data[126:128]]
    for kind, body in _elements(data[128:], order, padded=False):
        if kind == _COMPRESSED:
            unpacked = zlib.decompressobj().decompress(body, _LARGEST_ELEMENT)
            ((kind, body),) = _elements(unpacked, order)  # noqa: PLW2901
        if kind != _MATRIX:
            raise ValueError(f"unknown element {kind}")
        inner = list(_elements(body, order))
        (flags,) = struct.unpack_from(f"{order}I", inner[0][1])
        if flags & 0xFF not in _PLAIN_CODES:
            continue
        # Flags, dimensions, name and real part; an imaginary part if the flags say so.
        if len(inner) != (5 if flags & _COMPLEX else 4):
            raise ValueError("parts of an array are missing")
        if not {kind for kind, _ in inner} <= _NUMBERS_AND_TEXT:
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


def _read_7_3(path: Path, naming: Naming) -> Table:
    check_lists(path)
    with h5py.File(path, "r") as file:
        names = set(datasets(file))
        notes: dict[str, str] = {}
        for key in ("voltage_is", "origin"):
            if key in names and "MATLAB_empty" not in file[key].attrs:
                codes = np.asarray(file[key][()], dtype="<u2")
                notes[key] = codes.tobytes().decode("utf-16-le", errors="replace")
        if "interval_s" in names:
            notes["interval_s"] = _first(file["interval_s"][()])
        return group_table(path, file, naming, notes)


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
