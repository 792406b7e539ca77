"""An amplifier that saturates: towards its limits the output falls behind the command."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bwbayes.model.declaration import Declaration, lognormal, normal
from bwbayes.model.stage import Side, Stage


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
