"""Plays read backwards: along straight lines, or with a gain along cubics.

Where a voltage goes one way, the plays that it has taken along are those with the smallest
thresholds. So a model knows how many they are, how steep the drive is with them, and at which
voltage, and which drive, the next one joins. In between, a sample is one line read backwards.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bwbayes.arrays import BoolArray, FloatArray

__all__ = ["played"]

# Rounds of the search at most; the step that changes the slope by less than this part of it is the
# last, because it doubles the digits to more than there are.
ROUNDS, CLOSE = 60, 1e-10


@njit(nogil=True, cache=True, error_model="numpy")
def played(
    slope: FloatArray,
    weights: FloatArray,
    thresholds: FloatArray,
    gain: FloatArray,
    memory: FloatArray,
    start: FloatArray,
    drive: FloatArray,
) -> BoolArray:
    """Write the voltages of drives over them (models, samples); tell which models' are right.

    Parameters
    ----------
    slope, weights, thresholds
        d (models,), w_j (models, plays), um/V, and r_j (models or 1, plays), V, rising.
    gain
        What is added to the drive, coefficients of 1, u, u² and u³, (models, 4) or (models, 0).
    memory, start
        Where the plays are (models, plays), V, and where the paths start (models,), V.
    drive
        (models, samples), um.
    """
    right = np.ones(slope.size, dtype=np.bool_)
    for model in range(slope.size):
        volts = thresholds[model if thresholds.shape[0] > 1 else 0]
        right[model] = _follow(
            slope[model], weights[model], volts, gain[model], memory[model].copy(), start[model],
            drive[model],
        )  # fmt: skip
    return right


@njit(nogil=True, cache=True, error_model="numpy")
def _follow(
    slope: float,
    weights: FloatArray,
    volts: FloatArray,
    gain: FloatArray,
    plays: FloatArray,
    u: float,
    drive: FloatArray,
) -> bool:
    """Turn one model's drive into its voltage; tell whether it rises with the voltage all along."""
    w = slope * u
    for j in range(plays.size):
        w += weights[j] * plays[j]
    w += _curve(gain, u)
    # Where the line begins, u₀ and w₀; it has as many plays as are taken along.
    s, taken, steep = 1.0, 0, slope
    u0, w0, before = u, w, w
    join, level = _next(s, taken, steep, volts, plays, gain, u0, w0)
    for t in range(drive.size):
        goal = drive[t]
        if s * (goal - before) < 0.0:
            for j in range(taken):
                plays[j] = u - s * volts[j]
            s, taken, steep = -s, 0, slope
            u0, w0 = u, before
            join, level = _next(s, taken, steep, volts, plays, gain, u0, w0)
        if goal == before:
            drive[t] = u
            continue
        while s * (goal - level) > 0.0:
            if not _rises(steep, gain, u0, join) and join != u0:
                return False
            u0, w0 = join, level
            steep += weights[taken]
            taken += 1
            join, level = _next(s, taken, steep, volts, plays, gain, u0, w0)
        if gain.size == 0:
            if not steep > 0.0:
                return False
            u = u0 + (goal - w0) / steep
        else:
            u = _where(s, steep, gain, u0, w0, u, join, goal)
            if not _rises(steep, gain, u0, u):
                return False
        before = goal
        drive[t] = u
    return True


@njit(nogil=True, cache=True, error_model="numpy")
def _next(
    s: float,
    taken: int,
    steep: float,
    volts: FloatArray,
    plays: FloatArray,
    gain: FloatArray,
    u: float,
    w: float,
) -> tuple[float, float]:
    """Return voltage and drive at which the next play is taken along, from a voltage and drive."""
    if taken == plays.size:
        return s * math.inf, s * math.inf
    join = plays[taken] + s * volts[taken]
    return join, w + steep * (join - u) + _curve(gain, join) - _curve(gain, u)


@njit(nogil=True, cache=True, error_model="numpy")
def _curve(gain: FloatArray, u: float) -> float:
    """Return what the gain adds, um."""
    if gain.size == 0:
        return 0.0
    return float(gain[0] + u * (gain[1] + u * (gain[2] + u * gain[3])))


@njit(nogil=True, cache=True, error_model="numpy")
def _slope(steep: float, gain: FloatArray, u: float) -> float:
    """Return how steep the drive is, um/V."""
    return float(steep + gain[1] + u * (2.0 * gain[2] + 3.0 * u * gain[3]))


@njit(nogil=True, cache=True, error_model="numpy")
def _rises(steep: float, gain: FloatArray, u: float, end: float) -> bool:
    """Tell whether the drive rises all along from one voltage to another."""
    if gain.size == 0:
        return steep > 0.0
    least = min(_slope(steep, gain, u), _slope(steep, gain, end))
    if gain[3] != 0.0:
        flattest = -gain[2] / (3.0 * gain[3])
        if min(u, end) < flattest < max(u, end):
            least = min(least, _slope(steep, gain, flattest))
    return least > 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def _where(
    s: float,
    steep: float,
    gain: FloatArray,
    u: float,
    w: float,
    guess: float,
    join: float,
    goal: float,
) -> float:
    """Return the voltage of a goal on the cubic through u and w, up to where the next play joins.

    By Chebyshev's rule, with bisection where the end of the cubic is known; nan where it fails.
    """
    low, high, x = u, join, guess
    level = w - _curve(gain, u)
    for _ in range(ROUNDS):
        off = s * (level + steep * (x - u) + _curve(gain, x) - goal)
        if off < 0.0:
            low = x
        else:
            high = x
        one = 1.0 / _slope(steep, gain, x)
        bend, step = gain[2] + 3.0 * x * gain[3], s * off * one
        # With the parabola that touches, as far as that is a small correction.
        closer = x - step * (1.0 + min(max(bend * one * step, -0.25), 0.25))
        moved = abs(closer - x)
        if (abs(bend) + 3.0 * moved * abs(gain[3])) * moved * one <= CLOSE:
            return float(min(max(closer, min(low, high)), max(low, high)))
        if not (s * (closer - low) >= 0.0 and s * (high - closer) >= 0.0) and math.isfinite(high):
            closer = 0.5 * (low + high)
        x = closer
    return math.nan
