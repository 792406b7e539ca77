"""A command that compensates, in numbers: its voltage, the displacement that it gives, its errors.

What :func:`~bwbayes.control.compensation.compensate` returns. Errors are those at the samples, to
the reference as requested and as it was smoothed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.wished import Reference
from bwbayes.data.record import Record
from bwbayes.model.linear import HOLD_NAMES, Hold
from bwbayes.results.bands import KINDS, LEVELS, Bands
from bwbayes.results.standing import Standing
from bwbayes.shown import brief

__all__ = ["Choice", "Compensation", "Errors", "Played", "planned"]

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

    def probability(self, limit: float) -> float:
        """Return the probability that the error stays below a limit, um, at all samples."""
        return float(np.mean(self.largest <= limit))

    def numbers(self, limit: float | None) -> dict[str, Any]:
        """Return means and intervals, um, and the probability of the limit, if there is one."""
        numbers: dict[str, Any] = {"expected_rms_um": self.expected}
        for name, values in (("rms_um", self.rms), ("largest_um", self.largest)):
            numbers[name] = {"mean": float(np.mean(values))} | {
                f"{level}": _interval(values, level) for level in LEVELS
            }
        if limit is not None:
            numbers["probability_below_limit"] = self.probability(limit)
        return numbers


@dataclass(frozen=True, eq=False)
class Played(Errors):
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


def _interval(values: FloatArray, level: int) -> list[float]:
    tail = (1 - level / 100) / 2
    return [float(edge) for edge in np.quantile(values, [tail, 1 - tail])]


@dataclass(frozen=True, eq=False)
class Compensation:
    """A command that makes a displacement, and what is promised of it.

    ``reference`` is what was asked for; ``command`` says which of the two voltages was taken;
    ``compensated`` is that command, ``linear`` the one without compensation; ``difference`` the
    largest difference of the two voltages that could have been taken, V, and ``other`` what the
    other one leaves, as ``Played.smoothed.expected``, um. ``limit`` is that of the error, um, if
    there is one; ``hold`` what the command does between samples, and ``between`` how far the
    displacement leaves straight lines there, um. ``standing`` is how the validation of the run came
    out that all of this builds on.
    """

    __repr__ = brief

    reference: Reference
    command: Choice
    compensated: Played
    linear: Played
    difference: float
    other: float
    hold: Hold
    between: float
    from_rest: bool
    limit: float | None = None
    remarks: tuple[str, ...] = ()
    standing: Standing = field(default_factory=Standing)

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
    def record(self) -> Record:
        """The command as a record that a signal generator can play."""
        return planned(
            self.voltage, self.reference, self.hold, f"command for {self.reference.name}"
        )

    @property
    def summary(self) -> dict[str, Any]:
        """What is promised, in numbers."""
        asked = self.asked
        return {
            "validation": self.standing.numbers,
            "reference": self.reference.name,
            "samples": asked.size,
            "interval_s": self.reference.interval,
            "from_um": float(np.min(asked)),
            "to_um": float(np.max(asked)),
            "smoothed_s": self.reference.smoothed,
            "smoothing_moves_um": self.reference.moved,
            "approach_s": self.reference.approach,
            "zero_um_is": "where the actuator stands at zero volts as the command begins",
            "from_rest": self.from_rest,
            "hold": HOLD_NAMES[self.hold],
            "between_samples_um": self.between,
            "command": self.command,
            "limit_um": self.limit,
            "compensated": self.compensated.numbers(self.limit),
            "uncompensated": self.linear.numbers(self.limit),
            "other_command": {
                "largest_difference_V": self.difference,
                "to_smoothed_reference": {"expected_rms_um": self.other},
            },
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
        for kind in KINDS:
            for level in LEVELS:
                yield f"{kind}_lower_{level}_um", bands.lower[kind, level]
                yield f"{kind}_upper_{level}_um", bands.upper[kind, level]
        for name, reference in (("error", self.asked), ("smoothed_error", self.smoothed)):
            for level in LEVELS:
                yield f"{name}_lower_{level}_um", bands.lower["displacement", level] - reference
                yield f"{name}_upper_{level}_um", bands.upper["displacement", level] - reference
        yield "uncompensated_voltage_V", self.linear.voltage
        yield "uncompensated_mean_um", self.linear.bands.mean

    def to_pandas(self) -> Any:
        """Return the columns of ``compensation.csv`` as a pandas.DataFrame."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        return pd.DataFrame(dict(self.columns()))


def planned(voltage: FloatArray, reference: Reference, hold: Hold, origin: str) -> Record:
    """Return a command as a record, whose voltage is what it is for this hold."""
    return Record(
        voltage,
        None,
        reference.interval,
        voltage_is="command" if hold == "zero" else "output",
        origin=origin,
    )
