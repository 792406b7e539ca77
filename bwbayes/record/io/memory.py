"""Records in memory: arrays and pandas tables as the columns of a file."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.errors import InputError
from bwbayes.record.io.columns import COMMON_NAMES
from bwbayes.record.io.series import Series, Source

__all__ = ["array_source", "frame_source", "frozen_vector", "in_seconds"]

_MOMENTS = "mM"  # NumPy's kinds of durations and dates


def array_source(
    origin: str,
    arrays: Mapping[str, FloatArray | None],
    units: Mapping[str, str],
    notes: Mapping[str, str],
) -> Source:
    """Return arrays (samples,) by quantity as what a file called ``origin`` holds.

    ``units`` are those of quantities that have others than the package's.
    """
    series = []
    for quantity, values in arrays.items():
        if values is not None:
            unit = units.get(quantity, COMMON_NAMES[quantity].rpartition("_")[2])
            name = f"{quantity}_{unit.removeprefix('-')}"
            series.append(Series(name, values.size, partial(np.asarray, values)))
    return Source(Path(origin), tuple(series), {"": notes})


def frame_source(frame: Any, origin: str) -> Source:
    """Return the columns of a pandas table, called ``origin``.

    The index counts as a column if it has a name, or dates or durations.
    """
    if frame.index.name is not None or frame.index.dtype.kind in _MOMENTS:
        frame = frame.reset_index()
    series = []
    for number, (label, kind) in enumerate(frame.dtypes.items()):
        moments = getattr(kind, "kind", "") in _MOMENTS
        load = partial(_column, frame, number, origin, str(label))
        series.append(Series(str(label), len(frame), load, "s" if moments else ""))
    return Source(Path(origin), tuple(series), {"": {"origin": origin}})


def _column(frame: Any, number: int, origin: str, name: str) -> NDArray[Any]:
    """Return a column's numbers; dates and durations in seconds.

    Raises
    ------
    InputError
        It holds no numbers.
    """
    values = frame.iloc[:, number].to_numpy()
    try:
        return np.asarray(in_seconds(values), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{origin}: {name}: not numbers ({error}); convert them") from None


def in_seconds(times: NDArray[Any]) -> NDArray[Any]:
    """Return dates, from 1970 on, or durations (samples,) in s; other values as they are."""
    if times.dtype.kind not in _MOMENTS:
        return times
    zero = np.datetime64(0, "ns") if times.dtype.kind == "M" else np.timedelta64(0, "ns")
    return np.asarray((times - zero) / np.timedelta64(1, "ns") / 1e9)


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
