"""Additions to a reading besides the displacement, at some times more than at others.

None of it is the actuator's: it is fitted in the record where it was, and not expected of the next.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import FloatArray, select
from bwbayes.model.declaration import Context, Declaration, Distribution, Values, lognormal, normal
from bwbayes.model.stage import Side, Stage, Timing


def _size(name: str, unit: str, label: str, description: str, fraction: float) -> Declaration:
    """Declare a size of an event, whose prior sd is a part of the displacement's range."""

    def default(context: Context) -> Distribution:
        over = context.ranges.duration ** unit.count("s")
        return normal(0.0, fraction * 2 * context.ranges.displacement / over)

    return Declaration(name, unit, label, description, default, scope="event", at_rest=0.0)


class Drift(Stage):
    """Drift of the sensor or its mount: y = x + v t + a t², of displacement x, um."""

    name: ClassVar = "drift"
    side: ClassVar[Side] = "output"
    sees: ClassVar = ("time",)
    advice: ClassVar = "measure again after a longer warm-up"
    parameters: tuple[Declaration, ...] = (
        _size("drift", "um/s", "v_d", "drift of the readings", 0.1),
        _size("drift_curvature", "um/s/s", "a_d", "what the drift gains in speed, halved", 0.1),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how fast it begins."""
        return f"drift of the readings, by {values['drift']:+.2g} um/s at first"

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        return value + parameters[2] * (parameters[0] + parameters[1] * parameters[2])

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x."""
        return value - parameters[2] * (parameters[0] + parameters[1] * parameters[2])


class Transient(Stage):
    """Transient after a switch-on at t₀: y = x + A exp(−(t − t₀)/τ), of displacement x, um."""

    name: ClassVar = "transient"
    side: ClassVar[Side] = "output"
    sees: ClassVar = ("time",)
    starts: ClassVar = tuple({"transient_time": z} for z in (-1.2, 0.0, 1.2))
    advice: ClassVar = "wait until everything has settled"
    parameters: tuple[Declaration, ...] = (
        _size("transient", "um", "A_t", "transient of the readings at the start", 0.2),
        Declaration(
            "transient_time",
            "s",
            r"\tau_t",
            "time constant of the transient",
            lambda context: lognormal(context.ranges.duration / 30, 1.1),
            floor=0.0,
        ),
        Declaration(
            "transient_begin",
            "s",
            "t_0",
            "time of the switch-on since the record's first sample",
            lambda context: context.ranges.begin,
            scope="event",
            at_rest=0.0,
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how large it is, and how long."""
        size, time = values["transient"], values["transient_time"]
        return f"transient of {size:.2g} um at the start that decays within {time:.2g} s"

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        after_switch = np.maximum(parameters[3] - parameters[2], 0.0)
        return value + parameters[0] * np.exp(-after_switch / parameters[1])

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x."""
        after_switch = np.maximum(parameters[3] - parameters[2], 0.0)
        return value - parameters[0] * np.exp(-after_switch / parameters[1])


class OffsetStep(Stage):
    """Step of the mount or the sensor: y = x + A from the time t₁ on, of displacement x, um."""

    name: ClassVar = "step"
    side: ClassVar[Side] = "output"
    sees: ClassVar = ("time",)
    advice: ClassVar = "fit one side of the step"
    parameters: tuple[Declaration, ...] = (
        _size("step", "um", "A_1", "step of the readings", 0.1),
        Declaration(
            "step_time",
            "s",
            "t_1",
            "time of the step since the record's first sample",
            lambda context: Distribution(
                "uniform", {"lower": 0.0, "upper": context.ranges.duration}
            ),
            scope="event",
            at_rest=0.0,
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how large it is, and when."""
        return f"jump of the offset by {values['step']:.2g} um at {values['step_time']:.4g} s"

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        return value + select(parameters[2] >= parameters[1], parameters[0], 0.0)

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x."""
        return value - select(parameters[2] >= parameters[1], parameters[0], 0.0)


class Oscillation(Stage):
    """Oscillation, as of the mains: y = x + A sin 2πft + B cos 2πft, of displacement x, um."""

    name: ClassVar = "oscillation"
    side: ClassVar[Side] = "output"
    sees: ClassVar = ("time",)
    advice: ClassVar = "look for the source: mains, ground loops, vibration"
    parameters: tuple[Declaration, ...] = (
        _size("oscillation_sine", "um", "A_s", "oscillation in the readings, its sine", 0.01),
        _size("oscillation_cosine", "um", "A_c", "oscillation in the readings, its cosine", 0.01),
        Declaration(
            "oscillation_frequency",
            "Hz",
            "f",
            "frequency of the oscillation",
            lambda _: 50.0,
            floor=0.0,
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how large it is, and how fast."""
        size = float(np.hypot(values["oscillation_sine"], values["oscillation_cosine"]))
        return f"oscillation of {size:.2g} um at {values['oscillation_frequency']:.4g} Hz"

    def numbers(self, column: Values, timing: Timing) -> FloatArray:
        """Return A, B and 2πf, (models, 3)."""
        numbers = super().numbers(column, timing)
        numbers[:, 2] *= 2 * np.pi
        return numbers

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        phase = parameters[2] * parameters[3]
        return value + parameters[0] * np.sin(phase) + parameters[1] * np.cos(phase)

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x."""
        phase = parameters[2] * parameters[3]
        return value - parameters[0] * np.sin(phase) - parameters[1] * np.cos(phase)
