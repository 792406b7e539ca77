"""A command that compensates: its voltage, the displacement that it gives, its errors, its report.

:func:`~bwbayes.control.compensation.compensate` returns a :class:`Compensation`. Errors are those
at the samples, to the reference as requested and as it was smoothed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import Any, ClassVar, Literal

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.references import Reference
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.errors import ExitStatus
from bwbayes.model.limits import Limits
from bwbayes.model.linear import HOLD_NAMES, Hold
from bwbayes.prediction.bands import KINDS, LEVELS, Bands, Kind
from bwbayes.record.io.grid import clock
from bwbayes.record.record import Record
from bwbayes.report.report import (
    Banner,
    Facts,
    Figure,
    Kind as BannerKind,
    Picture,
    Product,
    Report,
    Section,
    Table,
    kind_of,
    remarks_banner,
    standing_banner,
)
from bwbayes.shown import brief

Choice = Literal["mean", "expected"]

# How a command ends whose limit is kept, is not, or may be.
ENDINGS = {
    True: ExitStatus.SUCCESS,
    False: ExitStatus.VALIDATION_FAILED,
    None: ExitStatus.VALIDATION_INCONCLUSIVE,
}


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
    there, um. ``standing`` is how the validation of the run came out that all of this builds on.
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
        return ENDINGS[self.limit_kept]

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
        """The command as a record that a signal generator can play."""
        return planned(
            self.voltage, self.reference, self.hold, f"command for {self.reference.name}"
        )

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
        from bwbayes.report.figures import control, draw_styled  # noqa: PLC0415  # slow to load

        return draw_styled(
            control.draw_command,
            self.reference.name,
            self.asked,
            self._commands,
            self.limit,
            quantities=self.quantities,
        )

    def report(self) -> Report:
        """Return the predicted error beside that of a linear command, with pictures."""
        from bwbayes.report.figures import control as figures  # noqa: PLC0415  # slow to load

        name, shown = self.reference.name, (self.asked, self._commands)
        validation = "" if self.standing.passed else f", validation {self.standing.status}"
        kind: BannerKind = kind_of(self.standing)
        if self.limit_kept is not True:
            validation += f", limit {'NOT KEPT' if self.limit_kept is False else 'uncertain'}"
            kind = "bad" if self.limit_kept is False else "note"
        promise = Banner(kind, f"Predicted error{validation}", [self._promise()])
        return Report(
            title=f"{name}, compensation",
            heading=f"Compensation: {name}",
            banners=[*standing_banner(self.standing), promise, *remarks_banner(self.remarks)],
            blocks=[
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
            "Amplifier": f"{self.limits}; the command changes by up to {self.fastest:.4g} V/s",
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


def planned(voltage: FloatArray, reference: Reference, hold: Hold, origin: str) -> Record:
    """Return a command as a record, whose voltage is what it is for this hold."""
    return Record(
        voltage,
        None,
        interval=reference.interval,
        voltage_is="command" if hold == "zero" else "output",
        origin=origin,
    )
