"""Series with a column of times each, as some programs write their channels.

The times are in the series' group of the file or, in a text, in the last column of times before it.
Where the times of voltage and displacement differ, each gets a clock, by which they are aligned.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, InputWarning, one_line
from bwbayes.record.io.recognition import likeness, unit_of
from bwbayes.record.io.series import Clock, Series, Source
from bwbayes.record.io.units import scale_of

if TYPE_CHECKING:
    from bwbayes.record.io.columns import Naming


def with_own_times(
    source: Source, chosen: Mapping[str, Series], naming: Naming
) -> dict[str, Series]:
    """Return the chosen series with times, or clocks where they have different times.

    Raises
    ------
    InputError
        Their times differ, and are not uniform.

    Warns
    -----
    InputWarning
        Their times differ, and one column of times is said to count for both.
    """
    read = {q: chosen[q] for q in ("voltage", "displacement") if q in chosen}
    own_times = {q: times for q, series in read.items() if (times := _beside(source, series))}
    seconds = {q: _seconds(times, naming) for q, times in own_times.items()}
    # Other functions handle one column of times for both, or one that cannot be understood.
    is_known = len({times.name for times in own_times.values()}) == 2
    is_known &= all(times.size > 1 for times in seconds.values())
    if naming.fs is not None or not is_known:
        return dict(chosen)
    first, last = seconds.values()
    interval = float(first[-1] - first[0]) / (first.size - 1)
    size = min(first.size, last.size)
    apart = float(np.abs(first[:size] - last[:size]).max())
    if first.size == last.size and apart <= 0.01 * interval:
        return {"time": own_times["voltage"], **chosen}
    names = [repr(times.name) for times in own_times.values()]
    differ = f"{source.path}: {names[1]}: not the times of {names[0]}, by up to {apart:.6g} s"
    if "time" in naming.columns:
        advice = "name no column of times to put each by its own"
        text = one_line(f"{differ}, but {chosen['time'].name!r} counts for both; {advice}")
        warnings.warn(text, InputWarning, stacklevel=5)
        return dict(chosen)
    clocked = {q: _clocked(series, seconds[q]) for q, series in read.items()}
    if not all(series.clock for series in clocked.values()):
        advice = "write both at the same times, or name the column of times that counts for both"
        raise InputError(one_line(f"{differ}, and not uniform; {advice}"))
    return {**{q: s for q, s in chosen.items() if q != "time"}, **clocked}


def _beside(source: Source, series: Series) -> Series | None:
    """Return the times of one series; None if all series share their times or there are none."""
    times = [
        s
        for s in source.series
        if s.size == series.size and likeness(s.label, s.unit, "time") is not None
    ]
    if source.lines:
        before = source.series[: source.series.index(series)]
        return next((s for s in before[::-1] if s in times), None) if times[1:] else None
    group_times = [s for s in times if s.group == series.group != ""]
    return group_times[0] if len(group_times) == 1 else None


def _seconds(times: Series, naming: Naming) -> FloatArray:
    """Return times, s, up to their end; None if they do not rise or have no unit."""
    unit = naming.units.get("time") or unit_of(times.label, times.unit, "time")
    scale = scale_of(unit or "", "time")
    values = times.numbers("", readings=True).astype(np.float64)
    values = values[: values.size - int(np.argmax(np.isfinite(values[::-1])))]
    if scale is None or not (np.diff(values) > 0).all():
        return np.empty(0)
    factor, power = scale
    return np.asarray(factor * values * 10.0**power)


def _clocked(series: Series, seconds: FloatArray) -> Series:
    """Return a series with the clock of its times, up to where they end, if they are uniform."""
    interval = float(seconds[-1] - seconds[0]) / (seconds.size - 1)
    uniform = seconds[0] + interval * np.arange(seconds.size)
    if np.abs(seconds - uniform).max() > 0.01 * interval:
        return series
    load_all, size = series.load_readings or series.load, seconds.size
    clock = Clock(interval, float(seconds[0]))
    return replace(
        series, size=size, load=lambda: load_all()[:size], load_readings=None, clock=clock
    )
