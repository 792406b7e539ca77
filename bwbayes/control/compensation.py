"""Compensation: the voltage for a reference displacement, and its predicted error.

The voltage is the inverse of the posterior's mean model, or the one whose squared error, expected
over the posterior, is least. Every draw then predicts its displacement, as that of any planned
voltage. So there are bands of the displacement and of the tracking error, its rms with an interval,
and the probability that it stays below a limit. A linear command stands beside it, by the slope of
a line through the training record.

A command is played by a DAC, which holds each voltage until the next sample. So it has a hold of
its own, whatever the voltage did in the record that was fitted: a command for straight lines that a
DAC holds comes half a sample late. The errors are those at the samples, just before the voltage
changes, and to the reference as requested, not as it was smoothed.

0 um of a reference is where the actuator stands at zero volts as the command begins, here as in a
closed loop and in an exported model. A command so begins at zero volts and goes on from where the
actuator is, which is also where one would set a sensor to zero. Where the sensor of the record that
was fitted had its zero says nothing of the actuator: to take it for 0 um would make a command begin
with a jump, of 10 V for an offset of 7 um.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.predicted import Choice, Compensation, Errors, PredictedResponse, planned
from bwbayes.control.references import Reference
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.inverse import inverse
from bwbayes.model.limits import Limits
from bwbayes.model.linear import Hold
from bwbayes.prediction.initial_state import (
    InitialConditions,
    InitialStates,
    estimate_initial_states,
)
from bwbayes.prediction.prediction import predict_record
from bwbayes.record.instruments import EXACT, Instruments
from bwbayes.record.record import Record
from bwbayes.watching import Watch, part, unwatched


@dataclass(frozen=True)
class _Plan:
    """The parts that all commands share: the draws of one record, the reference, and the start."""

    posterior: Posterior
    draws: FloatArray
    reference: Reference
    start: InitialConditions
    hold: Hold
    seed: int
    instruments: Instruments

    @property
    def references(self) -> FloatArray:
        """The reference as requested and as smoothed, (2, samples), um."""
        return np.stack([self.reference.given, np.asarray(self.reference.displacement)])

    def rng(self) -> np.random.Generator:
        """Return the same random numbers for every command: they share their initial states."""
        return np.random.default_rng(self.seed)

    def record(self, voltage: FloatArray) -> Record:
        """Return a command as a record."""
        record = planned(voltage, self.reference, self.hold, self.reference.name)
        return replace(record, instruments=self.instruments)

    def initial_states(self, voltage: FloatArray) -> InitialStates:
        """Return the initial states of all draws."""
        theta = self.posterior.prior.theta(self.draws)
        return estimate_initial_states(
            self.posterior, theta, self.record(voltage), self.start, self.rng()
        )

    def displacements(self, voltage: FloatArray) -> Iterator[tuple[slice, FloatArray]]:
        """Yield some draws at a time, and their displacement (draws, samples), um."""
        states = self.initial_states(voltage)
        size = max(500_000 // voltage.size, 1)
        for start in range(0, len(states.model), size):
            rows = slice(start, start + size)
            histories = replace(states.histories, which=states.histories.which[rows])
            fields = {
                name: getattr(states, name)[rows]
                for name in ("model", "initial_transient", "offset_sd")
            }
            subset = replace(states, histories=histories, **fields)
            yield rows, subset.displacement(self.record(voltage).inputs)

    def expected(self, voltage: FloatArray, weights: FloatArray) -> tuple[float, FloatArray]:
        """Return the expected rms error to the smoothed reference, um, and the weighted mean."""
        square, mean = 0.0, np.zeros(voltage.size)
        for rows, displacement in self.displacements(voltage):
            mean += weights[rows] @ displacement
            square += float(np.sum(np.mean((displacement - self.references[1]) ** 2, axis=1)))
        return math.sqrt(square / len(self.draws)), mean

    def played(self, voltage: FloatArray, watch: Watch) -> PredictedResponse:
        """Predict a command; ``watch`` is called with the share that is done."""
        bands = predict_record(
            self.posterior, self.draws, self.record(voltage), self.start, self.rng()
        )
        theta = self.posterior.prior.theta(self.draws)
        theta = self.posterior.noise_of_new(theta)
        noise, rng = self.posterior.single_record.noise.at(self.reference.interval), self.rng()
        rms, largest, squares = np.empty((3, len(theta), 2))
        # The reference is in true um, whatever the sensor would read.
        extent = self.posterior.single_record.extent
        true = self.instruments.displacements(len(theta), extent, self.rng())
        for rows, read in self.displacements(voltage):
            displacement = true(rows, read)
            errors = displacement[:, np.newaxis] - self.references
            squares[rows] = np.mean(errors**2, axis=2)
            errors += noise.draw_all(theta[rows], voltage.size, rng)[0][:, np.newaxis]
            rms[rows] = np.sqrt(np.mean(errors**2, axis=2))
            largest[rows] = np.max(np.abs(errors), axis=2)
            watch(min(rows.stop / len(theta), 1.0))
        expected = np.sqrt(np.mean(squares, axis=0)).tolist()
        smoothed = Errors(rms[:, 1], largest[:, 1], expected[1])
        return PredictedResponse(rms[:, 0], largest[:, 0], expected[0], voltage, bands, smoothed)


def compensate(
    posterior: Posterior,
    draws: FloatArray,
    reference: Reference,
    generator: np.random.Generator,
    *,
    command: Choice = "mean",
    hold: Hold = "zero",
    from_rest: bool = False,
    limits: Limits | None = None,
    nearest: bool = False,
    limit: float | None = None,
    instruments: Instruments = EXACT,
    watch: Watch = unwatched,
) -> Compensation:
    """Return the command for a reference, and what is promised of it.

    Parameters
    ----------
    posterior, draws
        The posterior of one record, and draws (draws, free) from it, parameters in their own units.
    reference
        Reference of the displacement.
    generator
        Draws the starts and the discrepancy.
    command
        ``"mean"``: the inverse of the mean model. ``"expected"``: the voltage at which the mean of
        the draws' displacements, each weighted by its slope, is the reference. For an actuator that
        is slow enough not to show its dynamics, that is where the expected squared error, to the
        reference as smoothed, is least; it is taken only if it is less.
    hold
        ``"zero"``: the voltage of a sample brings the displacement to the reference at the next
        sample, just before it changes; ``"first"``: it goes in straight lines.
    from_rest, limits, nearest
        As of :func:`~bwbayes.model.inverse.inverse`. Otherwise the actuator has waited at
        zero volts until it stood still, in a state of its hysteresis that nothing tells.
    limit
        Limit of the tracking error, um.
    instruments
        How well the scales of those are known that read the record that was fitted.
    watch
        Called with the share that is done.

    Raises
    ------
    InputError
        A reference that cannot be reached, with its place and time; an amplifier without zero
        volts; a limit that is not positive.
    """
    if limit is not None and not limit > 0:
        raise InputError(f"limit: {limit:g} um; must be positive")
    if command not in get_args(Choice):
        raise InputError(
            f"command: {command!r} is unknown; {suggestion(command, get_args(Choice))}"
        )
    limits = limits or Limits()
    if not limits.low <= 0 <= limits.high:
        raise InputError(
            f"voltage: {limits.low:g} to {limits.high:g} V leaves out zero volts, where a command "
            "begins; include it"
        )
    reference = reference.from_zero()
    seed = int(generator.integers(2**62))
    plan = _Plan(
        posterior,
        draws,
        reference,
        InitialConditions(from_rest, False, settled=True),
        hold,
        seed,
        instruments,
    )
    requested, target = plan.references
    record = posterior.single_record
    slope, _ = np.polyfit(record.voltage[record.readings.rows], record.readings.values, 1)
    linear = np.clip(requested / slope, limits.low, limits.high)
    states = plan.initial_states(linear)
    actuator = states.histories.likelihoods[-1].actuator
    model = states.model.mean(axis=0)
    # The mean model's own place at zero volts, where all begin, is not the mean of the places.
    at_zero = actuator.displacement(model, [0.0], from_rest=from_rest)[0, 0]
    model[actuator.parameters.index("offset")] -= at_zero

    def invert(displacement: FloatArray) -> FloatArray:
        voltage = inverse(
            actuator, model, displacement, from_rest=from_rest, limits=limits, nearest=nearest
        )
        return np.asarray(voltage[0])

    voltage = invert(target)
    if command == "expected":
        span = actuator.span
        assert span is not None
        slopes = actuator.hysteresis.typical_slope(actuator.columns(states.model), span)
        weights = np.broadcast_to(slopes, len(draws)) / np.sum(np.broadcast_to(slopes, len(draws)))
        smallest, mean = plan.expected(voltage, weights)
        aim = target
        for _ in range(4):
            aim = aim + (target - mean)
            trial = invert(aim)
            error, mean = plan.expected(trial, weights)
            if not error < smallest:
                break
            voltage, smallest = trial, error
    played = plan.played(voltage, part(watch, 0.0, 0.5))
    between = _between(actuator, model, voltage, from_rest)
    notes = _notes(reference, voltage, actuator, limits, nearest)
    if between > np.mean(played.rms):
        notes.append(
            f"between samples the displacement leaves a straight line by up to {between:.3g} um, "
            "more than the rms error at them; choose a shorter sampling interval"
        )
    straight = plan.played(linear, part(watch, 0.5, 1.0))
    return Compensation(
        reference, command, played, straight, hold, between, from_rest, limits, limit, tuple(notes)
    )


def _between(actuator: Actuator, model: FloatArray, voltage: FloatArray, from_rest: bool) -> float:
    """Return how far a model's displacement leaves straight lines between samples, um.

    It is simulated ten times as fast.
    """
    samples, faster = np.arange(voltage.size), np.arange((voltage.size - 1) * 10 + 1)
    between = voltage[faster // 10]
    if actuator.hold == "first":
        between = np.interp(faster / 10, samples, voltage)
    actuator = replace(actuator, interval=actuator.interval / 10)
    displacement = actuator.displacement(model, between, from_rest=from_rest)[0]
    straight = np.interp(faster / 10, samples, displacement[::10])
    return float(np.max(np.abs(displacement - straight)))


def _notes(
    reference: Reference,
    voltage: FloatArray,
    actuator: Actuator,
    limits: Limits,
    nearest: bool,
) -> list[str]:
    """Return what is to be said of a reference that was changed, and of limits that were met."""
    notes = []
    if reference.approach > 0:
        begins = reference.given[round(reference.approach / reference.interval)]
        notes.append(
            f"the reference begins at {begins:.4g} um: a way of {reference.approach:g} s is put "
            "before it, from 0 um, where the actuator stands at zero volts"
        )
    if reference.moved > 0:
        notes.append(
            f"the reference is smoothed over {reference.smoothed:.3g} s, which moves it by up to "
            f"{reference.moved:.3g} um; errors are those to the reference as requested"
        )
    if nearest:
        at = np.mean((voltage <= limits.low) | (voltage >= limits.high))
        fast = np.abs(np.diff(voltage)) >= (1 - 1e-9) * limits.rate * actuator.interval
        if at > 0 or fast.any():
            notes.append(
                f"the amplifier is at its voltage limit for {at:.1%} of the samples, and at its "
                f"speed limit for {np.mean(fast):.1%}: the command is the nearest one"
            )
    return notes
