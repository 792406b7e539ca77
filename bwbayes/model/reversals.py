"""A drive's own turns, times and speeds, whatever the sampling rate.

The voltage alone decides: a record and its every k-th sample have the same turning points. Noise on
a measured voltage makes none, because a turn counts only where the voltage comes back by a part of
its range.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray

# Part of the range by which the voltage must come back for a turn to count. A sensor's noise and a
# DAC's steps are well below it; the smallest loops of a decaying drive do not matter for a scale.
RETURN = 0.05

# Elements (models x samples) that one array expression handles: small enough for the cache.
PIECE = 65_536


class Stretch(NamedTuple):
    """Samples ``first`` to ``last`` (both included), along which the voltage goes one way."""

    first: int
    last: int
    direction: float


def monotone_stretches(voltage: FloatArray, longest: int | None = None) -> Iterator[Stretch]:
    """Cut a voltage (samples,) where it turns; each stretch starts at the last one's end.

    A plateau belongs to the stretch that leads to it. ``longest`` also cuts stretches of more
    samples than that, which changes nothing: the state at the cut carries over.
    """
    steps = np.sign(np.diff(voltage))
    moving = np.flatnonzero(steps)
    direction = float(steps[moving[0]]) if moving.size else 1.0
    # The voltage turns at these samples: the step from there on goes the other way.
    turns = moving[1:][np.diff(steps[moving]) != 0]
    ends = [*turns.tolist(), voltage.size - 1]
    for start, end in zip([0, *ends[:-1]], ends, strict=True):
        size = longest or max(end - start, 1)
        for first in range(start, end, size):
            yield Stretch(first, min(first + size, end), direction)
        direction = -direction


def turning_points(voltage: FloatArray, threshold: float | None = None) -> IntArray:
    """Return the samples (turns,) at which a voltage (samples,) turns by ``threshold`` V or more.

    By default a twentieth of the voltage's range.
    """
    threshold = RETURN * float(np.ptp(voltage)) if threshold is None else threshold
    if not threshold > 0:
        return np.array([], dtype=np.int64)
    # Only where the voltage turns at all can it turn by that much.
    ends = [stretch.last for stretch in monotone_stretches(voltage)]
    turns: list[int] = []
    direction, furthest = 1.0, 0
    for end, reached in zip(ends, voltage[ends].tolist(), strict=True):
        back = direction * (voltage[furthest] - reached)
        if back <= 0:
            furthest = end
        elif back >= threshold:
            turns.append(furthest)
            direction, furthest = -direction, end
    # A voltage that goes down first has turned nowhere yet.
    return np.array([turn for turn in turns if turn > 0], dtype=np.int64)


def time_between_turns(
    voltage: FloatArray, interval: float, windows: Sequence[slice] = (slice(None),)
) -> float:
    """Return the typical time between turning points, s: of a sine, half its period.

    For half of the time, the voltage is on a stretch that takes this long or longer; so a long rest
    before the drive does not count for more than it lasts. The borders of ``windows`` of a record
    cut stretches too. At rest, or without a turn, it is the length of the (longest) window.
    """
    threshold = RETURN * float(np.ptp(np.concatenate([voltage[window] for window in windows])))
    stretches = []
    for window in windows:
        segment = voltage[window]
        edges = np.concatenate([[0], turning_points(segment, threshold), [segment.size - 1]])
        stretches.append(np.diff(edges) * interval)
    times = np.sort(np.concatenate(stretches))
    times = times[times > 0]
    if times.size == 0:
        return interval
    passed = np.cumsum(times)
    return float(times[np.searchsorted(passed, passed[-1] / 2)])


def rate(voltage: FloatArray, interval: float) -> FloatArray:
    """Return how fast the voltage changes at each sample, (samples,), V/s.

    A measured voltage is noisy, and its change noisier: it is smoothed over a five-hundredth of
    the record.
    """
    slow = scipy.ndimage.uniform_filter1d(voltage, max(1, voltage.size // 500), mode="nearest")
    change: FloatArray = np.gradient(slow, interval) if slow.size > 1 else np.zeros_like(slow)
    return change


def fastest(
    voltage: FloatArray, interval: float, over: float, windows: Sequence[slice] = (slice(None),)
) -> float:
    """Return the largest speed, V/s, at which the voltage moves for ``over`` s (a sample, if less).

    A mean over that time, so that a measured voltage's noise counts for little.
    """
    lag = max(round(over / interval), 1)
    moved = [np.abs(v[lag:] - v[:-lag]) for v in (voltage[w] for w in windows) if v.size > lag]
    return max([float(np.max(movement)) for movement in moved], default=0.0) / (lag * interval)
