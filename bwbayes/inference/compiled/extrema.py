"""The stage of operators that remember extrema: each provides its Everett function alone.

Models are worked out one after the other, each with a stack: the voltages of the extrema that still
count, and the displacements there. The samples between two changes of that stack are one branch and
are worked out together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled.caching import compile_cached
from bwbayes.inference.compiled.lanes import LANES, repeat_last
from bwbayes.model.compiled import formula
from bwbayes.model.operators.extremum_memory import Memory, RemembersExtrema


class Branches(NamedTuple):
    """Numbers and memory of models.

    ``numbers`` (models, any) are those of the operator; (models,) are w₀, w of the last sample, um,
    its direction and the number of extrema in memory; (models, extrema) their voltages, V, and the
    displacements there, um.
    """

    numbers: FloatArray
    equilibrium: FloatArray
    last: FloatArray
    direction: FloatArray
    depth: IntArray
    voltages: FloatArray
    displacements: FloatArray

    @classmethod
    def of(cls, numbers: FloatArray, voltage: FloatArray, memory: Memory) -> Branches:
        """Return the models at the first sample of a voltage."""
        models, extrema = memory.displacement.size, memory.extrema
        levels = np.array([extremum.voltage for extremum in extrema])
        stacks = np.zeros((2, models, deepest(voltage, levels, memory.direction)))
        for slot, (level, displacement, voltage_of_model) in enumerate(extrema):
            stacks[0, :, slot] = level if voltage_of_model is None else voltage_of_model
            stacks[1, :, slot] = displacement
        direction, depth = np.full(models, memory.direction), np.full(models, len(extrema))
        start = memory.displacement
        return cls(numbers, start, start.copy(), direction, depth, *stacks)


@compile_cached()
def deepest(voltage: FloatArray, levels: FloatArray, direction: float) -> int:
    """Return the largest number of extrema in memory, from the models' largest initial extrema.

    A lower extremum is forgotten earlier.
    """
    stack = np.empty(levels.size + voltage.size)
    stack[: levels.size] = levels
    depth = slots = levels.size
    for t in range(1, voltage.size):
        s = np.sign(voltage[t] - voltage[t - 1])
        if s == 0.0:
            continue
        if s == -direction:
            stack[depth] = voltage[t - 1]
            depth += 1
            slots = max(slots, depth)
        direction = s
        depth = _remaining(stack, depth, s, voltage[t])
    return slots


@compile_cached()
def _closing(stack: FloatArray, depth: int, s: float) -> float:
    """Return the voltage at which the branch from the last extremum is forgotten, V, times s.

    It is the same as in :meth:`RemembersExtrema.advance`.
    """
    if depth == 1:
        return np.inf
    closing: float = stack[depth - 2] if depth > 2 else -stack[1]
    return s * closing


@compile_cached()
def _remaining(stack: FloatArray, depth: int, s: float, u: float) -> int:
    """Return the number of extrema that remain once a voltage has reached u in direction s."""
    while s * u >= _closing(stack, depth, s):
        depth -= 2 if depth > 2 else 1
    return depth


@compile_cached()
def _ends(voltage: FloatArray, first: int, last: int) -> IntArray:
    """Return the index of the voltage's next reversal, for samples ``first`` to ``last``."""
    ends = np.full(last - first, last)
    direction, following = 0.0, last
    for t in range(last - 1, max(first, 1) - 1, -1):
        s = np.sign(voltage[t] - voltage[t - 1])
        if s != 0.0:
            ends[t - first] = ends[following - first] if s == direction else following
            direction, following = s, t
    return ends


@compile_cached()
def along_branches(
    operator: RemembersExtrema,
    models: Branches,
    group: int,
    voltage: FloatArray,
    first: int,
    out: FloatArray,
) -> None:
    """Write w − w₀ of samples from ``first`` on to ``out`` (samples, lanes); advance the memory."""
    last = first + len(out)
    w, ends = np.empty(len(out)), _ends(voltage, first, last)
    count = min(LANES, models.equilibrium.size - group * LANES)
    for i in range(count):
        model = group * LANES + i
        voltages, displacements = models.voltages[model], models.displacements[model]
        here, direction = models.last[model], models.direction[model]
        depth, begin = models.depth[model], first
        while begin < last:
            before, u = voltage[max(begin - 1, 0)], voltage[begin]
            s = np.sign(u - before)
            if s == 0.0:
                w[begin - first] = here
                begin += 1
                continue
            if s == -direction:
                voltages[depth], displacements[depth] = before, here
                depth += 1
            direction = s
            depth = _remaining(voltages, depth, s, u)
            closing, end = _closing(voltages, depth, s), ends[begin - first]
            if s * voltage[end - 1] >= closing:
                end = begin + 1
                while s * voltage[end] < closing:
                    end += 1
            turned, level = voltages[depth - 1], displacements[depth - 1]
            branch = w[begin - first : end - first]
            _branch(
                operator, models.numbers[model], turned, level, s, depth,
                voltage[begin:end], branch,
            )  # fmt: skip
            here, begin = branch[-1], end
        models.last[model], models.direction[model], models.depth[model] = here, direction, depth
        for t in range(len(out)):
            out[t, i] = w[t] - models.equilibrium[model]
    repeat_last(count, out)


@compile_cached(error_model="numpy", fastmath={"contract", "nsz"})
def _branch(
    operator: RemembersExtrema,
    numbers: FloatArray,
    turned: float,
    level: float,
    s: float,
    depth: int,
    voltage: FloatArray,
    w: FloatArray,
) -> None:
    """Write w along a branch from an extremum on; on the first branch it moves half as far."""
    first = depth == 1
    half_step = 0.5 * s if first else s
    for t in range(voltage.size):
        u = voltage[t]
        w[t] = level + half_step * formula(operator, numbers, -u if first else turned, u)
