"""The filter of a noise with one state, in lanes, as :mod:`bwbayes.inference.rough` says it."""

from __future__ import annotations

import math

from numba import njit

from bwbayes.arrays import FloatArray

# isort: off
# fmt: off
from bwbayes.inference.compiled.lanes import (
    DECAY, ESTIMATE, INVERSE, LANES, PREDICTED, RATE, RATIO, SURPLUS, TRUST, UNSURE, VARIANCE,
)
# fmt: on
# isort: on

__all__ = ["is_settled", "skip", "unsure"]

# What is below this part of an innovation's variance adds nothing to it.
FORGOTTEN = 1e-18


@njit(nogil=True, cache=True, error_model="numpy")
def unsure(state: FloatArray) -> None:
    """Take what the filter does not know yet to the next reading."""
    for i in range(LANES):
        ratio = state[UNSURE + i] / state[VARIANCE + i]
        inverse = 1.0 / (state[VARIANCE + i] + state[UNSURE + i])
        state[RATIO + i] *= 1.0 + ratio
        state[TRUST + i] = (state[PREDICTED + i] + state[UNSURE + i]) * inverse
        state[UNSURE + i] *= state[DECAY + i] * state[DECAY + i] * state[VARIANCE + i] * inverse
        state[INVERSE + i] = inverse


@njit(nogil=True, cache=True)
def skip(state: FloatArray, readings: float, series: int) -> None:
    """Let the filter pass over missing readings."""
    for i in range(LANES):
        decay = math.exp(-readings * state[RATE + i])
        fresh = -math.expm1(-2.0 * readings * state[RATE + i])
        state[UNSURE + i] = decay * decay * state[UNSURE + i] + fresh * state[SURPLUS + i]
        for k in range(series):
            state[ESTIMATE + k * LANES + i] *= decay


@njit(nogil=True, cache=True)
def is_settled(state: FloatArray) -> bool:
    """Tell whether all models' filters are in their steady state."""
    settled = True
    for i in range(LANES):
        settled &= state[UNSURE + i] <= FORGOTTEN * state[VARIANCE + i]
    return settled
