"""Records in HDF5: datasets named like the columns, ``time_s``, ``voltage_V``, ``displacement_um``.

The datasets stand at the root or in one group; the attributes ``voltage_is``, ``origin`` and
``interval_s`` stand beside them, and a simulated record has the dataset ``truth_um``. Other
datasets are passed over.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bwbayes.data.checks import Table, named_columns
from bwbayes.data.record import Record
from bwbayes.errors import InputError

__all__ = ["group_table", "read_hdf5", "record_arrays", "write_hdf5"]

_NOTES = ("voltage_is", "origin", "interval_s")


def read_hdf5(path: Path) -> Table:
    """Return the columns of an HDF5 file.

    Raises
    ------
    InputError
        If it is no HDF5 file, is damaged, or has datasets that are no vectors of real numbers.
    """
    if not h5py.is_hdf5(path):
        raise InputError(f"{path}: not an HDF5 file, or its beginning is lost; write it anew")
    try:
        with h5py.File(path, "r") as file:
            group = _group_of_columns(path, file)
            notes = {key: _text(group.attrs[key]) for key in _NOTES if key in group.attrs}
            return group_table(path, group, notes)
    except InputError:
        raise
    except Exception as error:  # a damaged file fails in whatever way HDF5 stumbles over it
        raise InputError(f"{path}: damaged or cut off ({_brief(error)}); write it anew") from error


def group_table(path: Path, group: Any, notes: dict[str, str]) -> Table:
    """Return the columns among the datasets of an open HDF5 group."""
    names = tuple(str(name) for name in group if isinstance(group.get(name), h5py.Dataset))
    columns = named_columns(
        path, names, lambda name: int(group[name].size or 0), lambda name: group[name][()]
    )
    return Table(path, columns, notes, names=names)


def write_hdf5(record: Record, path: Path) -> None:
    """Write a record as HDF5, every number exactly."""
    # The file format since HDF5 1.8 has checksums: reading notices damage to all but the numbers.
    with h5py.File(path, "w", libver="v108") as file:
        for name, values in record_arrays(record).items():
            file.create_dataset(name, data=values)
        # Text of fixed length, since HDF5 can loop for ever over damaged text of variable length.
        file.attrs["voltage_is"] = np.bytes_(record.voltage_is)
        if record.origin:
            file.attrs["origin"] = np.bytes_(record.origin.encode())
        file.attrs["interval_s"] = record.interval


def record_arrays(record: Record) -> dict[str, Any]:
    """Return the arrays of a record by the names that they have in binary files."""
    arrays = {
        "time_s": record.time,
        "voltage_V": record.voltage,
        "displacement_um": record.displacement,
        "truth_um": record.truth,
    }
    return {name: values for name, values in arrays.items() if values is not None}


def _group_of_columns(path: Path, file: Any) -> Any:
    """Return the root if datasets stand there, else the only group that has some."""
    groups = [
        group for group in (file, *file.values()) if isinstance(group, h5py.Group) and _holds(group)
    ]
    if not groups or groups[0] == file:
        return file
    if len(groups) > 1:
        names = ", ".join(repr(group.name) for group in groups[:5])
        raise InputError(f"{path}: several groups hold records ({names}); keep one per file")
    return groups[0]


def _holds(group: Any) -> bool:
    return any(isinstance(group.get(name), h5py.Dataset) for name in group)


def _text(value: Any) -> str:
    if not np.size(value):
        return ""
    first = np.ravel(value)[0]
    return first.decode("utf-8", errors="replace") if isinstance(first, bytes) else str(first)


def _brief(error: Exception) -> str:
    return " ".join(str(error).split())[:80] or type(error).__name__
