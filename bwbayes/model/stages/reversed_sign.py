"""A sensor that counts the other way round."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration, Values
from bwbayes.model.stage import Side, Stage, Timing


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
