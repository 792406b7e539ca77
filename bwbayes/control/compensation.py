"""Compensation: the voltage for a displacement that is asked for, and how well it will do.

The voltage is the inverse of the posterior's mean model, or the one whose squared error, expected
over the posterior, is least. What it does is then predicted with every draw, as any planned voltage
is: bands of the displacement, and so of the tracking error, its rms with an interval, and the
probability that it stays below a limit. Beside it stands what a linear command would do, which is
the line through the record that was fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.wished import Reference
from bwbayes.data.record import Record
from bwbayes.errors import InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.inverse.chain import inverse
from bwbayes.model.inverse.limits import Limits
from bwbayes.results.bands import KINDS, LEVELS, Bands
from bwbayes.results.prediction import predict_record
from bwbayes.results.start import Start, Started, started

__all__ = ["ROUNDS", "Choice", "Compensation", "Played", "compensate"]

Choice = Literal["mean", "expected"]

# Rounds in which the command with the least expected error is looked for.
ROUNDS = 4

# Numbers (draws x samples) that are simulated at once.
BLOCK = 2_000_000


@dataclass(frozen=True, eq=False)
class Played:
    """A command and what it will do.

    ``voltage`` (samples,), V; ``bands`` of the displacement; ``rms`` and ``largest`` (draws,), um,
    of the tracking error with the discrepancy, one draw each; ``expected`` the square root of the
    squared error that the parameters leave, expected over the draws, um.
    """

    voltage: FloatArray
    bands: Bands
    rms: FloatArray
    largest: FloatArray
    expected: float

    def probability(self, limit: float) -> float:
        """Return the probability that the error stays below a limit, um, at all samples."""
        return float(np.mean(self.largest <= limit))

    def numbers(self, limit: float | None) -> dict[str, Any]:
        """Return what is promised of the error, um, and the voltages, V."""
        said: dict[str, Any] = {
            "voltage_V": [float(np.min(self.voltage)), float(np.max(self.voltage))],
            "expected_rms_um": self.expected,
        }
        for name, values in (("rms_um", self.rms), ("largest_um", self.largest)):
            said[name] = {"mean": float(np.mean(values))} | {
                f"{level}": _interval(values, level) for level in LEVELS
            }
        if limit is not None:
            said["probability_below_limit"] = self.probability(limit)
        return said


def _interval(values: FloatArray, level: int) -> list[float]:
    tail = (1 - level / 100) / 2
    return [float(edge) for edge in np.quantile(values, [tail, 1 - tail])]


@dataclass(frozen=True, eq=False)
class Compensation:
    """A command that makes a displacement, and what is promised of it.

    ``reference`` is what was asked for; ``command`` says which of the two voltages was taken;
    ``compensated`` is that command, ``linear`` the one without compensation; ``difference`` the
    largest difference of the two voltages that could have been taken, V, and ``other`` what the
    other one leaves, as ``Played.expected``, um. ``limit`` is that of the error, um, if there is
    one; ``hold`` what the voltage does between samples.
    """

    reference: Reference
    command: Choice
    compensated: Played
    linear: Played
    difference: float
    other: float
    hold: str
    from_rest: bool
    limit: float | None = None
    remarks: tuple[str, ...] = ()

    @property
    def asked(self) -> FloatArray:
        """What the displacement is to be, (samples,), um."""
        return np.asarray(self.reference.displacement)

    @property
    def voltage(self) -> FloatArray:
        """The command, (samples,), V."""
        return self.compensated.voltage

    @property
    def record(self) -> Record:
        """The command as a record that a signal generator can play."""
        return _planned(
            self.voltage, self.reference, self.hold, f"command for {self.reference.name}"
        )

    @property
    def summary(self) -> dict[str, Any]:
        """What is promised, in numbers."""
        asked = self.asked
        return {
            "reference": self.reference.name,
            "samples": asked.size,
            "interval_s": self.reference.interval,
            "from_um": float(np.min(asked)),
            "to_um": float(np.max(asked)),
            "smoothed_s": self.reference.smoothed,
            "smoothing_moves_um": self.reference.moved,
            "from_rest": self.from_rest,
            "hold": self.hold,
            "command": self.command,
            "limit_um": self.limit,
            "compensated": self.compensated.numbers(self.limit),
            "uncompensated": self.linear.numbers(self.limit),
            "other_command": {
                "largest_difference_V": self.difference,
                "expected_rms_um": self.other,
            },
            "remarks": list(self.remarks),
        }

    def columns(self) -> Iterator[tuple[str, FloatArray]]:
        """Yield names and values of the columns of ``compensation.csv``."""
        yield "time_s", self.reference.time
        yield "reference_um", self.asked
        yield "voltage_V", self.voltage
        bands = self.compensated.bands
        yield "mean_um", bands.mean
        for kind in KINDS:
            for level in LEVELS:
                yield f"{kind}_lower_{level}_um", bands.lower[kind, level]
                yield f"{kind}_upper_{level}_um", bands.upper[kind, level]
        for level in LEVELS:
            yield f"error_lower_{level}_um", bands.lower["displacement", level] - self.asked
            yield f"error_upper_{level}_um", bands.upper["displacement", level] - self.asked
        yield "uncompensated_voltage_V", self.linear.voltage
        yield "uncompensated_mean_um", self.linear.bands.mean

    def to_pandas(self) -> Any:
        """Return the columns of ``compensation.csv`` as a pandas.DataFrame."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        return pd.DataFrame(dict(self.columns()))


@dataclass(frozen=True)
class _Task:
    """What all commands share: the draws of one record, the reference, and what is known."""

    posterior: Posterior
    draws: FloatArray
    reference: Reference
    start: Start
    hold: str
    seed: int

    @property
    def asked(self) -> FloatArray:
        return np.asarray(self.reference.displacement)

    def generator(self) -> np.random.Generator:
        """Return the same random numbers for every command: they share their starts."""
        return np.random.default_rng(self.seed)

    def begun(self, voltage: FloatArray) -> Started:
        theta = self.posterior.prior.theta(self.draws)
        return started(self.posterior, theta, self.planned(voltage), self.start, self.generator())

    def planned(self, voltage: FloatArray) -> Record:
        return _planned(voltage, self.reference, self.hold, self.reference.name)

    def simulated(self, voltage: FloatArray) -> Iterator[tuple[slice, FloatArray]]:
        """Yield some draws at a time, and their displacement (draws, samples), um."""
        begun = self.begun(voltage)
        size = max(BLOCK // voltage.size, 1)
        for first in range(0, len(begun.model), size):
            some = slice(first, first + size)
            part = replace(
                begun,
                which=begun.which[some],
                model=begun.model[some],
                unrest=begun.unrest[some],
                offset_sd=begun.offset_sd[some],
            )
            yield some, part.advance(voltage)[0]

    def expected(self, voltage: FloatArray, weights: FloatArray) -> tuple[float, FloatArray]:
        """Return the expected squared error, um², and the weighted mean displacement (samples,)."""
        squares, mean = 0.0, np.zeros(voltage.size)
        for some, simulated in self.simulated(voltage):
            mean += weights[some] @ simulated
            squares += float(np.sum(np.mean((simulated - self.asked) ** 2, axis=1)))
        return squares / len(self.draws), mean

    def played(self, voltage: FloatArray) -> Played:
        """Predict a command."""
        bands = predict_record(
            self.posterior, self.draws, self.planned(voltage), self.start, self.generator()
        )
        record = self.posterior.only
        theta = record.table.noise(self.posterior.prior.theta(self.draws))
        noise, generator = record.noise.at(self.reference.interval), self.generator()
        rms, largest = np.empty((2, len(theta)))
        squares = 0.0
        for some, simulated in self.simulated(voltage):
            missed = simulated - self.asked
            squares += float(np.sum(np.mean(missed**2, axis=1)))
            for row, one in enumerate(missed, some.start):
                error = one + noise.draw(theta[row : row + 1], one.size, generator)[0]
                rms[row] = np.sqrt(np.mean(error**2))
                largest[row] = np.max(np.abs(error))
        return Played(voltage, bands, rms, largest, float(np.sqrt(squares / len(theta))))


def _planned(voltage: FloatArray, reference: Reference, hold: str, origin: str) -> Record:
    return Record(
        voltage,
        None,
        reference.interval,
        voltage_is="command" if hold == "zero" else "output",
        origin=origin,
    )


def compensate(
    posterior: Posterior,
    draws: FloatArray,
    reference: Reference,
    generator: np.random.Generator,
    *,
    command: Choice = "mean",
    from_rest: bool = False,
    limits: Limits | None = None,
    nearest: bool = False,
    limit: float | None = None,
    remarks: Sequence[str] = (),
) -> Compensation:
    """Return the command for a reference, and what is promised of it.

    Parameters
    ----------
    posterior, draws
        The posterior of one record, and draws (draws, free) from it, parameters in their own units.
    reference
        What the displacement is to be, as the sensor of that record would read it.
    generator
        Draws the starts and the discrepancy.
    command
        ``"mean"``: the inverse of the mean model. ``"expected"``: the voltage at which the mean of
        the draws' displacements, each weighted by its slope, is the reference. For an actuator that
        is slow enough not to show its dynamics, that is where the expected squared error is least;
        it is taken only if it is less.
    from_rest
        The actuator starts demagnetised at zero volts; otherwise it has waited at the first voltage
        until it stood still, in a state of its hysteresis that nothing tells.
    limits, nearest
        The amplifier's, and whether to come as near as they allow; see
        :func:`~bwbayes.model.inverse.chain.inverse`.
    limit
        Of the tracking error, um.
    remarks
        What else is to be said.

    Raises
    ------
    InputError
        A reference that cannot be reached, with its place and time; a limit that is not positive.
    """
    if limit is not None and not limit > 0:
        raise InputError(f"limit: {limit:g} um; must be positive")
    hold = posterior.only.actuator.hold
    seed = int(generator.integers(2**62))
    task = _Task(posterior, draws, reference, Start(from_rest, False, settled=True), hold, seed)
    linear = _linear(posterior, task.asked, limits or Limits())
    begun = task.begun(linear)
    actuator, model = begun.actuators[-1], begun.model.mean(axis=0)
    column = actuator.columns(begun.model)
    span = actuator.span
    assert span is not None
    slopes = np.broadcast_to(actuator.hysteresis.gain(column, span), len(draws))
    weights = slopes / np.sum(slopes)

    def inverted(asked: FloatArray) -> FloatArray:
        made = inverse(actuator, model, asked, from_rest=from_rest, limits=limits, nearest=nearest)
        return np.asarray(made[0])

    by_mean = inverted(task.asked)
    error, mean = task.expected(by_mean, weights)
    best, least, asked = by_mean, error, task.asked
    for _ in range(ROUNDS):
        asked = asked + (task.asked - mean)
        tried = inverted(asked)
        left, mean = task.expected(tried, weights)
        if not left < least:
            break
        best, least = tried, left
    taken, other = (by_mean, least) if command == "mean" else (best, error)
    return Compensation(
        reference,
        command,
        task.played(taken),
        task.played(linear),
        float(np.max(np.abs(best - by_mean))),
        float(np.sqrt(other)),
        hold,
        from_rest,
        limit,
        (*remarks, *_said(reference, taken, actuator, limits, nearest)),
    )


def _linear(posterior: Posterior, asked: FloatArray, limits: Limits) -> FloatArray:
    """Return the voltage that a straight line through the fitted readings gives for a reference."""
    record = posterior.only
    rows = record.readings.rows
    slope, level = np.polyfit(record.voltage[rows], record.readings.values, 1)
    return np.asarray(np.clip((asked - level) / slope, limits.low, limits.high))


def _said(
    reference: Reference,
    voltage: FloatArray,
    actuator: Actuator,
    limits: Limits | None,
    nearest: bool,
) -> list[str]:
    said = []
    if reference.moved > 0:
        said.append(
            f"the reference is smoothed over {reference.smoothed:.3g} s, which moves it by up to "
            f"{reference.moved:.3g} um"
        )
    if nearest and limits is not None:
        at = np.mean((voltage <= limits.low) | (voltage >= limits.high))
        fast = np.abs(np.diff(voltage)) >= (1 - 1e-9) * limits.rate * actuator.interval
        if at > 0 or fast.any():
            said.append(
                f"the amplifier is at its voltage limit for {at:.1%} of the samples, and at its "
                f"speed limit for {np.mean(fast):.1%}: the command is the nearest one"
            )
    return said
