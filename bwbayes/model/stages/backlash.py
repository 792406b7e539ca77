"""Backlash in the mount: the sensor follows the actuator only once a gap is used up.

A loose screw or a worn joint lets the actuator move by twice the play before it takes along what
the sensor looks at. That opens any loop by the same amount, minor loops most of all.

Plays in series are friction in the actuator's guide, which holds some of the displacement back.
Where a backlash is one gap, a guide or a glued joint slips bit by bit: each bit follows only once
the displacement has gone far enough. Loops open, all the more the longer they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import FloatArray, select
from bwbayes.model.declaration import Declaration, Distribution, Values, lognormal
from bwbayes.model.stage import Side, Stage, Timing


def _after_a_swing(column: Values, extent: float, part: FloatArray) -> FloatArray:
    """Return where in its play a swing as wide as an extent, um, leaves y, at a part of its period.

    On its way up from the lowest point y is at the play's upper end at first, then at the lower.
    """
    way = extent * (1 - np.cos(2 * np.pi * part)) / 2
    up = np.maximum(1 - way / column["backlash"], -1.0)
    return np.where(part < 0.5, up, -up)


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
            left=_after_a_swing,
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


# Radii are spread evenly to one and a half of the range's half: what no loop of the record moves
# matters to its first rise, and to a wider drive.
PLAYS, BEYOND = 30, 1.5
PARTS = BEYOND * (np.arange(PLAYS) + 0.5) / PLAYS


class SeriesPlays(Stage):
    """Plays in series: y = x − Σ w_j (x − z_j), z_j the play of radius r_j of displacement x, um.

    z_j = min(max(z_j₋, x − r_j), x + r_j) at 30 radii up to 1.5 Y, Y half of the range of the
    displacement that was fitted. The weights are those of a gamma distribution of radii, w_j ∝
    r_j^(k−1) exp(−k r_j/r₀), and their sum is s: k = 1 is a spectrum that falls from the smallest
    radius on, a large k one gap. The memory are all z_j, and x.
    """

    name: ClassVar = "series-plays"
    side: ClassVar[Side] = "output"
    rate_independent: ClassVar = True
    remembers: ClassVar = PLAYS + 1
    starts: ClassVar = tuple({"series_radius": z} for z in (-1.0, 0.5))
    # Beside a hysteresis that may open the same loops, it takes minutes to sample.
    named_only: ClassVar = True
    advice: ClassVar = "look for friction between the actuator and what the sensor looks at"

    parameters: tuple[Declaration, ...] = (
        Declaration(
            "series_loss",
            "-",
            "s",
            "part of the displacement that plays in series hold back, below 1",
            lambda _: Distribution("beta", {"a": 1.0, "b": 9.0, "lower": 0.0, "upper": 1.0}),
            floor=0.0,
            bounds=lambda _: (0.0, 1.0),
            stated_bounds="0 <= series_loss <= 1",
            loop=True,
        ),
        Declaration(
            "series_radius",
            "um",
            "r_0",
            "mean radius of the plays in series",
            lambda context: lognormal(0.3 * context.ranges.displacement, 1.0),
            floor=0.0,
            loop=True,
        ),
        Declaration(
            "series_shape",
            "-",
            "k",
            "shape of the spectrum of the plays in series, 1 if it is exponential",
            lambda _: lognormal(1.0, 0.5),
            floor=0.0,
            loop=True,
        ),
        Declaration(
            "series_half",
            "um",
            "Y_s",
            "half of the range over which the plays in series are spread",
            lambda context: context.ranges.displacement,
            floor=0.0,
        ),
        Declaration(
            "series_start",
            "-",
            "s_0",
            "where in their plays those in series start a record, from -1 to 1",
            # As a swing is found: most often near one of its ends.
            lambda _: Distribution("beta", {"a": 0.5, "b": 0.5, "lower": -1.0, "upper": 1.0}),
            bounds=lambda _: (-1.0, 1.0),
            stated_bounds="-1 <= series_start <= 1",
            scope="record",
            at_rest=0.0,
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how much they hold back, and over which way."""
        percent, radius = 100 * values["series_loss"], values["series_radius"]
        return f"friction that holds {percent:.2g}% of the displacement back, over {radius:.2g} um"

    def numbers(self, column: Values, timing: Timing) -> FloatArray:  # noqa: ARG002  # no pace
        """Return all weights, and all radii, (models, 60), um."""
        loss, mean, shape, half = (
            column[f"series_{name}"][:, np.newaxis] for name in ("loss", "radius", "shape", "half")
        )
        radii = half * PARTS
        logs = (shape - 1) * np.log(radii) - shape * radii / mean
        weights = np.exp(logs - logs.max(axis=1, keepdims=True))
        return np.hstack([loss * weights / weights.sum(axis=1, keepdims=True), radii])

    @staticmethod
    def settle(parameters: Any, value: Any, after: Any) -> Any:  # noqa: ARG004  # any plays
        """Return x, in the middle of all plays."""
        for j in range(len(after)):
            after[j] = value
        return value

    def begin(
        self,
        column: Values,
        numbers: FloatArray,
        first: FloatArray,
        timing: Timing,  # noqa: ARG002  # no pace
    ) -> FloatArray:
        """Return z_j = x + s₀ r_j, and x."""
        start = np.clip(column["series_start"], -1.0, 1.0)[:, np.newaxis]
        return np.column_stack([first[:, np.newaxis] + start * numbers[:, PLAYS:], first])

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:
        """Return y."""
        plays, y = len(memory) - 1, 1.0 * value
        for j in range(plays):
            low, high = value - parameters[plays + j], value + parameters[plays + j]
            play = np.minimum(np.maximum(memory[j], low), high)
            after[j] = play
            y = y - parameters[j] * (value - play)
        after[len(memory) - 1] = value
        return y

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:
        """Return x, by Newton's rule: up and down from where it was, y(x) bends one way.

        Each step but the first finds at least one more play at its end, or x.
        """
        plays = len(memory) - 1
        x = 1.0 * memory[len(memory) - 1]
        for _ in range(plays + 2):
            y, slope = 1.0 * x, 1.0 + 0.0 * x
            for j in range(plays):
                low, high = x - parameters[plays + j], x + parameters[plays + j]
                play = np.minimum(np.maximum(memory[j], low), high)
                y = y - parameters[j] * (x - play)
                slope = slope - select(play == memory[j], parameters[j], 0.0)
            x = x + (value - y) / slope
        return x
