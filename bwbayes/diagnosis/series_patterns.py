"""Shapes in a series of numbers: runs and spikes."""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray, IntArray

__all__ = ["find_gross_outliers", "runs", "scatter", "spikes"]

# Samples in the median that a spike is held against: two beside each other are a spike still.
NEIGHBORS = 5


def runs(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the first index and the length of every run of true values."""
    edges = np.diff(mask.astype(np.int8), prepend=0, append=0)
    first = np.flatnonzero(edges == 1)
    return first, np.flatnonzero(edges == -1) - first


def scatter(values: FloatArray) -> float:
    """Return the sd of values about their median, whatever a minority of them is."""
    # A normal distribution's sd is 1.4826 times its median absolute deviation.
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def spikes(
    values: FloatArray,
    drive: FloatArray | None = None,
    least: float = 0.0,
    *,
    ends: bool = False,
) -> IntArray:
    """Return the samples of isolated outliers in values (samples,).

    A spike is one or two samples that lie off the median of their neighborhood by eight times what
    is usual, and by `least`; an edge or a turn does not. Where `drive` (samples,), in the values'
    unit, has a spike of its own nearby, the values may have one of twice its size. With `ends` the
    first and the last value may be spikes too, though a fast transient begins like one.
    """
    off = _off_median(values, ends)
    allowed = np.zeros_like(values)
    if drive is not None:
        allowed = 2 * scipy.ndimage.maximum_filter1d(
            np.abs(_off_median(drive, ends)), 2 * NEIGHBORS + 1
        )
    usual = scatter(off[off != 0]) if np.any(off) else 0.0
    limit = max(8 * usual, least) + allowed
    suspects = np.flatnonzero(np.abs(off) > limit)
    # A spike moves its neighbors' medians too. The largest comes first, and a straight line takes
    # its place before the next is judged.
    half = NEIGHBORS // 2
    rest = np.pad(values, half, mode="reflect" if ends else "edge")
    isolated = np.zeros(rest.size, dtype=np.bool_)
    for at in suspects[np.argsort(-np.abs(off[suspects]), kind="stable")] + half:
        middle = np.sort(rest[at - half : at + half + 1])[half]
        if abs(rest[at] - middle) > limit[at - half]:
            isolated[at] = True
            before = after = at
            while isolated[before]:
                before -= 1
            while isolated[after]:
                after += 1
            rest[before : after + 1] = np.linspace(rest[before], rest[after], after - before + 1)
    return np.flatnonzero(isolated[half:])


def find_gross_outliers(values: FloatArray, drive: FloatArray) -> IntArray:
    """Return the samples of isolated values (samples,) that are far off the range of all others.

    They lie off the line of least absolute deviations through `values` over `drive` (samples,),
    which a minority does not move, by more than twice the range of that line and of the central
    80% of the residuals: no actuator's hysteresis, lag, creep or ringing does. Ranges and fits are
    to be taken without them.
    """
    line = np.stack([np.ones_like(drive), drive - drive.mean()])
    weights = np.ones_like(values)
    for _ in range(30):
        # Sums, without the threads of a linear algebra library.
        products = np.einsum("in,n,jn->ij", line, weights, line)
        pulls = np.einsum("in,n,n->i", line, weights, values)
        coefficients = np.linalg.lstsq(products, pulls)[0]
        off = np.abs(values - coefficients @ line)
        weights = 1 / np.maximum(off, 1e-6 * max(float(np.median(off)), 1e-300))
        weights /= weights.max()
    low, high = np.quantile(values - coefficients @ line, (0.1, 0.9))
    far = off > 2 * (abs(coefficients[1]) * np.ptp(drive) + high - low)
    first, length = runs(far)
    short = length <= NEIGHBORS // 2
    gross: IntArray = np.union1d(first[short], (first + length - 1)[short])
    return gross


def _off_median(values: FloatArray, ends: bool) -> FloatArray:
    mode: Literal["mirror", "nearest"] = "mirror" if ends else "nearest"
    off: FloatArray = values - scipy.ndimage.median_filter(values, NEIGHBORS, mode=mode)
    return off
