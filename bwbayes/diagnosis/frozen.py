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

__all__ = ["Stuck", "clipped", "held", "repeated"]


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

    A sensor whose steps are finer than its noise hardly ever repeats itself, in 2 % of its
    readings at most: then all readings of the largest value count. A coarse one repeats it at rest,
    where the other column stands still: only runs count in which its quartiles lie apart, by 1 % of
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
        moving = _quartile_distances(other[at_top], lengths) > travel
        enough = _enough(first, first + lengths - 1, (lengths >= 5) & moving)
    if enough is None or enough.samples <= 3 * np.count_nonzero(values == levels[-2]):
        return None
    return enough


def held(voltage: FloatArray, displacement: FloatArray) -> Stuck | None:
    """Return where readings (samples,) are held while the voltage moves, and then jump.

    A coarse sensor repeats itself where it moves slowly, and goes on by a step or two; one that is
    held goes on as it came, by all that it has missed. One run of twenty samples is enough, of
    shorter ones more than chance makes.
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
    """Return the runs that are stuck if these are ten samples in all, enough to say so."""
    runs_stuck = Stuck(first[stuck], last[stuck])
    return runs_stuck if runs_stuck.samples >= 10 else None


def _quartile_distances(values: FloatArray, lengths: IntArray) -> FloatArray:
    """Return third less first quartile of every run, where `values` holds run after run."""
    run = np.repeat(np.arange(lengths.size), lengths)
    ordered = values[np.lexsort((values, run))]
    first = np.cumsum(lengths) - lengths
    distances: FloatArray = ordered[first + 3 * lengths // 4] - ordered[first + lengths // 4]
    return distances
