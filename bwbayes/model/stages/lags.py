"""First-order lags of an amplifier behind its command and of a sensor behind the displacement.

Both are first-order, τ y′ + y = x. The actuator's own lag is a part of its dynamics; a slow
amplifier stands before the hysteresis, which then sees a voltage that is smoother than the command,
and a slow sensor, with its filter, behind everything.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Context, Declaration, Distribution, Values, lognormal, normal
from bwbayes.model.linear import ComplexArray, first_order_lag
from bwbayes.model.stage import Side, Stage, Timing


class _Lag(Stage):
    """A first-order lag. The memory is y and x.

    Where x is held, the output is the mean of y until the next sample.
    """

    remembers: ClassVar = 2

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how slow it is."""
        subject = self.name.partition("-")[0]
        return f"{subject} with a lag of {1000 * values[self.parameters[0].name]:.2g} ms"

    def numbers(self, column: Values, timing: Timing) -> FloatArray:
        """Return the coefficients of x, of x before and of y before, (models, 6).

        Three that give what comes out, and three that give y at the sample, or at the next one.
        """
        lag = column[self.parameters[0].name]
        if not self.is_held(timing):
            recursion = first_order_lag(lag, timing.interval, "first")
            row = np.column_stack([recursion.numerator, -recursion.denominator[:, 1]])
            return np.concatenate([row, row], axis=1)
        with np.errstate(divide="ignore"):
            z = timing.interval / lag
        mean = -np.expm1(-z) / z
        none = np.zeros_like(z)
        return np.column_stack([1 - mean, none, mean, -np.expm1(-z), none, np.exp(-z)])

    def is_held(self, timing: Timing) -> bool:  # noqa: ARG002  # a displacement has no steps
        """Tell whether x stays the same until the next sample."""
        return False

    @staticmethod
    def settle(parameters: Any, value: Any, after: Any) -> Any:  # noqa: ARG004  # whatever the lag
        """Return x."""
        after[0], after[1] = value, value
        return value

    def begin(
        self, column: Values, numbers: FloatArray, first: FloatArray, timing: Timing
    ) -> FloatArray:
        """Return y as far behind x as it is where x has long moved at the stated speed."""
        slope = column[self.parameters[1].name] * timing.interval
        before, keep = numbers.T[4:]
        # y = x − g s solves the recursion with x before and y before a slope s less.
        behind = (before + keep) / np.maximum(1.0 - keep, 1e-300)
        return np.stack([first - slope - slope * behind, first - slope], axis=1)

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:
        """Return y."""
        after[0] = parameters[3] * value + parameters[4] * memory[1] + parameters[5] * memory[0]
        after[1] = value
        return parameters[0] * value + parameters[1] * memory[1] + parameters[2] * memory[0]

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:
        """Return x."""
        return (value - parameters[1] * memory[1] - parameters[2] * memory[0]) / parameters[0]

    def response(self, numbers: FloatArray, angles: FloatArray) -> ComplexArray:
        """Return that of the recursion."""
        out, x_out, y_out, now, before, keep = numbers.T[:, :, np.newaxis]
        late = np.exp(-1j * angles)
        y = (now + before * late) / (1 - keep * late)
        response: ComplexArray = out + x_out * late + y_out * late * y
        return response


def _declared(name: str, label: str, whose: str, unit: str, range_: str) -> tuple[Declaration, ...]:
    """Declare time constant and speed before the record."""

    def speed(context: Context) -> Distribution:
        # Twice the slope of a triangle.
        return normal(0.0, 4 * getattr(context.ranges, range_) / context.ranges.time)

    return (
        Declaration(
            name,
            "s",
            label,
            f"time constant of the {whose}",
            lambda context: lognormal(0.02 * context.ranges.time, 1.5),
            floor=0.0,
            limit_at_floor=True,
        ),
        Declaration(
            f"{name}_speed",
            f"{unit}/s",
            rf"v_{{{label[-2]}}}",
            f"speed before the record of what the {whose} follows",
            speed,
            scope="record",
            at_rest=0.0,
        ),
    )


class AmplifierLag(_Lag):
    """A slow amplifier: τ y′ + y = x, with the command x and the actuator's voltage y, V."""

    name: ClassVar = "amplifier-lag"
    starts: ClassVar = ({}, {"amplifier_lag": 1.0}, {"amplifier_lag": -0.5, "lag": 0.0})
    advice: ClassVar = "record the amplifier's output voltage"
    side: ClassVar[Side] = "input"
    parameters = _declared("amplifier_lag", "\\tau_{a}", "amplifier", "V", "voltage")

    def is_held(self, timing: Timing) -> bool:
        """Tell whether the command is."""
        return timing.hold == "zero"


class SensorLag(_Lag):
    """A slow sensor: τ y′ + y = x, with the displacement x and what is read y, um."""

    name: ClassVar = "sensor-lag"
    starts: ClassVar = ({}, {"sensor_lag": 1.0}, {"sensor_lag": -0.5, "lag": 0.0})
    advice: ClassVar = "widen the sensor's filter"
    side: ClassVar[Side] = "output"
    parameters = _declared("sensor_lag", "\\tau_{s}", "sensor", "um", "displacement")


# Time constants of first-order lags in a row, by name. A record determines them as a set, but
# hardly which of them is which.
TIME_CONSTANTS = "lag", AmplifierLag.parameters[0].name, SensorLag.parameters[0].name
