"""A displacement that is larger at some times than at others, as a piezo's is when it is warm.

A piezo moves by some tenths of a percent more or less for every kelvin, its loop is wider or
narrower, and its mount expands; a load does the same. Where the temperature or the load is a
further column of the record, a covariate, the gain, the loop's width and the offset follow it by a
straight line: each is a stage with one coefficient, which evidence may choose alone. Where no
temperature is recorded, the gain drifts along a record, or rises as the actuator heats itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import (
    Context,
    Declaration,
    Distribution,
    Ranges,
    Values,
    lognormal,
    normal,
)
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


class Covariate(NamedTuple):
    """A covariate that stages follow.

    ``column`` is its name in a record, ``name`` what it is, ``unit`` that of a value, ``per`` that
    of a difference. ``relative`` is the prior sd of the change that a unit makes, in parts; a
    column that says nothing has zero.
    """

    column: str
    name: str
    unit: str
    per: str
    symbol: str
    relative: Callable[[Ranges], float]


def _load_per_newton(ranges: Ranges) -> float:
    """Let half of the load's range change a tenth."""
    low, high = ranges.covariate("load_N")
    return 0.2 / (high - low) if high > low else 0.0


TEMPERATURE = Covariate("temperature_degC", "temperature", "degC", "K", "T", lambda _: 0.01)
LOAD = Covariate("load_N", "load", "N", "N", "F", _load_per_newton)


class _Follows(Stage):
    """Stage that follows a covariate, ``of``: a coefficient, from a value that all of them share.

    The coefficient's unit is that of ``change``, 1 or um, by that of the covariate.
    """

    side: ClassVar[Side] = "output"
    advice: ClassVar = "keep temperature and load constant"
    of: ClassVar[Covariate]
    effect: ClassVar[str]
    symbol: ClassVar[str]
    change: ClassVar[str] = "1"
    changes: ClassVar[str]
    described: ClassVar[str]
    parameters: tuple[Declaration, ...] = ()

    def __init_subclass__(cls, of: Covariate | None = None) -> None:
        """Declare coefficient and reference of a stage ``of`` a covariate."""
        super().__init_subclass__()
        if of is None:
            return

        def coefficient(context: Context) -> Distribution | float:
            size = context.ranges.displacement if cls.change == "um" else 1.0
            sd = size * of.relative(context.ranges)
            return normal(0.0, sd) if sd else 0.0

        cls.of = of
        cls.name = of.name if cls.effect == "gain" else f"{of.name}-{cls.effect}"
        cls.sees = (*cls.sees, of.column)
        cls.parameters = (
            Declaration(
                f"{of.name}_{cls.effect}",
                f"{cls.change}/{of.per}",
                f"{cls.symbol}_{of.symbol}",
                f"{cls.described} with the {of.name}",
                coefficient,
            ),
            Declaration(
                f"{of.name}_reference",
                of.unit,
                f"{of.symbol}_0",
                f"{of.name} at which the displacement is that of the other parameters",
                lambda context: context.ranges.middle_of(of.column),
            ),
        )

    def describe(self, values: Mapping[str, float]) -> str:
        """Say how much a unit changes, and from where."""
        change, reference = (values[declared.name] for declared in self.parameters)
        size = f"{100 * change:+.2g}%" if self.change == "1" else f"{change:+.2g} um"
        start = f"{reference:.3g} {self.of.unit}"
        return f"{self.changes} by {size} per {self.of.per} from {start} on"


class _Gain(_Follows):
    effect, symbol = "gain", "c"
    changes = "displacement that changes"
    described = "relative change of the displacement"

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        return value * (1.0 + parameters[0] * (parameters[2] - parameters[1]))

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x."""
        return value / (1.0 + parameters[0] * (parameters[2] - parameters[1]))


class _Width(_Follows):
    effect, symbol = "width", "w"
    changes = "loop whose width changes"
    described = "relative change of the loop's width, beside the displacement's,"
    sees = ("voltage",)

    def numbers(self, column: Values, timing: Timing) -> FloatArray:
        """Return coefficient, reference and d, (models, 3)."""
        numbers = super().numbers(column, timing)
        return np.column_stack([numbers, column.get("d", np.zeros(len(numbers)))])

    def settled(self, numbers: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return y at rest, which is at zero volts, and no memory."""
        at_zero = numbers.copy()
        at_zero[:, -2] = 0.0
        return super().settled(at_zero, value)

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        straight = parameters[2] * parameters[3]
        wider = 1.0 + parameters[0] * (parameters[4] - parameters[1])
        return straight + (value - straight) * wider

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x."""
        straight = parameters[2] * parameters[3]
        wider = 1.0 + parameters[0] * (parameters[4] - parameters[1])
        return straight + (value - straight) / wider


class _Offset(_Follows):
    effect, symbol, change = "offset", "o", "um"
    changes = "offset that changes"
    described = "change of the offset"

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        return value + parameters[0] * (parameters[2] - parameters[1])

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x."""
        return value - parameters[0] * (parameters[2] - parameters[1])


class Temperature(_Gain, of=TEMPERATURE):
    """Gain that follows the temperature: y = x (1 + c (T − T₀)), of displacement x, um.

    T is the covariate ``temperature_degC`` and T₀ the middle of its range in the fitted records.
    """


class TemperatureWidth(_Width, of=TEMPERATURE):
    """Loop width that follows the temperature: y = d u + (x − d u) (1 + w (T − T₀)), um.

    With u the voltage and d the operator's slope without hysteresis: all that departs from there
    changes, dynamics and creep included. The loop of an operator without d is all of x.
    """


class TemperatureOffset(_Offset, of=TEMPERATURE):
    """Offset that follows the temperature, as a mount expands: y = x + o (T − T₀), um."""


class Load(_Gain, of=LOAD):
    """Gain that follows the load: y = x (1 + c (F − F₀)), of displacement x, um.

    F is the covariate ``load_N`` and F₀ the middle of its range in the fitted records.
    """


class LoadWidth(_Width, of=LOAD):
    """Loop width that follows the load: y = d u + (x − d u) (1 + w (F − F₀)), um.

    u and d are those of ``temperature-width``.
    """


class LoadOffset(_Offset, of=LOAD):
    """Offset that follows the load, as a spring gives way: y = x + o (F − F₀), um."""
