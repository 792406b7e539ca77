"""What the stages of operators that remember extrema share: where the voltage turns and returns.

Which branch a sample lies on is the voltage's affair alone: :func:`plan_of` says it for all models
and the whole record at once. What is left to a stage is to remember the displacement of each model
at each turn, in slots, and to move along a branch, by a recurrence where it can.

The unknown start gives each model an extremum of its own. While the voltage stays below all of
these, or has passed all, nothing is different; in between, models are told apart one by one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.model.operators.memory import Memory

__all__ = [
    "EACH_OWN",
    "EITHER",
    "EXTRA",
    "FRESH",
    "LAST",
    "OWN",
    "PUSH",
    "REST",
    "ROWS",
    "SHARED",
    "SIGN",
    "SLOT",
    "TURNED",
    "WHOSE",
    "ExtremaPlan",
    "common_rows",
    "of_slots",
    "still",
    "turns",
]

# Columns of a plan: the slot of the extremum that a sample's branch comes from (−1: the voltage has
# not moved yet); the direction; the extremum's voltage; the slot in which the last sample becomes
# an extremum (0: none); whether the branch is another than the last sample's; whose extremum it is;
# and what an operator needs to know.
SLOT, SIGN, TURNED, PUSH, FRESH, WHOSE, EXTRA = range(7)
COLUMNS = 7

# Whose: all models'; each has its own; of those that have passed their own it is the one before.
SHARED, EACH_OWN, EITHER = 0.0, 1.0, 2.0

# Rows that all stages have: w₀, w of the last sample, the extremum of its own.
ROWS = 3
REST, LAST, OWN = (LANES * row for row in range(ROWS))


class ExtremaPlan(NamedTuple):
    """What is known beforehand: ``rows`` (samples, columns), and how many slots it takes."""

    rows: FloatArray
    slots: int

    @classmethod
    def of(cls, voltage: FloatArray, memory: Memory) -> ExtremaPlan:
        """Look where a voltage (samples,) turns and closes loops."""
        levels = np.array([extremum.voltage for extremum in memory.extrema])
        each = [i for i, extremum in enumerate(memory.extrema) if extremum.own is not None]
        own = each[0] if each else -1
        lowest = float(np.min(_own(memory))) if each else 0.0
        return cls(*plan_of(voltage, levels, memory.direction, own, lowest))


def _own(memory: Memory) -> FloatArray:
    """Return the extremum (models,) that each model has of its own, V, or zeros."""
    for extremum in memory.extrema:
        if extremum.own is not None:
            return extremum.own
    return np.zeros_like(memory.displacement)


@njit(nogil=True, cache=True)
def plan_of(
    voltage: FloatArray, levels: FloatArray, direction: float, own: int, lowest: float
) -> tuple[FloatArray, int]:
    """Return the plan (samples, columns), and the number of slots.

    ``levels`` are the extrema at the first sample, V, the one in slot ``own`` (−1: none) being the
    largest of those that models have of their own, and ``lowest`` the lowest.
    """
    plan = np.zeros((voltage.size, COLUMNS))
    stack = np.empty(levels.size + voltage.size)
    stack[: levels.size] = levels
    depth, slots = levels.size, levels.size
    plan[0, SLOT] = -1.0
    for t in range(1, voltage.size):
        u = voltage[t]
        step = u - voltage[t - 1]
        if step == 0.0:
            plan[t] = plan[t - 1]
            plan[t, PUSH] = plan[t, FRESH] = 0.0
            continue
        s = 1.0 if step > 0.0 else -1.0
        if s == -direction:
            stack[depth] = voltage[t - 1]
            plan[t, PUSH] = depth
            depth += 1
            slots = max(slots, depth)
        direction = s
        while depth > 1:
            closing = stack[depth - 2] if depth > 2 else -stack[1]
            if s * u < s * closing:
                break
            depth -= 2 if depth > 2 else 1
        if own >= depth:
            own = -1
        slot = depth - 1
        plan[t, SLOT] = slot
        plan[t, SIGN] = s
        plan[t, TURNED] = stack[slot]
        if own > 0 and slot == own:
            plan[t, WHOSE] = EACH_OWN
        elif own > 0 and slot == own + 1 and u >= lowest:
            plan[t, WHOSE] = EITHER
        same = plan[t - 1, SLOT] == slot and plan[t - 1, WHOSE] == plan[t, WHOSE]
        plan[t, FRESH] = 0.0 if same and plan[t, PUSH] == 0.0 else 1.0
        # For those that have passed their own: where their branch comes from.
        plan[t, EXTRA] = stack[slot - 2] if plan[t, WHOSE] == EITHER else 0.0
    return plan, slots


def of_slots(plan: ExtremaPlan, memory: Memory, *kept: FloatArray) -> list[FloatArray]:
    """Return the rows of all slots: of each, ``kept`` (slots known, models) in turn."""
    nothing = np.zeros_like(memory.displacement)
    known = len(memory.extrema)
    return [one[k] if k < known else nothing for k in range(plan.slots) for one in kept]


def turns(memory: Memory) -> tuple[FloatArray, FloatArray]:
    """Return the extrema's voltages, V, and displacements, um, each (extrema, models)."""
    nothing = np.zeros_like(memory.displacement)
    volts = [e.voltage + nothing if e.own is None else e.own for e in memory.extrema]
    return np.stack(volts), np.stack([e.displacement for e in memory.extrema])


def common_rows(memory: Memory) -> list[FloatArray]:
    """Return the rows that all stages have."""
    return [memory.displacement, memory.displacement, _own(memory)]


@njit(nogil=True, cache=True)
def still(own: FloatArray, row: int, out: FloatArray) -> None:
    """Stay where the voltage has not moved yet."""
    for i in range(LANES):
        out[row + i] = own[LAST + i] - own[REST + i]
