"""The stage of Prandtl-Ishlinskii with exponentially distributed thresholds.

Along a branch w = w_r + s ((d + α) v − 2 α r₀ g) with g = 1 − exp(−v / 2r₀), and g of v + Δ is
g + (1 − g) g(Δ): no difference of nearly equal numbers at small steps.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.bouc_wen import C1, C2, C3, C4, C5, C6, C7, SHORT
from bwbayes.inference.compiled.extrema import (
    EACH_OWN,
    EITHER,
    EXTRA,
    FRESH,
    LAST,
    OWN,
    PUSH,
    REST,
    ROWS,
    SIGN,
    SLOT,
    TURNED,
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

__all__ = ["exponential", "rows"]

# Rows: d + α, 2 α r₀, 1 / 2r₀, g, g of a long step; then w_r − (d + α) u_r of each slot.
STEEP, SHORTFALL, RATE, GONE, STEP = (LANES * row for row in range(ROWS, ROWS + 5))
SLOTS = (ROWS + 5) * LANES


def rows(column: Values, plan: ExtremaPlan, memory: Memory) -> FloatArray:
    """Return what the stage starts from, (models, rows). A slot keeps w_r − (d + α) u_r."""
    d, alpha, threshold = column["d"], column["alpha"], column["threshold"]
    volts, displacements = turns(memory)
    nothing = np.zeros_like(d)
    steep = d + alpha
    every = [
        *common_rows(memory),
        *(steep, 2 * alpha * threshold, 1 / (2 * threshold), nothing, nothing),
        *of_slots(plan, memory, displacements - steep * volts),
    ]
    return np.stack(every, axis=1)


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def exponential(
    own: FloatArray, plan: FloatArray, voltage: FloatArray, first: int, last: int, out: FloatArray
) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out`` and move the memory on."""
    fastest = 0.0
    for i in range(LANES):
        fastest = max(fastest, own[RATE + i])
    for t in range(first, last):
        u = voltage[t]
        row = (t - first) * LANES
        slot = int(plan[t, SLOT])
        if slot < 0:
            still(own, row, out)
            continue
        if plan[t, PUSH] > 0.0:
            at = SLOTS + int(plan[t, PUSH]) * LANES
            for i in range(LANES):
                own[at + i] = own[LAST + i] - own[STEEP + i] * voltage[t - 1]
        s = plan[t, SIGN]
        whose = plan[t, WHOSE]
        base = SLOTS + slot * LANES
        # The first curve is half a branch of twice the length.
        part = 0.5 if slot == 0 else 1.0
        if whose == EITHER:
            _either(own, base, plan[t, TURNED], plan[t, EXTRA], u, row, out)
            continue
        v = abs(u - voltage[t - 1]) / part
        if plan[t, FRESH] > 0.0:
            v = _afresh(own, whose, plan[t, TURNED], u, part)
        if v * fastest > SHORT:
            _long(own, v, fastest)
            v = 0.0
        for i in range(LANES):
            z = own[RATE + i] * v
            end = C4 + z * (C5 + z * (C6 + z * C7))
            g = z * (1.0 + z * (C1 + z * (C2 + z * (C3 + z * end))))
            gone = own[GONE + i]
            gone += (1.0 - gone) * g
            own[GONE + i] = gone
            w = own[base + i] + own[STEEP + i] * u - s * part * own[SHORTFALL + i] * gone
            own[LAST + i] = w
            out[row + i] = w - own[REST + i]


@njit(nogil=True, cache=True)
def _afresh(own: FloatArray, whose: float, turned: float, u: float, part: float) -> float:
    """Put g to a new branch, and return how far along it is still to go."""
    for i in range(LANES):
        own[GONE + i] = 0.0
    if whose != EACH_OWN:
        return abs(u - turned) / part
    for i in range(LANES):
        own[GONE + i] = -math.expm1((u - own[OWN + i]) * own[RATE + i])
    return 0.0


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _long(own: FloatArray, v: float, fastest: float) -> None:
    """Move g on by v of any length: g(2z) = g(z) (2 − g(z)) from a small z on."""
    doublings = 0
    while v * fastest > SHORT:
        v *= 0.5
        doublings += 1
    for i in range(LANES):
        z = own[RATE + i] * v
        end = C4 + z * (C5 + z * (C6 + z * C7))
        own[STEP + i] = z * (1.0 + z * (C1 + z * (C2 + z * (C3 + z * end))))
    for _ in range(doublings):
        for i in range(LANES):
            g = own[STEP + i]
            own[STEP + i] = g * (2.0 - g)
    for i in range(LANES):
        own[GONE + i] += (1.0 - own[GONE + i]) * own[STEP + i]


@njit(nogil=True, cache=True)
def _either(
    own: FloatArray,
    base: int,
    turned: float,
    before: float,
    u: float,
    row: int,
    out: FloatArray,
) -> None:
    """Move on models that have come back to an extremum of their own, and those that have not."""
    for i in range(LANES):
        passed = u >= own[OWN + i]
        from_slot = base - 2 * LANES if passed else base
        start = before if passed else turned
        gone = -math.expm1(-(u - start) * own[RATE + i])
        w = own[from_slot + i] + own[STEEP + i] * u - own[SHORTFALL + i] * gone
        if passed:
            own[OWN + i] = u
            own[base - LANES + i] = w - own[STEEP + i] * u
        own[LAST + i] = w
        out[row + i] = w - own[REST + i]
