"""Records in HDF5 files: datasets ``time_s``, ``voltage_V``, ``displacement_um``, or others.

Datasets may stand in groups, and are named by their path, ``run_3/hv_out``; an attribute ``unit``
says a dataset's unit, columns of a table or matrix are series of their own, ``table.u`` and
``log[2]``. The attributes ``voltage_is``, ``origin``, ``interval_s`` and ``time_offset_s``
may stand beside the datasets, and a simulated record has the dataset ``truth_um``.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bwbayes.record.io.series import Series, Source, damaged, vectors
from bwbayes.record.record import Record

__all__ = ["is_hdf5", "read_hdf5", "record_arrays", "write_hdf5"]

# Marks in an HDF5 file: its beginning, a heap of names, a collection of texts; and the number that
# ends a list of free blocks.
_SIGNATURE, _HEAP, _COLLECTION = b"\x89HDF\r\n\x1a\n", b"HEAP", b"GCOL\1\0\0\0"
_NO_BLOCK = 1

_NOTES = ("voltage_is", "origin", "interval_s", "time_offset_s")
_UNITS = ("unit", "units", "Unit", "Units")


def is_hdf5(path: Path) -> bool:
    """Tell whether a file is an HDF5 file."""
    return bool(h5py.is_hdf5(path))


def read_hdf5(path: Path) -> Source:
    """Return the series of numbers in an HDF5 file.

    Raises
    ------
    InputError
        The file is damaged.
    """
    try:
        check_lists(path)
        with h5py.File(path, "r") as file:
            series: list[Series] = []
            notes = {}
            for group in _groups(file, set()):
                name = group.name.strip("/")
                prefix = f"{name}/" if name else ""
                notes[prefix] = {k: _text(group.attrs[k]) for k in _NOTES if k in group.attrs}
                for leaf, dataset in _datasets(group):
                    unit = next((_text(dataset.attrs[k]) for k in _UNITS if k in dataset.attrs), "")
                    load = partial(_loaded, path, dataset.name)
                    series += vectors(prefix, leaf, dataset.shape, dataset.dtype, load, unit)
            return Source(path, tuple(series), notes)
    except Exception as error:
        raise damaged(path, error) from error


def _loaded(path: Path, name: str) -> Any:
    with h5py.File(path, "r") as file:
        return file[name][()]


def write_hdf5(record: Record, path: Path) -> None:
    """Write a record as HDF5, every number exactly."""
    # The file format since HDF5 1.8 has checksums: reading notices damage to all but the numbers.
    content = BytesIO()  # in memory first: HDF5 does not survive a disk that is full
    with h5py.File(content, "w", libver="v108") as file:
        for name, values in record_arrays(record).items():
            file.create_dataset(name, data=values)
        # Text of fixed length, since HDF5 can loop for ever over damaged text of variable length.
        file.attrs["voltage_is"] = np.bytes_(record.voltage_is)
        if record.origin:
            file.attrs["origin"] = np.bytes_(record.origin.encode())
        file.attrs["interval_s"] = record.interval
        if record.time_offset:
            file.attrs["time_offset_s"] = record.time_offset
    path.write_bytes(content.getbuffer())


def record_arrays(record: Record) -> dict[str, Any]:
    """Return the arrays of a record by the names that they have in binary files."""
    arrays = {
        "time_s": record.time,
        "voltage_V": record.voltage,
        "displacement_um": record.displacement,
        "truth_um": record.truth,
    }
    return {name: values for name, values in arrays.items() if values is not None}


def _groups(group: Any, passed: set[int]) -> Iterator[Any]:
    """Yield a group and all below it, each once, but for MATLAB's own."""
    address = h5py.h5o.get_info(group.id).addr
    if address in passed:
        return
    passed.add(address)
    yield group
    for name in _linked(group):
        if not name.startswith("#") and isinstance(group[name], h5py.Group):
            yield from _groups(group[name], passed)


def _datasets(group: Any) -> Iterator[tuple[str, Any]]:
    """Yield names and datasets of a group whose numbers are in this very file.

    Links to other files, and numbers stored in other files, are passed over unopened: a stranger's
    file could name any file or device of this machine. So are MATLAB's texts and empty arrays.
    """
    for name in _linked(group):
        dataset = group[name]
        if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual:
            continue
        if dataset.attrs.get("MATLAB_class") != b"char" and "MATLAB_empty" not in dataset.attrs:
            yield name, dataset


def _linked(group: Any) -> list[str]:
    """Return the names in a group that stand for objects in the same file."""
    links = ((str(name), group.get(name, getlink=True)) for name in group)
    return [name for name, link in links if isinstance(link, h5py.HardLink)]


def check_lists(path: Path) -> None:
    """Raise a ValueError if HDF5 2.0 would follow a damaged list in the file for ever.

    There are two kinds: the free blocks of a heap of names, which may run in a circle and take all
    memory, and the texts in a collection, of which one may have no length.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        base = data.find(_SIGNATURE)
        endless = any(_runs_in_a_circle(data, base, at) for at in _places(data, _HEAP)) or any(
            _stands_still(data, at) for at in _places(data, _COLLECTION)
        )
    if endless:
        raise ValueError("a list in it has no end")


def _places(data: mmap.mmap, mark: bytes) -> Iterator[int]:
    """Yield where a structure with this mark and 32 bytes at least may begin."""
    at = data.find(mark)
    while 0 <= at <= len(data) - 32:
        yield at
        at = data.find(mark, at + 1)


def _runs_in_a_circle(data: mmap.mmap, base: int, heap: int) -> bool:
    # Behind the heap's own size: its first free block, and where its blocks are.
    block, address = struct.unpack_from("<QQ", data, heap + 16)
    passed = set()
    while block != _NO_BLOCK and base + address + block <= len(data) - 8:
        if block in passed:
            return True
        passed.add(block)
        (block,) = struct.unpack_from("<Q", data, base + address + block)
    return False


def _stands_still(data: mmap.mmap, collection: int) -> bool:
    (size,) = struct.unpack_from("<Q", data, collection + 8)
    at, end = collection + 16, min(collection + size, len(data))
    while at + 16 <= end:
        number, length = struct.unpack_from("<H6xQ", data, at)
        # Number 0 is what is free, and its length includes these 16 bytes.
        step = 16 + (length + 7) // 8 * 8 if number else length
        if not 0 < step <= end - at:
            return True
        at += step
    return False


def _text(value: Any) -> str:
    if not np.size(value):
        return ""
    first = np.ravel(value)[0]
    return first.decode("utf-8", errors="replace") if isinstance(first, bytes) else str(first)
