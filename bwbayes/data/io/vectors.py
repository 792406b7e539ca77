"""Arrays as the columns of a file: vectors of numbers, in the units that one says."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.data.io.columns import COMMON_NAMES, Naming
from bwbayes.data.io.table import FileColumn, FileTable
from bwbayes.errors import InputError

__all__ = ["array_table", "frozen_vector"]


def array_table(
    where: str,
    arrays: Mapping[str, FloatArray | None],
    units: Mapping[str, str],
    notes: Mapping[str, str],
) -> FileTable:
    """Return arrays (samples,) by quantity as the columns of a file that is called ``where``.

    Raises
    ------
    InputError
        A unit that a quantity cannot have.
    """
    Naming(units=units)  # refuses what is none
    columns = {}
    for quantity, values in arrays.items():
        if values is not None:
            unit = units.get(quantity, COMMON_NAMES[quantity].rpartition("_")[2])
            columns[quantity] = FileColumn(f"{quantity}_{unit.removeprefix('-')}", values, unit)
    return FileTable(Path(where), columns, notes)


def frozen_vector(name: str, values: ArrayLike, samples: int) -> FloatArray:
    """Return a vector of so many finite numbers that cannot be written to.

    A displacement may be missing (nan) in all places but one.

    Raises
    ------
    InputError
        It is none.
    """
    try:
        vector = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: not numbers ({error}); give real numbers") from error
    if vector.ndim != 1 or vector.size == 0:
        raise InputError(f"{name}: shape {vector.shape} is not a vector; give (samples,)")
    if vector.size != samples:
        raise InputError(f"{name}: {vector.size} samples, voltage has {samples}; give the same")
    missing = np.isnan(vector) if name == "displacement" else np.zeros(samples, dtype=np.bool_)
    if missing.all():
        raise InputError(f"{name}: holds no reading; give at least one")
    vector[missing] = np.nan  # one nan for all, as there are many and a digest tells them apart
    finite = np.isfinite(vector) | missing
    if not finite.all():
        sample = int(np.argmin(finite))
        raise InputError(f"{name}: {vector[sample]} at sample {sample}; give finite numbers")
    vector.setflags(write=False)
    return vector
