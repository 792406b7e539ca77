"""The actuator: voltage in, displacement out, for a batch of parameter vectors at once.

It is put together from parts. A hysteresis operator makes the drive w of the voltage's path, to
which a static nonlinearity may add; linear dynamics follow the drive (equations (6) to (8) of the
paper), creep may add to what they do, and the sensor adds its offset. Further stages may stand
before all that and behind it (:mod:`bwbayes.model.stage`). An
:class:`Actuator` says which parts there are, what the voltage does between samples, and how long
those are apart; the parameters come as the columns of a matrix θ, in the order in which the parts
declare them. A long record can be walked through in pieces: the :class:`State` at the end of one
piece starts the next.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, get_args

import numpy as np

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.declaration import Declaration, Values, check, each_model, normal
from bwbayes.model.inputs import Hold, Inputs, Span
from bwbayes.model.linear import Creep, Filter, Sections
from bwbayes.model.nonlinearity import PolynomialNonlinearity
from bwbayes.model.operator import Operator
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.registry import DYNAMICS, build_part
from bwbayes.model.stage import (
    Advance,
    Side,
    Stage,
    Timing,
    begin_stages,
    pass_stages,
)
from bwbayes.shown import brief

OFFSET = Declaration(
    "offset",
    "um",
    r"y_0",
    "sensor offset",
    lambda context: normal(context.ranges.middle, context.ranges.reach),
    scope="record",
    aliases=("y0",),
)


@dataclass(frozen=True)
class State:
    """All that a batch of models remembers after a piece of a record.

    ``hysteresis`` is the operator's memory; ``rest`` are the drives at the record's first sample,
    at which dynamics and creep were at rest, (models,) each, um; ``filter`` are the states of their
    recursions, (models, taps - 1) each; ``inputs`` and ``outputs`` are the memories of the stages
    before and behind.
    """

    __repr__ = brief

    hysteresis: Any
    equilibrium: tuple[FloatArray, ...]
    filter: tuple[FloatArray, ...]
    inputs: tuple[FloatArray, ...] = ()
    outputs: tuple[FloatArray, ...] = ()


@dataclass(frozen=True)
class Actuator:
    """An actuator with hysteresis and linear dynamics.

    Parameters
    ----------
    dynamics
        ``"none"``; ``"lag"``, one first-order lag; ``"second-order"``, equation (7); or the import
        path of another filter.
    hold
        ``"first"``: the drive goes straight from sample to sample (a measured voltage);
        ``"zero"``: it is held until the next sample (the command of a DAC).
    interval
        Sampling interval, s, above zero.
    hysteresis
        The operator that makes the drive.
    nonlinearity
        Static nonlinearity, added to the drive.
    creep
        Slow growth, added to the displacement.
    span
        The voltages that drives before a record may have had, V; by default those of the voltage
        that is simulated.
    stages
        Further stages between command and reading, in the order of the signal.
    demagnetized
        The voltage came to a record's first one straight from 0 V, where the actuator was
        demagnetized; dynamics and creep may still be moving.
    conditions
        Covariates that do not change along a voltage that comes alone, by name.

    Raises
    ------
    InputError
        An unknown ``dynamics`` or ``hold``, or an ``interval`` that is not positive and finite.
    """

    __repr__ = brief

    dynamics: str = "lag"
    hold: Hold = "first"
    interval: float = 1e-3
    hysteresis: Operator = field(default_factory=BoucWen)
    nonlinearity: PolynomialNonlinearity | None = None
    creep: Creep | None = None
    span: Span | None = None
    stages: tuple[Stage, ...] = ()
    demagnetized: bool = False
    conditions: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        build_part("dynamics", self.dynamics, DYNAMICS, {}, Filter)
        if self.hold not in get_args(Hold):
            choices = ", ".join(get_args(Hold))
            raise InputError(f"hold: {self.hold!r} is unknown; write one of {choices}")
        if not 0 < self.interval < math.inf:
            raise InputError(f"interval: {self.interval:.6g}; must be positive and finite, in s")

    @cached_property
    def filter(self) -> Filter:
        """The linear dynamics."""
        return build_part("dynamics", self.dynamics, DYNAMICS, {}, Filter)

    @cached_property
    def declarations(self) -> tuple[Declaration, ...]:
        """The parameters that the parts declare, in the order of θ's columns.

        One that several stages declare is the same.
        """
        parts = (self.hysteresis, self.nonlinearity, self.filter, self.creep, *self.stages)
        declared = [d for component in parts if component is not None for d in component.parameters]
        return tuple({d.name: d for d in (*declared, OFFSET)}.values())

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """Names of θ's columns."""
        return tuple(declaration.name for declaration in self.declarations)

    @cached_property
    def unknowns(self) -> int:
        """How many numbers say how dynamics and creep are at a record's first sample."""
        return self.filter.unknowns(self.hold) + (len(self.creep.times) if self.creep else 0)

    def displacement(
        self, theta: ArrayLike, inputs: Inputs | ArrayLike, *, from_rest: bool = False
    ) -> FloatArray:
        """Displacement of every model along the same inputs.

        Parameters
        ----------
        theta
            (models, parameters), the columns and their units as in :attr:`declarations`.
        inputs
            At the actuator's interval; or the voltage (samples,), V, alone.
        from_rest
            The voltage came from zero, where the actuator was at rest.

        Returns
        -------
        FloatArray
            (models, samples), um.

        Raises
        ------
        InputError
            θ of a wrong shape or outside the model's domain: not finite, or what a part refuses.
            The text names the parameter.
        """
        return self.advance(theta, inputs, from_rest=from_rest)[0]

    def advance(
        self,
        theta: ArrayLike,
        inputs: Inputs | ArrayLike,
        state: State | None = None,
        initial_transient: FloatArray | None = None,
        *,
        from_rest: bool = False,
    ) -> tuple[FloatArray, State]:
        """Displacement along the next piece of a record, and the state at its end.

        Shapes and units as in :meth:`displacement`. Without a ``state`` the record starts here: the
        hysteresis is in the state that θ's initial one says; dynamics and creep are at rest at the
        first drive, or ``initial_transient`` (models, unknowns) away from there, um: the dynamics
        (also how fast they move, where there is a mass), then each lag of the creep; (models, 0) is
        rest.
        """
        models = np.atleast_2d(np.asarray(theta, dtype=np.float64))
        if models.ndim != 2 or models.shape[1] != len(self.parameters):
            raise InputError(
                f"theta: has shape {models.shape}; its columns are {', '.join(self.parameters)}"
            )
        if not isinstance(inputs, Inputs):
            voltage = np.asarray(inputs, dtype=np.float64)
            inputs = self.along(voltage)
        path = inputs.voltage
        if path.ndim != 1 or path.size == 0:
            raise InputError(f"voltage: has shape {path.shape}; give a non-empty row of samples")
        if not np.isfinite(path).all():
            raise InputError("voltage: must be finite; check the record")
        column = self.columns(models)
        self.check(column)
        if state is None:
            before = self.begin_inputs(column, inputs, from_rest=from_rest)
        else:
            before = state.inputs
        driven, before = self.pass_inputs(column, inputs, before)
        if state is None:
            memory = self.begin(column, driven, from_rest=from_rest, span=self.range_of(path))
        else:
            memory = state.hysteresis
        drive, hysteresis = self.drive(column, driven, memory)
        result, equilibrium, filtered = self._follow(column, drive, path, state, initial_transient)
        if state is None:
            outputs = self.begin_outputs(column, result[:, 0], inputs, from_rest=from_rest)
        else:
            outputs = state.outputs
        result, outputs = pass_stages(self.outputs, column, result, outputs, inputs, self.timing)
        result += column["offset"][:, np.newaxis]
        return result, State(hysteresis, equilibrium, filtered, before, outputs)

    def _follow(
        self,
        column: Values,
        drive: FloatArray,
        path: FloatArray,
        state: State | None,
        initial_transient: FloatArray | None,
    ) -> tuple[FloatArray, tuple[FloatArray, ...], tuple[FloatArray, ...]]:
        """Let dynamics and creep follow a drive (models, samples), um, along a path (samples,), V.

        Returns the displacement without the offset, the drives at which they were at rest, and the
        states of their recursions; ``state`` and ``initial_transient`` as in :meth:`advance`.
        """
        sections, drives = self.sections(column), [drive]
        if self.creep is not None:
            crept = self.creep.drive(column, drive, path)
            drives += [crept.copy() for _ in self.creep.times]
        if state is None:
            equilibrium, filtered = (
                tuple(w[:, 0].copy() for w in drives),
                sections.begin(initial_transient),
            )
        else:
            equilibrium, filtered = (
                state.equilibrium,
                tuple(carried.copy() for carried in state.filter),
            )
        # The recursions see the drives' distance from rest, so that they start at zero exactly.
        for driven, before in zip(drives, equilibrium, strict=True):
            np.subtract(driven, before[:, np.newaxis], out=driven)
        result = sections.run(drives, filtered)
        levels = zip(sections.gains, equilibrium, strict=True)
        level: FloatArray = sum((gain * w for gain, w in levels), start=np.zeros(len(drive)))
        result += level[:, np.newaxis]
        return result, equilibrium, filtered

    def along(self, voltage: FloatArray) -> Inputs:
        """Return a voltage (samples,), V, with the conditions."""
        covariates = {
            name: np.full(voltage.shape, value) for name, value in self.conditions.items()
        }
        return Inputs(voltage, interval=self.interval, covariates=covariates)

    def fixes(self, stage: Stage) -> bool:
        """Tell whether all that a stage sees are conditions."""
        return {*stage.sees} <= {*self.conditions}

    @cached_property
    def linear(self) -> Actuator:
        """Dynamics and creep alone: what follows the drive without further stages."""
        return replace(self, nonlinearity=None, stages=())

    @property
    def static(self) -> Actuator:
        """The same, as far as only the path of the voltage counts, not its pace."""
        stages = tuple(s for s in self.stages if s.rate_independent or (s.sees and self.fixes(s)))
        return replace(self, dynamics="none", hold="first", creep=None, stages=stages)

    @property
    def without_events(self) -> Actuator:
        """The same without the stages of what happened once, in a record alone."""
        stages = (
            stage
            for stage in self.stages
            if all(declared.scope != "event" for declared in stage.parameters)
        )
        return replace(self, stages=tuple(stages))

    @property
    def timing(self) -> Timing:
        """How its samples follow each other."""
        return Timing(self.interval, self.hold)

    @cached_property
    def inputs(self) -> tuple[Stage, ...]:
        """The stages before the hysteresis."""
        return self._on("input")

    @cached_property
    def outputs(self) -> tuple[Stage, ...]:
        """The stages behind dynamics and creep."""
        return self._on("output")

    def _on(self, side: Side) -> tuple[Stage, ...]:
        return tuple(stage for stage in self.stages if stage.side == side)

    def begin_inputs(
        self, column: Values, inputs: Inputs, *, from_rest: bool
    ) -> tuple[FloatArray, ...]:
        """Return the memories of the stages before the hysteresis at a record's first voltage."""
        models = column["offset"].size
        equilibrium, first = (
            np.zeros(models) if from_rest else None,
            np.full(models, inputs.voltage[0]),
        )
        return begin_stages(self.inputs, column, first, inputs, self.timing, equilibrium)

    def begin_outputs(
        self, column: Values, first: FloatArray, inputs: Inputs, *, from_rest: bool
    ) -> tuple[FloatArray, ...]:
        """Return the memories of the stages behind the dynamics at a first displacement (models,).

        Displacements are in um, without the offset.
        """
        equilibrium = self.level_at_rest(column, inputs) if from_rest else None
        return begin_stages(self.outputs, column, first, inputs, self.timing, equilibrium)

    def level_at_rest(self, column: Values, inputs: Inputs) -> FloatArray:
        """Return the displacement (models,), um, of demagnetized models at rest at zero volts.

        Before the first sample of inputs, before the stages behind the dynamics, and without the
        offset.
        """
        zero, driven = np.zeros(1), np.zeros(1)
        if self.inputs:
            equilibrium = np.zeros(column["offset"].size)
            for stage in self.inputs:
                equilibrium, _ = stage.settled(
                    stage.numbers_at(column, self.timing, inputs), equilibrium
                )
            driven = equilibrium[:, np.newaxis]
        memory = self.begin(column, driven, from_rest=True, span=self.range_of(zero))
        drive, _ = self.drive(column, driven, memory)
        level: FloatArray = drive[:, 0].copy()
        if self.creep is not None:
            crept = self.creep.drive(column, drive, zero)[:, 0]
            level += crept * sum(column[name] for name in self.creep.names)
        return level

    def pass_inputs(
        self,
        column: Values,
        inputs: Inputs,
        memories: tuple[FloatArray, ...],
        advance: Advance | None = None,
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        """Return what the stages before the hysteresis make of the voltage (samples,), V.

        The voltage itself without any, else (models, samples); and their memories after it.
        """
        if not self.inputs:
            return inputs.voltage, ()
        paths = np.broadcast_to(inputs.voltage, (column["offset"].size, inputs.samples))
        return pass_stages(self.inputs, column, paths, memories, inputs, self.timing, advance)

    def drive(self, column: Values, path: FloatArray, memory: Any) -> tuple[FloatArray, Any]:
        """Return what hysteresis and nonlinearity make of a path, V, (models, samples), um.

        The path is (samples,), or (models, samples) if each model has its own; beside the drive
        comes the operator's memory after it, in the second case one for each model.
        """
        if path.ndim == 2:
            parts = [
                self.drive(values, path_of_model, before)
                for values, path_of_model, before in zip(
                    each_model(column), path, memory, strict=True
                )
            ]
            drives, memories = zip(*parts, strict=True)
            return np.concatenate(drives), memories
        drive, after = self.hysteresis.advance(column, path, memory)
        if self.nonlinearity is not None:
            drive += self.nonlinearity.displacement(column, path)
        return drive, after

    def columns(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return the columns (models,) of θ (models, parameters) by name."""
        return dict(zip(self.parameters, theta.T, strict=True))

    def known(
        self, theta: FloatArray, displacement: FloatArray, *, from_rest: bool = False
    ) -> FloatArray:
        """Return readings (samples,) that models θ (models, parameters) can follow; others are nan.

        A stage may need inputs from before the record, unless it starts from rest, or behind it.
        """
        reaches = [(0.0, 0.0), *(stage.reach(self.columns(theta)) for stage in self.stages)]
        before, behind = (math.ceil(sum(s) / self.interval) for s in zip(*reaches, strict=True))
        if not before and not behind:
            return displacement
        samples = np.arange(displacement.size)
        is_known = (samples >= before * (not from_rest)) & (samples < samples.size - behind)
        return np.where(is_known, displacement, np.nan)

    def begin(
        self,
        column: Mapping[str, FloatArray],
        path: FloatArray,
        *,
        from_rest: bool,
        span: Span | None = None,
    ) -> Any:
        """Return the operator's memory at the first sample of a record; paths as in :meth:`drive`.

        ``span`` of earlier drives; by default that of :meth:`range_of` the path.
        """
        span, from_rest = span or self.range_of(path), from_rest or self.demagnetized
        if path.ndim == 2:
            return tuple(
                self.begin(values, path_of_model, from_rest=from_rest, span=span)
                for values, path_of_model in zip(each_model(column), path, strict=True)
            )
        return self.hysteresis.begin(column, float(path[0]), span, from_rest=from_rest)

    def within(self, voltage: FloatArray) -> Actuator:
        """Return the actuator with a span; by default the range of a whole record's voltage."""
        return replace(self, span=self.range_of(voltage))

    def range_of(self, voltage: FloatArray) -> Span:
        """Return the voltages that earlier drives may have had, V."""
        return self.span or Span(float(np.min(voltage)), float(np.max(voltage)))

    def check(self, column: Mapping[str, FloatArray]) -> None:
        """Raise an InputError where a model is outside of the domain of a part."""
        check(self.declarations, column)
        self.hysteresis.check(column)

    def sections(self, column: Values) -> Sections:
        """Return dynamics and creep of models given by the columns (models,) of θ."""
        models = column["offset"].size
        dynamics = self.filter.recursion(column, models, self.interval, self.hold)
        if self.creep is None:
            return Sections((dynamics,), (np.ones(models),))
        lags = self.creep.recursions(models, self.interval, self.hold)
        strengths = (column[name] for name in self.creep.names)
        return Sections((dynamics, *lags), (np.ones(models), *strengths))
