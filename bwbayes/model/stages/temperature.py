"""A displacement that changes with the temperature, which is recorded beside the voltage.

A piezo moves by some tenths of a percent more or less for every kelvin.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration, Values, normal
from bwbayes.model.stage import Side, Stage, Timing


class Temperature(Stage):
    """Gain that follows the temperature: y = x (1 + c (T − T₀)), of displacement x, um.

    T is the covariate ``temperature_degC`` and T₀ the middle of its range in the fitted records.
    """

    name: ClassVar = "temperature"
    side: ClassVar[Side] = "output"
    sees: ClassVar = "temperature_degC"
    advice: ClassVar = "keep the temperature constant"

    parameters: tuple[Declaration, ...] = (
        Declaration(
            "temperature_gain",
            "1/K",
            "c_T",
            "relative change of the displacement with the temperature",
            lambda _: normal(0.0, 0.01),
        ),
        Declaration(
            "temperature_reference",
            "degC",
            "T_0",
            "temperature at which the displacement is that of the other parameters",
            lambda context: context.ranges.middle_of("temperature_degC"),
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how much a kelvin changes, and from where."""
        percent, reference = 100 * values["temperature_gain"], values["temperature_reference"]
        return f"displacement that changes by {percent:+.2g}% per K from {reference:.3g} degC on"

    def numbers(self, column: Values, timing: Timing) -> FloatArray:  # noqa: ARG002  # no pace
        """Return c and T₀, (models, 2)."""
        return np.stack([column["temperature_gain"], column["temperature_reference"]], axis=1)

    @staticmethod
    def settle(parameters: Any, value: Any, after: Any) -> Any:  # noqa: ARG004  # no memory
        """Return y."""
        return value * (1.0 + parameters[0] * (parameters[2] - parameters[1]))

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        return value * (1.0 + parameters[0] * (parameters[2] - parameters[1]))

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x."""
        return value / (1.0 + parameters[0] * (parameters[2] - parameters[1]))
