"""Classic netCDF files, of versions 3 and before; those of version 4 are HDF5."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import netcdf_file

from bwbayes.errors import InputError
from bwbayes.record.io.series import NOTES, RATES, Series, Source, note, vectors


def read_netcdf(path: Path) -> Source:
    """Return the variables of a classic netCDF file; a damaged file may raise any exception.

    Numbers are unpacked as those of HDF5 files are, by the CF conventions.

    Raises
    ------
    InputError
        It is of the 64-bit data format, which SciPy does not read.
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
