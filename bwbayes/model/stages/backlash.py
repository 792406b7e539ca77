"""Backlash in the mount: the sensor follows the actuator only once a gap is used up.

A loose screw or a worn joint lets the actuator move by twice the play before it takes along what
the sensor looks at. That opens any loop by the same amount, minor loops most of all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import FloatArray, select
from bwbayes.model.declaration import Declaration, Distribution, Values, lognormal
from bwbayes.model.stage import Side, Stage, Timing


class Backlash(Stage):
    """Backlash: y stays where it is until x is farther than b from it, |x − y| ≤ b.

    With x the displacement before the mount and y behind it, um, the play operator:
    y = min(max(y₋, x − b), x + b). The memory is y and x, um.
    """

    name: ClassVar = "backlash"
    side: ClassVar[Side] = "output"
    rate_independent: ClassVar = True
    remembers: ClassVar = 2
    starts: ClassVar = ({"backlash": 0.0}, {"backlash": 1.5})
    advice: ClassVar = "tighten the mount, or preload it"

    parameters: tuple[Declaration, ...] = (
        Declaration(
            "backlash",
            "um",
            r"b",
            "play of the mount, to either side",
            lambda context: lognormal(0.02 * context.ranges.displacement, 1.0),
            floor=0.0,
            loop=True,
        ),
        Declaration(
            "backlash_start",
            "-",
            r"s_b",
            "where in its play a record starts, from -1 to 1",
            # As a swing is found: most often near one of its ends.
            lambda _: Distribution("beta", {"a": 0.5, "b": 0.5, "lower": -1.0, "upper": 1.0}),
            bounds=lambda _: (-1.0, 1.0),
            stated_bounds="-1 <= backlash_start <= 1",
            scope="record",
            at_rest=0.0,
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how much it is from end to end."""
        return f"backlash of {2 * values['backlash']:.2g} um in the mount"

    def numbers(self, column: Values, timing: Timing) -> FloatArray:  # noqa: ARG002  # no pace
        """Return b, (models, 1), um."""
        return column["backlash"][:, np.newaxis].copy()

    @staticmethod
    def settle(parameters: Any, value: Any, after: Any) -> Any:  # noqa: ARG004  # any play
        """Return x, in the middle of the play."""
        after[0], after[1] = value, value
        return value

    def begin(
        self,
        column: Values,
        numbers: FloatArray,
        first: FloatArray,
        timing: Timing,  # noqa: ARG002  # no pace
    ) -> FloatArray:
        """Return y = x + s b, and x."""
        y = first + np.clip(column["backlash_start"], -1.0, 1.0) * numbers[:, 0]
        return np.stack([y, first], axis=1)

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:
        """Return y."""
        low, high = value - parameters[0], value + parameters[0]
        y = np.minimum(np.maximum(memory[0], low), high)
        after[0], after[1] = y, value
        return y

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:
        """Return x: at the end of the play where y moves, and where it was if y stays."""
        moved = select(value > memory[0], value + parameters[0], value - parameters[0])
        # Rounding does not turn it.
        stays = np.abs(value - memory[0]) <= 1e-9 * parameters[0]
        return select(stays, memory[1], moved)
