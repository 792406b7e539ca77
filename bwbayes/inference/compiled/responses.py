"""Responses that stay: how an offset and the start of the creep are heard all along a record.

An offset never dies out, and the slowest lags of the creep hardly do. But once the noise's filter
is in its steady state, and has forgotten how a response began, its innovation is a constant part of
the response itself. Then nothing is filtered for it any more.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray, IntArray

# isort: off
# fmt: off
from bwbayes.inference.compiled.lanes import (
    A1, A2, B0, B1, B2, DECAY, ESTIMATE, GAIN, INNOVATION, KEEP_1, KEPT, LANES, LEVEL, PRODUCTS,
    SQUARES, SUM, VARIANCE, X1, X2,
)
# fmt: on
# isort: on

__all__ = ["is_tracked", "tracked_by"]

# An innovation that follows its response to this part of it does not do so better.
ROUNDING = 1e-13


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def tracked_by(
    state: FloatArray,
    displacement: FloatArray,
    first: int,
    last: int,
    drive: FloatArray,
    decays: FloatArray,
    series: IntArray,
) -> None:
    """Do the settled form, with responses whose innovations follow them.

    A response r that keeps the part ρ of itself from reading to reading has an innovation κ r, with
    κ = (ρ − φ)/(ρ − a), so only Σ ρᵗ η of the residual's innovations η has to be added up; products
    of two responses are geometric sums. ``decays`` is ρ of each, ``series`` says which they are.
    """
    count = series.size
    for k in range(count):
        for i in range(LANES):
            state[INNOVATION + series[k] * LANES + i] = 0.0
    weight = np.ones(count)
    for t in range(first, last):
        y = displacement[t]
        row = (t - first) * LANES
        for i in range(LANES):
            w = drive[row + i]
            x = state[B0 + i] * w + state[X1 + i]
            state[X1 + i] = state[B1 + i] * w - state[A1 + i] * x + state[X2 + i]
            state[X2 + i] = state[B2 + i] * w - state[A2 + i] * x
            residual = y - state[LEVEL + i] - x
            estimate = state[ESTIMATE + i]
            innovation = residual - estimate
            state[ESTIMATE + i] = state[DECAY + i] * estimate + state[GAIN + i] * residual
            state[SQUARES + i] += innovation * innovation
            state[SUM + i] = innovation
        for k in range(count):
            factor, at = weight[k], INNOVATION + series[k] * LANES
            for i in range(LANES):
                state[at + i] += factor * state[SUM + i]
            weight[k] *= decays[k]
    _fold(state, last - first, weight, decays, series)


@njit(nogil=True, cache=True, error_model="numpy")
def _fold(
    state: FloatArray, samples: int, weight: FloatArray, decays: FloatArray, series: IntArray
) -> None:
    """Add what a number of samples brought to the products, and move the responses on.

    ``weight`` is what remains of each response after them.
    """
    count = series.size
    for k in range(count):
        at, rho = series[k] * LANES, decays[k]
        for j in range(k + 1):
            other, sigma = series[j] * LANES, decays[j]
            product = rho * sigma
            total = float(samples)
            if product < 1.0:
                total = (1.0 - weight[k] * weight[j]) / (1.0 - product)
            pair = PRODUCTS + (series[k] * (series[k] + 1) // 2 + series[j]) * LANES
            for i in range(LANES):
                first = state[KEEP_1 + at + i] * _follows(state, i, rho)
                second = state[KEEP_1 + other + i] * _follows(state, i, sigma)
                state[pair + i] += first * second * total / state[VARIANCE + i]
        pair = PRODUCTS + (series[k] * (series[k] + 1) // 2) * LANES
        for i in range(LANES):
            kappa = _follows(state, i, rho)
            pull = kappa * state[KEEP_1 + at + i] * state[INNOVATION + at + i]
            state[pair + i] += pull / state[VARIANCE + i]
    for k in range(count):
        at = series[k] * LANES
        for i in range(LANES):
            state[KEEP_1 + at + i] *= weight[k]
            follows = _follows(state, i, decays[k])
            state[ESTIMATE + at + i] = state[KEEP_1 + at + i] * (1.0 - follows)


@njit(nogil=True, cache=True, error_model="numpy")
def _follows(state: FloatArray, i: int, rho: float) -> float:
    """Return κ, the innovation of a response that keeps ρ of itself, over the response."""
    return float((rho - state[KEPT + i]) / (rho - state[DECAY + i]))


@njit(nogil=True, cache=True)
def is_tracked(state: FloatArray, decays: FloatArray, series: IntArray) -> bool:
    """Tell whether the innovations of all those responses only follow them, to their rounding."""
    for k in range(series.size):
        at = series[k] * LANES
        for i in range(LANES):
            if decays[k] <= state[DECAY + i]:
                return False
            keep = state[KEEP_1 + at + i]
            gap = state[ESTIMATE + at + i] - keep * (1.0 - _follows(state, i, decays[k]))
            if not abs(gap) <= ROUNDING * abs(keep):
                return False
    return True
