"""Records in pandas tables: a column each for time, voltage and displacement, or time as index."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bwbayes.data.io.series import Series, Source
from bwbayes.errors import InputError

__all__ = ["frame_source", "in_seconds"]

_MOMENTS = "mM"  # NumPy's kinds of durations and dates


def frame_source(frame: Any, origin: str) -> Source:
    """Return the columns of a pandas table, called ``origin``.

    The index counts as a column if it has a name, or dates or durations.
    """
    if frame.index.name is not None or frame.index.dtype.kind in _MOMENTS:
        frame = frame.reset_index()
    series = []
    for number, (label, kind) in enumerate(frame.dtypes.items()):
        moments = getattr(kind, "kind", "") in _MOMENTS
        load = partial(_values, frame, number, origin, str(label))
        series.append(Series(str(label), len(frame), load, "s" if moments else ""))
    return Source(Path(origin), tuple(series), {"": {"origin": origin}})


def _values(frame: Any, number: int, origin: str, name: str) -> NDArray[Any]:
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
