"""The stage of any operator that has a step: one model after the other, sample by sample."""

from __future__ import annotations

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.model.compiled import move
from bwbayes.model.step import HysteresisStep

__all__ = ["rows", "stepped"]

# Where rows begin: a model's number, w₀, and what its step remembers.
NUMBER, REST, MEMORY = LANES * 0, LANES * 1, LANES * 2


def rows(memory: FloatArray, equilibrium: FloatArray) -> FloatArray:
    """Return what the stage starts from, (models, rows); its plan are the step's parameters."""
    return np.column_stack([np.arange(equilibrium.size), equilibrium, memory])


@njit(nogil=True, cache=True)
def stepped(
    step: HysteresisStep,
    group: FloatArray,
    plan: FloatArray,
    voltage: FloatArray,
    first: int,
    last: int,
    out: FloatArray,
) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out`` and move the memory on."""
    memory = np.empty((group.size - MEMORY) // LANES)
    after = np.empty(memory.size)
    for i in range(LANES):
        parameters = plan[int(group[NUMBER + i])]
        for k in range(memory.size):
            memory[k] = group[MEMORY + k * LANES + i]
        for t in range(first, last):
            w, _ = move(step, parameters, memory, voltage[t], after)
            out[(t - first) * LANES + i] = w - group[REST + i]
            for k in range(memory.size):
                memory[k] = after[k]
        for k in range(memory.size):
            group[MEMORY + k * LANES + i] = memory[k]
