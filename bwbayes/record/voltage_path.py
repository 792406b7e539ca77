"""Path of a measured voltage: the voltage without the noise of its reading.

Rate-independent hysteresis, dh = α du − β |du| h − γ du |h|, remembers every reversal of its input.
White noise of the sd s on the reading of a voltage u adds a path of 2 s / √π per sample, and erases
memory that the actuator still has. The real reversals of a path and their heights have to be right,
and it has to be monotone between them:

1. The noise's sd comes from differences of rising order p, sd(Δᵖ u) = s √C(2p, p) for noise alone:
   the share of a smooth voltage dies out. While the estimates still fall, noise cannot be detected.
2. Local quadratics over windows of 4, 8, 16, ... samples to the left, to the right and around each
   sample, each as long as the intervals of all windows so far intersect (Goldenshluger and
   Nemirovski, Math. Methods Stat. 6 (1997) 135; Katkovnik, IEEE Trans. Signal Process. 47 (1999)
   2567), joined by their precision. Where the sides contradict each other, the sd grows.
3. A reversal is real if it goes beyond √(2 ln n), the largest of n normal deviates, times the sds
   of the two samples that it is between.
4. Between reversals the path is the isotonic regression of the fits. The samples about an extreme
   that their mean describes become this mean, or a parabola, where that is the more certain.
5. Lines of the residual's spectrum, such as mains hum, move the actuator too: they are set aside
   before and added again. Hum of the monitor alone cannot be distinguished from them.

A voltage without noise may lack the corners that fall between its samples: a sampled triangle does
not reach its extremes. :func:`with_corners` is the path that does.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, log, sqrt

import numpy as np
from scipy.optimize import isotonic_regression

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.shown import brief

# Half width, in sds, of the windows' intervals that have to intersect.
WITHIN = 1.5

# Part of a corner's bend that its lines may have beside it: a sine's bends are alike, a third each.
STRAIGHT = 0.1


@dataclass(frozen=True)
class VoltagePath:
    """Estimate of the voltage that moves the actuator, from its reading.

    ``voltage`` (samples,), V, is the measured one without noise of the sd ``noise_sd``, V; if that
    is 0, it is the measured one bit for bit. ``remark`` is a note for the user, or "".
    """

    __repr__ = brief

    voltage: FloatArray
    noise_sd: float = 0.0
    remark: str = ""

    def redrawn(self, generator: np.random.Generator) -> FloatArray:
        """Add new noise to this path and return the path (samples,), V, estimated from that."""
        if self.noise_sd == 0:
            return self.voltage
        noise = self.noise_sd * generator.standard_normal(self.voltage.size)
        return estimate_path(self.voltage + noise).voltage


def estimate_path(voltage: FloatArray) -> VoltagePath:
    """Estimate the path of a measured voltage (samples,), V, under white noise of unknown sd.

    A voltage whose reversals are all real comes back bit for bit, and so does one that changes too
    fast for its sampling, with a remark. The path of a u + b is a times that of u, plus b.
    """
    low, high = float(np.min(voltage)), float(np.max(voltage))
    extent, center = high - low, (high + low) / 2
    if voltage.size < 50 or extent == 0:  # fewer samples show no noise
        return VoltagePath(voltage)
    u = voltage - center
    step = rounding_step(u)
    hum, frequencies, last = np.zeros_like(u), list[float](), 0.0
    for searched in range(8):
        sd, settled = noise_sd(u - hum)
        # Rounding is monotone, so that it adds no reversal.
        if sd == 0 or (settled and sd < 1.1 * step / sqrt(12)):
            return VoltagePath(voltage)
        if not (settled or searched):
            remark = "voltage changes too fast for its sampling to tell its noise: none is removed"
            return VoltagePath(voltage, remark=remark)
        fitted, reversals, length_sd = _fit_path(u - hum, max(sd, step / 2))
        # The first and the last reversal may be real without enough evidence.
        if not searched and turns(u) <= reversals + 1:
            return VoltagePath(voltage)
        residual = u - hum - fitted
        frequency = _line(residual, sd)
        is_known = any(abs(frequency - other) < 6 / u.size for other in frequencies)
        if not frequency or (len(frequencies) == 3 and not is_known):
            break
        frequencies += [] if is_known else [frequency]
        phases = np.outer(np.arange(u.size), frequencies)
        waves = np.hstack([np.cos(phases), np.sin(phases)])
        more = waves @ np.linalg.lstsq(waves.T @ waves, waves.T @ residual)[0]
        size = float(np.std(more))
        if sqrt(2) * size < step / np.pi:  # the error of rounding a ramp has such a line
            break
        # The path follows a part of the hum, so that the rest falls by one factor each time.
        ratio = size / last if is_known and last else 0.0
        last = 0.0 if ratio else size
        hum = hum + (more / (1 - ratio) if ratio < 0.95 else more)
    path = fitted + hum
    shown = f"noise of {sd:.2g} V SD ({100 * sd / extent:.2g}% of its range)"
    length = _length(path)
    excess = _length(u) - length
    harmless = 1e-3 * length
    if excess <= max(harmless, 3 * length_sd):  # beyond three sds it is clear
        left_in = f"voltage may have {shown}, which cannot be told from the drive: none is removed"
        return VoltagePath(voltage, remark=left_in * (excess > harmless))
    remark = (
        f"voltage has {shown}: the model is driven by its estimated path, with {reversals} "
        f"reversals for {turns(u)}"
    )
    # Beyond these the path is too uncertain for parameters; a hold is known to half of a step.
    if sd > 0.005 * extent or step > 0.003 * extent:
        remark = (
            f"voltage has {shown}, too much to repair: do not trust the parameters; measure the "
            'voltage with less noise, or give the command (voltage_is = "command")'
        )
    return VoltagePath(path + center, sd, remark)


def with_corners(voltage: FloatArray) -> FloatArray:
    """Return a voltage (samples,), V, that reaches the corners between its samples.

    Where a rising and a falling line meet between two samples, the voltage turned further out than
    either of them; the nearer one is moved there. A round extreme, as of a sine, stays as it is.
    """
    path = voltage.copy()
    slope = np.diff(voltage)
    # Of the line up to sample k + 1 and the one from k + 2 on; both go through another sample.
    before, between, after = slope[:-2], slope[1:-1], slope[2:]
    turn = before - after
    bend = np.pad(np.abs(np.diff(slope)), 1)  # beyond the ends, lines are as straight as can be
    straight = np.maximum(bend[:-3], bend[3:]) < STRAIGHT * np.abs(turn)
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = (between - after) / turn
    (k,) = np.nonzero((before * after < 0) & straight & (fraction > 0) & (fraction < 1))
    nearest = k + 1 + (fraction[k] > 0.5)
    corner = voltage[k + 1] + before[k] * fraction[k]
    # Rounding may show one corner on both sides of a sample: the further one is assigned last.
    order = np.argsort(np.abs(corner - voltage[nearest]))
    path[nearest[order]] = corner[order]
    return path


def rounding_step(voltage: FloatArray) -> float:
    """Return the step, V, that divides all differences of a voltage, or 0."""
    gaps = np.diff(np.unique(voltage))
    gaps = gaps[gaps > 1e-6 * np.ptp(voltage)]  # not the rounding of doubles
    if not gaps.size:
        return 0.0
    multiples = gaps / gaps.min()
    return float(gaps.min()) if np.all(np.abs(multiples - np.rint(multiples)) < 0.02) else 0.0


def noise_sd(voltage: FloatArray) -> tuple[float, bool]:
    """Return the sd of the white noise on a voltage, V, and whether it is noise: see step 1.

    If it is not, the voltage changes too fast for its sampling, and the noise's sd may be less.
    """
    extent, orders, sds = float(np.ptp(voltage)), range(4, 11), list[float]()
    differences = np.diff(voltage, orders[0] - 1)
    for order in orders:
        differences = np.diff(differences)
        # Take the median, since corners and steps are few.
        sd = float(np.median(np.abs(differences))) / 0.6745 / sqrt(comb(2 * order, order))
        sds.append(sd)
    if sds[-1] < 1e-9 * extent:
        return 0.0, True
    if sds[-1] < 0.8 * sds[-3]:  # it still falls
        return (0.0, True) if sds[-1] < 1e-4 * extent else (sds[-1], False)
    # Beyond this the voltage changes too fast for its sampling.
    return min(sds), min(sds) < 0.03 * extent


def turns(voltage: FloatArray) -> int:
    """Return the number of reversals of a voltage."""
    steps = np.diff(voltage)
    return int(np.count_nonzero(np.diff(np.sign(steps[steps != 0]))))


def _length(path: FloatArray) -> float:
    return float(np.sum(np.abs(np.diff(path))))


def _line(residual: FloatArray, noise_sd: float) -> float:
    """Return the frequency of a residual's strongest line, rad per sample, or 0 without any."""
    n = residual.size
    if n < 300:
        return 0.0
    power = np.abs(np.fft.rfft(residual * np.hanning(n))) ** 2 / (0.375 * n * noise_sd**2)
    first = n // 200 + 20
    k = first + int(np.argmax(power[first:]))
    near = np.median(power[max(k - 40, 1) : k + 41])
    if power[k] < max(12 + log(n), 20 * near):
        return 0.0
    # Refine between the bins, by sums over parts in which a wave of the bin stays nearly in phase.
    parts = np.arange(0, n, max(n // 256, 1))
    sums = np.add.reduceat(residual * np.exp(-2j * np.pi * k / n * np.arange(n)), parts)
    offsets = 2 * np.pi / n * np.linspace(-1, 1, 81)
    sizes = np.abs(np.exp(-1j * np.outer(offsets, parts)) @ sums)
    return float(2 * np.pi * k / n + offsets[int(np.argmax(sizes))])


def _fit_path(voltage: FloatArray, noise_sd: float) -> tuple[FloatArray, int, float]:
    """Return a voltage's path (samples,), V, its reversals, and a bound of its length's sd, V.

    The white noise on the voltage has a known sd, V.
    """
    fits, sd, agreeing_sd = _local_fits(voltage, noise_sd)
    extrema, first_is_top = _real_reversals(fits, sqrt(2 * log(voltage.size)) * sd)
    weights = 1 / sd**2
    path = _monotone(fits, extrema, first_is_top, weights)
    path = _level_extremes(voltage, path, noise_sd, agreeing_sd, extrema, first_is_top)
    path = _monotone(path, extrema, first_is_top, weights)
    return path, extrema.size, float(2 * np.sum(agreeing_sd[extrema]))


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
    """Return the samples of the real reversals, and whether the first is a maximum: see step 3.

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


def _level_extremes(
    voltage: FloatArray,
    path: FloatArray,
    noise_sd: float,
    sd: FloatArray,
    extrema: IntArray,
    first_is_top: bool,
) -> FloatArray:
    """Return a path with the samples about each extreme at one level or a parabola: see step 4."""
    result, is_top = path.copy(), first_is_top
    bounds = np.concatenate([[0], extrema, [path.size - 1]])
    for before, extremum, after in zip(bounds, extrema, bounds[2:], strict=False):
        away = np.abs(path[before : after + 1] - path[extremum])
        nearest = np.argsort(away, kind="stable")
        count = np.arange(1, nearest.size + 1)
        outermost = away[nearest] - np.cumsum(away[nearest]) / count
        # Stop at the first sample that lies outside: more samples at another level would agree.
        outside = outermost > 3 * noise_sd / np.sqrt(count)
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
