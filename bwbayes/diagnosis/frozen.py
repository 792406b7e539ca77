"""Numbers that stay where they are: sensors at the end of their range, and readings that are held.

Repeated values are normal where nothing moves, and where a sensor is coarse. What is not normal is
a value that stays at the end of a range while the other column moves on, and one that is held and
then jumps by what it has missed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.diagnosis.series_patterns import runs

__all__ = ["SHORTEST_AT_END", "Stuck", "clipped", "clipped_drive", "held", "repeated"]

SHORTEST_AT_END = 5  # samples in a row at the end of a range
LEAST_FALL = 0.25  # of what follows a run, in its last quarter
LEAST_OF_RANGE = 0.01
MOST_REPEATED = 0.02  # of the readings of a sensor whose noise is larger than its steps
FEWEST = 10  # samples that are stuck, in all
LEAST_PART = 0.005  # of the samples
LONG_ENOUGH = 20  # samples in a row, of which one run is enough


class Stuck(NamedTuple):
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


def clipped(values: FloatArray, other: FloatArray) -> Stuck | None:
    """Return where values (samples,) stay at their largest while the other column moves on.

    A sensor whose steps are finer than its noise hardly ever repeats itself: then all readings of
    the largest value count. A coarse one repeats it in two ways that are harmless. At rest the
    other column stands still: only runs count in which its quartiles lie apart, by 1 % of its range
    and by what three steps of the sensor are worth. At a smooth peak the next level lasts as well:
    a parabola stays at its top level up to 2.4 times as long as at the next, a clipped one longer.
    """
    levels = np.unique(values)
    if levels.size < 3:
        return None
    at_top = values == levels[-1]
    first, lengths = runs(at_top)
    if np.mean(np.diff(values)[~(at_top[1:] & at_top[:-1])] == 0) < MOST_REPEATED:
        enough = _enough(first, first + lengths - 1, np.full(first.size, np.ptp(other[at_top]) > 0))
    else:
        resolution = float(np.diff(levels).min() / (levels[-1] - levels[0]))
        travel = max(0.01, 3 * resolution) * float(np.ptp(other))
        moving = _quartile_distances(other[at_top], lengths) > travel
        enough = _enough(first, first + lengths - 1, (lengths >= SHORTEST_AT_END) & moving)
    if enough is None or enough.samples <= 3 * np.count_nonzero(values == levels[-2]):
        return None
    return enough


def clipped_drive(values: FloatArray, other: FloatArray, usual: float) -> Stuck | None:
    """Return where a voltage stays at its largest while the displacement turns and goes back.

    Behind a voltage that really rests the displacement may lag and creep, but it does not fall
    before the voltage does. Here it must, in the last quarters of the runs and on the whole, by a
    part of what it falls by in the same time after them: more than it scatters by from run to run,
    or than its unexplained part, of sd `usual`, would.
    """
    first, lengths = runs(values == values.max())
    last = first + lengths - 1
    quarter, shortest = lengths // 4, lengths // 8 + 1
    whole = (lengths >= SHORTEST_AT_END) & (last + quarter < values.size)
    if not whole.any():
        return None
    first, last, quarter, shortest = (each[whole] for each in (first, last, quarter, shortest))
    sums = np.concatenate([[0.0], np.cumsum(other)])
    before, end, after = (
        (sums[at + 1] - sums[at + 1 - shortest]) / shortest
        for at in (last - quarter, last, last + quarter)
    )
    falls, count = before - end, last.size
    sure = falls.sum() > 4 * usual * np.sqrt(count)
    if count >= 6:
        sure |= falls.mean() > 4 * falls.std(ddof=1) / np.sqrt(count)
    lowest_fall = max(
        LEAST_FALL * float((end - after).sum()), LEAST_OF_RANGE * float(np.ptp(other))
    )
    if not sure or falls.sum() < lowest_fall:
        return None
    return _enough(first, last, np.ones(count, dtype=np.bool_))


def held(voltage: FloatArray, displacement: FloatArray) -> Stuck | None:
    """Return where readings (samples,) are held while the voltage moves, and then jump.

    A sensor with coarse steps repeats itself where it moves slowly, and goes on by a step or two;
    one that is held goes on by all that it has missed, on the same side as it came from.
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
    if np.count_nonzero(stuck) < 3 * chance + 5 and not np.any(lengths[stuck] >= LONG_ENOUGH):
        return None
    if lengths[stuck].sum() < LEAST_PART * displacement.size:
        return None
    return _enough(first, last, stuck)


def _jumps(before: FloatArray, after: FloatArray, step: float) -> BoolArray:
    """Tell where values go on as they came, by more than four steps of the sensor."""
    result: BoolArray = (before * after > 0) & (
        np.minimum(np.abs(before), np.abs(after)) > 4 * step
    )
    return result


def repeated(voltage: FloatArray, displacement: FloatArray) -> Stuck | None:
    """Return where whole samples are repeated and what follows has gone on without them.

    The voltage (samples,) then jumps by as many of its steps as samples were repeated; that of a
    staircase does not.
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


def _enough(first: IntArray, last: IntArray, stuck: BoolArray) -> Stuck | None:
    """Return the runs that are stuck if these are enough samples to say so."""
    runs_stuck = Stuck(first[stuck], last[stuck])
    return runs_stuck if runs_stuck.samples >= FEWEST else None


def _quartile_distances(values: FloatArray, lengths: IntArray) -> FloatArray:
    """Return third less first quartile of every run, where `values` holds run after run."""
    run = np.repeat(np.arange(lengths.size), lengths)
    ordered = values[np.lexsort((values, run))]
    first = np.cumsum(lengths) - lengths
    distances: FloatArray = ordered[first + 3 * lengths // 4] - ordered[first + lengths // 4]
    return distances
