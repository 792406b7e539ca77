"""The stage of Preisach with a density of bells.

With T = tanh(u / u_s) a branch is w = w_r + d (u − u_r) + s H (T − T_r)². T comes from
exp(−2u / u_s), which is multiplied on and keeps its digits wherever the voltage is.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.bouc_wen import C1, C2, C3, C4, C5, C6, C7, SHORT
from bwbayes.inference.compiled.extrema import (
    EITHER,
    LAST,
    OWN,
    PUSH,
    REST,
    ROWS,
    SIGN,
    SLOT,
    WHOSE,
    ExtremaPlan,
    common_rows,
    of_slots,
    still,
    turns,
)
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.model.declaration import Values
from bwbayes.model.operators.memory import Memory

__all__ = ["FARTHEST", "NEAREST", "bells", "rows"]

# Rows: d, H = α_R u_s² / 2, 2 / u_s, the exponential, T, the factor of a long step; then
# w_r − d u_r and T_r of each slot.
SLOPE, HEIGHT, SCALE, DECAYED, TANH, FACTOR = (LANES * row for row in range(ROWS, ROWS + 6))
SLOTS = (ROWS + 6) * LANES

# The largest |u| in units of u_s must lie between these: nearer to zero T loses digits of what
# Rayleigh's law needs, and beyond, the exponential overflows.
FARTHEST, NEAREST = 1e-3, 300.0


def rows(column: Values, plan: ExtremaPlan, memory: Memory) -> FloatArray:
    """Return what the stage starts from, (models, rows). A slot keeps w_r − d u_r, and T_r."""
    d, rayleigh, saturation = column["d"], column["rayleigh"], column["saturation"]
    volts, displacements = turns(memory)
    nothing = np.zeros_like(d)
    start = np.tanh(memory.voltage / saturation)
    every = [
        *common_rows(memory),
        *(d, rayleigh / 2 * saturation**2, 2 / saturation, nothing, start, nothing),
        *of_slots(plan, memory, displacements - d * volts, np.tanh(volts / saturation)),
    ]
    return np.stack(every, axis=1)


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def bells(
    own: FloatArray, plan: FloatArray, voltage: FloatArray, first: int, last: int, out: FloatArray
) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out`` and move the memory on."""
    fastest = 0.0
    for i in range(LANES):
        fastest = max(fastest, own[SCALE + i])
        # Anew from time to time, so that rounding does not add up.
        own[DECAYED + i] = math.exp(-own[SCALE + i] * voltage[max(first - 1, 0)])
    for t in range(first, last):
        u = voltage[t]
        row = (t - first) * LANES
        slot = int(plan[t, SLOT])
        if slot < 0:
            still(own, row, out)
            continue
        if plan[t, PUSH] > 0.0:
            at = SLOTS + 2 * int(plan[t, PUSH]) * LANES
            for i in range(LANES):
                own[at + i] = own[LAST + i] - own[SLOPE + i] * voltage[t - 1]
                own[at + LANES + i] = own[TANH + i]
        s = plan[t, SIGN]
        base = SLOTS + 2 * slot * LANES
        step = u - voltage[t - 1]
        if abs(step) * fastest > SHORT:
            _long(own, step, fastest)
            step = 0.0
        # The first curve is half a branch from −u on.
        part = 2.0 if slot == 0 else 1.0
        for i in range(LANES):
            z = own[SCALE + i] * step
            end = C4 + z * (C5 + z * (C6 + z * C7))
            decayed = own[DECAYED + i]
            decayed -= decayed * z * (1.0 + z * (C1 + z * (C2 + z * (C3 + z * end))))
            own[DECAYED + i] = decayed
            tanh = (1.0 - decayed) / (1.0 + decayed)
            own[TANH + i] = tanh
            moved = tanh - own[base + LANES + i]
            w = own[base + i] + own[SLOPE + i] * u + s * part * own[HEIGHT + i] * moved * moved
            own[LAST + i] = w
            out[row + i] = w - own[REST + i]
        if plan[t, WHOSE] == EITHER:
            _either(own, base, u, row, out)


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _long(own: FloatArray, step: float, fastest: float) -> None:
    """Multiply exp(−2u / u_s) on over a step of any length: squared from a small one on."""
    doublings = 0
    while abs(step) * fastest > SHORT:
        step *= 0.5
        doublings += 1
    for i in range(LANES):
        z = own[SCALE + i] * step
        end = C4 + z * (C5 + z * (C6 + z * C7))
        own[FACTOR + i] = 1.0 - z * (1.0 + z * (C1 + z * (C2 + z * (C3 + z * end))))
    for _ in range(doublings):
        for i in range(LANES):
            own[FACTOR + i] *= own[FACTOR + i]
    for i in range(LANES):
        own[DECAYED + i] *= own[FACTOR + i]


@njit(nogil=True, cache=True)
def _either(own: FloatArray, base: int, u: float, row: int, out: FloatArray) -> None:
    """Correct the models that have come back to an extremum of their own."""
    before, passed = base - 4 * LANES, base - 2 * LANES
    for i in range(LANES):
        if u >= own[OWN + i]:
            tanh = own[TANH + i]
            moved = tanh - own[before + LANES + i]
            level = own[before + i] + own[HEIGHT + i] * moved * moved
            own[OWN + i] = u
            own[passed + i] = level
            own[passed + LANES + i] = tanh
            own[LAST + i] = level + own[SLOPE + i] * u
            out[row + i] = own[LAST + i] - own[REST + i]
