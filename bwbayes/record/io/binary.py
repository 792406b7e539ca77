"""Records in binary files: HDF5, netCDF, TDMS and MATLAB; ``time_s``, ``voltage_V``, or others.

Datasets may stand in groups, and are named by their path, ``run_3/hv_out``; an attribute ``unit``
says a dataset's unit, one like ``fs`` or ``dt`` how fast it was sampled; packed numbers, as netCDF
has them, are unpacked by ``scale_factor``, ``add_offset`` and ``_FillValue``; columns of a table or
matrix are series of their own, ``table.u`` and ``log[2]``. Beside the datasets may stand
``voltage_is``, ``origin``, ``interval_s`` and ``time_offset_s``, as attributes or, in MATLAB's
files, as variables. NetCDF of version 4 is HDF5; older versions are read by SciPy. National
Instruments' ``.tdms`` files are read by npTDMS; channels are named by their group,
``group/channel``, and waveforms state clocks.

MATLAB's version 7.3 is HDF5. Version 5 (MATLAB's ``save`` with ``-v6`` or ``-v7``) is read here:
SciPy 1.18 takes the types of a file's elements on trust, and an unknown one ends the whole process.
The rare version 4 is refused. Vectors may be rows or columns; those in a struct are named by their
path, ``log.Ux`` or ``log.Y(2).Data``.
"""

from __future__ import annotations

import math
import mmap
import re
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import scipy
from scipy.io import netcdf_file

from bwbayes.errors import InputError, InputWarning, one_line
from bwbayes.quantities import DEFAULT, DISPLACEMENT, VOLTAGE
from bwbayes.record.io.series import (
    INSTRUMENT_NOTES,
    MAXIMUM_SAMPLES,
    NOTES,
    RATES,
    Clock,
    Series,
    Source,
    in_seconds,
    note,
    notes_of,
    pass_over_object,
    vectors,
    with_units_beside,
)
from bwbayes.record.record import Record


def read_hdf5(path: Path) -> Source:
    """Return the series of numbers in an HDF5 file; a damaged file may raise any exception."""
    # HDF5 2.0 would follow two kinds of damaged lists for ever: the free blocks of a heap of names,
    # which may run in a circle and take all memory, and the texts in a collection, of which one may
    # have no length.
    with path.open("rb") as raw, mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ) as data:
        base = data.find(b"\x89HDF\r\n\x1a\n")
        for mark, is_endless in ((b"HEAP", _is_circle), (b"GCOL\1\0\0\0", _stands_still)):
            at = data.find(mark)
            while 0 <= at <= len(data) - 32:
                if is_endless(data, base, at):
                    raise ValueError("a list in it has no end")
                at = data.find(mark, at + 1)
    notes: dict[str, dict[str, str]] = {}
    texts: dict[str, str] = {}
    with _open(path, remark=True) as file:
        series = tuple(_series(path, file, notes, texts, set()))
    return Source(path, with_units_beside(series, texts), notes)


def write_hdf5(record: Record, path: Path) -> None:
    """Write a record as HDF5, every number exactly."""
    # The file format since HDF5 1.8 has checksums: reading notices damage to all but the numbers.
    content = BytesIO()  # in memory first: HDF5 does not survive a disk that is full
    with h5py.File(content, "w", libver="v108") as file:
        for name, values in record_arrays(record).items():
            file.create_dataset(name, data=values)
        for name, value in record_notes(record).items():
            # Text of fixed length: HDF5 can loop for ever over damaged text of variable length.
            file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value
    # Write a copy, not a view: a view that the traceback of an error holds can crash Python.
    path.write_bytes(content.getvalue())


def record_arrays(record: Record) -> dict[str, Any]:
    """Return the arrays of a record by the names that they have in files.

    Arrays of other quantities are named input and output; the notes hold their units.
    """
    quantities = record.quantities
    arrays = {
        "time_s": record.time if quantities.has_clock else None,
        "voltage_V" if quantities.input == VOLTAGE else "input": record.voltage,
        "displacement_um" if quantities.output == DISPLACEMENT else "output": record.displacement,
        "truth_um" if quantities.output == DISPLACEMENT else "truth": record.truth,
    }
    return {name: v for name, v in arrays.items() if v is not None} | dict(record.covariates)


def record_notes(record: Record) -> dict[str, str | float]:
    """Return the notes of a record that a file holds beside its arrays, by the names in `NOTES`."""
    notes: dict[str, str | float] = {
        "voltage_is": record.voltage_is,
        "origin": record.origin,
        "interval_s": record.interval,
        "time_offset_s": record.time_offset,
        "covariates": ", ".join(record.covariates),
    }
    if record.quantities != DEFAULT:
        quantities = record.quantities
        notes |= {"input_is": str(quantities.input), "output_is": str(quantities.output)}
    if not record.quantities.has_clock:
        del notes["interval_s"]
    notes |= dict(zip(INSTRUMENT_NOTES, astuple(record.instruments), strict=True))
    return {name: value for name, value in notes.items() if value}


def _series(
    path: Path,
    group: Any,
    notes: dict[str, dict[str, str]],
    texts: dict[str, str],
    passed: set[int],
) -> Iterator[Series]:
    """Yield the series of a group and of those below it, each once; collect notes and texts.

    Links to other files, and numbers stored in other files, are skipped unopened: a stranger's
    file could name any file or device of this machine. MATLAB's internal groups (``#``) are skipped
    as well.
    """
    passed.add(h5py.h5o.get_info(group.id).addr)
    prefix = group.name.strip("/") + "/" * (group.name != "/")
    notes[prefix] = {
        key: _note(group.attrs, key) for key in group.attrs if key in NOTES or key.lower() in RATES
    }
    links = [name for name in group if isinstance(group.get(name, getlink=True), h5py.HardLink)]
    items = {name: group[name] for name in links if not name.startswith("#")}
    for name, item in items.items():
        if not isinstance(item, h5py.Dataset) or item.external or item.is_virtual:
            continue
        is_text = "MATLAB_class" in item.attrs and _note(item.attrs, "MATLAB_class") == "char"
        if "MATLAB_empty" in item.attrs or item.shape is None:
            continue
        no_variable = "This is a netCDF dimension but not a netCDF variable"
        if "NAME" in item.attrs and _note(item.attrs, "NAME").startswith(no_variable):
            continue
        if "MATLAB_object_decode" in item.attrs:
            pass_over_object(path, name, _note(item.attrs, "MATLAB_class"))
            continue
        if is_text:
            codes = np.asarray(item[()], dtype="<u2")
            text = codes.tobytes().decode("utf-16-le", errors="replace")
            if name in NOTES:
                notes[prefix][name] = text
            else:
                texts[f"{prefix}{name}"] = text
        elif name in NOTES and name.endswith("_s") and item.size and item.dtype.kind in "iuf":
            notes[prefix][name] = note(item[()])
        else:
            stated = [key for key in item.attrs if key.lower() in RATES]
            notes[f"{prefix}{name}"] = {key: _note(item.attrs, key) for key in stated}
            unit = next((_note(item.attrs, k) for k in item.attrs if k.lower()[:4] == "unit"), "")
            unit = unit.partition(" since ")[0]  # of dates: "seconds since 2026-03-03"
            load = partial(_load_unpacked, path, item.name)
            columns = _columns(item, items)
            yield from vectors(prefix, name, item.shape, item.dtype, load, unit, columns)
    for item in items.values():
        if isinstance(item, h5py.Group) and h5py.h5o.get_info(item.id).addr not in passed:
            yield from _series(path, item, notes, texts, passed)


def _columns(
    dataset: Any, beside: Mapping[str, Any]
) -> dict[str, tuple[Sequence[str], Sequence[str]]]:
    """Return names and units of a matrix's columns, or of those in a table's fields, if stated.

    The names are as many words as there are columns, in an attribute or in a dataset beside the
    matrix, as netCDF and pandas write them. The units are in the attribute with that name.
    """
    leaf = dataset.name.rpartition("/")[2]
    if dataset.dtype.names:  # PyTables' list of words, as a text
        kinds = {name: f"{name}_kind" for name in dataset.dtype.names}
        return {
            name: (re.findall("^a?V(.*)$", _note(dataset.attrs, kind), re.MULTILINE), ())
            for name, kind in kinds.items()
            if kind in dataset.attrs
        }
    if dataset.ndim != 2 or dataset.dtype.kind not in "iuf":
        return {}
    names_or_units = re.compile("column|channel|field|header|^names?$|^labels?$|^unit")
    stated = {
        key: notes_of(dataset.attrs[key])
        for key in dataset.attrs
        if _is_text(dataset.attrs.get_id(key).dtype) and names_or_units.search(key.lower())
    }
    texts = [
        notes_of(other.asstr()[()] if h5py.check_string_dtype(other.dtype) else other[()])
        for other in beside.values()
        if isinstance(other, h5py.Dataset)
        and other.shape == (min(dataset.shape),)
        and _is_text(other.dtype)
    ]
    unit = next((stated.pop(key) for key in [*stated] if key.lower()[:4] == "unit"), [])
    names = [words for words in (*stated.values(), *texts) if len(words) == min(dataset.shape)]
    return {leaf: (names[0] if names else (), unit)}


def _is_text(kind: Any) -> bool:
    return kind.kind == "S" or h5py.check_string_dtype(kind) is not None


def _note(attributes: Any, name: str) -> str:
    """Read an attribute, but no list: it is no note, and a damaged one ends the process in HDF5."""
    kind = attributes.get_id(name).dtype
    is_list = kind.kind == "O" and h5py.check_string_dtype(kind) is None
    return "" if is_list else note(attributes[name])


def _open(path: Path, *, remark: bool = False) -> Any:
    """Open a file for reading, if possible even while another program writes it.

    Raises InputError: too little of it is written.
    Warns InputWarning: if another program has it open, where a ``remark`` is wanted.
    """
    try:
        return h5py.File(path, "r", locking="best-effort")
    except OSError as error:
        if not isinstance(error, BlockingIOError) and "already open" not in str(error):
            raise
    for swmr in (False, True):
        with suppress(OSError, RuntimeError):
            file = h5py.File(path, "r", locking=False, swmr=swmr)
            if remark:
                text = f"{path}: another program has it open; what that has not written is missing"
                warnings.warn(text, InputWarning, stacklevel=5)
            return file
    problem = "another program has it open, or ended without closing it, and it is not complete"
    raise InputError(f"{path}: {problem}; close it there, or run `h5clear -s` on it, and try again")


def _load_unpacked(path: Path, name: str) -> Any:
    # Attributes that may scale or shift raw numbers in an unknown way, and their neutral values.
    factors = {
        **dict.fromkeys(("gain", "scale", "scaling", "factor", "slope", "calibration"), (0.0, 1.0)),
        **dict.fromkeys(("sensitivity", "offset", "bias"), (0.0,)),
    }
    with _open(path) as file:
        attributes = file[name].attrs
        for key in attributes:
            if key.lower() in factors and attributes.get_id(key).dtype.kind in "iuf":
                factor = np.ravel(attributes[key])
                if factor.size == 1 and factor[0] not in factors[key.lower()]:
                    fact = f"attribute {key} = {factor[0]:g} is not applied"
                    advice = f"if 1 stands for that, say so as a unit, '{factor[0]:g} V'"
                    remark = one_line(f"{path}: {name.strip('/')}: {fact}; {advice}")
                    warnings.warn(remark, InputWarning, stacklevel=6)
        return _unpack(file[name][()], attributes)


def _unpack(values: Any, attributes: Any) -> Any:
    """Return packed numbers by the CF conventions: ``scale_factor * values + add_offset``.

    Numbers equal to ``_FillValue`` or ``missing_value`` become nan. Source: CF 1.11, 2.5.1 and 8.1.
    """
    if values.dtype.kind not in "iuf":
        return values
    keys = ("scale_factor", "add_offset", "_FillValue", "missing_value")
    stated = {
        key: np.ravel(attributes[key])
        for key in keys
        if key in attributes and attributes.get_id(key).dtype.kind in "iuf"
    }
    marks = [mark for key in keys[2:] for mark in stated.get(key, ())]
    is_missing = np.isin(values, marks)
    if is_missing.any() or keys[0] in stated or keys[1] in stated:
        scale, offset = (
            float(stated.get(key, [d])[0]) for key, d in zip(keys, (1, 0), strict=False)
        )
        values = np.where(is_missing, np.nan, scale * values.astype(np.float64) + offset)
    return values


def _is_circle(data: mmap.mmap, base: int, heap: int) -> bool:
    # The heap's size is followed by its first free block and the address of its blocks; 1 ends the
    # list.
    block, address = struct.unpack_from("<QQ", data, heap + 16)
    passed = set()
    while block != 1 and base + address + block <= len(data) - 8:
        if block in passed:
            return True
        passed.add(block)
        (block,) = struct.unpack_from("<Q", data, base + address + block)
    return False


def _stands_still(data: mmap.mmap, _: int, collection: int) -> bool:
    (size,) = struct.unpack_from("<Q", data, collection + 8)
    at, end = collection + 16, min(collection + size, len(data))
    while at + 16 <= end:
        number, length = struct.unpack_from("<H6xQ", data, at)
        # Number 0 is the free space, and its length includes these 16 bytes.
        step = 16 + (length + 7) // 8 * 8 if number else length
        if not 0 < step <= end - at:
            return True
        at += step
    return False


def read_netcdf(path: Path) -> Source:
    """Return the variables of a classic netCDF file; a damaged file may raise any exception.

    Numbers are unpacked as those of HDF5 files are, by the CF conventions.

    Raises InputError: it is of the 64-bit data format, which SciPy does not read.
    """
    with path.open("rb") as raw:
        if raw.read(4) == b"CDF\x05":
            raise InputError(f"{path}: netCDF of the 64-bit data format; write it as netCDF-4")
    with netcdf_file(path, "r", mmap=False, maskandscale=True) as file:
        stated = {key: note(getattr(file, key)) for key in (*NOTES, *RATES) if hasattr(file, key)}
        variables = {name: _values(variable) for name, variable in file.variables.items()}
        units = {name: note(getattr(v, "units", "")) for name, v in file.variables.items()}
        dimensions = {name: v.dimensions for name, v in file.variables.items()}
    series: list[Series] = []
    for name, values in variables.items():
        # A variable of words along the same dimension names the columns of a matrix.
        words = [
            [str(word).strip() for word in others]
            for other, others in variables.items()
            if others.dtype.kind == "U" and dimensions[other][:1] == dimensions[name][1:2]
        ]
        columns = {name: (words[0], ())} if words else None
        unit = units[name].partition(" since ")[0]
        load = partial(np.asarray, values)
        series += vectors("", name, values.shape, values.dtype, load, unit, columns)
    return Source(path, tuple(series), {"": stated})


def _values(variable: Any) -> Any:
    """Return a variable's numbers, nan for those that are missing, or its words."""
    values: Any = np.ma.asarray(variable[:] if variable.shape else variable.getValue())
    if values.dtype.kind == "S":
        rows = values.filled(b" ")
        return np.array([b"".join(row).decode(errors="replace").rstrip("\0 ") for row in rows])
    if values.dtype.kind in "iu" and not np.ma.is_masked(values):
        return values.filled().astype(values.dtype.newbyteorder("="))
    return values.astype(np.float64).filled(np.nan)


def read_tdms(path: Path) -> Source:
    """Return the channels of a TDMS file; npTDMS may raise any exception for a damaged one.

    Raises InputError: npTDMS is not installed.
    """
    try:
        from nptdms import TdmsFile  # noqa: PLC0415  # an extra
    except ImportError:
        raise InputError(
            f"{path}: reading TDMS needs npTDMS; pip install 'bwbayes[tdms]'"
        ) from None

    series = []
    for channel in (c for group in TdmsFile.read(path).groups() for c in group.channels()):
        wave, clock = channel.properties, None
        if wave.get("wf_increment"):
            start = float(wave.get("wf_start_offset", 0.0))
            clock = Clock(float(wave["wf_increment"]), start, wave.get("wf_start_time"))
        name, group = f"{channel.group_name}/{channel.name}", f"{channel.group_name}/"
        load = partial(lambda channel: in_seconds(channel[:]), channel)
        unit = str(wave.get("unit_string", ""))
        series.append(Series(name, len(channel), load, unit, group, clock=clock))
    return Source(path, tuple(series))


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
            series += _variable_series("", matrix, order, texts)
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


def _variable_series(
    path: str, matrix: bytes, order: str, texts: dict[str, str]
) -> Iterator[Series]:
    """Yield the series in a variable, an element of a cell array, or a field of a struct.

    Texts are collected by their paths. Objects and sparse matrices are passed over.
    """
    flags, *inner = _elements(matrix, order)
    word = struct.unpack_from(f"{order}I", flags[1])[0]
    kind = word & 0xFF
    if kind not in {_CELL, _STRUCT, _CHAR, *_NUMERIC}:
        return
    shape = _numbers(inner[0], order).tolist()
    path = path or inner[1][1].decode("latin-1")
    content = inner[2:]
    if kind == _CHAR:
        if content and content[0][1]:
            codes = _numbers(content[0], order)
            encoding = "utf-8" if codes.itemsize == 1 else f"utf-{8 * codes.itemsize}-le"
            text = codes.astype(f"<u{codes.itemsize}").tobytes().decode(encoding, errors="replace")
            texts[path] = text
    elif kind in _NUMERIC:
        is_complex = bool(word & _IS_COMPLEX)
        dtype = np.dtype("?" if word & _IS_LOGICAL else "c16" if is_complex else _NUMERIC[kind])
        if len(content) != 1 + is_complex:
            raise ValueError("parts of an array are missing")

        def load() -> Any:
            return _numbers(content[0], order).astype(dtype).reshape(shape, order="F")

        if path in NOTES and math.prod(shape) > 0:
            texts[path] = note(load())
        else:
            group, dot, leaf = path.rpartition(".")
            yield from vectors(group + dot, leaf, shape, dtype, load)
    else:
        fields = [""]
        if kind == _STRUCT:
            (width,), names = _numbers(content[0], order), content[1][1]
            fields = [
                "." + names[at : at + width].partition(b"\0")[0].decode("latin-1")
                for at in range(0, len(names), width)
            ]
        matrices = [body for kind, body in content if kind == _MATRIX]
        for number, body in enumerate(matrices):
            index, field = divmod(number, len(fields))
            index_text = f"({index + 1})" if math.prod(shape) > 1 else ""
            if body:  # else an empty array
                yield from _variable_series(
                    f"{path}{index_text}{fields[field]}", body, order, texts
                )


def _numbers(element: tuple[int, bytes], order: str) -> Any:
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
