"""Gain and creep on the compiled engine: what is added to a drive, sample by sample.

The gain adds to the drive, before the dynamics. The creep's lags stand beside the dynamics, so with
creep the dynamics are followed here as well, and what comes out is the displacement from rest.
"""

from __future__ import annotations

from numba import njit

from bwbayes.arrays import FloatArray

# isort: off
# fmt: off
from bwbayes.inference.compiled.lanes import (
    CREEPS, CUBIC, GROWTH, LAG, LANES, QUADRATIC, REST, STRENGTH, TRUE_A1, TRUE_A2, TRUE_B0,
    TRUE_B1, TRUE_B2, TRUE_X1, TRUE_X2,
)
# fmt: on
# isort: on

__all__ = ["creep", "polynomial"]


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def polynomial(
    state: FloatArray, curve: FloatArray, first: int, last: int, drive: FloatArray
) -> None:
    """Add q₂ (x² − x₀²) + q₃ (x³ − x₀³) to the drive's distance from rest.

    ``curve`` (samples, 2) has both differences of powers.
    """
    for t in range(first, last):
        square, cube = curve[t, 0], curve[t, 1]
        row = (t - first) * LANES
        for i in range(LANES):
            drive[row + i] += square * state[QUADRATIC + i] + cube * state[CUBIC + i]


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def creep(
    state: FloatArray,
    lags: FloatArray,
    growth: FloatArray,
    first: int,
    last: int,
    drive: FloatArray,
) -> None:
    """Let dynamics and creep follow the drive, and put x − x₀ in its place.

    ``lags`` (times, 3) are each lag's two coefficients of the drive and the part that it keeps of
    itself; ``growth`` (samples,) is |u| / U, or empty.
    """
    for t in range(first, last):
        row = (t - first) * LANES
        size = 1.0 if growth.size == 0 else growth[t]
        size_0 = 1.0 if growth.size == 0 else growth[0]
        for i in range(LANES):
            w = drive[row + i]
            total = w + state[REST + i]
            before = state[REST + i] * (1.0 + state[GROWTH + i] * size_0)
            state[CREEPS + i] = total * (1.0 + state[GROWTH + i] * size) - before
            x = state[TRUE_B0 + i] * w + state[TRUE_X1 + i]
            state[TRUE_X1 + i] = state[TRUE_B1 + i] * w - state[TRUE_A1 + i] * x
            state[TRUE_X1 + i] += state[TRUE_X2 + i]
            state[TRUE_X2 + i] = state[TRUE_B2 + i] * w - state[TRUE_A2 + i] * x
            drive[row + i] = x
        for k in range(lags.shape[0]):
            now, next_, keep = lags[k, 0], lags[k, 1], lags[k, 2]
            at = k * LANES
            for i in range(LANES):
                w = state[CREEPS + i]
                x = now * w + state[LAG + at + i]
                state[LAG + at + i] = next_ * w + keep * x
                drive[row + i] += state[STRENGTH + at + i] * x
