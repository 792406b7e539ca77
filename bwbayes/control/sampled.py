"""A model that runs at a controller's pace: one sample in, one sample out, forward or backward.

:class:`SampledModel` is what ``bwbayes export`` writes as C and what ``bwbayes track`` closes the
loop around. It is the actuator's own recursion, with a voltage for each model; backward it finds
the voltage that brings the displacement where it is to be, by a safeguarded Newton iteration whose
number of rounds is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.gain import DriveStep
from bwbayes.model.operator import Span
from bwbayes.model.step import Gone, HysteresisStep
from bwbayes.shown import brief

__all__ = [
    "BISECTION_ROUNDS",
    "NEWTON_ROUNDS",
    "SampledModel",
    "SampledSections",
    "SteppedState",
    "require_inverse",
    "resolution",
    "sections_of",
]

# Rounds of the solver at most: some of Newton's, of which it needs a few, and should they not do,
# bisection to the last bit of a voltage.
NEWTON_ROUNDS, BISECTION_ROUNDS = 40, 60

# A zero that is nearer to -1 than this leaves an inverse that swings for thousands of samples.
LARGEST_ZERO = 0.999


class SampledSections(NamedTuple):
    """Linear recursions side by side, (models, sections, 3) and (models, sections).

    ``crept`` (models, sections) tells the sections whose drive is that of the creep.
    """

    numerator: FloatArray
    denominator: FloatArray
    gains: FloatArray
    crept: BoolArray


class SteppedState(NamedTuple):
    """What the models remember between two samples.

    ``memory`` is the hysteresis' own, ``voltage`` (models,) the last one, V, ``rest`` (models,) and
    ``crept_rest`` (models,) are the drives at the start, um, and ``filters`` (models, sections, 2)
    the recursions' states.
    """

    memory: FloatArray
    voltage: FloatArray
    rest: FloatArray
    crept_rest: FloatArray
    filters: FloatArray


@dataclass(frozen=True)
class SampledModel:
    """A batch of models, a sample at a time.

    They start demagnetized at zero volts, go to a first voltage and settle there, with dynamics and
    creep at rest. 0 um is where they stand at zero volts: the displacement is without the sensor's
    offset.

    Parameters
    ----------
    actuator
        Parts, hold and sampling interval.
    column
        The columns (models,) of θ by name.
    step
        The operator's step.
    sections
        Dynamics and creep.
    """

    __repr__ = brief

    actuator: Actuator
    column: dict[str, FloatArray]
    step: HysteresisStep
    sections: SampledSections

    @classmethod
    def of(cls, actuator: Actuator, theta: FloatArray) -> Self:
        """Return the models with parameters θ (models, parameters).

        Raises
        ------
        InputError
            The hysteresis has no step of bounded time.
        """
        column = {name: values.copy() for name, values in actuator.columns(theta).items()}
        return cls(
            actuator, column, actuator.hysteresis.step(column), sections_of(actuator, column)
        )

    @property
    def models(self) -> int:
        """How many there are."""
        return int(self.sections.gains.shape[0])

    def begin(self, voltage: FloatArray) -> SteppedState:
        """Return the state of actuators that have settled at a voltage (models,), V."""
        equilibrium, _, memory = self.drive(self.step.demagnetized(), voltage)
        filters = np.zeros((*self.sections.gains.shape, 2))
        return SteppedState(
            memory, voltage, equilibrium, equilibrium * self._growth(voltage), filters
        )

    @cached_property
    def zero(self) -> FloatArray:
        """What dynamics and creep make of the drive at zero volts, where 0 um is, (models,), um."""
        return self._settled(self.begin(np.zeros(self.models)))

    def level(self, state: SteppedState) -> FloatArray:
        """Return the displacement (models,) at which they began, um."""
        return self._settled(state) - self.zero

    def _settled(self, state: SteppedState) -> FloatArray:
        before = np.where(self.sections.crept, state.crept_rest[:, None], state.rest[:, None])
        return (self.sections.gains * before).sum(axis=1)

    def displacement(self, state: SteppedState) -> FloatArray:
        """Return the displacement (models,), um, that a held voltage has led to."""
        return self.level(state) + (self.sections.gains * state.filters[..., 0]).sum(axis=1)

    def forward(self, state: SteppedState, voltage: FloatArray) -> tuple[FloatArray, SteppedState]:
        """Return the displacement (models,), um, at a sample with this voltage, and the state.

        If the voltage is held, the displacement is that just before it changes.
        """
        numerator, denominator, gains, crept = self.sections
        w, _, memory = self.drive(state.memory, voltage)
        creeping = w if self._even else w * self._growth(voltage)
        drives = np.where(
            crept, (creeping - state.crept_rest)[:, np.newaxis], (w - state.rest)[:, np.newaxis]
        )
        moved = numerator[..., 0] * drives + state.filters[..., 0]
        ahead = numerator[..., 1:] * drives[..., np.newaxis]
        ahead -= denominator[..., 1:] * moved[..., np.newaxis]
        ahead[..., 0] += state.filters[..., 1]
        displacement = self.level(state) + (gains * moved).sum(axis=1)
        return displacement, state._replace(memory=memory, voltage=voltage, filters=ahead)

    def inverse(
        self,
        state: SteppedState,
        displacement: FloatArray,
        limits: Span,
        guess: FloatArray | None = None,
        close: float | None = None,
    ) -> tuple[FloatArray, SteppedState]:
        """Return the voltage (models,), V, that gives a displacement (models,), um, and the state.

        If the voltage is held, it is the displacement of the next sample. What would need a voltage
        outside of the limits gets the limit. The search starts at a ``guess``, or else the last
        voltage, and ends when it is ``close``, V, by default to the last bits.
        """
        drive, crept, missing = self._instant(state, displacement)
        first = np.clip(state.voltage if guess is None else guess, *limits)
        close = resolution(limits) if close is None else close
        voltage = self._solve(state.memory, first, (drive, crept, missing), limits, close)
        return voltage, self.forward(state, voltage)[1]

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return bounds (models,) of the drive's slope dw/du within limits, um/V."""
        smallest, largest = self.step.slopes(limits)
        if self.actuator.gain is None:
            return smallest, largest
        # q₂ and q₃ leave a slope that is a parabola: its extremes are at the ends or its vertex.
        added = self._shaped.added_slope(np.linspace(*limits, 1001)[:, np.newaxis])
        return smallest + added.min(axis=0), largest + added.max(axis=0)

    def _instant(
        self, state: SteppedState, displacement: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what the drives w and w (1 + κ |u| / U) count at once, and their sum, um."""
        numerator, denominator, gains, crept = self.sections
        carried = state.filters[..., 0]
        now = numerator[..., 0]
        if self.actuator.hold == "zero":
            # The next sample; this one is out of reach.
            carried = state.filters[..., 1] - denominator[..., 1] * carried
            now = numerator[..., 1]
        counts = gains * now
        drive = np.where(crept, 0.0, counts).sum(axis=1)
        creep = np.where(crept, counts, 0.0).sum(axis=1)
        missing = displacement - self.level(state) - (gains * carried).sum(axis=1)
        return drive, creep, missing + drive * state.rest + creep * state.crept_rest

    def _solve(
        self,
        memory: FloatArray,
        voltage: FloatArray,
        demand: tuple[FloatArray, FloatArray, FloatArray],
        limits: Span,
        close: float,
    ) -> FloatArray:
        """Solve (b + b_c (1 + κ |u| / U)) w(u) = missing, rising in u, between limits."""
        drive, crept, missing = demand
        low, high = np.full_like(missing, limits.low), np.full_like(missing, limits.high)
        for done in range(NEWTON_ROUNDS + BISECTION_ROUNDS):
            w, slope, _ = self.drive(memory, voltage)
            factor = drive + crept * self._growth(voltage)
            excess = factor * w - missing
            steepness = factor * slope + crept * w * self._growth_slope(voltage)
            low = np.where(excess < 0, voltage, low)
            high = np.where(excess < 0, high, voltage)
            better = (low + high) / 2
            if done < NEWTON_ROUNDS:
                with np.errstate(divide="ignore", invalid="ignore"):
                    newton = np.clip(voltage - excess / steepness, limits.low, limits.high)
                better = np.where((newton >= low) & (newton <= high), newton, better)
            moved, voltage = np.abs(better - voltage), better
            if np.all(moved <= close):
                break
        return voltage

    def drive(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return hysteresis and gain once the voltage has gone there."""
        return self._shaped.go(memory, voltage)

    @property
    def _shaped(self) -> DriveStep:
        return DriveStep(self.step, self.actuator.gain, self.column)

    @property
    def _even(self) -> bool:
        """Whether the creep does not grow with the voltage."""
        return self.actuator.creep is None or not self.actuator.creep.growing

    def _growth(self, voltage: FloatArray) -> FloatArray:
        """Return 1 + κ |u| / U (models,)."""
        creep = self.actuator.creep
        if creep is None or self._even:
            return np.ones_like(voltage)
        grown: FloatArray = 1 + self.column["creep_growth"] * creep.size(voltage)
        return grown

    def _growth_slope(self, voltage: FloatArray) -> FloatArray:
        """Return the slope of 1 + κ |u| / U, 1/V."""
        creep = self.actuator.creep
        if creep is None or self._even:
            return np.zeros_like(voltage)
        slope: FloatArray = (
            np.sign(voltage) * self.column["creep_growth"] * creep.size(np.array(1.0))
        )
        return slope


def sections_of(actuator: Actuator, column: dict[str, FloatArray]) -> SampledSections:
    """Return dynamics and creep of models given by the columns (models,) of θ."""
    numerator, denominator, gains = actuator.sections(column).taps
    # The first is that of the dynamics.
    crept = np.broadcast_to(np.arange(gains.shape[1]) > 0, gains.shape)
    return SampledSections(numerator, denominator, gains, crept)


def require_inverse(model: SampledModel, limits: Span) -> None:
    """Refuse models that have no inverse a sample at a time.

    Raises
    ------
    InputError
        The displacement may turn back while the voltage goes on, or the dynamics between samples
        are such that the voltage would swing ever wider from sample to sample.
    """
    lowest = float(model.slopes(limits)[0].min())
    if not lowest > 0:
        raise InputError(
            f"inverse: the model's slope may be as low as {lowest:.3g} um/V within {limits.low:g} "
            f"to {limits.high:g} V, so that a displacement has more than one voltage"
        )
    zeros = model.actuator.sections(model.column).zeros
    for zero in zeros[(abs(zeros) >= 1) | ((zeros.real < 0) & (abs(zeros) > LARGEST_ZERO))]:
        raise InputError(
            "inverse: from sample to sample the voltage would swing on and on (the sampled "
            f"dynamics have a zero at {zero.real:.4g}); sample more slowly, or hold the voltage"
        )


def resolution(limits: Span) -> float:
    """Return the change of a voltage at which its search ends, V: some units in its last place."""
    return float(4 * np.finfo(np.float64).eps * max(abs(limits.low), abs(limits.high)))
