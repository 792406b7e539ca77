"""A fitted model at a controller's pace: one sample in, one sample out, forward or inverse.

:class:`SampledModel` is what ``bwbayes track`` closes the loop around, and what ``bwbayes export``
writes as C: :func:`settle`, :func:`advance` and :func:`search` are the actuator's own recursion,
with a voltage for each model, and are printed as they are. The linear part behind the hysteresis is
given as a system of ``scipy.signal`` too.

These functions take the model in arrays: ``move`` and ``parameters`` of the hysteresis' step;
``curve``, the coefficients of 1, u, u² and u³ that the nonlinearity adds, and κ/U, by which the
creep's drive w (1 + κ |u| / U) grows; and ``taps`` of each section, b₀, b₁, b₂, a₁, a₂ and the
gain, then b of the sample that a voltage acts on first, and how its two states carry over to that
sample. A state is ``memory``, the ``initial`` drive of each section, um, and two ``filters`` of
each. Stages before and behind all that (:mod:`bwbayes.model.stage`) bring functions of the same
kind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import add
from typing import Any, NamedTuple, Self

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, anywhere, select
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Values
from bwbayes.model.inputs import Span
from bwbayes.model.linear import Taps
from bwbayes.model.operator import HysteresisStep
from bwbayes.model.stage import Stage
from bwbayes.prediction.loops import steady_loop
from bwbayes.shown import brief

# Rounds of the inverse at most: Newton's rule needs a few; if it fails, bisection goes on to the
# last bit of a voltage.
NEWTON_ROUNDS, BISECTION_ROUNDS = 40, 60


def drive(move: Any, parameters: Any, curve: Any, memory: Any, voltage: Any, after: Any) -> Any:
    """Return hysteresis and nonlinearity at a voltage, um, and their slope, um/V."""
    w, slope = move(parameters, memory, voltage, after)
    w = w + curve[0] + voltage * (curve[1] + voltage * (curve[2] + voltage * curve[3]))
    return w, slope + curve[1] + voltage * (2.0 * curve[2] + voltage * 3.0 * curve[3])


def settle(
    move: Any, parameters: Any, curve: Any, memory: Any, voltage: Any, after: Any, settled: Any
) -> Any:
    """Return hysteresis and nonlinearity, um, at a first voltage with all else at rest."""
    w, _ = drive(move, parameters, curve, memory, voltage, after)
    for i in range(len(settled)):
        settled[i] = select(i > 0, w * (1.0 + curve[4] * np.abs(voltage)), w)
    return w


def advance(
    move: Any, parameters: Any, curve: Any, taps: Any, memory: Any, initial: Any, filters: Any,
    voltage: Any, after: Any, filtered: Any,
) -> Any:  # fmt: skip
    """Return the displacement at a sample with this voltage, um, and write the state after it."""
    w, _ = drive(move, parameters, curve, memory, voltage, after)
    creeping, displacement = w * (1.0 + curve[4] * np.abs(voltage)), 0.0
    for i in range(len(initial)):
        driven = select(i > 0, creeping, w) - initial[i]
        moved = taps[i, 0] * driven + filters[i, 0]
        filtered[i, 0] = taps[i, 1] * driven - taps[i, 3] * moved + filters[i, 1]
        filtered[i, 1] = taps[i, 2] * driven - taps[i, 4] * moved
        displacement = displacement + taps[i, 5] * (initial[i] + moved)
    return displacement


def within(voltage: Any, lowest: Any, highest: Any) -> Any:
    """Return a voltage within limits, V."""
    return select(voltage < lowest, lowest, select(voltage > highest, highest, voltage))


def search(
    move: Any, parameters: Any, curve: Any, taps: Any, memory: Any, initial: Any, filters: Any,
    voltage: Any, displacement: Any, lowest: Any, highest: Any, close: Any, after: Any,
) -> Any:  # fmt: skip
    """Return the voltage that brings the displacement there, or the limit that is nearest, V.

    With (direct + creeping (1 + κ |u| / U)) w(u) = demand, whose left side rises with u: Newton's
    rule between bounds, and bisection should that not do, until a step is as small as ``close``.
    """
    direct, creeping, demand = 0.0, 0.0, displacement
    for i in range(len(initial)):
        weight = taps[i, 5] * taps[i, 6]
        carried = taps[i, 7] * filters[i, 0] + taps[i, 8] * filters[i, 1]
        demand = demand - taps[i, 5] * (initial[i] + carried) + weight * initial[i]
        direct = select(i > 0, direct, weight)
        creeping = select(i > 0, creeping + weight, 0.0)
    low, high = lowest, highest
    voltage = within(voltage, lowest, highest)
    change, rounds = 2.0 * close, 0.0
    while anywhere(change > close) and rounds < NEWTON_ROUNDS + BISECTION_ROUNDS:
        w, slope = drive(move, parameters, curve, memory, voltage, after)
        growth = select(voltage < 0.0, -curve[4], curve[4])
        factor = direct + creeping * (1.0 + growth * voltage)
        excess = factor * w - demand
        low = select(excess < 0.0, voltage, low)
        high = select(excess < 0.0, high, voltage)
        newton = voltage - excess / (factor * slope + creeping * growth * w)
        newton = within(newton, lowest, highest)
        inside = (newton >= low) & (newton <= high) & (rounds < NEWTON_ROUNDS)
        better = select(inside, newton, (low + high) / 2.0)
        change, voltage = np.abs(better - voltage), better
        rounds = rounds + 1.0
    return voltage


class SteppedState(NamedTuple):
    """State of the models between two samples.

    ``memory`` (any, models) is that of the hysteresis, ``voltage`` (models,) the last one, V,
    ``rest`` (sections, models) the drives at the start, um, and ``filters`` (sections, 2, models)
    the states of the recursions; ``inputs`` and ``outputs`` (any, models) are the memories of the
    stages before and behind.
    """

    memory: FloatArray
    voltage: FloatArray
    equilibrium: FloatArray
    filters: FloatArray
    inputs: tuple[FloatArray, ...] = ()
    outputs: tuple[FloatArray, ...] = ()


class SampledStage(NamedTuple):
    """A stage of the models, what its functions take as ``numbers``, and its value at zero volts.

    ``numbers`` (any, models); ``at_rest`` (models,) is what goes in there, V or um.
    """

    stage: Stage
    numbers: FloatArray
    at_rest: FloatArray

    @classmethod
    def row(
        cls, stages: Sequence[Stage], actuator: Actuator, column: Values, at_rest: FloatArray
    ) -> tuple[tuple[SampledStage, ...], FloatArray]:
        """Return stages in a row, and what comes out behind them at rest at zero volts."""
        row, inputs = [], actuator.along(np.zeros(1))
        for stage in stages:
            numbers = stage.numbers_at(column, actuator.timing, inputs)
            row.append(cls(stage, numbers.T, at_rest))
            at_rest, _ = stage.settled(numbers, at_rest)
        return tuple(row), at_rest

    def settled(self, value: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what comes out (models,) once they went to a value and settled, and the memory."""
        numbers = self.numbers.T
        if not self.stage.rate_independent:
            result, memory = self.stage.settled(numbers, value)
            return result, memory.T
        return self.step(self.stage.settled(numbers, self.at_rest)[1].T, value)

    def step(self, memory: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what comes out (models,) at a sample with a value, and the memory after it."""
        after = np.empty_like(memory)
        return self.stage.move(self.numbers, memory, value, after), after


@dataclass(frozen=True)
class SampledModel:
    """A batch of models, a sample at a time.

    They start demagnetized at zero volts, go to a first voltage and settle there, with dynamics and
    creep at rest. 0 um is where they stand at zero volts: the displacement is without the sensor's
    offset. ``column`` has the columns (models,) of θ by name; ``sections`` are dynamics and creep.
    """

    __repr__ = brief

    actuator: Actuator
    column: dict[str, FloatArray]
    step: HysteresisStep
    sections: Taps

    @classmethod
    def of(cls, actuator: Actuator, theta: FloatArray) -> Self:
        """Return the models with parameters θ (models, parameters).

        Raises InputError: the hysteresis has no step of bounded time, or a stage sees what a
        controller does not.
        """
        column = {name: values.copy() for name, values in actuator.columns(theta).items()}
        actuator = actuator.without_events
        for stage in actuator.stages:
            if not actuator.fixes(stage):
                raise InputError(
                    f"stages: {stage.name} follows {' and '.join(stage.sees)}, which a model of "
                    "one sample at a time does not see; fit without it"
                )
        sections = actuator.sections(column).taps
        return cls(actuator, column, actuator.hysteresis.step(column), sections)

    @property
    def models(self) -> int:
        """Number of models."""
        return int(self.sections.gains.shape[0])

    @cached_property
    def curve(self) -> FloatArray:
        """Polynomial of the nonlinearity, um/Vᵏ for k from 0 to 3, then κ/U, 1/V; (5, models)."""
        nonlinearity, creep = self.actuator.nonlinearity, self.actuator.creep
        curve = np.zeros((5, self.models))
        if nonlinearity is not None:
            curve[:4] = nonlinearity.powers(self.column)
        if creep is not None and creep.growing:
            curve[4] = self.column["creep_growth"] * creep.size(np.array(1.0))
        return curve

    @cached_property
    def taps(self) -> FloatArray:
        """Taps of the sections, (sections, 9, models)."""
        numerator, denominator, gains = (np.moveaxis(values, 0, -1) for values in self.sections)
        held = self.actuator.hold == "zero"
        unity, first = np.ones_like(gains), denominator[:, 1]
        # A voltage that is held acts on the next sample; this one is out of reach.
        reach = [numerator[:, 1], -first, unity] if held else [numerator[:, 0], unity, 0 * unity]
        rows = [*np.moveaxis(numerator, 1, 0), first, denominator[:, 2], gains, *reach]
        return np.stack(rows, axis=1)

    @property
    def hysteresis(self) -> tuple[Any, FloatArray, FloatArray]:
        """First arguments of a sample's functions: ``move``, ``parameters`` and ``curve``."""
        return type(self.step).move, self.step.parameters.T, self.curve

    @cached_property
    def inputs(self) -> tuple[tuple[SampledStage, ...], FloatArray]:
        """The stages before the hysteresis, and the voltage behind them at rest, (models,), V."""
        zero = np.zeros(self.models)
        return SampledStage.row(self.actuator.inputs, self.actuator, self.column, zero)

    @cached_property
    def outputs(self) -> tuple[tuple[SampledStage, ...], FloatArray]:
        """The stages behind the dynamics, and what comes out of them at rest, (models,), um."""
        level = self._settle(self.inputs[1])[2]
        return SampledStage.row(self.actuator.outputs, self.actuator, self.column, level)

    def _settle(self, voltage: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Let hysteresis, dynamics and creep come to rest at a voltage (models,), V.

        Returns the memory, the drives there, and the displacement (models,), um.
        """
        memory, initial = self.step.demagnetized().T, np.empty(self.taps[:, 0].shape)
        after = np.empty_like(memory)
        settle(*self.hysteresis, memory, voltage, after, initial)
        return after, initial, np.asarray(np.sum(self.taps[:, 5] * initial, axis=0))

    def begin(self, voltage: FloatArray) -> SteppedState:
        """Return the state of actuators that have settled at a voltage (models,), V."""
        driven, inputs = voltage, []
        for stage in self.inputs[0]:
            driven, memory = stage.settled(driven)
            inputs.append(memory)
        after, initial, moved = self._settle(driven)
        outputs = []
        for stage in self.outputs[0]:
            moved, memory = stage.settled(moved)
            outputs.append(memory)
        filters = np.zeros((len(initial), 2, self.models))
        return SteppedState(after, voltage, initial, filters, tuple(inputs), tuple(outputs))

    @property
    def zero(self) -> FloatArray:
        """Where models stand at zero volts, demagnetized and at rest: 0 um, (models,), um."""
        return self.outputs[1]

    def displacement(self, state: SteppedState) -> FloatArray:
        """Return the displacement (models,), um, that a held voltage has led to."""
        moved = np.sum(self.taps[:, 5] * (state.equilibrium + state.filters[:, 0]), axis=0)
        return _pass_stages(self.outputs[0], state.outputs, moved)[0] - self.zero

    def forward(self, state: SteppedState, voltage: FloatArray) -> tuple[FloatArray, SteppedState]:
        """Return the displacement (models,), um, at a sample with this voltage, and the state.

        If the voltage is held, the displacement is that just before it changes.
        """
        memory, _, initial, filters, *_ = state
        after, filtered = np.empty_like(memory), np.empty_like(filters)
        driven, inputs = _pass_stages(self.inputs[0], state.inputs, voltage)
        moved = advance(
            *self.hysteresis, self.taps, memory, initial, filters, driven, after, filtered
        )
        moved, outputs = _pass_stages(self.outputs[0], state.outputs, moved)
        return moved - self.zero, SteppedState(after, voltage, initial, filtered, inputs, outputs)

    def inverse(
        self,
        state: SteppedState,
        displacement: FloatArray,
        limits: Span,
        guess: FloatArray | None = None,
        tolerance: float | None = None,
    ) -> tuple[FloatArray, SteppedState]:
        """Return the voltage (models,), V, that gives a displacement (models,), um, and the state.

        If the voltage is held, it is the displacement of the next sample. A displacement that needs
        a voltage outside of the limits gets the limit. The search starts at a ``guess``, by default
        the last voltage, and ends at a ``tolerance``, V, by default the last bits.
        """
        memory, last, initial, filters, *_ = state
        begin = last if guess is None else guess
        behind = state.outputs
        if self.outputs[0] and self.actuator.hold == "zero":
            # The displacement of this sample is settled: they see that first.
            behind = self.forward(state, last)[1].outputs
        aim = _undone(self.outputs[0], behind, displacement + self.zero)
        close, after = tolerance or resolution(limits), np.empty_like(memory)
        model = *self.hysteresis, self.taps
        with np.errstate(divide="ignore", invalid="ignore"):
            voltage = search(*model, memory, initial, filters, begin, aim, *limits, close, after)
        if self.inputs[0]:
            voltage = within(_undone(self.inputs[0], state.inputs, voltage), *limits)
        return voltage, self.forward(state, voltage)[1]

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return bounds (models,) of the drive's slope dw/du within limits, um/V."""
        smallest, largest = self.step.slopes(limits)
        # q₂ and q₃ leave a slope that is a parabola: its extremes are at the ends or its vertex.
        voltage, (_, first, second, third, _) = (
            np.linspace(*limits, 1001)[:, np.newaxis],
            self.curve,
        )
        added = first + voltage * (2 * second + voltage * 3 * third)
        return smallest + added.min(axis=0), largest + added.max(axis=0)

    def reach(self, limits: Span) -> Span:
        """Return the displacements of the first model, um, that slow sweeps of the voltage end at.

        Without dynamics and creep, between limits, V.
        """
        loop = steady_loop(self.actuator, self.column, *limits, points=3)
        # At rest nothing of the sections but the drive counts, and without creep.
        drive, behind = self._settle(self.inputs[1])[1][0], self.actuator.static.outputs
        at_zero = SampledStage.row(behind, self.actuator, self.column, drive)[1][0]
        return Span(float(loop.falling[0, 0] - at_zero), float(loop.rising[0, -1] - at_zero))

    def frequency_response(self, angles: FloatArray) -> FloatArray:
        """Return the complex response (models, frequencies) of dynamics and creep together.

        ``angles`` (frequencies,) are per sample, rad.
        """
        taps = (np.moveaxis(row, -1, 0) for row in self.sections[:2])
        top, bottom = (np.polynomial.polynomial.polyval(np.exp(-1j * angles), row) for row in taps)
        responses = top / bottom
        total: Any = np.einsum("ms,msf->mf", self.sections.gains, responses)
        for stage, numbers, _ in (*self.inputs[0], *self.outputs[0]):
            total = total * stage.response(numbers.T, angles)
        return np.asarray(total)

    @property
    def linear(self) -> Any:
        """The linear part of the first model, a discrete ``scipy.signal.StateSpace``.

        With the drive w in um, from hysteresis and nonlinearity, and x the displacement in um, both
        as differences from rest,

            z[t+1] = A z[t] + B w[t],   x[t] = C z[t] + D w[t],

        with the states that ``scipy.signal.lfilter`` has. If the creep grows with the voltage,
        w (1 + κ |u| / U) is a second input. ``dt`` is in s.
        """
        growing = self.actuator.creep is not None and self.actuator.creep.growing
        systems = []
        sections = zip(*(values[0] for values in self.sections), strict=True)
        for number, (numerator, denominator, gain) in enumerate(sections):
            order = max(int(np.max(np.nonzero([numerator, denominator])[1])), 1)
            inputs = np.eye(1, 1 + growing, int(growing and number > 0))
            shift = np.eye(order, k=1)
            shift[:, 0] -= denominator[1 : order + 1]
            entry = (numerator - denominator * numerator[0])[1 : order + 1, np.newaxis] * inputs
            direct, interval = gain * numerator[0] * inputs, self.actuator.interval
            output = gain * np.eye(1, order)
            systems.append(scipy.signal.StateSpace(shift, entry, output, direct, dt=interval))
        return reduce(add, systems)  # side by side


def _pass_stages(
    row: Sequence[SampledStage], memories: Sequence[FloatArray], value: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Let a value (models,) pass stages in a row; return what comes out, and their memories."""
    after = []
    for stage, memory in zip(row, memories, strict=True):
        value, reached = stage.step(memory, value)
        after.append(reached)
    return value, tuple(after)


def _undone(
    row: Sequence[SampledStage], memories: Sequence[FloatArray], value: FloatArray
) -> FloatArray:
    """Return the value (models,) that has to go into stages in a row for one to come out."""
    for (stage, numbers, _), memory in zip(reversed(row), reversed(memories), strict=True):
        value = stage.undo(numbers, memory, value)
    return value


def require_inverse(model: SampledModel, limits: Span) -> None:
    """Refuse models that have no inverse a sample at a time.

    Raises InputError: the displacement may turn back while the voltage goes on, or the dynamics
    between samples are such that the voltage would swing ever wider from sample to sample.
    """
    for stage in model.actuator.stages:
        stage.require_inverse()
    lowest = float(model.slopes(limits)[0].min())
    if not lowest > 0:
        raise InputError(
            f"inverse: the model's slope may be as low as {lowest:.3g} um/V within {limits.low:g} "
            f"to {limits.high:g} V, so that a displacement has more than one voltage"
        )
    zeros = model.actuator.sections(model.column).zeros
    # With a zero that is nearer to -1 than this, an inverse swings for thousands of samples.
    unstable = (abs(zeros) >= 1) | ((zeros.real < 0) & (abs(zeros) > 0.999))
    for zero in zeros[unstable]:
        raise InputError(
            "inverse: from sample to sample the voltage would swing on and on (the sampled "
            f"dynamics have a zero at {zero.real:.4g}); sample more slowly, or hold the voltage"
        )


def resolution(limits: Span) -> float:
    """Return the change of a voltage at which its search ends, V: some units in its last place."""
    return float(4 * np.finfo(np.float64).eps * max(abs(limits.low), abs(limits.high)))
