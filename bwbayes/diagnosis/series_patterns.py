"""Patterns in a series of numbers: runs, spikes, and held values.

Repeated values are normal where nothing moves, and where a sensor is coarse. A value is not normal
if it stays at the end of a range while the other column moves on, or if it is held and then jumps
by the change it has missed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray, IntArray

# Number of samples in the median to compare a spike with: two neighboring samples are still one.
NEIGHBORS = 5


def runs(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the first index and the length of every run of true values."""
    edges = np.diff(mask.astype(np.int8), prepend=0, append=0)
    first = np.flatnonzero(edges == 1)
    return first, np.flatnonzero(edges == -1) - first


def scatter(values: FloatArray) -> float:
    """Return the sd of values about their median, robust against a minority of outliers."""
    # A normal distribution's sd is 1.4826 times its median absolute deviation.
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def spikes(values: FloatArray, drive: FloatArray, threshold: float) -> IntArray:
    """Return the samples of isolated outliers in values (samples,).

    A spike is one or two samples that lie off the median of their neighborhood by eight times the
    usual scatter, and by ``threshold``; an edge or a reversal does not. If `drive` (samples,), in
    the values' unit, has a spike nearby, a spike of up to twice its size is allowed.
    """
    off, own_scatter = (
        series - scipy.ndimage.median_filter(series, NEIGHBORS, mode="mirror")
        for series in (values, drive)
    )
    allowed = 2 * scipy.ndimage.maximum_filter1d(np.abs(own_scatter), 2 * NEIGHBORS + 1)
    spread = scatter(off[off != 0]) if np.any(off) else 0.0
    limit = max(8 * spread, threshold) + allowed
    suspects = np.flatnonzero(np.abs(off) > limit)
    # A spike moves its neighbors' medians, too. Take the largest first, and replace it by a
    # straight line before testing the next.
    half = NEIGHBORS // 2
    padded = np.pad(values, half, mode="reflect")
    isolated = np.zeros(padded.size, dtype=np.bool_)
    for at in suspects[np.argsort(-np.abs(off[suspects]), kind="stable")] + half:
        local_median = np.sort(padded[at - half : at + half + 1])[half]
        if abs(padded[at] - local_median) > limit[at - half]:
            isolated[at] = True
            before = after = at
            while isolated[before]:
                before -= 1
            while isolated[after]:
                after += 1
            padded[before : after + 1] = np.linspace(
                padded[before], padded[after], after - before + 1
            )
    return np.flatnonzero(isolated[half:])


def lasting_jumps(
    values: FloatArray, drive: FloatArray, adjacent: BoolArray, threshold: float
) -> IntArray:
    """Return the samples at which values (samples,) jump, and stay for longer than a spike does.

    A jump is a spike of the differences (samples - 1,) that are `adjacent`, of at least twice the
    largest spike in those of `drive` anywhere, since values may be late. The medians of the samples
    before it and from it on have to differ, too.
    """
    moved, pushed = (np.where(adjacent, np.diff(series), 0.0) for series in (values, drive))
    pushed -= scipy.ndimage.median_filter(pushed, NEIGHBORS, mode="mirror")
    threshold = max(threshold, 2 * float(np.max(np.abs(pushed))))
    at = spikes(moved, np.zeros(moved.size), threshold) + 1
    half = NEIGHBORS // 2
    # Keep jumps with enough samples for a median on either side.
    at = at[(at >= NEIGHBORS) & (at <= values.size - NEIGHBORS)]
    medians = scipy.ndimage.median_filter(values - drive, NEIGHBORS, mode="nearest")
    return at[2 * np.abs(medians[at + half] - medians[at - half - 1]) > np.abs(moved[at - 1])]


class Line(NamedTuple):
    """A line of a spectrum: its frequency, Hz, and a source of that frequency in words, or "".

    It ``is_steady`` if it goes on where the drive rests, instead of growing with it.
    """

    frequency: float
    source: str
    is_steady: bool = False


def strongest_line(
    white: FloatArray, drive: FloatArray, rows: IntArray, interval: float
) -> Line | None:
    """Return the strongest line of innovations (readings,) at ``rows`` that the drive lacks.

    An error of the loop shows at harmonics of the drive (readings,), which rise and fall slowly
    with their order: a line is stronger than any two of them on either side, and may lie on one.
    """
    samples = int(rows[-1]) + 1
    values = np.zeros((2, samples))
    values[:, rows] = white, drive - np.mean(drive)
    power = np.abs(np.fft.rfft(values * np.hanning(samples), 4 * samples)) ** 2
    frequency = np.fft.rfftfreq(4 * samples, interval)
    main = int(np.argmax(power[1]))
    strongest = scipy.ndimage.maximum_filter1d(power[0], 5 * main + 1)
    lines = (power[0] == strongest) & (np.arange(frequency.size) >= 3 * main)
    best = float(frequency[int(np.argmax(lines * power[0]))])
    if not best:
        return None
    # Compare a line of constant size with one in proportion to the drive's swing, by their nats.
    span = round(1 / (interval * max(frequency[main], frequency[1])))
    swing = scipy.ndimage.maximum_filter1d(values[1], span)
    swing = (swing - scipy.ndimage.minimum_filter1d(values[1], span))[rows]
    turned = white * np.exp(2j * np.pi * best * interval * rows)
    steady, swelling = (
        abs(size @ turned) ** 2 / max(size @ size, np.finfo(float).tiny)
        for size in (np.ones(rows.size), swing)
    )
    is_steady = bool(steady > swelling + np.log(20))
    # Tolerance: mains are right to a fifth of a percent; half a line's width under the window.
    width = max(2e-3 * best, 2 / (interval * max(samples - 1 - int(rows[0]), 1)))
    for mains in (50, 60):
        harmonic = round(best / mains)
        if 1 <= harmonic <= 10 and abs(best - harmonic * mains) <= width:
            times = "" if harmonic == 1 else f"{harmonic} times "
            return Line(best, f" (mains: {times}{mains} Hz)", is_steady)
    return Line(best, "", is_steady)


class FrozenRun(NamedTuple):
    """Runs of samples that are stuck: the first and the last sample of each, (runs,)."""

    first: IntArray
    last: IntArray

    @property
    def samples(self) -> int:
        """Number of samples that are stuck."""
        return int((self.last - self.first + 1).sum())

    @property
    def length(self) -> int:
        """Usual number of samples in a run."""
        return int(np.median(self.last - self.first + 1))


def find_clipped(values: FloatArray, other: FloatArray) -> FrozenRun | None:
    """Return the runs of values (samples,) at their largest while the other column moves on.

    A sensor whose steps are finer than its noise hardly ever repeats itself, in 2% of its
    readings at most: then all readings of the largest value count. A coarse one repeats it at rest,
    where the other column stands still: only runs count in which its quartiles lie apart, by 1% of
    its range and by what three steps of the sensor are worth. And at a smooth peak: a parabola
    stays at its top level up to 2.4 times as long as at the next, a clipped one longer.
    """
    levels = np.unique(values)
    if levels.size < 3:
        return None
    at_top = values == levels[-1]
    first, lengths = runs(at_top)
    if np.mean(np.diff(values)[~(at_top[1:] & at_top[:-1])] == 0) < 0.02:
        enough = _enough(first, first + lengths - 1, np.full(first.size, np.ptp(other[at_top]) > 0))
    else:
        resolution = float(np.diff(levels).min() / (levels[-1] - levels[0]))
        travel = max(0.01, 3 * resolution) * float(np.ptp(other))
        ordered = [np.sort(other[f : f + n]) for f, n in zip(first, lengths, strict=True)]
        moving = [run[3 * run.size // 4] - run[run.size // 4] > travel for run in ordered]
        enough = _enough(first, first + lengths - 1, (lengths >= 5) & np.array(moving))
    if enough is None or enough.samples <= 3 * np.count_nonzero(values == levels[-2]):
        return None
    return enough


def find_held(voltage: FloatArray, displacement: FloatArray) -> FrozenRun | None:
    """Return the runs of readings (samples,) that are held while the voltage moves, and then jump.

    A coarse sensor repeats itself where it moves slowly, and goes on by a step or two; a held one
    goes on in its direction, by all the change it has missed. One run of twenty samples is enough;
    shorter runs have to be more than chance makes.
    """
    moved = np.diff(displacement)
    if not np.any(moved):
        return None
    same = np.concatenate([[False], moved == 0])
    first, lengths = runs(same)
    first, lengths = first - 1, lengths + 1
    inside = (first > 0) & (first + lengths < displacement.size)
    first, lengths = first[inside], lengths[inside]
    if not first.size:
        return None
    last = first + lengths - 1
    before, after = moved[first - 1], moved[last]
    sizes = np.abs(moved[moved != 0])
    step = max(float(sizes.min()), 0.05 * float(np.median(sizes)))
    drive = np.array([np.ptp(voltage[f : e + 1]) for f, e in zip(first, last, strict=True)])
    moves = drive > 1e-4 * float(np.ptp(voltage))
    stuck = _jumps(before, after, step) & moves
    # A noisy reading comes twice by chance, half as often as it goes on by one step up or down.
    near = np.flatnonzero((moved[1:-1] != 0) & (np.abs(moved[1:-1]) < 1.5 * step)) + 1
    chance = np.count_nonzero(_jumps(moved[near - 1], moved[near + 1], step)) / 2
    if np.count_nonzero(stuck) < 3 * chance + 5 and not np.any(lengths[stuck] >= 20):
        return None
    if lengths[stuck].sum() < 0.005 * displacement.size:
        return None
    return _enough(first, last, stuck)


def _jumps(before: FloatArray, after: FloatArray, step: float) -> BoolArray:
    """Tell where values go on in their direction, by more than four steps of the sensor."""
    result: BoolArray = (before * after > 0) & (
        np.minimum(np.abs(before), np.abs(after)) > 4 * step
    )
    return result


def find_repeated(voltage: FloatArray, displacement: FloatArray) -> FrozenRun | None:
    """Return the runs of repeated samples after which both columns continue as if without a pause.

    The voltage (samples,) then jumps by as many of its steps as samples were repeated; the voltage
    of a staircase does not.
    """
    steps = np.diff(voltage)
    same = np.concatenate([[False], (steps == 0) & (np.diff(displacement) == 0)])
    first, lengths = runs(same)
    inside = (first > 1) & (first + lengths < voltage.size - 1)
    first, lengths = first[inside], lengths[inside]
    if not first.size:
        return None
    last = first + lengths - 1
    # A step before, the jump at the end of the run, and a step after it.
    before, jump, after = steps[first - 2], steps[last], steps[last + 1]
    expected = (before + after) / 2 * (lengths + 1)
    stuck = (np.abs(jump - expected) < 0.4 * np.abs(expected)) & (before * after > 0)
    return _enough(first, last, stuck)


def copies(voltage: FloatArray, displacement: FloatArray) -> int:
    """Return how many times in a row every sample (samples,) is written, both columns alike.

    Then at least 19 of 20 changes of the columns lie on a grid of that many samples.
    """
    changes = np.flatnonzero((np.diff(voltage) != 0) | (np.diff(displacement) != 0))
    if changes.size < 20:
        return 1
    times = int(np.bincount(np.diff(changes)).argmax())
    in_step = int(np.bincount(changes % times).max())
    return times if in_step >= 0.95 * changes.size else 1


def resolution(values: FloatArray) -> float:
    """Return the smallest distance of two levels of values (samples,), as a part of their range.

    Numbers that agree to nine digits of the range count as one level.
    """
    levels = np.unique(np.round((values - values.min()) / (np.ptp(values) or 1.0), 9))
    return float(np.diff(levels).min()) if levels.size > 1 else 0.0


def moves_between(voltage: FloatArray, displacement: FloatArray) -> bool:
    """Tell whether a displacement (samples,) moves on while the voltage stays at its levels.

    If it does, it moves as fast before each jump as on average. Along a staircase it has settled by
    then: behind a lag of half a hold, its speed in a hold's second half is 0.54 of the average.
    """
    jumps = np.flatnonzero(np.diff(voltage)) + 1
    if jumps.size < 5:
        return False
    middles = (jumps[:-1] + jumps[1:]) // 2
    last, direction = jumps[1:-1] - 1, np.sign(np.diff(voltage)[jumps[1:-1] - 1])
    motion, samples = direction @ np.diff(displacement[middles]), np.diff(middles).sum()
    before = direction @ (displacement[last] - displacement[middles[:-1]])
    return bool(before * samples > 0.65 * motion * (last - middles[:-1]).sum() > 0)


def _enough(first: IntArray, last: IntArray, stuck: BoolArray) -> FrozenRun | None:
    """Return the stuck runs if they have ten samples in all, the least that is significant."""
    runs_stuck = FrozenRun(first[stuck], last[stuck])
    return runs_stuck if runs_stuck.samples >= 10 else None
