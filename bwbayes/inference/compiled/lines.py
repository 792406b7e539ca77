"""The stage of plays with given thresholds, which all models share.

A branch is a straight line between two of the thresholds, w = w_r + s (steepness v + level), and
which of the lines a sample is on is known beforehand. So it costs the same for any number of plays.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.extrema import (
    EACH_OWN,
    EXTRA,
    LAST,
    OWN,
    PUSH,
    REST,
    ROWS,
    SHARED,
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
from bwbayes.model.operators.memory import Memory
from bwbayes.model.operators.prandtl_ishlinskii import Lines

__all__ = ["lines", "planned", "rows"]

# Rows: the number of plays; steepness and level by thresholds passed; 2 r_j; then w_r of each slot.
PLAYS, LINES = (LANES * row for row in range(ROWS, ROWS + 2))


def rows(lines: Lines, plan: ExtremaPlan, memory: Memory) -> FloatArray:
    """Return what the stage starts from, (models, rows). A slot keeps w_r."""
    nothing = np.zeros_like(memory.displacement)
    every = [
        *common_rows(memory),
        nothing + lines.corners.shape[1],
        *(*lines.steepness.T, *lines.level.T),
        *(corner + nothing for corner in lines.corners[0]),
        *of_slots(plan, memory, turns(memory)[1]),
    ]
    return np.stack(every, axis=1)


def planned(lines: Lines, plan: ExtremaPlan, voltage: FloatArray) -> FloatArray:
    """Return the plan with the number of thresholds passed."""
    table = plan.rows
    travel = np.abs(voltage - table[:, TURNED])
    travel[table[:, SLOT] == 0] *= 2
    shared = table[:, WHOSE] == SHARED
    table[shared, EXTRA] = np.searchsorted(lines.corners[0], travel[shared])
    return table


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def lines(
    own: FloatArray, plan: FloatArray, voltage: FloatArray, first: int, last: int, out: FloatArray
) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out`` and move the memory on."""
    plays = int(own[PLAYS])
    levels = LINES + (plays + 1) * LANES
    slots = levels + (2 * plays + 1) * LANES
    for t in range(first, last):
        u = voltage[t]
        row = (t - first) * LANES
        slot = int(plan[t, SLOT])
        if slot < 0:
            still(own, row, out)
            continue
        if plan[t, PUSH] > 0.0:
            at = slots + int(plan[t, PUSH]) * LANES
            for i in range(LANES):
                own[at + i] = own[LAST + i]
        base = slots + slot * LANES
        if plan[t, WHOSE] == SHARED:
            # The first curve is half a branch of twice the length.
            part = 0.5 if slot == 0 else 1.0
            s = plan[t, SIGN]
            v = s * abs(u - plan[t, TURNED])
            line = int(plan[t, EXTRA]) * LANES
            steepness, level = LINES + line, levels + line
            for i in range(LANES):
                w = own[base + i] + own[steepness + i] * v + s * part * own[level + i]
                own[LAST + i] = w
                out[row + i] = w - own[REST + i]
        elif plan[t, WHOSE] == EACH_OWN:
            for i in range(LANES):
                own[LAST + i] = own[base + i] - _line(own, plays, i, own[OWN + i] - u)
            still(own, row, out)
        else:
            _either(own, plays, base, plan[t, TURNED], plan[t, EXTRA], u)
            still(own, row, out)


@njit(nogil=True, cache=True)
def _either(own: FloatArray, plays: int, base: int, turned: float, before: float, u: float) -> None:
    """Move on models that have come back to an extremum of their own, and those that have not."""
    for i in range(LANES):
        if u >= own[OWN + i]:
            w = own[base - 2 * LANES + i] + _line(own, plays, i, u - before)
            own[OWN + i] = u
            own[base - LANES + i] = w
        else:
            w = own[base + i] + _line(own, plays, i, u - turned)
        own[LAST + i] = w


@njit(nogil=True, cache=True)
def _line(own: FloatArray, plays: int, i: int, v: float) -> float:
    """Return how far model i is along a branch of length v, um."""
    levels = LINES + (plays + 1) * LANES
    corners = levels + (plays + 1) * LANES
    passed = 0
    while passed < plays and v > own[corners + passed * LANES + i]:
        passed += 1
    at = passed * LANES + i
    moved: float = own[LINES + at] * v + own[levels + at]
    return moved
