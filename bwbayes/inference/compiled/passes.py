"""Stages along values of each model's own, one model after the other.

What stands before the hysteresis makes the voltages differ from model to model, and what stands
behind the dynamics is seldom there: neither is worth a place among the lanes.
"""

from __future__ import annotations

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.caching import compile_cached
from bwbayes.model.compiled import formula
from bwbayes.model.stage import Stage
from bwbayes.model.step import HysteresisStep


def advance_stage(
    stage: Stage,
    numbers: FloatArray,
    memory: FloatArray,
    values: FloatArray,
    seen: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return what :meth:`~bwbayes.model.stage.Stage.advance` does."""
    result, after = np.empty(values.shape), memory.copy()
    seen = np.empty(0) if seen is None else seen.copy()  # of one type, for which one is compiled
    _pass(stage, numbers.copy("C"), after, np.ascontiguousarray(values), seen, result)
    return result, after


def drive_of_own(
    step: HysteresisStep, memory: FloatArray, voltage: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the drive (models, samples), um, along voltages (models, samples), V.

    And what the step remembers after them, (models, any), as ``memory`` is before.
    """
    drive, after = np.empty(voltage.shape), memory.copy()
    _step(step, step.parameters, after, np.ascontiguousarray(voltage), drive)
    return drive, after


@compile_cached()
def _pass(
    stage: Stage,
    numbers: FloatArray,
    memory: FloatArray,
    values: FloatArray,
    seen: FloatArray,
    result: FloatArray,
) -> None:
    """Write what comes out of values, and move the memory on."""
    after = np.empty(memory.shape[1])
    for i in range(values.shape[0]):
        for t in range(values.shape[1]):
            if seen.size > 0:
                numbers[i, -1] = seen[t]
            result[i, t] = formula(stage, numbers[i], memory[i], values[i, t], after)
            for k in range(after.size):
                memory[i, k] = after[k]


@compile_cached()
def _step(
    step: HysteresisStep,
    parameters: FloatArray,
    memory: FloatArray,
    voltage: FloatArray,
    drive: FloatArray,
) -> None:
    """Write the drive along voltages, and move the memory on."""
    after = np.empty(memory.shape[1])
    for i in range(voltage.shape[0]):
        for t in range(voltage.shape[1]):
            drive[i, t], _ = formula(step, parameters[i], memory[i], voltage[i, t], after)
            for k in range(after.size):
                memory[i, k] = after[k]
