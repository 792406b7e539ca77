"""Stages that come late: first-order lags, and a pure delay.

An amplifier is behind its command, and a sensor behind the displacement, τ y′ + y = x. The
actuator's own lag is a part of its dynamics; a slow amplifier stands before the hysteresis, which
then sees a voltage that is smoother than the command, and a slow sensor, with its filter, behind
everything.

A delay is a column of the record that is late, the displacement or the voltage. Each channel of an
instrument has its own latency, and files are put together from channels by rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Context, Declaration, Distribution, Values, lognormal, normal
from bwbayes.model.inputs import Inputs
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


def _declare(name: str, label: str, whose: str, unit: str, range_: str) -> tuple[Declaration, ...]:
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
    parameters = _declare("amplifier_lag", "\\tau_{a}", "amplifier", "V", "voltage")

    def is_held(self, timing: Timing) -> bool:
        """Tell whether the command is."""
        return timing.hold == "zero"


class SensorLag(_Lag):
    """A slow sensor: τ y′ + y = x, with the displacement x and what is read y, um."""

    name: ClassVar = "sensor-lag"
    starts: ClassVar = ({}, {"sensor_lag": 1.0}, {"sensor_lag": -0.5, "lag": 0.0})
    advice: ClassVar = "widen the sensor's filter"
    side: ClassVar[Side] = "output"
    parameters = _declare("sensor_lag", "\\tau_{s}", "sensor", "um", "displacement")


# Time constants of first-order lags in a row, by name. A record determines them as a set, but
# hardly which of them is which.
TIME_CONSTANTS = "lag", AmplifierLag.parameters[0].name, SensorLag.parameters[0].name


class Delay(Stage):
    """A delay: y(t) = u(t − δ), of the command u, V; the voltage is late where δ < 0.

    It goes straight between samples, and stays before the first and behind the last: readings that
    need the voltage there are left out. It is worked out of all samples at once, since it may be
    ahead: a controller does not have it.
    """

    name: ClassVar = "delay"
    side: ClassVar[Side] = "input"
    sees: ClassVar = ("voltage",)
    starts: ClassVar = tuple({"delay": z} for z in (-0.1, 0.0, 0.1))
    advice: ClassVar = "move the column that is late up by rows in the file"
    parameters: tuple[Declaration, ...] = (
        Declaration(
            "delay",
            "s",
            r"\delta",
            "delay of the displacement behind the voltage",
            # Two sds are a quarter of a period, which nearly is another sign, and leave most of a
            # record that has hardly one.
            lambda context: normal(0.0, min(context.ranges.time / 4, context.ranges.duration / 10)),
            # A lag delays slow drives by its time constant.
            summed_with=TIME_CONSTANTS,
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say which column is late, and by how much."""
        column = "displacement" if values["delay"] > 0 else "voltage"
        return f"{column} that is late by {1000 * abs(values['delay']):.3g} ms"

    def numbers(self, column: Values, timing: Timing) -> FloatArray:
        """Return δ in samples, (models, 1)."""
        return column["delay"][:, np.newaxis] / timing.interval

    def numbers_at(self, column: Values, timing: Timing, inputs: Inputs) -> FloatArray:
        """Return how many samples before those of the whole path it is, (models, 1)."""
        return self.numbers(column, timing) - inputs.around[1]

    def seen(self, inputs: Inputs) -> FloatArray:
        """Return the whole path (1, any), V, of which the inputs are a part."""
        return inputs.around[0][np.newaxis]

    def reach(self, column: Values) -> tuple[float, float]:
        """Return the longest delay of either sign, s."""
        return max(float(np.max(column["delay"])), 0.0), max(-float(np.min(column["delay"])), 0.0)

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return u, of a sample by itself."""
        return value

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return y, of a sample by itself."""
        return value

    def advance(
        self,
        numbers: FloatArray,
        memory: FloatArray,
        values: FloatArray,
        seen: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the path as late as each model has it, (models, samples)."""
        if seen is None:
            return values, memory
        path, floor = seen[0], np.floor(numbers)
        after = np.arange(values.shape[1]) - floor.astype(np.intp)
        late, before = (path[np.clip(at, 0, path.size - 1)] for at in (after, after - 1))
        return late + (numbers - floor) * (before - late), memory

    def inverse(
        self,
        numbers: FloatArray,
        memory: FloatArray,  # noqa: ARG002
        values: FloatArray,
        seen: FloatArray | None = None,  # noqa: ARG002  # what is sought
    ) -> FloatArray:
        """Return the commands (models, samples) of which these are late."""
        commands = np.empty(values.shape)
        for row, (shift,) in enumerate(numbers.tolist()):
            floor = int(np.floor(shift))
            fraction, wanted, late = shift - floor, values[row], floor
            # From the side on which errors fade: y = (1 − f) u₀ + f u₁, where f is at most a half.
            backwards = fraction > 0.5
            if backwards:
                fraction, wanted, late = 1 - fraction, wanted[::-1], floor + 1
            fade = [1 - fraction, fraction]
            command, _ = scipy.signal.lfilter(
                [1.0], fade, wanted, zi=[-fraction / fade[0] * wanted[0]]
            )
            command = command[::-1] if backwards else command
            commands[row] = command[np.clip(np.arange(command.size) + late, 0, command.size - 1)]
        return commands
