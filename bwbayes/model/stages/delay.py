"""A column of the record that is late: the displacement behind the voltage, or the voltage itself.

Each channel of an instrument has its own latency, and files are put together from channels by rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration, Values, normal
from bwbayes.model.inputs import Inputs
from bwbayes.model.stage import Side, Stage, Timing
from bwbayes.model.stages.lags import TIME_CONSTANTS


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
