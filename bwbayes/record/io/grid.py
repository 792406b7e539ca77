"""Uniform time grid of a record, derived from the times of its samples.

Times count as uniform as far as their digits can tell. Where samples are missing, the others stay
at their places. Where times scatter, as those of a loop in a program do, samples move to the
nearest times of the grid, along the columns' slopes. Time stamps of a clock count from the first;
those of a coarse one, whose ticks are longer than an interval, may repeat. A few others may, too.
"""

from __future__ import annotations

import math
import warnings
from typing import NamedTuple

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.errors import InputWarning
from bwbayes.record.io.columns import ColumnTable
from bwbayes.record.io.series import MAXIMUM_SAMPLES


class Grid(NamedTuple):
    """Times of a record, s, the offset of its clock, and the positions of the samples.

    Where not all times of the grid have one sample each, the samples ``sources`` (sources,) are at
    ``positions``; where they were taken at other times, ``elapsed`` (samples,) has these, s.
    """

    start: float
    interval: float
    time_offset: float = 0.0
    positions: IntArray | None = None
    sources: IntArray | None = None
    elapsed: FloatArray | None = None

    def only(self, rows: IntArray) -> Grid:
        """Return the grid of some samples, (rows,), which include the first and the last."""
        if self.positions is None or self.sources is None:
            return self._replace(positions=rows, sources=np.arange(rows.size))
        has_sample = np.isin(self.sources, rows)
        return self._replace(
            positions=self.positions[has_sample],
            sources=np.searchsorted(rows, self.sources[has_sample]),
            elapsed=None if self.elapsed is None else self.elapsed[rows],
        )

    def filled(self, values: FloatArray) -> FloatArray:
        """Return a column (samples,) at all times of the grid, nan where no sample is.

        Values that were taken a little earlier or later are moved along the column's own slope, by
        central differences. This keeps a branch of a loop, since it is exact for all that is
        linear, and white noise, with up to an eighth more variance at half an interval.
        """
        if self.positions is None:
            return values
        full = np.full(int(self.positions[-1]) + 1, np.nan)
        full[self.positions] = values[self.sources]
        if self.elapsed is not None:
            measured = ~np.isnan(values)
            between = np.interp(self.elapsed, self.elapsed[measured], values[measured])
            slope = np.gradient(between, self.elapsed)[self.sources]
            full[self.positions] += slope * (
                self.interval * self.positions - self.elapsed[self.sources]
            )
        return full


def decimals_of(interval: float) -> int:
    """Return the number of decimals that distinguish the times of neighboring samples."""
    return max(0, -math.floor(math.log10(interval))) if interval > 0 else 9


def clock(time: float, interval: float) -> str:
    """Return a time, s, with the decimals that tell samples an interval, s, apart."""
    return f"{round(float(time), decimals_of(interval)):.15g}"


def time_grid(table: ColumnTable, stamps: FloatArray) -> tuple[ColumnTable, Grid]:
    """Return the grid of a table's times, whose values in s are ``stamps`` (samples,).

    The table is without the samples that repeat others.

    Raises InputError: times are repeated too often or go back, or a gap makes the record too long.
    Warns InputWarning: if samples are missing, or times are repeated or not uniform.
    """
    column = table.values["time"]
    is_float = column.dtype.kind == "f"
    raw = column if is_float else column.astype(np.int64)
    # Count from the first time, so that a clock's times lose no digits. A time above 1e6 s is that
    # of a clock, not of a measurement that counts from its start: the record's times leave it out.
    elapsed = table.convert((raw - raw[0]).astype(np.float64), "time")
    start = float(stamps[0])
    offset = start if abs(start) > 1e6 else 0.0
    steps, samples = np.diff(elapsed), np.arange(elapsed.size)
    interval = float(elapsed[-1]) / steps.size
    # A step below the last bit of the latest time repeats the time before.
    resolution = float(np.abs(elapsed).max() * np.finfo(np.float64).eps)
    for row in np.flatnonzero((steps > 0) & (steps < resolution)):
        elapsed[row + 1] = elapsed[row]
    steps = np.diff(elapsed)
    sample = int(np.argmax(steps < 0))
    times = stamps[sample : sample + 2] - offset
    earlier, later = (f"{clock(time, float(np.abs(steps).mean()))} s" for time in times)
    if steps[sample] < 0:
        problem = f"time goes back from {earlier} to {later}; sort the rows, or cut the file there"
        raise table.error(problem, "time", sample + 1)
    if interval == 0:
        problem = f"all times are {later}; give those of the samples, or `fs=HZ` for them"
        raise table.error(problem, "time")
    require_plausible(table, interval, elapsed.size)
    # Rounding error of a number of the time column in memory, s.
    unit = np.spacing(np.abs(column).max()) if is_float else 0.0
    rounding = float(table.convert(np.array(unit, dtype=np.float64), "time"))
    is_repeat = np.append(False, steps == 0)
    is_copy = is_repeat.copy()
    for values in table.values.values():
        before, after = values[:-1], values[1:]
        is_copy[1:] &= (after == before) | (np.isnan(after) & np.isnan(before))
    # A coarse clock repeats times, but not all other columns with them.
    if is_copy.any() and (is_copy == is_repeat).all():
        table, elapsed = _without_repeats(table, elapsed, start - offset, is_copy)
        stamps, steps, samples = start + elapsed, np.diff(elapsed), np.arange(elapsed.size)
    uniform = _uniform_interval(table, stamps, elapsed, samples, rounding)
    if uniform := uniform or _rounded_interval(table, elapsed):
        return table, Grid(start - offset, uniform, offset)
    if (steps == 0).any():
        table, elapsed = _without_repeats(table, elapsed, start - offset, is_copy)
        stamps = start + elapsed
    positions = _with_gaps(table, np.diff(elapsed))
    if uniform := _uniform_interval(table, stamps, elapsed, positions, rounding):
        if positions[-1] == elapsed.size - 1:
            return table, Grid(start - offset, uniform, offset)
        return table, Grid(start - offset, uniform, offset, positions, np.arange(elapsed.size))
    return table, _nearest_grid(table, elapsed, positions, start - offset, offset)


def require_plausible(table: ColumnTable, interval: float, samples: int) -> None:
    """Refuse an interval, s, that no instrument has, or that makes a record absurdly long."""
    if interval < 1e-10 or interval * samples > 1e12:
        problem = f"a sample every {interval:.3g} s is absurd; check the unit of times, or `fs`"
        raise table.error(problem, "time")


def _without_repeats(
    table: ColumnTable, elapsed: FloatArray, start: float, is_copy: BoolArray
) -> tuple[ColumnTable, FloatArray]:
    """Return a table in which no time is repeated, and its times, s after ``start``.

    Rows that copy the one above, ``is_copy`` (samples,), are left out. Other rows of the same time
    move on or back to times where samples are missing, as if a late logger had written them, or are
    left out.

    Raises InputError: more than one in twenty would be left out.
    Warns InputWarning: always.
    """
    steps = np.diff(elapsed)
    is_repeat = np.append(False, steps == 0)
    rows = np.flatnonzero(~is_copy)
    times, first, of = np.unique(elapsed[rows], return_index=True, return_inverse=True)
    counts = np.bincount(of)
    interval = float(np.median(steps[steps > 0]))
    room = np.rint(np.diff(times) / interval)
    is_late = np.append(room, np.inf) < counts
    # Move back only where the sample before was not repeated: it may need the same time.
    is_early = is_late & (np.append(0, np.where(counts[:-1] > 1, 0, room)) >= counts)
    rank = np.arange(rows.size) - first[of]
    shift = np.where(is_late[of], 0, rank) - np.where(is_early[of], counts[of] - 1 - rank, 0)
    is_left_out = (is_late & ~is_early)[of] & (rank > 0)
    number, sample = int(np.count_nonzero(is_repeat)), int(np.argmax(is_repeat))
    several, time = "s are" if number > 1 else " is", clock(start + elapsed[sample], interval)
    issue = f"{number} time{several} repeated, first {time} s"
    if (lost := int(np.count_nonzero(is_left_out))) > 0.05 * elapsed.size:
        advice = "remove one of two samples, or give `fs=HZ` for the times if none are missing"
        raise table.error(f"{issue}; {advice}", "time", sample)
    kinds = {
        "equal to the row above, left out": int(np.count_nonzero(is_copy)),
        "moved to times without a sample": int(np.count_nonzero(shift)),
        "left out": lost,
    }
    remark = f"{issue}: {', '.join(f'{n} {kind}' for kind, n in kinds.items() if n)}"
    warnings.warn(str(table.error(remark, "time", sample)), InputWarning, stacklevel=6)
    moved = elapsed[rows] + interval * shift
    return table.only(rows[~is_left_out]), moved[~is_left_out]


def _uniform_interval(
    table: ColumnTable,
    stamps: FloatArray,
    elapsed: FloatArray,
    positions: IntArray,
    rounding: float,
) -> float | None:
    """Return the interval, s, of a uniform grid with samples at these positions, or None."""
    interval = float(elapsed[-1] / positions[-1])
    # A time may be off the grid by 1% of the interval, or by what printing rounds off, which moves
    # a time and the grid's ends by half a unit of the last decimal each. A whole unit is already an
    # uneven sample, and 0.4 intervals keep a missing sample apart from rounding.
    printed = 0.0
    for digits in range(3):
        unit = 10.0 ** (math.floor(math.log10(interval)) - digits)
        counts = stamps / unit
        if np.all(np.abs(counts - np.rint(counts)) <= 1e-6 + 1e-15 * np.abs(counts)):
            printed = 0.999 * unit
            break
    tolerance = max(0.01 * interval, min(max(printed, rounding), 0.4 * interval))
    if (np.abs(elapsed - interval * positions) > tolerance).any():
        return _printed_interval(table, elapsed, positions)
    if (stated := _stated_interval(table, elapsed, positions)) is not None:
        return stated
    return _exact_interval(table, interval, tolerance, rounding, int(positions[-1]))


def _stated_interval(table: ColumnTable, elapsed: FloatArray, positions: IntArray) -> float | None:
    """Return the interval, s, of a file's stated rate, if all printed times agree, or None."""
    rate = table.source.stated_rate()
    half = _half_units(np.asarray(table.values["time"], dtype=np.float64))
    if not rate or half is None or "interval_s" in table.notes:
        return None
    half = table.convert(half, "time")
    # A time halfway between two digits is rounded by just half a unit, and by the last bits.
    is_on_it = np.abs(elapsed - positions / rate) <= 1.000001 * (half + half[0])
    return 1 / rate if is_on_it.all() else None


def _printed_interval(table: ColumnTable, elapsed: FloatArray, positions: IntArray) -> float | None:
    """Return the interval, s, of a uniform grid whose times have a fixed number of digits in print.

    With a fixed number of digits, unlike decimals, a later time is rounded to a coarser unit. All
    times lie within half a unit of their last digit, or 1% of the interval, of a line. Where late
    units are longer than 0.8 intervals, early ones have to be short, as coarse times alone would
    hide missing samples.
    """
    half = _half_units(np.asarray(table.values["time"], dtype=np.float64))
    if half is None:
        return None
    steps, interval = int(positions[-1]), float(elapsed[-1] / positions[-1])
    half = np.maximum(table.convert(half, "time"), 0.01 * interval)
    is_even = steps == elapsed.size - 1
    if half.max() > 0.4 * interval and not (
        is_even and np.count_nonzero(half <= 0.1 * interval) >= 10
    ):
        return None
    slopes = _slopes_between(elapsed - half, elapsed + half, positions)
    if slopes is None:
        return None
    if (stated := _stated_interval(table, elapsed, positions)) is not None:
        return stated
    low, high = slopes
    unsure = (high - low) / 2 * steps
    return _exact_interval(table, (low + high) / 2, unsure, unsure / 2, steps, or_rate=True)


def _half_units(values: FloatArray) -> FloatArray | None:
    """Return half a unit of each number's last significant digit, if none has more than 12."""
    # Below the smallest normal numbers there are no digits to count.
    size = np.where(np.abs(values) < 1e-290, 0.0, np.abs(values))
    exponent = np.floor(np.log10(np.where(size > 0, size, 1.0)))
    for digits in range(3, 13):
        unit = 10.0 ** (exponent - digits + 1)
        counts = size / unit
        if np.all(np.abs(counts - np.rint(counts)) <= 1e-6 + 1e-15 * counts):
            return np.where(size > 0, unit / 2, 0.0)
    return None


def _slopes_between(
    lower: FloatArray, upper: FloatArray, positions: IntArray
) -> tuple[float, float] | None:
    """Return the least and the largest slope of the lines between bounds, if there are any.

    The search starts from the slopes at either end of the range that the first and the last bounds
    allow; while two bounds exclude a slope, these two give the next one.
    """
    slopes = []
    for sign, end in (-1, lower[-1] - upper[0]), (1, upper[-1] - lower[0]):
        slope = float(end / positions[-1])
        while True:
            low = int(np.argmax(lower - slope * positions))
            high = int(np.argmin(upper - slope * positions))
            run, rise = float(positions[high] - positions[low]), float(upper[high] - lower[low])
            if rise - slope * run >= -1e-6 * abs(slope):
                break
            if sign * run <= 0:
                return None
            slope = rise / run
        slopes.append(slope)
    return slopes[0], slopes[1]


def _rounded_interval(table: ColumnTable, elapsed: FloatArray) -> float | None:
    """Return the interval, s, of a uniform grid whose times a coarse clock rounded to its ticks.

    Times of whole ticks, about as long as the interval or longer, are within a tick along a line,
    and their steps differ by one tick at most. Missing samples make such times too, if they are
    evenly spread: ten at random, once in 3000.
    """
    steps = np.diff(elapsed)
    shortest = float(steps[steps > 0].min())
    differences = np.diff(np.sort(steps))
    tick = float(np.min(differences[differences > 1e-3 * shortest], initial=shortest))
    counts = steps / tick
    samples = np.arange(elapsed.size)
    _, interval = np.polynomial.polynomial.polyfit(samples, elapsed, 1)
    # Measure about the line nearest to all times: about another one they may be a tenth of a tick
    # wider.
    margin = tick / samples.size
    width = scipy.optimize.minimize_scalar(
        lambda trial: np.ptp(elapsed - trial * samples),
        bounds=(interval - margin, interval + margin),
        method="bounded",
        options={"xatol": 1e-4 * margin},
    ).fun
    is_rounded = width <= 1.001 * tick
    is_whole = np.abs(counts - np.rint(counts)).max() < 1e-3
    others = np.count_nonzero(np.rint(counts) != np.rint(np.median(counts)))
    if not is_rounded or not is_whole or np.ptp(np.rint(counts)) > 1 or others < 10:
        return None
    unsure = 1.5 * tick / math.sqrt(elapsed.size)
    interval = _exact_interval(table, float(interval), tick, unsure, steps.size)
    remark = f"in ticks of {tick:.4g} s; samples are taken as uniform, every {interval:.6g} s"
    warnings.warn(str(table.error(remark, "time")), InputWarning, stacklevel=6)
    return interval


def _nearest_grid(
    table: ColumnTable, elapsed: FloatArray, positions: IntArray, start: float, time_offset: float
) -> Grid:
    """Return the uniform grid nearest to irregular times, s after the first of them.

    All but a few of the ``positions`` (samples,) on the grid are right.
    """
    sources = np.arange(elapsed.size)
    first, interval = np.polynomial.polynomial.polyfit(positions, elapsed, 1)
    elapsed = elapsed - first
    away = np.abs(elapsed - interval * positions)
    if away.max() > 0.4 * interval:
        nearest = np.rint(elapsed / interval).astype(np.int64)
        away = np.abs(elapsed - interval * nearest)
        order = np.lexsort((away, nearest))
        positions, index = np.unique(nearest[order], return_index=True)
        sources = order[index]
    scatter = float(away.max())
    # The interval is as exact as three standard errors of the line's slope.
    unsure = 3 * scatter / math.sqrt(elapsed.size)
    interval = _exact_interval(table, interval, scatter, unsure, int(np.ptp(positions)))
    remark = f"irregular sampling: samples are moved by up to {scatter:.2g} s onto a uniform grid"
    if shared := elapsed.size - sources.size:
        remark += f"; {shared} are left out, where another is nearer to the same time"
    remark = str(table.error(remark, "time", int(np.argmax(away))))
    warnings.warn(remark, InputWarning, stacklevel=6)
    # Round to the digits that resolve a hundredth of an interval.
    begin = round(float(first + interval * positions[0]), decimals_of(interval) + 2)
    moved = elapsed + first - begin
    positions = positions - positions[0]
    return Grid(start + begin, interval, time_offset, positions, sources, moved)


def _with_gaps(table: ColumnTable, steps: FloatArray) -> IntArray:
    """Return the positions of samples separated by these steps, s, some of which may be gaps."""
    gaps = steps > 1.5 * np.median(steps)
    # Divide by the mean of the other steps, in which the rounding of the times averages out.
    counts = np.where(gaps, np.rint(steps / steps[~gaps].mean()), 1.0)
    if counts.sum() >= MAXIMUM_SAMPLES:
        sample = int(np.argmax(steps))
        problem = f"gap of {steps[sample]:.6g} s makes the record too long; cut it there"
        raise table.error(problem, "time", sample + 1)
    return np.concatenate([[0], np.cumsum(counts.astype(np.int64))])


def _exact_interval(
    table: ColumnTable,
    measured: float,
    tolerance: float,
    rounding: float,
    steps: int,
    *,
    or_rate: bool = False,
) -> float:
    """Return the interval that the file declares, if its times agree, or else the roundest one.

    With ``or_rate``, the interval of a round rate counts as round, too.
    """
    text = table.notes.get("interval_s")
    if text is None:
        rate = table.source.stated_rate()
        if rate and abs(1 / rate - measured) <= tolerance / steps:
            return 1 / rate
        # Digits beyond this uncertainty come from the rounding of the first and the last time, of
        # half a unit each.
        unsure = max(rounding / steps, 5e-13 * measured)
        rounded = []
        for digits in range(1, 13):
            rounded += [float(f"{measured:.{digits}g}")]
            rounded += [1 / float(f"{1 / measured:.{digits}g}")] * or_rate
        return next((value for value in rounded if abs(value - measured) <= unsure), rounded[-1])
    try:
        declared = float(text)
    except ValueError:
        declared = math.nan
    if not (declared > 0 and abs(declared - measured) <= tolerance / steps):
        problem = f"interval_s {text!r} contradicts the time column, {measured:.9g} s"
        raise table.error(f"{problem}; remove or correct it")
    return declared


def is_smooth(values: FloatArray, positions: IntArray, missing: int) -> bool:
    """Tell whether a polynomial across ``missing`` values is right where none are missing.

    The polynomial is fitted to as many values on either side, and one more; it is right if its
    error in the middle is at most 1% of the range.
    """
    width = 3 * missing + 2
    if width > values.size:
        return False
    powers = np.vander(np.arange(width) / width - 0.5, min(6, 2 * missing + 2))
    is_inside = (np.arange(width) > missing) & (np.arange(width) <= 2 * missing)
    error = np.zeros(width)
    error[~is_inside] = -powers[width // 2] @ np.linalg.pinv(powers[~is_inside])
    error[width // 2] = 1.0
    errors = scipy.signal.oaconvolve(values - values[0], error[::-1], mode="valid")
    errors = errors[positions[width - 1 :] - positions[: values.size - width + 1] == width - 1]
    return errors.size > 0 and bool(np.abs(errors).max() <= 0.01 * np.ptp(values))
