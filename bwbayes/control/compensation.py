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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from types import MappingProxyType
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.references import Reference
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.errors import ExitStatus, InputError, suggestion
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import InitialConditions
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import HOLD_NAMES, Hold, Limits
from bwbayes.model.inverse import inverse
from bwbayes.prediction.bands import KINDS, LEVELS, Bands, Kind
from bwbayes.prediction.initial_state import InitialStates, estimate_initial_states
from bwbayes.prediction.prediction import predict_record
from bwbayes.record.instruments import EXACT, Instruments
from bwbayes.record.io.grid import clock
from bwbayes.record.record import Record
from bwbayes.report.report import (
    Banner,
    Facts,
    Figure,
    Picture,
    Product,
    Report,
    Section,
    Table,
    kind_of,
    remarks_banner,
    standing_banner,
)
from bwbayes.shown import brief, rounded
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
    conditions: Mapping[str, float]

    @property
    def references(self) -> FloatArray:
        """The reference as requested and as smoothed, (2, samples), um."""
        return np.stack([self.reference.given, np.asarray(self.reference.displacement)])

    def rng(self) -> np.random.Generator:
        """Return the same random numbers for every command: they share their initial states."""
        return np.random.default_rng(self.seed)

    def record(self, voltage: FloatArray) -> Record:
        """Return a command as a record."""
        name = self.reference.name
        record = command_record(voltage, self.reference, self.hold, name, self.conditions)
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
    conditions: Mapping[str, float] = MappingProxyType({}),
    watch: Watch = unwatched,
) -> Compensation:
    """Return the command for a reference, and what is promised of it.

    The ``posterior`` is that of one record, with ``draws`` (draws, free), parameters in their own
    units; the ``generator`` draws the starts and the discrepancy. The ``command`` "mean" is the
    inverse of the mean model, and "expected" the voltage at which the mean of the draws'
    displacements, each weighted by its slope, is the reference. For an actuator that is slow enough
    not to show its dynamics, that is where the expected squared error, to the reference as
    smoothed, is least; it is taken only if it is less.

    With the ``hold`` "zero" the voltage of a sample brings the displacement to the reference at the
    next sample, just before it changes; with "first" it goes in straight lines. ``from_rest``,
    ``limits`` and ``nearest`` are as of :func:`~bwbayes.model.inverse.inverse`; not from rest, the
    actuator has waited at zero volts until it stood still, in a state of its hysteresis that
    nothing tells. ``limit`` is that of the tracking error, um; the ``instruments`` are those that
    read the record that was fitted, ``conditions`` the covariates, which stay as they are.
    ``watch`` is called with the share that is done.

    Raises InputError: a reference that cannot be reached, with its place and time; an amplifier
    without zero volts; a limit that is not positive.
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
        conditions,
    )
    requested, target = plan.references
    record = posterior.single_record
    slope, _ = np.polyfit(record.voltage[record.readings.rows], record.readings.values, 1)
    linear = np.clip(requested / slope, limits.low, limits.high)
    states = plan.initial_states(linear)
    actuator = replace(states.histories.likelihoods[-1].actuator, conditions=conditions)
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
        reference, command, played, straight, hold, between, from_rest, limits, limit, tuple(notes),
        conditions=dict(conditions),
    )  # fmt: skip


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


Choice = Literal["mean", "expected"]


@dataclass(frozen=True, eq=False)
class Errors:
    """Predicted errors of a command to a reference, um.

    ``rms`` and ``largest`` (draws,) with the discrepancy, one draw each; ``expected`` the square
    root of the squared error without the discrepancy, expected over the draws.
    """

    __repr__ = brief

    rms: FloatArray
    largest: FloatArray
    expected: float

    def numbers(self, limit: float | None) -> dict[str, Any]:
        """Return means and intervals, um, and how probably a limit is kept, if there is one."""
        numbers: dict[str, Any] = {"expected_rms_um": self.expected}
        for name, values in (("rms_um", self.rms), ("largest_um", self.largest)):
            numbers[name] = {"mean": float(np.mean(values))}
            for level in LEVELS:
                edges = np.quantile(values, [0.5 - level / 200, 0.5 + level / 200])
                numbers[name][str(level)] = edges.tolist()
        if limit is not None:
            numbers["probability_below_limit"] = float(np.mean(self.largest <= limit))
        return numbers


@dataclass(frozen=True, eq=False)
class PredictedResponse(Errors):
    """A command, the displacement that it gives, and its errors to the reference as requested.

    ``voltage`` (samples,), V; ``bands`` of the displacement; ``smoothed`` the errors to the
    reference as it was smoothed.
    """

    __repr__ = brief

    voltage: FloatArray
    bands: Bands
    smoothed: Errors

    def numbers(self, limit: float | None) -> dict[str, Any]:
        """Return the voltages, V, and the errors, um, to the reference requested and smoothed."""
        return {
            "voltage_V": [float(np.min(self.voltage)), float(np.max(self.voltage))],
            **super().numbers(limit),
            "to_smoothed_reference": self.smoothed.numbers(limit),
        }


@dataclass(frozen=True, eq=False)
class Compensation(Product):
    """A command that makes a displacement, and its predicted errors.

    ``voltage`` (samples,), V, is the command for the ``asked`` reference, um, which it follows as
    ``smoothed``; ``reference`` is what was asked for; ``command`` says which of the two voltages
    was taken; ``compensated`` is that command, ``linear`` the one without compensation. ``limit``
    is that of the error, um, if there is one; ``limits`` are the amplifier's; ``hold`` is what the
    command does between samples, and ``between`` how far the displacement leaves straight lines
    there, um. ``conditions`` are the covariates, and ``standing`` is how the validation of the run
    came out that all of this builds on.
    """

    NAME: ClassVar[str] = "compensation"

    reference: Reference
    command: Choice
    compensated: PredictedResponse
    linear: PredictedResponse
    hold: Hold
    between: float
    from_rest: bool
    limits: Limits
    limit: float | None = None
    remarks: tuple[str, ...] = ()
    standing: ValidationSummary = field(default_factory=ValidationSummary)
    conditions: Mapping[str, float] = field(default_factory=dict)

    @property
    def asked(self) -> FloatArray:
        """The reference as requested, (samples,), um."""
        return self.reference.given

    @property
    def smoothed(self) -> FloatArray:
        """The reference as it was smoothed, which the command follows, (samples,), um."""
        return np.asarray(self.reference.displacement)

    @property
    def voltage(self) -> FloatArray:
        """The command, (samples,), V."""
        return self.compensated.voltage

    @property
    def fastest(self) -> float:
        """The fastest change of the command from one sample to the next, V/s."""
        return float(np.max(np.abs(np.diff(self.voltage)), initial=0.0)) / self.reference.interval

    @property
    def limit_kept(self) -> bool | None:
        """Whether the limit of the error is kept: at 95%; False below even odds, else None."""
        if self.limit is None:
            return True
        within = float(np.mean(self.compensated.largest <= self.limit))
        return True if within >= 0.95 else None if within >= 0.5 else False

    @property
    def exit_status(self) -> ExitStatus:
        """The status is a success only if the limit is kept."""
        if self.limit_kept is None:
            return ExitStatus.VALIDATION_INCONCLUSIVE
        return ExitStatus.SUCCESS if self.limit_kept else ExitStatus.VALIDATION_FAILED

    @property
    def shortfall(self) -> str:
        """The message on a limit that is not kept: how probably, where, and the fix."""
        if self.limit_kept:
            return ""
        after = self.compensated.numbers(self.limit)
        farthest = int(np.argmax(np.abs(self.compensated.bands.mean - self.asked)))
        return (
            f"the limit of {self.limit:g} um is kept with a probability of "
            f"{after['probability_below_limit']:.2f} only: the largest error is "
            f"{after['largest_um']['mean']:.3g} um, in the mean at "
            f"{clock(float(self.reference.time[farthest]), self.reference.interval)} s; ask for "
            "less, smooth corners (smoothed, --smooth), or choose a larger limit"
        )

    @property
    def record(self) -> Record:
        """The command as a record that a signal generator can play; it states its limits."""
        origin = f"command for {self.reference.name}; amplifier {self.limits}"
        return command_record(self.voltage, self.reference, self.hold, origin, self.conditions)

    def records(self) -> dict[str, Record]:
        """Return the command by the name of its file."""
        return {"command": self.record}

    @property
    def summary(self) -> dict[str, Any]:
        """The predicted errors as numbers."""
        target = self.asked
        return {
            "validation": self.standing.numbers,
            "reference": self.reference.name,
            "samples": target.size,
            "interval_s": self.reference.interval,
            "from_um": float(np.min(target)),
            "to_um": float(np.max(target)),
            "smoothed_s": self.reference.smoothed,
            "smoothing_moves_um": self.reference.moved,
            "approach_s": self.reference.approach,
            "zero_um_is": "where the actuator stands at zero volts as the command begins",
            "from_rest": self.from_rest,
            "hold": HOLD_NAMES[self.hold],
            "between_samples_um": self.between,
            "command": self.command,
            **self.limits.numbers,
            "conditions": dict(self.conditions),
            "fastest_V_per_s": self.fastest,
            "limit_um": self.limit,
            "limit_kept": self.limit_kept,
            "compensated": self.compensated.numbers(self.limit),
            "uncompensated": self.linear.numbers(self.limit),
            "remarks": list(self.remarks),
        }

    def columns(self) -> Iterator[tuple[str, FloatArray]]:
        """Yield names and values of the columns of ``compensation.csv``."""
        yield "time_s", self.reference.time
        yield "reference_um", self.asked
        yield "smoothed_reference_um", self.smoothed
        yield "voltage_V", self.voltage
        bands = self.compensated.bands
        yield "mean_um", bands.mean
        shown: list[tuple[str, Kind, float | FloatArray]] = [(kind, kind, 0.0) for kind in KINDS]
        shown += [("error", "displacement", self.asked)]
        shown += [("smoothed_error", "displacement", self.smoothed)]
        for name, kind, reference in shown:
            for level in LEVELS:
                yield f"{name}_lower_{level}_um", bands.lower[kind, level] - reference
                yield f"{name}_upper_{level}_um", bands.upper[kind, level] - reference
        yield "uncompensated_voltage_V", self.linear.voltage
        yield "uncompensated_mean_um", self.linear.bands.mean

    def to_pandas(self) -> Any:
        """Return the columns of ``compensation.csv`` as a pandas.DataFrame."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        return pd.DataFrame({self.quantities.heading(n): v for n, v in self.columns()})

    def plot(self) -> Figure:
        """Draw reference, prediction and error along time."""
        from bwbayes.report.figures import draw_styled, products  # noqa: PLC0415  # slow to load

        return draw_styled(
            products.draw_command,
            self.reference.name,
            self.asked,
            self._commands,
            self.limit,
            quantities=self.quantities,
        )

    def report(self) -> Report:
        """Return the predicted error beside that of a linear command, with pictures."""
        from bwbayes.report.figures import products as figures  # noqa: PLC0415  # slow to load

        name, shown = self.reference.name, (self.asked, self._commands)
        validation = "" if self.standing.passed else f", validation {self.standing.status}"
        kind = kind_of(self.standing)
        if self.limit_kept is not True:
            validation += f", limit {'NOT KEPT' if self.limit_kept is False else 'uncertain'}"
            kind = "bad" if self.limit_kept is False else "note"
        promise = Banner(kind, f"Predicted error{validation}", [self._promise()])
        fastest = f"the command changes by up to {rounded(self.fastest, 4)} V/s"
        return Report(
            title=f"{name}, compensation",
            heading=f"Compensation: {name}",
            banners=[*standing_banner(self.standing), promise, *remarks_banner(self.remarks)],
            blocks=[
                Facts([("Amplifier", f"{self.limits}; {fastest}"), *facts_of(self.conditions)]),
                self._table(),
                Picture(
                    "tracking",
                    "Reference and prediction",
                    "The command, the displacement that it will give with its 95% bands, and the "
                    "error; beside it what a linear command would do.",
                    partial(figures.draw_command, name, *shown, self.limit),
                ),
                Picture(
                    "error",
                    "Error",
                    "Left: the tracking error, to the reference as requested, with its 95% bands; "
                    "dotted, the limit. Right: what its rms may be, with the discrepancy, over the "
                    "draws.",
                    partial(figures.draw_error, *shown, self.limit),
                ),
                Picture(
                    "loops",
                    "Before and after",
                    "What is predicted against the reference: without compensation the loop is "
                    "open.",
                    partial(figures.draw_loops, *shown),
                ),
                Section("Request", [self._request()], folded=False),
            ],
            numbers=self.summary,
            csv=self.to_pandas().to_csv(index=False, float_format="%.9g"),
        )

    @property
    def _commands(self) -> dict[str, PredictedResponse]:
        """The commands as their figures take them."""
        return {"uncompensated": self.linear, "compensated": self.compensated}

    def _promise(self) -> str:
        after, before = (played.numbers(self.limit) for played in (self.compensated, self.linear))
        low, high = after["rms_um"]["95"]
        text = (
            f"rms error {after['rms_um']['mean']:.3g} µm (95%: {low:.3g} to {high:.3g}), without "
            f"compensation {before['rms_um']['mean']:.3g} µm"
        )
        if self.limit is not None:
            within = after["probability_below_limit"]
            text += f"; stays below {self.limit:g} µm with a probability of {within:.2f}"
        return text

    def _table(self) -> Table:
        """Return a row for each number, with a column for each command."""
        played = [command.numbers(self.limit) for command in (self.compensated, self.linear)]
        rows = [("Voltage", *(_span(numbers["voltage_V"]) for numbers in played), "V")]
        if self.limit is not None:
            texts = [f"{numbers['probability_below_limit']:.3f}" for numbers in played]
            rows.append((f"Probability that the error stays below {self.limit:g} µm", *texts, ""))
        references = {"": played}
        if self.reference.moved > 0:
            smoothed = [numbers["to_smoothed_reference"] for numbers in played]
            references[" to the smoothed reference"] = smoothed
        titles = {"rms_um": "Rms of the error", "largest_um": "Largest error"}
        for (reference, commands), (key, title) in product(references.items(), titles.items()):
            errors = [numbers[key] for numbers in commands]
            means = (f"{error['mean']:.3g}" for error in errors)
            rows.append((f"{title}{reference}, mean", *means, "µm"))
            for level in LEVELS:
                spans = (_span(error[str(level)]) for error in errors)
                rows.append((f"{title}{reference}, {level}% interval", *spans, "µm"))
        return Table(
            "error",
            "Error",
            ("Quantity", "Compensated", "Uncompensated", "Unit"),
            rows,
            note="The displacement less the reference as requested, with the model's discrepancy "
            "and without the sensor's noise, over the posterior's draws. Uncompensated: the "
            "reference over the slope of a straight line through the record that was fitted.",
        )

    def _request(self) -> Facts:
        target, interval = self.asked, self.reference.interval
        commands = {"mean": "inverse of the mean model", "expected": "least expected squared error"}
        holds = {
            "zero": "held until the next sample, as a DAC does (zero-order hold)",
            "first": "straight lines (first-order hold)",
        }
        start = "demagnetized" if self.from_rest else "waited"
        extent = f"{np.min(target):.4g} to {np.max(target):.4g} µm"
        between = f"up to {self.between:.3g} µm from a straight line; errors are those at the"
        pairs = {
            "Reference": f"{extent}, {target.size} samples every {interval:g} s",
            "Command": commands[self.command],
            "Voltage between samples": holds[self.hold],
            "Displacement between samples": f"{between} samples, just before the voltage changes",
            "Start": f"{start} at zero volts{'' if self.from_rest else ', after any drive'}",
            "0 µm": "where the actuator stands at zero volts as the command begins",
        }
        return Facts([*pairs.items()])

    def __repr__(self) -> str:
        promise = f"compensation for {self.reference.name}: {self._promise()}"
        return "\n".join([*self.standing.messages, promise.replace("µ", "u")])


def _span(edges: Sequence[float]) -> str:
    return f"{edges[0]:.4g} to {edges[1]:.4g}"


def facts_of(conditions: Mapping[str, float]) -> list[tuple[str, str]]:
    """Return a page's facts on the covariates of a command or model."""
    return [(name, f"{value:.6g}, constant") for name, value in conditions.items()]


def command_record(
    voltage: FloatArray,
    reference: Reference,
    hold: Hold,
    origin: str,
    conditions: Mapping[str, float],
) -> Record:
    """Return a command as a record, whose voltage is what it is for this hold."""
    return Record(
        voltage,
        None,
        interval=reference.interval,
        covariates={name: np.full(voltage.size, value) for name, value in conditions.items()},
        voltage_is="command" if hold == "zero" else "output",
        origin=origin,
    )
