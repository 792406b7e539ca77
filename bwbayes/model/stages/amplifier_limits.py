"""Limits of an amplifier: its range of voltages, and how fast it changes them.

An amplifier that saturates: towards its limits the output falls behind the command.

An amplifier that cannot follow: its output changes by no more than so many volts a second.

Its current charges the actuator's capacitance, so that fast parts of a drive are cut to slopes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration, Values, lognormal, normal
from bwbayes.model.stage import Side, Stage, Timing


class Saturation(Stage):
    """Saturation: y = c + r tanh((x − c) / r), command x, middle c and reach r, V."""

    name: ClassVar = "saturation"
    side: ClassVar[Side] = "input"
    rate_independent: ClassVar = True
    starts: ClassVar = tuple({"saturation_reach": z} for z in (0.5, -0.3, -0.7))
    advice: ClassVar = "record the amplifier's output voltage, or drive inside its range"

    parameters: tuple[Declaration, ...] = (
        Declaration(
            "saturation_middle",
            "V",
            "c",
            "middle of the amplifier's range",
            lambda context: normal(context.ranges.bias, context.ranges.voltage / 2),
        ),
        Declaration(
            "saturation_reach",
            "V",
            "r",
            "what the amplifier's output never passes, from the middle of its range",
            lambda context: lognormal(2 * context.ranges.voltage, 0.7),
            floor=0.0,
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say where the amplifier ends."""
        middle, reach = values["saturation_middle"], values["saturation_reach"]
        ends = f"{middle - reach:.3g} and {middle + reach:.3g} V"
        return f"amplifier that saturates towards {ends}"

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        middle, reach = parameters[0], parameters[1]
        return middle + reach * np.tanh((value - middle) / reach)

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x; of what is beyond reach, that of a millionth before the end."""
        middle, reach = parameters[0], parameters[1]
        fraction = np.minimum(np.maximum((value - middle) / reach, -0.999999), 0.999999)
        return middle + reach * np.arctanh(fraction)


class SlewLimit(Stage):
    """A slew rate: y goes to the command x, V, but by no more than r V/s, |y′| ≤ r."""

    name: ClassVar = "slew-limit"
    side: ClassVar[Side] = "input"
    remembers: ClassVar = 1
    starts: ClassVar = tuple({"slew_limit": z} for z in (0.5, 0.2, 0.0, -0.3, -0.8))
    advice: ClassVar = "record the amplifier's output voltage, or drive more slowly"

    parameters: tuple[Declaration, ...] = (
        Declaration(
            "slew_limit",
            "V/s",
            "r",
            "largest slope of the amplifier's output",
            # A triangle's slope: a limit above the drive's fastest says nothing.
            lambda context: lognormal(2 * context.ranges.voltage / context.ranges.time, 0.7),
            floor=0.0,
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say what the amplifier does."""
        return f"amplifier that follows no faster than {values['slew_limit']:.3g} V/s"

    def numbers(self, column: Values, timing: Timing) -> FloatArray:
        """Return the largest change between two samples, (models, 1), V."""
        return column["slew_limit"][:, np.newaxis] * timing.interval

    @staticmethod
    def settle(parameters: Any, value: Any, after: Any) -> Any:  # noqa: ARG004  # any rate
        """Return x."""
        after[0] = value
        return value

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:
        """Return y."""
        low, high = memory[0] - parameters[0], memory[0] + parameters[0]
        y = np.minimum(np.maximum(value, low), high)
        after[0] = y
        return y

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004  # where it follows
        """Return y: what changes more slowly passes as it is."""
        return value
