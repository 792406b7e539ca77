"""The stage of Duhem hysteresis: sample by sample, models side by side.

Along a step of v = |Δu| in direction s, with z = β v and α(u) = α₀ + α₁ u + α₂ u², h moves by

    v [(s α(u₀) − β h) φ₁ + v α′(u₀) φ₂ + 2 s v² α₂ φ₃],   φ at −z,

as in :mod:`bwbayes.model.operators.duhem`; nothing in it cancels.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.model.declaration import Values

__all__ = ["duhem", "rows"]

# φ₃(−z) by its series, to 1e-14 of itself up to this z; doubled beyond.
SHORT = 0.25
C0, C1, C2, C3, C4 = 1 / 6, -1 / 24, 1 / 120, -1 / 720, 1 / 5040
C5, C6, C7, C8 = -1 / 40320, 1 / 362880, -1 / 3628800, 1 / 39916800

# Rows of what a model is and remembers; each name is where a row begins.
(
    REST, H, BETA, ALPHA_0, ALPHA_1, ALPHA_2, D_1, D_2, D_3, Z, PHI_1, PHI_2, PHI_3,
) = (LANES * row for row in range(13))  # fmt: skip


def rows(column: Values, h: FloatArray, rest: FloatArray) -> FloatArray:
    """Return what the stage starts from, (models, rows): h (models,) and the drive w₀ (models,)."""
    nothing = np.zeros_like(rest)
    names = ("beta", "alpha", "alpha1", "alpha2", "d", "d2", "d3")
    own = (column.get(name, nothing) for name in names)
    return np.stack([rest, h, *own, *(4 * [nothing])], axis=1)


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def duhem(state: FloatArray, voltage: FloatArray, first: int, last: int, out: FloatArray) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out`` and move h on."""
    steepest = 0.0
    for i in range(LANES):
        steepest = max(steepest, state[BETA + i])
    for t in range(first, last):
        u = voltage[t]
        before = voltage[t - 1] if t > 0 else u
        s = 1.0 if u > before else -1.0
        v = abs(u - before)
        row = (t - first) * LANES
        if v * steepest <= SHORT:
            for i in range(LANES):
                z = state[BETA + i] * v
                end = C4 + z * (C5 + z * (C6 + z * (C7 + z * C8)))
                three = C0 + z * (C1 + z * (C2 + z * (C3 + z * end)))
                two = 0.5 - z * three
                one = 1.0 - z * two
                h = state[H + i]
                curved = state[ALPHA_2 + i]
                slope = state[ALPHA_1 + i] + 2.0 * before * curved
                strength = state[ALPHA_0 + i] + before * (state[ALPHA_1 + i] + before * curved)
                change = (s * strength - state[BETA + i] * h) * one
                h += v * (change + v * (slope * two + 2.0 * s * v * curved * three))
                state[H + i] = h
                f = u * (state[D_1 + i] + u * (state[D_2 + i] + u * state[D_3 + i]))
                out[row + i] = f - h - state[REST + i]
        else:
            _long_step(state, s, before, u, v, steepest, row, out)


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _long_step(
    state: FloatArray,
    s: float,
    before: float,
    u: float,
    v: float,
    steepest: float,
    row: int,
    out: FloatArray,
) -> None:
    """Move h along a step of any size, with the φ functions doubled from a small z on.

    φ₁(−2z) = φ₁ (1 + e⁻ᶻ)/2, φ₂(−2z) = (φ₁² + 2 φ₂)/4, φ₃(−2z) = (φ₁ φ₂ + φ₂ + 2 φ₃)/8.
    """
    part, doublings = v, 0
    while part * steepest > SHORT:
        part *= 0.5
        doublings += 1
    for i in range(LANES):
        z = state[BETA + i] * part
        end = C4 + z * (C5 + z * (C6 + z * (C7 + z * C8)))
        three = C0 + z * (C1 + z * (C2 + z * (C3 + z * end)))
        two = 0.5 - z * three
        state[Z + i] = z
        state[PHI_1 + i] = 1.0 - z * two
        state[PHI_2 + i] = two
        state[PHI_3 + i] = three
    for _ in range(doublings):
        for i in range(LANES):
            z, one, two = state[Z + i], state[PHI_1 + i], state[PHI_2 + i]
            state[PHI_3 + i] = 0.125 * (one * two + two + 2.0 * state[PHI_3 + i])
            state[PHI_2 + i] = 0.25 * (one * one + 2.0 * two)
            state[PHI_1 + i] = one * (1.0 - 0.5 * z * one)
            state[Z + i] = 2.0 * z
    for i in range(LANES):
        one, two, three = state[PHI_1 + i], state[PHI_2 + i], state[PHI_3 + i]
        h = state[H + i]
        curved = state[ALPHA_2 + i]
        slope = state[ALPHA_1 + i] + 2.0 * before * curved
        strength = state[ALPHA_0 + i] + before * (state[ALPHA_1 + i] + before * curved)
        change = (s * strength - state[BETA + i] * h) * one
        h += v * (change + v * (slope * two + 2.0 * s * v * curved * three))
        state[H + i] = h
        f = u * (state[D_1 + i] + u * (state[D_2 + i] + u * state[D_3 + i]))
        out[row + i] = f - h - state[REST + i]
