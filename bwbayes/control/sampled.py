"""A fitted model at a controller's pace: one sample in, one sample out, forward or inverse.

:class:`SampledModel` is what ``bwbayes export`` writes as C and what ``bwbayes track`` closes the
loop around. It is the actuator's own recursion, with a voltage for each model. The inverse is a
safeguarded Newton iteration with a bounded number of rounds. What follows the hysteresis is linear,
and is given as a system of ``scipy.signal`` too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.linear import Taps
from bwbayes.model.operator import Span
from bwbayes.model.step import Gone, HysteresisStep
from bwbayes.shown import brief

# Rounds of the inverse at most: Newton's rule needs a few; if it fails, bisection goes on to the
# last bit of a voltage.
NEWTON_ROUNDS, BISECTION_ROUNDS = 40, 60


class SteppedState(NamedTuple):
    """State of the models between two samples.

    ``memory`` (models, any) is that of the hysteresis, ``voltage`` (models,) the last one, V,
    ``rest`` (models, sections) the drives at the start, um, and ``filters`` (models, sections, 2)
    the states of the recursions.
    """

    memory: FloatArray
    voltage: FloatArray
    rest: FloatArray
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
    sections: Taps

    @classmethod
    def of(cls, actuator: Actuator, theta: FloatArray) -> Self:
        """Return the models with parameters θ (models, parameters).

        Raises
        ------
        InputError
            The hysteresis has no step of bounded time.
        """
        column = {name: values.copy() for name, values in actuator.columns(theta).items()}
        sections = actuator.sections(column).taps
        return cls(actuator, column, actuator.hysteresis.step(column), sections)

    @property
    def models(self) -> int:
        """Number of models."""
        return int(self.sections.gains.shape[0])

    @cached_property
    def creep_growth(self) -> FloatArray:
        """κ / U (models,), 1/V, by which the creep's drive w (1 + κ |u| / U) grows."""
        creep = self.actuator.creep
        if creep is None or not creep.growing:
            return np.zeros(self.models)
        return np.asarray(self.column["creep_growth"] * creep.size(np.array(1.0)))

    def begin(self, voltage: FloatArray) -> SteppedState:
        """Return the state of actuators that have settled at a voltage (models,), V."""
        w, _, memory = self.drive(self.step.demagnetized(), voltage)
        filters = np.zeros((*self.sections.gains.shape, 2))
        return SteppedState(memory, voltage, self._section_drives(w, voltage), filters)

    @cached_property
    def zero(self) -> FloatArray:
        """What dynamics and creep make of the drive at zero volts, where 0 um is, (models,), um."""
        return self._weigh(self.begin(np.zeros(self.models)).rest)

    def level(self, state: SteppedState) -> FloatArray:
        """Return the displacement (models,) at which they began, um."""
        return self._weigh(state.rest) - self.zero

    def displacement(self, state: SteppedState) -> FloatArray:
        """Return the displacement (models,), um, that a held voltage has led to."""
        return self.level(state) + self._weigh(state.filters[..., 0])

    def forward(self, state: SteppedState, voltage: FloatArray) -> tuple[FloatArray, SteppedState]:
        """Return the displacement (models,), um, at a sample with this voltage, and the state.

        If the voltage is held, the displacement is that just before it changes.
        """
        numerator, denominator, _ = self.sections
        w, _, memory = self.drive(state.memory, voltage)
        drives = self._section_drives(w, voltage) - state.rest
        moved = numerator[..., 0] * drives + state.filters[..., 0]
        filters = numerator[..., 1:] * drives[..., np.newaxis]
        filters -= denominator[..., 1:] * moved[..., np.newaxis]
        filters[..., 0] += state.filters[..., 1]
        displacement = self.level(state) + self._weigh(moved)
        return displacement, state._replace(memory=memory, voltage=voltage, filters=filters)

    def inverse(
        self,
        state: SteppedState,
        displacement: FloatArray,
        limits: Span,
        guess: FloatArray | None = None,
        tolerance: float | None = None,
    ) -> tuple[FloatArray, SteppedState]:
        """Return the voltage (models,), V, that gives a displacement (models,), um, and the state.

        If the voltage is held, it is the displacement of the next sample. What would need a voltage
        outside of the limits gets the limit. The search starts at a ``guess``, by default the last
        voltage, and ends at a ``tolerance``, V, by default the last bits.
        """
        numerator, denominator, gains = self.sections
        carried, now = state.filters[..., 0], numerator[..., 0]
        if self.actuator.hold == "zero":
            # The next sample; this one is out of reach.
            carried = state.filters[..., 1] - denominator[..., 1] * carried
            now = numerator[..., 1]
        weights = gains * now
        direct, creeping = weights[:, 0], weights[:, 1:].sum(axis=1)
        demand = displacement - self.level(state) - self._weigh(carried)
        demand += (weights * state.rest).sum(axis=1)
        tolerance = resolution(limits) if tolerance is None else tolerance

        # (direct + creeping (1 + κ |u| / U)) w(u) = demand, where the left side rises with u.
        voltage = np.clip(state.voltage if guess is None else guess, *limits)
        low, high = np.full_like(demand, limits.low), np.full_like(demand, limits.high)
        for iteration in range(NEWTON_ROUNDS + BISECTION_ROUNDS):
            w, slope, _ = self.drive(state.memory, voltage)
            factor = direct + creeping * (1 + self.creep_growth * np.abs(voltage))
            excess = factor * w - demand
            steepness = factor * slope + creeping * w * self.creep_growth * np.sign(voltage)
            low = np.where(excess < 0, voltage, low)
            high = np.where(excess < 0, high, voltage)
            better = (low + high) / 2
            if iteration < NEWTON_ROUNDS:
                with np.errstate(divide="ignore", invalid="ignore"):
                    newton = np.clip(voltage - excess / steepness, limits.low, limits.high)
                better = np.where((newton >= low) & (newton <= high), newton, better)
            change, voltage = np.abs(better - voltage), better
            if np.all(change <= tolerance):
                break
        return voltage, self.forward(state, voltage)[1]

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return bounds (models,) of the drive's slope dw/du within limits, um/V."""
        smallest, largest = self.step.slopes(limits)
        # q₂ and q₃ leave a slope that is a parabola: its extremes are at the ends or its vertex.
        _, added = self._added(np.linspace(*limits, 1001)[:, np.newaxis])
        return smallest + added.min(axis=0), largest + added.max(axis=0)

    def drive(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return hysteresis and gain, um, once the voltages (models,) have gone there."""
        gone, (level, slope) = self.step.go(memory, voltage), self._added(voltage)
        return Gone(gone.w + level, gone.slope + slope, gone.memory)

    def _added(self, voltage: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the gain adds at voltages (models,) or (any, 1), um, and its slope, um/V."""
        if self.actuator.gain is None:
            return np.zeros_like(voltage), np.zeros_like(voltage)
        level, first, second, third = self.actuator.gain.powers(self.column)
        added = level + voltage * (first + voltage * (second + voltage * third))
        return added, first + voltage * (2 * second + voltage * 3 * third)

    def frequency_response(self, angles: FloatArray) -> FloatArray:
        """Return the complex response (models, frequencies) of dynamics and creep together.

        ``angles`` (frequencies,) are per sample, rad.
        """
        taps = (np.moveaxis(row, -1, 0) for row in self.sections[:2])
        top, bottom = (np.polynomial.polynomial.polyval(np.exp(-1j * angles), row) for row in taps)
        responses = top / bottom
        total: Any = np.einsum("ms,msf->mf", self.sections.gains, responses)
        return np.asarray(total)

    @property
    def linear(self) -> Any:
        """What follows the hysteresis of the first model, a discrete ``scipy.signal.StateSpace``.

        With the drive w in um, from hysteresis and gain, and x the displacement in um, both as
        differences from rest,

            z[t+1] = A z[t] + B w[t],   x[t] = C z[t] + D w[t],

        with the states that ``scipy.signal.lfilter`` has. If the creep grows with the voltage,
        w (1 + κ |u| / U) is a second input. ``dt`` is in s.
        """
        growing = self.actuator.creep is not None and self.actuator.creep.growing
        a, b, c, d = [], [], [], np.zeros((1, 1 + growing))
        sections = zip(*(values[0] for values in self.sections), strict=True)
        for number, (numerator, denominator, gain) in enumerate(sections):
            order = max(int(np.max(np.nonzero([numerator, denominator])[1])), 1)
            column = int(growing and number > 0)
            shift, entry = np.eye(order, k=1), np.zeros((order, 1 + growing))
            shift[:, 0] -= denominator[1 : order + 1]
            entry[:, column] = (numerator - denominator * numerator[0])[1 : order + 1]
            d[0, column] += gain * numerator[0]
            a.append(shift)
            b.append(entry)
            c.append(gain * np.eye(1, order))
        return scipy.signal.StateSpace(
            scipy.linalg.block_diag(*a), np.vstack(b), np.hstack(c), d, dt=self.actuator.interval
        )

    def _section_drives(self, w: FloatArray, voltage: FloatArray) -> FloatArray:
        """Return what drives each section, (models, sections), um."""
        drives = np.empty_like(self.sections.gains)
        drives[:, 0] = w
        drives[:, 1:] = (w * (1 + self.creep_growth * np.abs(voltage)))[:, np.newaxis]
        return drives

    def _weigh(self, values: FloatArray) -> FloatArray:
        """Return the sum of the sections' values (models, sections), each times its gain."""
        total: FloatArray = (self.sections.gains * values).sum(axis=1)
        return total


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
