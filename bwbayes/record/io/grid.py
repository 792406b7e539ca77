"""The time column of a file: a uniform grid, as far as its digits can tell.

Times are rounded when they are printed, and a clock's time stamps when they are stored; either is
allowed for. The stamps of a clock count from the first of them.
"""

from __future__ import annotations

import math
import warnings
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError, InputWarning
from bwbayes.record.io.series import MAXIMUM_SAMPLES
from bwbayes.record.io.table import FileColumn, FileTable, converted, scaled

__all__ = ["Grid", "clock", "decimals_of", "time_grid"]

_SHORTEST = 1e-12  # s
# No measurement counts from its beginning for so long, s: it is a clock, whose first time is left
# out of the record's own.
_LONGEST_WAIT = 1e6


def decimals_of(interval: float) -> int:
    """Return how many decimals tell the times of neighboring samples apart."""
    return max(0, -math.floor(math.log10(interval))) if interval > 0 else 9


def clock(time: float, interval: float) -> str:
    """Return a time, s, with the decimals that tell samples an interval, s, apart."""
    return f"{round(float(time), decimals_of(interval)):.15g}"


class Grid(NamedTuple):
    """The times of a record, s, and what a clock adds to them.

    ``places`` (samples,) are those of the samples, where some are missing.
    """

    start: float
    interval: float
    time_offset: float
    places: IntArray | None = None


def time_grid(table: FileTable, held: bool) -> Grid:
    """Return the grid of the time column after checking that it is uniform.

    With `held` samples may be missing; then their places on the whole grid are given.
    """
    column, stamps = table.columns["time"], converted(table, "time")
    raw = column.values if column.values.dtype.kind == "f" else column.values.astype(np.int64)
    # From the first one on, which loses no digits of a clock's times.
    elapsed = scaled((raw - raw[0]).astype(np.float64), column.unit, "time")
    start = float(stamps[0])
    offset = start if abs(start) > _LONGEST_WAIT else 0.0
    time = elapsed + (start - offset)
    steps = np.diff(elapsed)
    shown = f".{decimals_of(float(np.median(np.abs(steps))))}f"
    if (steps <= 0).any():
        sample = int(np.argmax(steps <= 0))
        before, after = time[sample], time[sample + 1]
        if after == before:
            problem = f"{after:{shown}} s is repeated; remove one of the two samples"
        else:
            problem = f"time goes back from {before:{shown}} s to {after:{shown}} s; sort them"
        raise table.error(problem, "time", sample + 1)
    typical = float(np.median(steps))
    if typical < _SHORTEST:
        problem = f"steps of {typical:.3g} s are absurdly small; check the unit"
        raise table.error(problem, "time")
    places = np.arange(time.size)
    gaps = steps > 1.5 * typical
    if held and gaps.any():
        # The mean of the other steps, as the rounding of the times goes to nothing in it.
        counts = np.maximum(np.rint(steps / steps[~gaps].mean()), 1.0)
        if counts.sum() >= MAXIMUM_SAMPLES:
            sample = int(np.argmax(steps))
            problem = f"gap of {steps[sample]:.6g} s makes the record too long; cut it there"
            raise table.error(problem, "time", sample + 1)
        places = np.concatenate([[0], np.cumsum(counts.astype(np.int64))])
    interval = float(elapsed[-1] / places[-1])
    rounding = _rounding(column, stamps)
    tolerance = _time_tolerance(stamps, interval, rounding)
    deviation = np.abs(elapsed - interval * places)
    if not (deviation <= tolerance).all():
        raise _uneven(table, time, tolerance, deviation, held)
    interval = _declared_interval(table, interval, tolerance, rounding, int(places[-1]))
    if places[-1] < time.size:
        return Grid(start - offset, interval, offset)
    sample = int(np.argmax(gaps)) + 1
    lost = int(places[-1]) + 1 - time.size
    count = int(np.count_nonzero(gaps))
    remark = f"{lost} samples are missing, from here on in {count} gap{'s' * (count > 1)}"
    error = table.error(f"{remark}; the commanded voltage is taken as held there", "time", sample)
    warnings.warn(str(error), InputWarning, stacklevel=4)
    return Grid(start - offset, interval, offset, places)


def _rounding(column: FileColumn, stamps: FloatArray) -> float:
    """Return by how much a number of the time column may be rounded off in memory, s."""
    if column.values.dtype.kind != "f":
        return 0.0
    return float(np.abs(stamps).max()) * float(np.finfo(column.values.dtype).eps)


def _time_tolerance(stamps: FloatArray, interval: float, rounding: float) -> float:
    """Return how far a time may be off the grid: 1 % of the interval, or what printing rounds off.

    Rounding moves a time and the grid's ends by half a unit of the last decimal each. A whole
    unit is already an uneven sample, and 0.4 intervals keep a missing sample apart from rounding.
    """
    printed = 0.0
    digits = math.floor(math.log10(interval))
    for unit in (10.0**digits, 10.0 ** (digits - 1), 10.0 ** (digits - 2)):
        counts = stamps / unit
        if np.all(np.abs(counts - np.rint(counts)) <= 1e-6 + 1e-15 * np.abs(counts)):
            printed = 0.999 * unit
            break
    return max(0.01 * interval, min(max(printed, rounding), 0.4 * interval))


def _uneven(
    table: FileTable, time: FloatArray, tolerance: float, deviation: FloatArray, held: bool
) -> InputError:
    """Return the error that says where the times leave the grid, and by how much."""
    steps = np.diff(time)
    typical = float(np.median(steps))
    off = np.abs(steps - typical) > tolerance
    if not off.any():
        sample = int(np.argmax(deviation))
        problem = f"irregular sampling: {deviation[sample]:.3g} s off the uniform grid"
        return table.error(f"{problem}; resample it or print more decimals", "time", sample)
    sample = int(np.argmax(off)) + 1
    step, before = float(steps[sample - 1]), float(time[sample - 1])
    if step > 1.5 * typical:
        if held:
            problem = f"gap of {step:.6g} s is not a whole number of intervals of {typical:.6g} s"
            return table.error(f"{problem}; resample it or cut the record", "time", sample)
        missing = round(step / typical) - 1
        after = f"{before:.{decimals_of(typical)}f} s"
        problem = f"gap of {step:.6g} s after {after}, about {missing} missing"
        advice = 'give the voltage there (the displacement may be nan), say voltage_is = "command"'
        return table.error(f"{problem}; {advice} if it was held, or cut the record", "time", sample)
    problem = f"irregular sampling: {step:.6g} s after the sample before, {typical:.6g} s elsewhere"
    return table.error(f"{problem}; resample it on a uniform grid", "time", sample)


def _declared_interval(
    table: FileTable, measured: float, tolerance: float, rounding: float, steps: int
) -> float:
    """Return the interval that the file declares, to the last bit, if its times agree with it."""
    text = table.notes.get("interval_s")
    if text is None:
        # The digits after these are the rounding of the times.
        unsure = max(2 * rounding / steps, 5e-13 * measured)
        rounded = [float(f"{measured:.{digits}g}") for digits in range(1, 13)]
        return next((value for value in rounded if abs(value - measured) <= unsure), rounded[-1])
    try:
        declared = float(text)
    except ValueError:
        declared = math.nan
    if not (declared > 0 and abs(declared - measured) <= tolerance / steps):
        problem = f"interval_s {text!r} contradicts the time column, {measured:.9g} s"
        raise table.error(f"{problem}; remove or correct it")
    return declared
