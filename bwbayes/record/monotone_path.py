"""The path between the real reversals of a voltage with white noise.

1. Local quadratics over windows of 4, 8, 16, ... samples to the left, to the right and around each
   sample, each as long as the intervals of all windows so far intersect (Goldenshluger and
   Nemirovski, Math. Methods Stat. 6 (1997) 135; Katkovnik, IEEE Trans. Signal Process. 47 (1999)
   2567), joined by their precision. Where the sides contradict each other, the sd grows.
2. A reversal is real if it goes beyond √(2 ln n), the largest of n normal deviates, times the sds
   of the two samples that it is between.
3. Between reversals the path is the isotonic regression of the fits. The samples about an extreme
   that their mean describes become this mean, or a parabola, where that is the more certain.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, sqrt

import numpy as np
from scipy.optimize import isotonic_regression

from bwbayes.arrays import BoolArray, FloatArray, IntArray

# Half widths, in sds, of the windows' intervals that have to intersect, and the largest distance of
# the mean of the samples about an extreme from the outermost of them.
WITHIN, ABOUT = 1.5, 3.0


@dataclass(frozen=True)
class MonotonePath:
    """A path (samples,), V, its number of reversals, and an upper bound of its length's sd, V."""

    path: FloatArray
    reversals: int
    length_sd: float


def fit_path(voltage: FloatArray, noise_sd: float) -> MonotonePath:
    """Return the path of a voltage (samples,), V, with white noise of a known sd, V."""
    fits, sd, agreeing_sd = _local_fits(voltage, noise_sd)
    extrema, first_is_top = _real_reversals(fits, sqrt(2 * log(voltage.size)) * sd)
    weights = 1 / sd**2
    path = _monotone(fits, extrema, first_is_top, weights)
    path = _leveled(voltage, path, noise_sd, agreeing_sd, extrema, first_is_top)
    path = _monotone(path, extrema, first_is_top, weights)
    return MonotonePath(path, extrema.size, float(2 * np.sum(agreeing_sd[extrema])))


class _Side:
    """The local fits (samples,) of windows to one side, as long as their intervals intersect."""

    def __init__(self, voltage: FloatArray, noise_sd: float) -> None:
        self.fit = voltage.copy()
        self.variance = np.full(voltage.size, noise_sd**2)
        self.low, self.high = voltage - WITHIN * noise_sd, voltage + WITHIN * noise_sd
        self.open = np.ones(voltage.size, dtype=np.bool_)

    def lengthen(self, samples: slice, fit: FloatArray, variance: float) -> bool:
        """Take the fits of longer windows, where they agree; return whether any does."""
        low = np.maximum(self.low[samples], fit - WITHIN * sqrt(variance))
        high = np.minimum(self.high[samples], fit + WITHIN * sqrt(variance))
        agrees: BoolArray = self.open[samples] & (low <= high)
        self.open[:] = False
        self.open[samples], self.low[samples], self.high[samples] = agrees, low, high
        self.fit[samples] = np.where(agrees, fit, self.fit[samples])
        self.variance[samples] = np.where(agrees, variance, self.variance[samples])
        return bool(agrees.any())


def _local_fits(voltage: FloatArray, noise_sd: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return fits (samples,) to a voltage, their sds, and the sds if both sides agree, V.

    A window of m samples has the orthogonal polynomials 1, x and x² − q about its center, whose
    coefficients are sums of u, j u and j² u over it: those of two windows of half its length.
    """
    sides = [_Side(voltage, noise_sd) for _ in range(3)]
    sum0, sum1, sum2 = voltage, np.zeros(voltage.size), np.zeros(voltage.size)
    m, lengthened = 1, True
    while lengthened and 2 * m <= voltage.size:
        windows = sum0.size - m
        sum2 = sum2[:windows] + sum2[m:] + 2 * m * sum1[m:] + m * m * sum0[m:]
        sum1 = sum1[:windows] + sum1[m:] + m * sum0[m:]
        sum0 = sum0[:windows] + sum0[m:]
        m *= 2
        if m < 4:
            continue
        center, quadratic = (m - 1) / 2, m >= 8
        norm1, q = m * (m * m - 1) / 12, (m * m - 1) / 12
        norm2 = m * (m * m - 1) * (m * m - 4) / 180
        mean, slope = sum0 / m, (sum1 - center * sum0) / norm1
        bend = (sum2 - 2 * center * sum1 + (center**2 - q) * sum0) / norm2
        lengthened = False
        for side, at in zip(sides, (0, m - 1, m // 2) if quadratic else (0, m - 1), strict=False):
            x = at - center
            fit, variance = mean + slope * x, 1 / m + x * x / norm1
            if quadratic:
                fit, variance = fit + bend * (x * x - q), variance + (x * x - q) ** 2 / norm2
            samples = slice(at, at + windows)
            lengthened |= side.lengthen(samples, fit, noise_sd**2 * variance)
    weight = sum(1 / side.variance for side in sides)
    fits = sum(side.fit / side.variance for side in sides) / weight
    apart = sum((side.fit - fits) ** 2 / side.variance for side in sides) / weight
    min_variance = np.minimum.reduce([side.variance for side in sides])
    return fits, np.sqrt(min_variance + apart), np.sqrt(min_variance)


def _real_reversals(fits: FloatArray, margin: FloatArray) -> tuple[IntArray, bool]:
    """Return the samples of the real reversals, and whether the first is a maximum: see step 2.

    The first of them is the extreme at which the path begins.
    """
    reached_above, reached_below = (fits - margin).tolist(), (fits + margin).tolist()
    reversals: list[int] = []
    top = bottom = direction = 0
    first_is_top = False
    for i in range(1, fits.size):
        if direction >= 0 and reached_above[i] > reached_above[top]:
            top = i
        if direction <= 0 and reached_below[i] < reached_below[bottom]:
            bottom = i
        if direction <= 0 and reached_above[i] > reached_below[bottom]:
            reversals.append(bottom)
            direction, top = 1, i
        elif direction >= 0 and reached_below[i] < reached_above[top]:
            first_is_top = first_is_top or not reversals
            reversals.append(top)
            direction, bottom = -1, i
    return np.array(reversals, dtype=np.int64), first_is_top


def _monotone(
    path: FloatArray, extrema: IntArray, first_is_top: bool, weights: FloatArray
) -> FloatArray:
    """Return the weighted isotonic regression of a path between its extrema."""
    if not extrema.size:
        return np.full_like(path, np.average(path, weights=weights))
    result, rising, start = np.empty_like(path), first_is_top, 0
    for end in [*extrema.tolist(), path.size - 1]:
        # Each extreme belongs to the branch behind it.
        branch = slice(start, end + 1)
        fitted = isotonic_regression(path[branch], weights=weights[branch], increasing=rising)
        result[branch] = fitted.x
        rising, start = not rising, end
    return result


def _leveled(
    voltage: FloatArray,
    path: FloatArray,
    noise_sd: float,
    sd: FloatArray,
    extrema: IntArray,
    first_is_top: bool,
) -> FloatArray:
    """Return a path with the samples about each extreme at one level or a parabola: see step 3."""
    result, is_top = path.copy(), first_is_top
    bounds = np.concatenate([[0], extrema, [path.size - 1]])
    for before, extremum, after in zip(bounds, extrema, bounds[2:], strict=False):
        away = np.abs(path[before : after + 1] - path[extremum])
        nearest = np.argsort(away, kind="stable")
        count = np.arange(1, nearest.size + 1)
        outermost = away[nearest] - np.cumsum(away[nearest]) / count
        # Stop at the first sample that lies outside: more samples at another level would agree.
        outside = outermost > ABOUT * noise_sd / np.sqrt(count)
        inside = nearest[: np.argmax(outside) if outside.any() else None]
        samples = slice(before + inside.min(), before + inside.max() + 1)
        near = voltage[samples]
        level, error = np.full(near.size, np.mean(near)), noise_sd / sqrt(near.size)
        x = np.arange(near.size) - (near.size - 1) / 2
        bend = x * x - (near.size**2 - 1) / 12
        if near.size >= 5 and (bend @ near) * (-1 if is_top else 1) > 3 * noise_sd * sqrt(
            bend @ bend
        ):
            level += (bend @ near) / (bend @ bend) * bend + (x @ near) / (x @ x) * x
            error *= 1.5
        if near.size >= 3 and error < sd[extremum]:
            result[samples] = level
        is_top = not is_top
    return result
