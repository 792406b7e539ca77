"""The hysteresis stages of the compiled likelihood, and their choice for an operator.

A stage writes the drive's difference from that of the first sample, w − w₀, for a piece of a record
and for ``LANES`` models side by side. The numbers and the memory of a model are in rows of
``LANES`` numbers of one flat array, ``group``; ``plan`` holds numbers that the stage needs in
advance. An operator that has a step (:mod:`bwbayes.model.operator`) is advanced by it; the drive of
an operator with neither step nor stage is worked out beforehand, and is the plan.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled import extrema, pinned, relaxing
from bwbayes.inference.compiled.lanes import LANES, inner
from bwbayes.model.compiled import FormulaType, formula
from bwbayes.model.declaration import Values
from bwbayes.model.operator import HysteresisStep, Operator
from bwbayes.model.operators.extremum_memory import RemembersExtrema
from bwbayes.model.operators.pinned import DomainWall, JilesAtherton
from bwbayes.model.operators.scalar_memory import RelaxingStep
from bwbayes.model.stage import Stage

Kind = HysteresisStep | RemembersExtrema | None


class CompiledDrive(NamedTuple):
    """Initial state of a compiled stage.

    ``kind`` is the object with its formula, None for a known drive; ``equilibrium`` (models,) is
    w₀, um; ``group`` (models, rows) and ``plan`` depend on the stage.
    """

    kind: Kind
    equilibrium: FloatArray
    group: FloatArray
    plan: FloatArray


def prepared(
    operator: Operator, column: Values, voltage: FloatArray, memory: Any
) -> CompiledDrive | None:
    """Return the stage for an operator's models; None if NumPy has to make the drive."""
    if isinstance(operator, RemembersExtrema):
        group = extrema.rows(voltage, memory)
        return CompiledDrive(operator, memory.displacement, group, operator.numbers(column))
    if type(operator).step is Operator.step:
        return None
    step = operator.step(column)
    state = step.remembered(memory)
    if isinstance(step, RelaxingStep):
        group, plan_rows = relaxing.rows(step, state, voltage[0]), relaxing.planned(step)
        return CompiledDrive(step, group[:, 0], group, plan_rows)
    equilibrium = step.apply(state, np.full(len(state), voltage[0])).w
    group = np.column_stack([np.arange(equilibrium.size), equilibrium, state])
    return CompiledDrive(step, equilibrium, group, step.parameters)


def advance_of(operator: Operator) -> Callable[..., tuple[FloatArray, Any]]:
    """Return a function that makes the drive of a whole piece, like ``advance`` of the class."""
    integrated = type(operator) in (JilesAtherton, DomainWall)
    return pinned.drive if integrated else type(operator).advance


def given(drive: FloatArray, models: int | None = None) -> CompiledDrive:
    """Return a stage for a known drive (models, samples), um; ``models`` may share fewer drives."""
    number = np.arange(models or len(drive)) % len(drive)
    equilibrium = drive[number, 0]
    group = np.stack([number, equilibrium], axis=1)
    # Keep one layout: numba would compile all functions once more for another one.
    return CompiledDrive(None, equilibrium, group, np.ascontiguousarray(drive))


def drive_of(
    kind: Any, group: Any, plan: Any, voltage: Any, first: Any, last: Any, out: Any
) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out``, and advance the memory.

    The type of ``kind`` selects the stage, so that no other one is compiled.
    """
    raise NotImplementedError


@overload(drive_of, strict=False)
def _compiled_drive_of(
    kind: Any, group: Any, plan: Any, voltage: Any, first: Any, last: Any, out: Any
) -> Any:
    del group, plan, voltage, first, last, out
    stage: Any = _given
    if isinstance(kind, FormulaType):
        stage = _stepped
        if issubclass(kind.kind, RelaxingStep):
            stage = relaxing.relaxing
        elif issubclass(kind.kind, RemembersExtrema):
            stage = extrema.along_branches
    return lambda kind, group, plan, voltage, first, last, out: stage(  # noqa: PLW0108  # a source
        kind, group, plan, voltage, first, last, out
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
        move = relaxing.steps_moved
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
def _given(
    kind: None,  # noqa: ARG001
    group: FloatArray,
    plan: FloatArray,
    voltage: FloatArray,  # noqa: ARG001
    first: int,
    last: int,
    out: FloatArray,
) -> None:
    """Copy a known drive: the row of the plan whose index is the first number of a model."""
    for i in range(LANES):
        drive = plan[int(group[i])]
        for t in range(first, last):
            out[(t - first) * LANES + i] = drive[t] - group[LANES + i]


@inner()
def _stepped(
    step: HysteresisStep,
    group: FloatArray,
    plan: FloatArray,
    voltage: FloatArray,
    first: int,
    last: int,
    out: FloatArray,
) -> None:
    """Step one model after the other, sample by sample.

    Rows are a model's number in the plan, w₀, and its step's memory.
    """
    memory = np.empty(group.size // LANES - 2)
    after = np.empty(memory.size)
    for i in range(LANES):
        parameters = plan[int(group[i])]
        for k in range(memory.size):
            memory[k] = group[(2 + k) * LANES + i]
        for t in range(first, last):
            w, _ = formula(step, parameters, memory, voltage[t], after)
            out[(t - first) * LANES + i] = w - group[LANES + i]
            for k in range(memory.size):
                memory[k] = after[k]
        for k in range(memory.size):
            group[(2 + k) * LANES + i] = memory[k]
