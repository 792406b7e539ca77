"""The hysteresis stages of the compiled likelihood, and their choice for an operator.

A stage writes the drive's difference from that of the first sample, w − w₀, for a piece of a record
and for ``LANES`` models side by side. The type of its models, a tuple of arrays, selects it. An
operator that has a step (:mod:`bwbayes.model.operator`) is advanced by it; the drive of an operator
with neither step nor stage is worked out beforehand.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled.lanes import LANES, inner, repeat_last
from bwbayes.inference.compiled.operators import (
    Branches,
    Relaxing,
    along_branches,
    pinned_drive,
    relaxing,
    steps_moved,
)
from bwbayes.model.compiled import formula
from bwbayes.model.declaration import Values
from bwbayes.model.operator import HysteresisStep, Operator
from bwbayes.model.operators.extremum_memory import RemembersExtrema
from bwbayes.model.operators.pinned import DomainWall, JilesAtherton
from bwbayes.model.operators.scalar_memory import RelaxingStep
from bwbayes.model.stage import Stage


class Given(NamedTuple):
    """A known drive (any, samples) from sample ``begin`` on, and w₀ (models,), um.

    ``number`` (models,) is the index of a model's drive.
    """

    drive: FloatArray
    begin: int
    number: IntArray
    equilibrium: FloatArray

    @classmethod
    def of(cls, drive: FloatArray, models: int | None = None) -> Given:
        """Return models with a drive (models, samples), um; ``models`` may share fewer drives."""
        number = np.arange(models or len(drive)) % len(drive)
        # Keep one layout: numba would compile all functions once more for another one.
        return cls(np.ascontiguousarray(drive), 0, number, drive[number, 0])


class Stepped(NamedTuple):
    """Numbers and memory (models, any) of a step, and w₀ (models,), um."""

    numbers: FloatArray
    memory: FloatArray
    equilibrium: FloatArray


Owner = HysteresisStep | RemembersExtrema | None
Models = Given | Stepped | Relaxing | Branches


class CompiledDrive(NamedTuple):
    """A compiled stage: the object that brings a formula, None without one, and its models.

    They are two arguments of a compiled function, as numba takes long to tell the type of a tuple
    that holds such an object.
    """

    owner: Owner
    models: Models


def prepare_drive(
    operator: Operator, column: Values, voltage: FloatArray, memory: Any
) -> CompiledDrive | None:
    """Return the stage for an operator's models; None if NumPy has to make the drive."""
    if isinstance(operator, RemembersExtrema):
        return CompiledDrive(operator, Branches.of(operator.numbers(column), voltage, memory))
    if type(operator).step is Operator.step:
        return None
    step = operator.step(column)
    state = step.remembered(memory)
    if isinstance(step, RelaxingStep):
        return CompiledDrive(None, Relaxing.of(step, state, voltage[0]))
    equilibrium, _, _ = step.apply(state, np.full(len(state), voltage[0]))
    return CompiledDrive(step, Stepped(step.parameters, np.array(state), equilibrium))


def advance_of(operator: Operator) -> Callable[..., tuple[FloatArray, Any]]:
    """Return a function that makes the drive of a whole piece, like ``advance`` of the class."""
    integrated = type(operator) in (JilesAtherton, DomainWall)
    return pinned_drive if integrated else type(operator).advance


def drive_of(owner: Any, models: Any, group: Any, voltage: Any, first: Any, out: Any) -> None:
    """Write w − w₀ of samples from ``first`` on to ``out`` (samples, lanes); advance the memory.

    The type of ``models`` selects the stage, so that no other one is compiled.
    """
    raise NotImplementedError


@overload(drive_of, strict=False)
def _compiled_drive_of(
    owner: Any, models: Any, group: Any, voltage: Any, first: Any, out: Any
) -> Any:
    del owner, group, voltage, first, out
    stages: dict[type, Any] = {
        Given: _copy_drive,
        Stepped: _step_models,
        Relaxing: relaxing,
        Branches: along_branches,
    }
    stage = stages[models.instance_class]
    return lambda owner, models, group, voltage, first, out: stage(  # noqa: PLW0108  # a source
        owner, models, group, voltage, first, out
    )


def move_lanes(kind: Any, numbers: Any, memory: Any, values: Any, after: Any, result: Any) -> None:
    """Write the result for a sample's values (lanes,), and the memory after it.

    ``kind`` is a stage, or an operator's step along individual voltages of the models; ``numbers``,
    ``memory`` and ``after`` are (any, lanes).
    """
    raise NotImplementedError


@overload(move_lanes, strict=False)
def _compiled_move_lanes(
    kind: Any, numbers: Any, memory: Any, values: Any, after: Any, result: Any
) -> Any:
    del numbers, memory, values, after, result
    move: Any = _stages_moved if issubclass(kind.kind, Stage) else _steps_moved
    if issubclass(kind.kind, RelaxingStep):
        move = steps_moved
    return lambda kind, numbers, memory, values, after, result: move(  # noqa: PLW0108  # a source
        kind, numbers, memory, values, after, result
    )


@inner()
def _stages_moved(
    stage: Stage,
    numbers: FloatArray,
    memory: FloatArray,
    values: FloatArray,
    after: FloatArray,
    result: FloatArray,
) -> None:
    for i in range(LANES):
        result[i] = formula(stage, numbers[:, i], memory[:, i], values[i], after[:, i])


@inner()
def _steps_moved(
    step: HysteresisStep,
    numbers: FloatArray,
    memory: FloatArray,
    values: FloatArray,
    after: FloatArray,
    result: FloatArray,
) -> None:
    for i in range(LANES):
        result[i], _ = formula(step, numbers[:, i], memory[:, i], values[i], after[:, i])


@inner(fastmath={"contract", "nsz"})
def _copy_drive(
    owner: None,  # noqa: ARG001
    models: Given,
    group: int,
    voltage: FloatArray,  # noqa: ARG001
    first: int,
    out: FloatArray,
) -> None:
    """Copy a known drive."""
    count = min(LANES, models.number.size - group * LANES)
    for i in range(count):
        model = group * LANES + i
        drive, equilibrium = models.drive[models.number[model]], models.equilibrium[model]
        for t in range(len(out)):
            out[t, i] = drive[first - models.begin + t] - equilibrium
    repeat_last(count, out)


@inner()
def _step_models(
    step: HysteresisStep,
    models: Stepped,
    group: int,
    voltage: FloatArray,
    first: int,
    out: FloatArray,
) -> None:
    """Step one model after the other, sample by sample."""
    after = np.empty(models.memory.shape[1])
    count = min(LANES, models.equilibrium.size - group * LANES)
    for i in range(count):
        model = group * LANES + i
        memory, numbers = models.memory[model], models.numbers[model]
        for t in range(len(out)):
            w, _ = formula(step, numbers, memory, voltage[first + t], after)
            out[t, i] = w - models.equilibrium[model]
            memory[:] = after
    repeat_last(count, out)
