"""Sensors that do not read the displacement itself.

A sensor whose reading is not in proportion to the displacement.

A sensor that counts the other way round.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration, Values, normal
from bwbayes.model.stage import Side, Stage, Timing


class SensorCurve(Stage):
    """A sensor's curve: y = x + Y (a + b s) (s² − 1), s = (x − m) / Y, of displacement x, um.

    Y is half of the displacement's range, and m its middle without the offset, of the record that
    is fitted: there, s = −1 and 1, y is x.
    """

    name: ClassVar = "sensor-curve"
    side: ClassVar[Side] = "output"
    rate_independent: ClassVar = True
    starts: ClassVar = ({},)
    advice: ClassVar = "calibrate the sensor over its range"

    parameters: tuple[Declaration, ...] = (
        *(
            Declaration(
                f"sensor_{name}",
                "-",
                f"b_{power}",
                f"{name} part of the sensor's curve, of half of its range",
                lambda _: normal(0.0, 0.03),
            )
            for name, power in (("quadratic", 2), ("cubic", 3))
        ),
        Declaration(
            "sensor_middle",
            "um",
            "m",
            "displacement in the middle of the sensor's curve",
            lambda context: context.ranges.slope * context.ranges.bias,
        ),
        Declaration(
            "sensor_half",
            "um",
            "Y_s",
            "half of the range of the sensor's curve",
            lambda context: context.ranges.displacement,
            floor=0.0,
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how far the curve leaves its chord."""
        s = np.linspace(-1.0, 1.0, 201)
        bent = values["sensor_quadratic"] * (s**2 - 1) + values["sensor_cubic"] * s * (s**2 - 1)
        return f"sensor with a curve, off its chord by {50 * np.abs(bent).max():.2g}% of the range"

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        return bent(parameters, value)

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x, by Newton's rule: the curve is nearly straight."""
        x = value
        for _ in range(8):
            s = (x - parameters[2]) / parameters[3]
            slope = 1.0 + 2.0 * parameters[0] * s + parameters[1] * (3.0 * s * s - 1.0)
            x = x - (bent(parameters, x) - value) / slope
        return x


def bent(parameters: Any, value: Any) -> Any:
    """Return what a sensor reads of a displacement."""
    s = (value - parameters[2]) / parameters[3]
    return value + parameters[3] * (parameters[0] + parameters[1] * s) * (s * s - 1.0)


class ReversedSign(Stage):
    """Reversed sign: y = −x, of displacement x, um."""

    name: ClassVar = "reversed-sign"
    side: ClassVar[Side] = "output"
    rate_independent: ClassVar = True
    advice: ClassVar = "change the sign of the displacement's column in the file"
    parameters: tuple[Declaration, ...] = ()

    def describe(self, values: Mapping[str, float]) -> str:  # noqa: ARG002  # there are none
        """Say what it does."""
        return "reversed sign of the displacement"

    def numbers(self, column: Values, timing: Timing) -> FloatArray:  # noqa: ARG002  # no pace
        """Return −1, (models, 1)."""
        return np.full((next(iter(column.values())).size, 1), -1.0)

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        return parameters[0] * value

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x."""
        return parameters[0] * value
