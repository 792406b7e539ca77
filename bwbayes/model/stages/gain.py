"""A displacement that is larger at some times than at others, as a piezo's is when it is warm.

A piezo moves by some tenths of a percent more or less for every kelvin. Where no temperature is
recorded (:mod:`bwbayes.model.stages.covariates`), the gain drifts along a record, or rises as the
actuator heats itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration, Values, lognormal, normal
from bwbayes.model.stage import Side, Stage, Timing


class MovingGain(Stage):
    """Gain that drifts along a record: y = x (1 + g t), of displacement x, um."""

    name: ClassVar = "moving-gain"
    side: ClassVar[Side] = "output"
    sees: ClassVar = ("time",)
    advice: ClassVar = "measure at a constant temperature"

    parameters: tuple[Declaration, ...] = (
        Declaration(
            "gain_drift",
            "1/s",
            "g",
            "relative growth of the displacement along the record",
            lambda context: normal(0.0, 0.1 / context.ranges.duration),
            scope="event",
            at_rest=0.0,
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how much it is in a minute."""
        return f"gain that changes by {6000 * values['gain_drift']:+.2g}% a minute"

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        return value * (1.0 + parameters[0] * parameters[1])

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x."""
        return value / (1.0 + parameters[0] * parameters[1])


class Heating(Stage):
    """Gain that rises with the actuator's own heat: y = x (1 + c h), of displacement x, um.

    The heat follows the speed of the command u with a lag, τ h′ + h = |u′| / s; it is 1 where the
    command has long moved at s, the mean speed of a triangle over the whole range that turns as
    often as the fitted drive. The memory is h and u.
    """

    name: ClassVar = "heating"
    side: ClassVar[Side] = "output"
    sees: ClassVar = ("voltage",)
    remembers: ClassVar = 2
    starts: ClassVar = tuple({"heating_time": z} for z in (-1.0, 0.5))
    advice: ClassVar = "measure when it has warmed up, or drive more slowly"

    parameters: tuple[Declaration, ...] = (
        Declaration(
            "heating",
            "-",
            "c_h",
            "relative change of the displacement where the drive has heated the actuator",
            lambda _: normal(0.0, 0.05),
        ),
        Declaration(
            "heating_time",
            "s",
            r"\tau_h",
            "time constant of the heating",
            lambda context: lognormal(context.ranges.duration / 3, 1.0),
            floor=0.0,
        ),
        Declaration(
            "heating_speed",
            "V/s",
            "s_h",
            "speed of the voltage that heats by 1",
            lambda context: 2 * context.ranges.voltage / context.ranges.time,
            floor=0.0,
        ),
        Declaration(
            "heating_start",
            "-",
            "h_0",
            "heat at the start of the record",
            lambda _: lognormal(0.3, 1.0),
            floor=0.0,
            reaches_floor=True,
            scope="record",
            at_rest=0.0,
        ),
    )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how much it is, and how slow."""
        percent, time = 100 * values["heating"], values["heating_time"]
        return (
            f"displacement that changes by {percent:+.2g}% as the drive heats it, in {time:.2g} s"
        )

    def numbers(self, column: Values, timing: Timing) -> FloatArray:
        """Return c, what of h is left after a sample, and what a volt adds, (models, 3)."""
        z = timing.interval / column["heating_time"]
        gone = -np.expm1(-z)
        speed = column["heating_speed"] * timing.interval
        return np.stack([column["heating"], 1.0 - gone, gone / speed], axis=1)

    @staticmethod
    def settle(parameters: Any, value: Any, after: Any) -> Any:
        """Return x: at rest it is cold."""
        after[0], after[1] = 0.0, parameters[3]
        return value

    def begin(
        self,
        column: Values,
        numbers: FloatArray,
        first: FloatArray,  # noqa: ARG002  # whatever the displacement
        timing: Timing,  # noqa: ARG002
    ) -> FloatArray:
        """Return h before the record, and u."""
        return np.stack([column["heating_start"], numbers[:, -1]], axis=1)

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:
        """Return y."""
        moved = np.abs(parameters[3] - memory[1])
        heat = parameters[1] * memory[0] + parameters[2] * moved
        after[0], after[1] = heat, parameters[3]
        return value * (1.0 + parameters[0] * heat)

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:
        """Return x."""
        heat = parameters[1] * memory[0] + parameters[2] * np.abs(parameters[3] - memory[1])
        return value / (1.0 + parameters[0] * heat)
