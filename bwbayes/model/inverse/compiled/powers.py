"""Bouc-Wen hysteresis of any exponent n read backwards, in Taylor series.

Along a step of direction s, with v = |u − u₀|, g = s h and x = (c/α) |g|ⁿ, it is

    g′ = α (1 − x),   g x′ = n x g′,

from which the coefficients of g in powers of v follow one from the other. What v adds to the drive
is then a polynomial, whose root is the step. It takes as many terms as rounding asks for; where
that would be too many, the step is made in parts.

Near g = 0, where gⁿ has no such series, the voltage is a function of g,

    v(g) = (g/α) (1 + x/(1 + n) + x²/(1 + 2 n) + …),

and g is what is looked for.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.model.inverse.compiled.slopes import flattest

__all__ = ["powered"]

# Terms at most, and what part of the first one the last may be.
TERMS, LAST = 20, 1e-17

# One over each number of a term.
OVER = tuple(1.0 / max(i, 1) for i in range(TERMS + 1))

# A step of so large a part of g is near zero, if |x| is below a bound there: the sum converges.
NEAR, SMALL = 0.2, 0.25

# So many times as far as a first guess its series is taken to be exact.
LONGER = 1.25

# A step of Newton's that changes the slope by less than this part doubles the digits to more than
# there are; rounds at most, and parts of a step.
CLOSE, ROUNDS, PARTS = 1e-8, 60, 400

# The same near zero, as a part of the step.
NEARER = 1e-10

EPSILON = float(np.finfo(np.float64).eps)

# So far from one, times 1 + n, x is at the ceiling.
RESTS = 4 * EPSILON


@njit(nogil=True, cache=True, error_model="numpy")
def powered(
    models: FloatArray, curve: FloatArray, memory: FloatArray, drive: FloatArray
) -> BoolArray:
    """Write the voltages of drives over them (models, samples); tell which models' are right.

    Parameters
    ----------
    models
        (models, 4): α (um/V), c/α below zero and above (um⁻ⁿ), and n.
    curve
        What the drive is but for h, coefficients of 1, u, u² and u³ (models, 4), um/Vᵏ.
    memory
        (models, 2), voltage and h where the paths start.
    drive
        (models, samples), um.
    """
    right = np.ones(drive.shape[0], dtype=np.bool_)
    series = np.empty((2, TERMS + 1))
    for model in range(drive.shape[0]):
        right[model] = _follow(models[model], curve[model], memory[model], drive[model], series)
    return right


@njit(nogil=True, cache=True, error_model="numpy")
def _follow(
    own: FloatArray, curve: FloatArray, memory: FloatArray, drive: FloatArray, series: FloatArray
) -> bool:
    """Turn one model's drive into its voltage; tell whether it rises with the voltage all along."""
    alpha, below, above, n = own
    u, h = memory
    before = curve[0] + u * (curve[1] + u * (curve[2] + u * curve[3])) - h
    for t in range(drive.size):
        goal = drive[t]
        if goal != before:
            s = 1.0 if goal > before else -1.0
            g, left = s * h, abs(goal - before)
            for _ in range(PARTS):
                if not left > 0.0:
                    break
                rate = below if g < 0.0 else above
                x = rate * abs(g) ** n
                line = (
                    curve[1] + u * (2.0 * curve[2] + 3.0 * u * curve[3]),
                    s * (curve[2] + 3.0 * u * curve[3]),
                    curve[3],
                )
                v, g, rest = _part(alpha, below, above, n, line, g, x, left, series)
                if not v >= 0.0:
                    return False
                u, left = u + s * v, rest
            if left > 0.0:
                return False
            h = curve[0] + u * (curve[1] + u * (curve[2] + u * curve[3])) - goal
            before = goal
        drive[t] = u
    return True


@njit(nogil=True, cache=True, error_model="numpy")
def _part(
    alpha: float,
    below: float,
    above: float,
    n: float,
    line: tuple[float, float, float],
    g: float,
    x: float,
    left: float,
    series: FloatArray,
) -> tuple[float, float, float]:
    """Go on until the drive has risen by what is left, or a part of it.

    Return how far the voltage has gone, nan where the drive does not rise all along; g there, and
    what is left then.
    """
    # At the ceiling it stays, where rounding would never let it arrive.
    k = alpha * (1.0 - x) if abs(1.0 - x) > RESTS * (1.0 + n) else 0.0
    slope = line[0] - k
    if not slope > 0.0:
        return math.nan, g, left
    bend = line[1] + (0.5 * alpha * n * x * k / g if g != 0.0 else 0.0)
    far = 2.0 * left / (slope + math.sqrt(max(slope * slope + 4.0 * bend * left, 0.0)))
    most = far
    if abs(k) * far > NEAR * abs(g):
        if abs(x) <= SMALL:
            return _near_zero(alpha, below, above, n, line, g, x, left)
        most = NEAR * abs(g) / abs(k)
    terms, until = _expand(alpha, n, g, x, k, most, series)
    # The guess may be a little short.
    low, high = 0.0, LONGER if most == far and until >= 1.0 else min(until, 1.0)
    t = min(high, 1.0)
    for _ in range(ROUNDS):
        rise, steep, after = _added(line, series[0], terms, most, t)
        if rise < left:
            if t == high:
                break
            low = t
        closer = t - (rise - left) / (most * steep)
        moved = most * abs(closer - t)
        if (abs(bend) + 3.0 * most * abs(line[2])) * moved <= CLOSE * slope and closer <= high:
            t, rise = closer, left
            break
        t = min(closer, high) if closer > low else 0.5 * (low + t)
    else:
        return math.nan, g, left
    v = most * t
    end = line[0] + v * (2.0 * line[1] + 3.0 * v * line[2]) - steep
    if not flattest(line, v) > max(k, end):
        return math.nan, g, left
    return v, after, left - rise


@njit(nogil=True, cache=True, error_model="numpy")
def _expand(
    alpha: float, n: float, g: float, x: float, k: float, most: float, series: FloatArray
) -> tuple[int, float]:
    """Write the coefficients of g and x in t = v / most.

    Return how many of g there are, and up to which t they are exact.
    """
    gs, xs = series[0], series[1]
    gs[0], xs[0] = g, x
    gs[1] = first = k * most
    one, least = 1.0 / g if g != 0.0 else 0.0, LAST * abs(first)
    for i in range(1, TERMS):
        total = 0.0
        weight = -float(i)
        for j in range(1, i + 1):
            weight += n + 1.0
            total += weight * gs[j] * xs[i - j]
        xs[i] = total * one * OVER[i]
        gs[i + 1] = -alpha * most * xs[i] * OVER[i + 1]
        if abs(gs[i]) + abs(gs[i + 1]) <= least:
            return i + 1, 1.0
    last = max(abs(gs[TERMS]), abs(gs[TERMS - 1]))
    return TERMS, float((least / last) ** (1.0 / (TERMS - 2)))


@njit(nogil=True, cache=True, error_model="numpy")
def _added(
    line: tuple[float, float, float], series: FloatArray, terms: int, most: float, t: float
) -> tuple[float, float, float]:
    """Return what v = t most adds to the drive, the slope there, and g there."""
    gone, slope = series[terms], 0.0
    for i in range(terms - 1, 0, -1):
        slope = slope * t + gone
        gone = gone * t + series[i]
    slope = slope * t + gone
    gone *= t
    v = most * t
    rise = v * (line[0] + v * (line[1] + v * line[2])) - gone
    steep = line[0] + v * (2.0 * line[1] + 3.0 * v * line[2]) - slope / most
    return rise, steep, series[0] + gone


@njit(nogil=True, cache=True, error_model="numpy")
def _near_zero(
    alpha: float,
    below: float,
    above: float,
    n: float,
    line: tuple[float, float, float],
    g: float,
    x: float,
    left: float,
) -> tuple[float, float, float]:
    """Go on as :func:`_part` does, by the sum of v(g), as far as that is short."""
    begun, start = x, _clock(alpha, n, g, x)
    edge = (2.0 * SMALL / above) ** (1.0 / n) if above > 0.0 else math.inf
    k = alpha * (1.0 - x)
    low, high, after = g, edge, g + k * left / (line[0] - k)
    for _ in range(ROUNDS):
        if after >= edge:
            v = _clock(alpha, n, edge, 2.0 * SMALL) - start
            rise = v * (line[0] + v * (line[1] + v * line[2])) - (edge - g)
            if rise < left:
                steepest = alpha * max(1.0 - begun, 1.0)
                return (v if flattest(line, v) > steepest else math.nan), edge, left - rise
        if not (low <= after <= high):
            after = 0.5 * (low + high)
        x = (below if after < 0.0 else above) * abs(after) ** n
        v = _clock(alpha, n, after, x) - start
        off = v * (line[0] + v * (line[1] + v * line[2])) - (after - g) - left
        if off < 0.0:
            low = after
        else:
            high = after
        k = alpha * (1.0 - x)
        steep = (line[0] + v * (2.0 * line[1] + 3.0 * v * line[2])) / k - 1.0
        moved = off / steep
        after -= moved
        if abs(moved) <= NEARER * abs(after - g):
            break
    else:
        return math.nan, g, left
    end = (below if after < 0.0 else above) * abs(after) ** n
    v = _clock(alpha, n, after, end) - start
    steepest = alpha * max(1.0 - begun, 1.0 - end, 1.0 if g < 0.0 < after else 0.0)
    return (v if flattest(line, v) > steepest else math.nan), after, 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def _clock(alpha: float, n: float, g: float, x: float) -> float:
    """Return v(g)."""
    total, power, i = 1.0, x, 1
    while abs(power) > EPSILON:
        total += power / (1.0 + i * n)
        power *= x
        i += 1
    return g / alpha * total
