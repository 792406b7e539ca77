"""The filter of a noise with two states, in lanes, as :mod:`bwbayes.inference.smooth` says it.

Its gain is not known beforehand: the covariance is followed until it stays, and then the gain does.
"""

from __future__ import annotations

import math

from numba import njit

from bwbayes.arrays import FloatArray

# isort: off
# fmt: off
from bwbayes.inference.compiled.lanes import (
    A1, A2, B0, B1, B2, CHANGE, ESTIMATE, ESTIMATE_2, FRESH_11, FRESH_12, FRESH_22, GAIN, INVERSE,
    KEPT, KEPT_12, KEPT_22, LANES, LEVEL, LOG, PRODUCTS, PULL_2, RATIO, SENSOR, SQUARES, SURPLUS,
    TRUST, TRUST_2, UNSURE, UNSURE_12, UNSURE_22, VALUE, VARIANCE, X1, X2,
)
# fmt: on
# isort: on

__all__ = ["advance", "is_settled", "settled", "skip", "unsure"]

# A covariance that changes by less of itself over a reading stays as it is.
SETTLED = 2e-15


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def settled(
    state: FloatArray, displacement: FloatArray, first: int, last: int, drive: FloatArray
) -> None:
    """Let the dynamics follow the drive, and the noise's filter what the measurement has beyond."""
    for t in range(first, last):
        y = displacement[t]
        row = (t - first) * LANES
        for i in range(LANES):
            w = drive[row + i]
            x = state[B0 + i] * w + state[X1 + i]
            state[X1 + i] = state[B1 + i] * w - state[A1 + i] * x + state[X2 + i]
            state[X2 + i] = state[B2 + i] * w - state[A2 + i] * x
            one, other = state[ESTIMATE + i], state[ESTIMATE_2 + i]
            innovation = y - state[LEVEL + i] - x - one
            across = state[KEPT_12 + i]
            state[ESTIMATE + i] = (
                state[KEPT + i] * one + across * other + (state[GAIN + i] * innovation)
            )
            state[ESTIMATE_2 + i] = (
                state[KEPT_22 + i] * other - across * one + (state[PULL_2 + i] * innovation)
            )
            state[SQUARES + i] += innovation * innovation
    # With the variance of the last reading of the exact form, which stays.
    for i in range(LANES):
        state[PRODUCTS + i] += state[SQUARES + i] * state[INVERSE + i]
        state[SQUARES + i] = 0.0
        state[LOG + i] -= (last - first) * math.log(state[INVERSE + i] * state[VARIANCE + i])


@njit(nogil=True, cache=True, error_model="numpy")
def unsure(state: FloatArray) -> None:
    """Take the covariance to the next reading, with the gain of this one on the way."""
    for i in range(LANES):
        p_11, p_12, p_22 = state[UNSURE + i], state[UNSURE_12 + i], state[UNSURE_22 + i]
        variance = p_11 + state[SENSOR + i]
        inverse = 1.0 / variance
        state[RATIO + i] *= variance / state[VARIANCE + i]
        state[INVERSE + i] = inverse
        state[TRUST + i], state[TRUST_2 + i] = p_11 * inverse, p_12 * inverse
        left = state[SENSOR + i] * inverse
        s_11, s_12, s_22 = p_11 * left, p_12 * left, p_22 - p_12 * p_12 * inverse
        a, b, d = state[KEPT + i], state[KEPT_12 + i], state[KEPT_22 + i]
        top, bottom = a * s_11 + b * s_12, a * s_12 + b * s_22
        state[UNSURE + i] = a * top + b * bottom + state[FRESH_11 + i]
        state[UNSURE_12 + i] = d * bottom - b * top + state[FRESH_12 + i]
        low, end = d * s_12 - b * s_11, d * s_22 - b * s_12
        state[UNSURE_22 + i] = d * end - b * low + state[FRESH_22 + i]
        moved_11 = abs(state[UNSURE + i] - p_11) / p_11
        moved_12 = abs(state[UNSURE_12 + i] - p_12) / math.sqrt(p_11 * p_22)
        moved_22 = abs(state[UNSURE_22 + i] - p_22) / p_22
        state[CHANGE + i] = max(moved_11, moved_12, moved_22)
        state[GAIN + i] = a * state[TRUST + i] + b * state[TRUST_2 + i]
        state[PULL_2 + i] = d * state[TRUST_2 + i] - b * state[TRUST + i]


@njit(nogil=True, cache=True)
def advance(state: FloatArray, i: int, at: int) -> float:
    """Take one series' estimate to the next reading; return the innovation of this one."""
    one, other = state[ESTIMATE + at + i], state[ESTIMATE_2 + at + i]
    innovation = state[VALUE + at + i] - one
    across = state[KEPT_12 + i]
    state[ESTIMATE + at + i] = state[KEPT + i] * one + across * other + state[GAIN + i] * innovation
    state[ESTIMATE_2 + at + i] = (
        state[KEPT_22 + i] * other - across * one + state[PULL_2 + i] * innovation
    )
    return float(innovation)


@njit(nogil=True, cache=True)
def skip(state: FloatArray, readings: float, series: int) -> None:
    """Let the filter pass over missing readings, by squaring as often as need be."""
    for i in range(LANES):
        a, b, d = state[KEPT + i], state[KEPT_12 + i], state[KEPT_22 + i]
        left, p, q, r = int(readings), 1.0, 0.0, 1.0
        while left > 0:
            if left % 2:
                p, q, r = p * a - q * b, p * b + q * d, r * d - q * b
            a, b, d = a * a - b * b, a * b + b * d, d * d - b * b
            left //= 2
        for k in range(series):
            at = k * LANES + i
            one, other = state[ESTIMATE + at], state[ESTIMATE_2 + at]
            state[ESTIMATE + at] = p * one + q * other
            state[ESTIMATE_2 + at] = r * other - q * one
        # By how much less than always is known.
        always = state[SURPLUS + i]
        g_11, g_22 = always - state[UNSURE + i], always - state[UNSURE_22 + i]
        g_12 = -state[UNSURE_12 + i]
        top, bottom = p * g_11 + q * g_12, p * g_12 + q * g_22
        state[UNSURE + i] = always - (p * top + q * bottom)
        state[UNSURE_12 + i] = -(r * bottom - q * top)
        low, end = r * g_12 - q * g_11, r * g_22 - q * g_12
        state[UNSURE_22 + i] = always - (r * end - q * low)


@njit(nogil=True, cache=True)
def is_settled(state: FloatArray) -> bool:
    """Tell whether no model's covariance changed by the last reading."""
    settled = True
    for i in range(LANES):
        settled &= state[CHANGE + i] <= SETTLED
    return settled
