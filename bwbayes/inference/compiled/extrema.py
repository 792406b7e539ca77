"""The stage of operators that remember extrema: each brings its Everett function alone.

Which branch a sample lies on is the voltage's affair alone: :func:`plan_of` says it for all models
and the whole record at once. What is left is to remember the displacement of each model at each
turn, in slots, and to add what :meth:`everett
<bwbayes.model.operators.extremum_memory.RemembersExtrema.everett>` says from there on.

The unknown start gives each model an extremum of its own. While the voltage stays below all of
these, or has passed all, nothing is different; in between, models are told apart one by one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.model.compiled import everett
from bwbayes.model.operators.extremum_memory import Memory, RemembersExtrema

__all__ = ["ExtremaPlan", "along_branches", "rows"]

# Columns of a plan: the slot of the extremum that a sample's branch comes from (−1: the voltage has
# not moved yet); the direction; the extremum's voltage; the slot in which the last sample becomes
# an extremum (0: none); whether the branch is another than the last sample's; whose extremum it is;
# and the voltage of that two before it.
SLOT, SIGN, TURNED, PUSH, FRESH, WHOSE, BEFORE = range(7)
COLUMNS = 7

# Whose: all models'; each has its own; of those that have passed their own it is the one before.
SHARED, EACH_OWN, EITHER = 0.0, 1.0, 2.0

# Rows: w₀, w of the last sample, the extremum of its own, how many numbers its Everett function
# needs; then these, and w of each slot.
FIXED = 4
REST, LAST, OWN, COUNT, NUMBERS = (LANES * row for row in range(FIXED + 1))


class ExtremaPlan(NamedTuple):
    """What is known beforehand: ``rows`` (samples, columns), and how many slots it takes."""

    rows: FloatArray
    slots: int

    @classmethod
    def of(cls, voltage: FloatArray, memory: Memory) -> ExtremaPlan:
        """Look where a voltage (samples,) turns and closes loops."""
        levels = np.array([extremum.voltage for extremum in memory.extrema])
        owners = [i for i, extremum in enumerate(memory.extrema) if extremum.own is not None]
        own_slot = owners[0] if owners else -1
        lowest = float(np.min(_own(memory))) if owners else 0.0
        return cls(*plan_of(voltage, levels, memory.direction, own_slot, lowest))


def _own(memory: Memory) -> FloatArray:
    """Return the extremum (models,) that each model has of its own, V, or zeros."""
    for extremum in memory.extrema:
        if extremum.own is not None:
            return extremum.own
    return np.zeros_like(memory.displacement)


@njit(nogil=True, cache=True)
def plan_of(
    voltage: FloatArray, levels: FloatArray, direction: float, own_slot: int, lowest: float
) -> tuple[FloatArray, int]:
    """Return the plan (samples, columns), and the number of slots.

    ``levels`` are the extrema at the first sample, V, that in ``own_slot`` (−1: none) being the
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
        if own_slot >= depth:
            own_slot = -1
        slot = depth - 1
        plan[t, SLOT] = slot
        plan[t, SIGN] = s
        plan[t, TURNED] = stack[slot]
        if own_slot > 0 and slot == own_slot:
            plan[t, WHOSE] = EACH_OWN
        elif own_slot > 0 and slot == own_slot + 1 and u >= lowest:
            plan[t, WHOSE] = EITHER
        same = plan[t - 1, SLOT] == slot and plan[t - 1, WHOSE] == plan[t, WHOSE]
        plan[t, FRESH] = 0.0 if same and plan[t, PUSH] == 0.0 else 1.0
        # For those that have passed their own: where their branch comes from.
        plan[t, BEFORE] = stack[slot - 2] if plan[t, WHOSE] == EITHER else 0.0
    return plan, slots


@njit(nogil=True, cache=True)
def along_branches(
    operator: RemembersExtrema,
    group: FloatArray,
    plan: FloatArray,
    voltage: FloatArray,
    first: int,
    last: int,
    out: FloatArray,
) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out`` and move the memory on."""
    count, w = int(group[COUNT]), np.empty(last - first)
    numbers, slots = np.empty(count), NUMBERS + count * LANES
    begin = first
    while begin < last:
        # As far as the branch is the same.
        end = begin + 1
        while end < last and plan[end, FRESH] == 0.0:
            end += 1
        base = slots + int(plan[begin, SLOT]) * LANES
        pushed = slots + int(plan[begin, PUSH]) * LANES
        for i in range(LANES):
            for k in range(count):
                numbers[k] = group[NUMBERS + k * LANES + i]
            if pushed > slots:
                group[pushed + i] = group[LAST + i]
            if base < slots:
                w[: end - begin] = group[LAST + i]
            else:
                own = group[OWN + i] if plan[begin, WHOSE] == EACH_OWN else plan[begin, TURNED]
                _branch(operator, numbers, group[base + i], own, plan[begin], voltage[begin:end], w)
            if plan[begin, WHOSE] == EITHER:
                _either(operator, numbers, group, base + i, i, plan[begin], voltage[begin:end], w)
            group[LAST + i] = w[end - begin - 1]
            for t in range(begin, end):
                out[(t - first) * LANES + i] = w[t - begin] - group[REST + i]
        begin = end


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _branch(
    operator: RemembersExtrema,
    numbers: FloatArray,
    level: float,
    turned: float,
    plan: FloatArray,
    voltage: FloatArray,
    w: FloatArray,
) -> None:
    """Write w along a branch from an extremum with a displacement ``level`` on."""
    s = plan[SIGN]
    if plan[SLOT] == 0.0:
        # The first curve is half a branch from the mirrored voltage on.
        for t in range(voltage.size):
            u = voltage[t]
            w[t] = level + 0.5 * s * everett(operator, numbers, -u, u)
    else:
        for t in range(voltage.size):
            w[t] = level + s * everett(operator, numbers, turned, voltage[t])


@njit(nogil=True, cache=True)
def _either(
    operator: RemembersExtrema,
    numbers: FloatArray,
    group: FloatArray,
    place: int,
    lane: int,
    plan: FloatArray,
    voltage: FloatArray,
    w: FloatArray,
) -> None:
    """Go on from the extremum before its own once a model has come back to that."""
    for t in range(voltage.size):
        u = voltage[t]
        if u >= group[OWN + lane]:
            moved = everett(operator, numbers, plan[BEFORE], u)
            w[t] = group[place - 2 * LANES] + moved
            group[OWN + lane], group[place - LANES] = u, w[t]


def rows(numbers: FloatArray, plan: ExtremaPlan, memory: Memory) -> FloatArray:
    """Return what the stage starts from, (models, rows), w₀ first."""
    extrema = len(memory.extrema)
    group = np.zeros((len(numbers), FIXED + numbers.shape[1] + max(plan.slots, extrema)))
    group[:, 0] = group[:, 1] = memory.displacement
    group[:, 2], group[:, 3] = _own(memory), numbers.shape[1]
    group[:, FIXED : FIXED + numbers.shape[1]] = numbers
    for slot, extremum in enumerate(memory.extrema, FIXED + numbers.shape[1]):
        group[:, slot] = extremum.displacement
    return group
