"""The stage of Bouc-Wen with n = 1 and |γ| ≤ β: sample by sample, models side by side."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.model.declaration import Values

__all__ = ["bouc_wen", "rows"]

# φ(z) = (1 − exp(−z)) / z by its series, to 3e-14 of itself up to this z; doubled beyond.
SHORT = 0.1
C1, C2, C3, C4, C5, C6, C7 = -1 / 2, 1 / 6, -1 / 24, 1 / 120, -1 / 720, 1 / 5040, -1 / 40320

# Rows of what a model is and remembers; each name is where a row begins.
REST, H, ALPHA, AGAINST, AHEAD, D, BEFORE, Z, PHI = (LANES * row for row in range(9))
ROWS = 9


def rows(column: Values, hysteretic: FloatArray, rest: FloatArray) -> FloatArray:
    """Return what the stage starts from, (models, rows): h (models,) and the drive w₀ (models,)."""
    scratch = np.zeros_like(rest)
    against, ahead = column["beta"] - column["gamma"], column["beta"] + column["gamma"]
    own = rest, hysteretic, column["alpha"], against, ahead, column["d"], *(3 * [scratch])
    return np.stack(own, axis=1)


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def bouc_wen(
    state: FloatArray, voltage: FloatArray, first: int, last: int, out: FloatArray
) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out`` and move h on.

    Along a step of v = |Δu| in direction s, g = s h follows dg/dv = α − c g exactly by
    g + (α − c g) v φ(c v), which has no difference of nearly equal numbers at small steps.
    """
    steepest = 0.0
    for i in range(LANES):
        steepest = max(steepest, state[AHEAD + i], state[AGAINST + i])
    for t in range(first, last):
        u = voltage[t]
        step = u - voltage[t - 1] if t > 0 else 0.0
        row = (t - first) * LANES
        s = 1.0 if step > 0.0 else -1.0
        v = abs(step)
        crossings = 0
        if step == 0.0:
            for i in range(LANES):
                out[row + i] = state[D + i] * u - state[H + i] - state[REST + i]
        elif v * steepest <= SHORT:
            crossings = _short_step(state, s, u, v, row, out)
        else:
            crossings = _long_step(state, s, u, v, steepest, row, out)
        if crossings > 0:
            _cross(state, s, u, v, row, out)


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _short_step(state: FloatArray, s: float, u: float, v: float, row: int, out: FloatArray) -> int:
    """Move h along a step whose z is small; return how many models passed zero."""
    crossings = 0
    for i in range(LANES):
        g = s * state[H + i]
        # Both are read first: a compiler does not make vectors of what is read on a condition.
        ahead = state[AHEAD + i]
        against = state[AGAINST + i]
        c = against if g < 0.0 else ahead
        z = c * v
        end = C4 + z * (C5 + z * (C6 + z * C7))
        phi = 1.0 + z * (C1 + z * (C2 + z * (C3 + z * end)))
        new = g + (state[ALPHA + i] - c * g) * (v * phi)
        crossings += (g < 0.0) & (new > 0.0)
        h = s * new
        state[BEFORE + i] = g
        state[H + i] = h
        out[row + i] = state[D + i] * u - h - state[REST + i]
    return crossings


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _long_step(
    state: FloatArray, s: float, u: float, v: float, steepest: float, row: int, out: FloatArray
) -> int:
    """Move h along a step of any size: φ(2z) = φ(z) (1 − z φ(z) / 2) from a small z on."""
    part, doublings = v, 0
    while part * steepest > SHORT:
        part *= 0.5
        doublings += 1
    for i in range(LANES):
        g = s * state[H + i]
        ahead = state[AHEAD + i]
        against = state[AGAINST + i]
        z = (against if g < 0.0 else ahead) * part
        end = C4 + z * (C5 + z * (C6 + z * C7))
        state[PHI + i] = 1.0 + z * (C1 + z * (C2 + z * (C3 + z * end)))
        state[Z + i] = z
        state[BEFORE + i] = g
    for _ in range(doublings):
        for i in range(LANES):
            z = state[Z + i]
            phi = state[PHI + i]
            state[PHI + i] = phi * (1.0 - 0.5 * z * phi)
            state[Z + i] = 2.0 * z
    crossings = 0
    for i in range(LANES):
        g = state[BEFORE + i]
        new = g + (state[ALPHA + i] * v - state[Z + i] * g) * state[PHI + i]
        crossings += (g < 0.0) & (new > 0.0)
        h = s * new
        state[H + i] = h
        out[row + i] = state[D + i] * u - h - state[REST + i]
    return crossings


@njit(nogil=True, cache=True)
def _cross(state: FloatArray, s: float, u: float, v: float, row: int, out: FloatArray) -> None:
    """Redo the models whose g passed zero within the step, where its rate changes."""
    for i in range(LANES):
        g, alpha = state[BEFORE + i], state[ALPHA + i]
        if g < 0.0 < s * state[H + i]:
            against, ahead = state[AGAINST + i], state[AHEAD + i]
            ratio = -g * against / alpha
            # What is left of v after zero, and how far g gets in it: with limits at a rate of zero.
            left = max(v - (-g / alpha if ratio == 0.0 else math.log1p(ratio) / against), 0.0)
            gone = ahead * left
            h = s * alpha * (left if gone == 0.0 else -math.expm1(-gone) / ahead)
            state[H + i] = h
            out[row + i] = state[D + i] * u - h - state[REST + i]
