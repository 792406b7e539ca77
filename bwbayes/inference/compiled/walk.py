"""The displacement on the compiled engine: models that walk along a voltage, piece by piece.

What the likelihood does sample by sample, without its noise: the same stages, nonlinearity and
dynamics, for ``LANES`` models side by side. Where stages before the hysteresis give each model a
voltage of its own, hysteresis and nonlinearity are worked out one model after the other. So are all
stages: what stands behind the dynamics is seldom there, and not worth a place among the lanes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.caching import compile_cached
from bwbayes.inference.compiled.lanes import LAG, LANES, STATE, X1, by_rows, in_lanes
from bwbayes.inference.compiled.motion import PIECE, displace, physics, shared
from bwbayes.inference.compiled.stages import Kind, advance_of, drive_of, given, prepared
from bwbayes.model.actuator import Actuator, each_model
from bwbayes.model.compiled import formula
from bwbayes.model.declaration import Values
from bwbayes.model.inputs import Inputs
from bwbayes.model.operator import Operator
from bwbayes.model.operators.extremum_memory import RemembersExtrema
from bwbayes.model.stage import Stage, pass_stages
from bwbayes.model.step import HysteresisStep


def walk(
    actuator: Actuator,
    theta: FloatArray,
    inputs: Inputs,
    initial_transient: FloatArray | None = None,
    *,
    from_rest: bool = False,
) -> Callable[[int], FloatArray]:
    """Put models to the inputs' first sample; what is returned walks them on to a sample.

    Called with growing numbers of samples, it returns the displacement (models, samples), um, from
    where they are. Parameters and errors are those of
    :meth:`~bwbayes.model.actuator.Actuator.advance`, but that the inputs are known up to the end.
    """
    column = actuator.columns(theta)
    actuator.check(column)
    if not actuator.stages:
        return _walk_core(actuator, column, inputs, initial_transient, from_rest)
    # The offset comes last.
    inner = replace(actuator, stages=actuator.inputs)
    without_offset = column | {"offset": np.zeros(len(theta))}
    core = _walk_core(inner, without_offset, inputs, initial_transient, from_rest)
    memories: tuple[FloatArray, ...] | None = None
    now = 0

    def onwards(last: int) -> FloatArray:
        nonlocal memories, now
        moved, piece, now = core(last), inputs[now:last], last
        if memories is None:
            memories = actuator.begin_outputs(column, moved[:, 0], piece, from_rest=from_rest)
        moved, memories = pass_stages(
            actuator.outputs, column, moved, memories, piece, actuator.timing, _advance_stage
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
    """Walk along the way up to creep and dynamics."""
    operator, voltage, compiled = actuator.hysteresis, inputs.voltage, None
    if actuator.inputs:
        advance, memory = _of_own(actuator, column, inputs, from_rest)
        actuator = replace(actuator, nonlinearity=None)  # it is in the drive
    else:
        along = advance_of(operator)

        def advance(piece: Inputs, memory: Any) -> tuple[FloatArray, Any]:
            return along(operator, column, piece.voltage, memory)

        memory = actuator.begin(column, voltage, from_rest=from_rest)
        compiled = prepared(operator, column, voltage, memory)
    stage = compiled or given(advance(inputs[:1], memory)[0])
    sections = actuator.sections(column)
    named = physics(actuator, sections, column, stage.equilibrium, voltage)
    models = by_rows(named, STATE // LANES)
    moving, *crept = sections.begin(initial_transient)
    models[:, X1 // LANES : X1 // LANES + moving.shape[1]] = moving
    for row, lag in enumerate(crept, LAG // LANES):
        models[:, row] = lag[:, 0]
    groups, state, now = in_lanes(stage.group), in_lanes(models), 0
    # A read-only view, so that numba compiles only one signature.
    read_only = np.broadcast_to(voltage, voltage.shape)
    curve, lags, growth = shared(actuator, voltage)

    def onwards(last: int) -> FloatArray:
        nonlocal memory, now
        displacement = np.empty((column["offset"].size, last - now))
        piece, begin, plan = slice(0, None), now, stage.plan
        if compiled is None:
            # The drive of this piece is known, and what goes with it begins where it does.
            piece, begin = slice(now, last), 0
            drive, memory = advance(inputs[piece], memory)
            plan = np.ascontiguousarray(drive)
        _walk(
            stage.kind, groups, plan, curve[piece], lags, growth[piece], state, read_only[piece],
            begin, begin + last - now, displacement,
        )  # fmt: skip
        now = last
        return displacement

    return onwards


def _of_own(
    actuator: Actuator, column: Values, inputs: Inputs, from_rest: bool
) -> tuple[Callable[[Inputs, Any], tuple[FloatArray, Any]], Any]:
    """Return what makes the drive along the next inputs, of models with voltages of their own.

    And what it remembers at the first sample: the stages' memories, and the operator's.
    """
    operator = actuator.hysteresis
    before = actuator.begin_inputs(column, inputs, from_rest=from_rest)
    first, _ = actuator.pass_inputs(column, inputs[:1], before)
    span = actuator.range_of(inputs.voltage)
    memory = actuator.begin(column, first, from_rest=from_rest, span=span)
    step = None
    # Those that remember extrema have another memory than their step has.
    if type(operator).step is not Operator.step and not isinstance(operator, RemembersExtrema):
        step = operator.step(column)
    if step is not None:
        steps = (operator.step(values) for values in each_model(column))
        remembered = [s.remembered(of_one) for s, of_one in zip(steps, memory, strict=True)]
        memory = np.concatenate(remembered)

    def advance(piece: Inputs, memories: Any) -> tuple[FloatArray, Any]:
        before, memory = memories
        driven, before = actuator.pass_inputs(column, piece, before, _advance_stage)
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
    kind: Kind,
    groups: FloatArray,
    plan: FloatArray,
    curve: FloatArray,
    lags: FloatArray,
    growth: FloatArray,
    state: FloatArray,
    voltage: FloatArray,
    first: int,
    last: int,
    displacement: FloatArray,
) -> None:
    """Move all models on from sample ``first`` to ``last``; write what they do on the way."""
    drive = np.empty(PIECE * LANES)
    for group in range(state.shape[0]):
        models = min(LANES, displacement.shape[0] - group * LANES)
        for now in range(first, last, PIECE):
            end = min(now + PIECE, last)
            drive_of(kind, groups[group], plan, voltage, now, end, drive)
            displace(state[group], curve, lags, growth, now, end, drive)
            for i in range(models):
                for t in range(now, end):
                    displacement[group * LANES + i, t - first] = drive[(t - now) * LANES + i]


def _advance_stage(
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


def _drive_of_own(
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
