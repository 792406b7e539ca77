"""Displacement on the compiled engine: models advance along a voltage, piece by piece.

The loop is that of the likelihood without its noise: the same stages, nonlinearity and dynamics,
sample by sample, for ``LANES`` models side by side. Further stages, and the hysteresis if stages
before it give each model an individual voltage, take whole pieces one after the other, with models
side by side, too: such rare parts are not worth a place in the loop that all models share.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES, Structs, compile_cached, inner, read_only
from bwbayes.inference.compiled.motion import PIECE, Motion, Shared, displace, physics
from bwbayes.inference.compiled.stages import (
    CompiledDrive,
    Given,
    Models,
    Owner,
    advance_of,
    drive_of,
    move_lanes,
    prepare_drive,
)
from bwbayes.model.actuator import Actuator
from bwbayes.model.compiled import compiling
from bwbayes.model.declaration import Values
from bwbayes.model.inputs import Inputs
from bwbayes.model.operator import HysteresisStep, Operator
from bwbayes.model.operators.scalar_memory import RelaxingStep
from bwbayes.model.stage import Stage, pass_stages


def walk(
    actuator: Actuator,
    theta: FloatArray,
    inputs: Inputs,
    initial_transient: FloatArray | None = None,
    *,
    from_rest: bool = False,
) -> Callable[[int], FloatArray]:
    """Set models to the inputs' first sample; return a function that advances them to a sample.

    Called with growing numbers of samples, the function returns the displacement (models, samples),
    um, from the present sample on. Parameters and errors are those of
    :meth:`~bwbayes.model.actuator.Actuator.advance`, but the inputs are known up to the end.
    """
    column = actuator.columns(theta)
    actuator.check(column)
    if not actuator.stages:
        return _walk_core(actuator, column, inputs, initial_transient, from_rest)
    # Add the offset last.
    without_offset = column | {"offset": np.zeros(len(theta))}
    core = _walk_core(actuator, without_offset, inputs, initial_transient, from_rest)
    memories: tuple[FloatArray, ...] | None = None
    now = 0

    def onwards(last: int) -> FloatArray:
        nonlocal memories, now
        moved, next_inputs, now = core(last), inputs[now:last], last
        if memories is None:
            memories = actuator.begin_outputs(column, moved[:, 0], next_inputs, from_rest=from_rest)
        moved, memories = pass_stages(
            actuator.outputs, column, moved, memories, next_inputs, actuator.timing, _advance_stage
        )
        return moved + column["offset"][:, np.newaxis]

    return onwards


def _walk_core(
    actuator: Actuator,
    column: Values,
    inputs: Inputs,
    initial_transient: FloatArray | None,
    from_rest: bool,
) -> Callable[[int], FloatArray]:
    """Return the function of :func:`walk` for the path up to creep and dynamics."""
    operator, voltage, compiled = actuator.hysteresis, inputs.voltage, None
    if actuator.inputs:
        advance, memory = _of_own(actuator, column, inputs, from_rest)
        actuator = actuator.linear  # the drive includes the nonlinearity
    else:
        along = advance_of(operator)

        def advance(next_inputs: Inputs, memory: Any) -> tuple[FloatArray, Any]:
            return along(operator, column, next_inputs.voltage, memory)

        memory = actuator.begin(column, voltage, from_rest=from_rest)
        compiled = prepare_drive(operator, column, voltage, memory)
    source = compiled or CompiledDrive(None, Given.of(advance(inputs[:1], memory)[0]))
    sections = actuator.sections(column)
    named = physics(actuator, sections, column, source.models.equilibrium, voltage)
    moving, *crept = sections.begin(initial_transient)
    named |= dict(zip(("x1", "x2"), moving.T, strict=False))
    if crept:
        named |= {"lag": np.concatenate(crept, axis=1)}
    motions, now = Motion.filled(named), 0
    shared = Shared.of(actuator, voltage)

    def onwards(last: int) -> FloatArray:
        nonlocal memory, now
        displacement = np.empty((column["offset"].size, last - now))
        window, models = inputs[now:last], source.models
        if isinstance(models, Given):
            drive, memory = advance(window, memory)
            models = models._replace(drive=np.ascontiguousarray(drive), begin=now)
        with compiling(source.owner):
            _walk(source.owner, models, shared, motions, read_only(voltage), now, displacement)
        now = last
        return displacement

    return onwards


def _of_own(
    actuator: Actuator, column: Values, inputs: Inputs, from_rest: bool
) -> tuple[Callable[[Inputs, Any], tuple[FloatArray, Any]], Any]:
    """Return a function that makes the drive of models with individual voltages, and its memory.

    The memory is that at the first sample, of the stages and of the operator.
    """
    operator = actuator.hysteresis
    before = actuator.begin_inputs(column, inputs, from_rest=from_rest)
    first, _ = actuator.pass_inputs(column, inputs[:1], before)
    span = actuator.range_of(inputs.voltage)
    if type(operator).step is Operator.step:
        step, memory = None, actuator.begin(column, first, from_rest=from_rest, span=span)
    else:
        step, from_rest = operator.step(column), from_rest or actuator.demagnetized
        memory = operator.begin_apart(column, step, first[:, 0], span, from_rest=from_rest)

    def advance(next_inputs: Inputs, memories: Any) -> tuple[FloatArray, Any]:
        before, memory = memories
        driven, before = actuator.pass_inputs(column, next_inputs, before, _advance_stage)
        if step is None:
            drive, memory = actuator.drive(column, driven, memory)
        else:
            drive, memory = _drive_of_own(step, memory, driven)
            if actuator.nonlinearity is not None:
                drive += actuator.nonlinearity.displacement(column, driven)
        return drive, (before, memory)

    return advance, (before, memory)


@compile_cached()
def _walk(
    owner: Owner,
    models: Models,
    shared: Shared,
    motions: Structs,
    voltage: FloatArray,
    begin: int,
    displacement: FloatArray,
) -> None:
    """Advance all models from a sample on; write their displacement (models, samples)."""
    count, samples = displacement.shape
    drives = np.empty((PIECE, LANES))
    for group in range(len(motions)):
        for first in range(0, samples, PIECE):
            last = min(first + PIECE, samples)
            drive = drives[: last - first]
            drive_of(owner, models, group, voltage, begin + first, drive)
            displace(motions[group], shared, begin + first, drive)
            for i in range(min(LANES, count - group * LANES)):
                for t in range(first, last):
                    displacement[group * LANES + i, t] = drive[t - first, i]


def _advance_stage(
    stage: Stage,
    numbers: FloatArray,
    memory: FloatArray,
    values: FloatArray,
    seen: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the result of :meth:`~bwbayes.model.stage.Stage.advance`."""
    if type(stage).advance is not Stage.advance or not stage.remembers:
        return stage.advance(numbers, memory, values, seen)  # takes all samples at once
    result, after = np.empty(values.shape), memory.copy()
    seen = np.empty((0, 0)) if seen is None else seen.copy()  # numba compiles for this type alone
    values = read_only(np.ascontiguousarray(values))
    with compiling(stage):
        _pass(stage, numbers.copy("C"), after, values, seen, result)
    return result, after


def _drive_of_own(
    step: HysteresisStep, memory: FloatArray, voltage: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the drive (models, samples), um, along voltages (models, samples), V, and the memory.

    The memory after them is (models, any), like ``memory`` before.
    """
    drive, after, numbers = np.empty(voltage.shape), memory.copy(), step.parameters
    if isinstance(step, RelaxingStep):
        # Add the row that tells its lanes whether any model is curved or depends on a sign.
        numbers = np.column_stack([numbers, np.full(len(numbers), step.curved or step.signed)])
    voltage = read_only(np.ascontiguousarray(voltage))
    with compiling(step):
        _pass(step, numbers, after, voltage, np.empty((0, 0)), drive)
    return drive, after


@compile_cached()
def _pass(
    kind: Stage | HysteresisStep,
    numbers: FloatArray,
    memory: FloatArray,
    values: FloatArray,
    seen: FloatArray,
    result: FloatArray,
) -> None:
    """Write the result for values (models, samples), and advance the memory."""
    models, samples = values.shape
    rows = np.empty((numbers.shape[1], LANES))
    now, after = np.empty((memory.shape[1], LANES)), np.empty((memory.shape[1], LANES))
    entering, leaving = np.empty((PIECE, LANES)), np.empty((PIECE, LANES))
    for group in range(0, models, LANES):
        _enter(numbers, group, 0, rows)
        _enter(memory, group, 0, now)
        for first in range(0, samples, PIECE):
            last = min(first + PIECE, samples)
            _enter(values, group, first, entering[: last - first])
            for t in range(last - first):
                for k in range(len(seen)):
                    rows[k - len(seen), :] = seen[k, first + t]
                move_lanes(kind, rows, now, entering[t], after, leaving[t])
                now[:] = after
            _leave(leaving[: last - first], group, first, result)
        _leave(now, group, 0, memory)


@inner()
def _enter(rows: FloatArray, group: int, first: int, lanes: FloatArray) -> None:
    """Put columns of some models (models, any) side by side, (columns, lanes).

    Spare lanes repeat the last model.
    """
    for i in range(LANES):
        model = min(group + i, rows.shape[0] - 1)
        for k in range(lanes.shape[0]):
            lanes[k, i] = rows[model, first + k]


@inner()
def _leave(lanes: FloatArray, group: int, first: int, rows: FloatArray) -> None:
    """Put columns side by side (columns, lanes) back into rows (models, any)."""
    for i in range(min(LANES, rows.shape[0] - group)):
        for k in range(lanes.shape[0]):
            rows[group + i, first + k] = lanes[k, i]
