"""An amplifier that cannot follow: its output changes by no more than so many volts a second.

Its current charges the actuator's capacitance, so that fast parts of a drive are cut to slopes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration, Values, lognormal
from bwbayes.model.stage import Side, Stage, Timing


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
