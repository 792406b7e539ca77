"""How a part of a model declares its parameters: once, with all that anybody asks of them.

A :class:`Declaration` is a parameter before anything is measured: what it is called, in which unit,
where it may lie, what is known of it beforehand. A part (a hysteresis operator, a filter, a noise)
lists its own; nobody else keeps names, units, bounds or default priors.

A default prior may know what a :class:`Context` holds: the ranges of a record, and what the config
states of other parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.distributions import Distribution
from bwbayes.shown import brief

Values = Mapping[str, FloatArray]
"""Columns (models,) of parameters by name."""

Scope = Literal["actuator", "record", "event"]


@dataclass(frozen=True)
class Ranges:
    """All that a default prior may know of a record.

    ``voltage`` is U, half the range of the voltage, V; ``displacement`` is Y, um; ``middle`` the
    middle of the displacement's range, um; ``time`` is T, the typical time between turning points
    of the drive, s; ``bias`` the middle of the voltage's range, V; ``interval`` between samples and
    ``duration`` of the record, s; ``begin`` the time of its first reading, s. ``rounding`` is the
    sd of the rounding of readings that show no other noise, um; 0 where they show some.
    ``resolution`` is the least sd of a sensor whose readings jump too often to show their noise,
    um; 0 where they show it. ``covariates`` are the least and the largest value of each, by name.
    """

    voltage: float
    displacement: float
    middle: float
    time: float
    bias: float = 0.0
    interval: float = 0.0
    duration: float = 0.0
    rounding: float = 0.0
    resolution: float = 0.0
    begin: float = 0.0
    covariates: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def middle_of(self, covariate: str) -> float:
        """Return the middle of a covariate's range.

        Raises
        ------
        InputError
            The records have no such covariate.
        """
        if covariate not in self.covariates:
            raise InputError(
                f"{covariate}: the model needs it at every sample, and a record comes without; "
                "name its column in covariates"
            )
        return sum(self.covariates[covariate]) / 2

    @property
    def slope(self) -> float:
        """Y/U, um/V."""
        return self.displacement / self.voltage

    @property
    def farthest(self) -> float:
        """The largest distance of the voltage from zero, V."""
        return self.voltage + abs(self.bias)

    @property
    def reach(self) -> float:
        """The most that the voltage's distance from zero adds to offset and hysteresis, um."""
        return self.displacement + self.slope * abs(self.bias)


@dataclass(frozen=True)
class Context:
    """The input of default priors: ranges, and ``stated`` priors and values by parameter."""

    ranges: Ranges
    stated: Mapping[str, float | Distribution] = field(default_factory=dict)

    def value(self, name: str) -> float | None:
        """Return the value at which a parameter is fixed, or None."""
        stated = self.stated.get(name)
        return None if isinstance(stated, Distribution) else stated


@dataclass(frozen=True)
class Declaration:
    """A parameter as its part declares it.

    Parameters
    ----------
    name, unit, label, description
        Text for people; ``label`` is LaTeX without the dollar signs.
    default
        Its default prior, or the value at which it is fixed unless a config frees it; None if it
        has no default.
    floor
        No parameter may be lower; it lies above unless ``reaches_floor``. A positive parameter has
        a floor of zero.
    limit_at_floor
        Whether a model may be simulated on the floor, a limit that no posterior reaches.
    bounds
        Lower and upper bound (models,) given other parameters: those that come before it, and those
        that are fixed. There are none (:meth:`limits`) where one that it asks for is not known yet.
    stated_bounds
        The bounds in words, for messages: ``|gamma| <= beta``.
    pressed
        Advice where the posterior presses against the lower or upper of these bounds, or of
        the default prior's where there are none.
    scope
        Whether it belongs to the actuator, to one record alone (its start, its offset), or to an
        event in one record, which no other has.
    loop
        Whether it shapes the loop.
    aliases
        Other names that people give it.
    at_rest
        Value of a parameter of one record where that starts from rest, and one of an event where
        that has not happened; None if this says nothing.
    unit_given
        The unit, where it depends on what is stated of other parameters.
    without_default
        Why there is no default prior, for messages.
    """

    __repr__ = brief

    name: str
    unit: str
    label: str
    description: str
    default: Callable[[Context], Distribution | float | None]
    floor: float = -math.inf
    reaches_floor: bool = False
    limit_at_floor: bool = False
    bounds: Callable[[Values], tuple[ArrayLike, ArrayLike]] | None = None
    stated_bounds: str = ""
    pressed: Mapping[str, str] = field(default_factory=dict)
    scope: Scope = "actuator"
    loop: bool = False
    aliases: tuple[str, ...] = ()
    at_rest: float | None = None
    unit_given: Callable[[Mapping[str, float | Distribution]], str] | None = None
    without_default: str = ""

    @property
    def positive(self) -> bool:
        """Whether it lies above zero."""
        return self.floor == 0 and not self.reaches_floor

    def limits(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return its bounds (models,) given values of other parameters; infinite without any.

        By the names that the parts declare, whatever the record.
        """
        if self.bounds is not None:
            try:
                low, high = self.bounds(values)
            except KeyError:  # one is free and comes later
                pass
            else:
                return np.asarray(low), np.asarray(high)
        return np.asarray(-np.inf), np.asarray(np.inf)

    def unit_in(self, stated: Mapping[str, float | Distribution]) -> str:
        """Return its unit, given what is stated of other parameters by name."""
        return self.unit if self.unit_given is None else self.unit_given(stated)


def positive(
    name: str,
    unit: str,
    label: str,
    description: str,
    median: Callable[[Ranges], float],
    sigma: float = 1.0,
    **others: Any,
) -> Declaration:
    """Declare a parameter of the loop above zero, with a lognormal default prior."""

    def default(context: Context) -> Distribution:
        return lognormal(median(context.ranges), sigma)

    declared = Declaration(name, unit, label, description, default, floor=0.0, loop=True)
    return replace(declared, **others)


def check(declared: Iterable[Declaration], column: Values) -> None:
    """Raise an InputError where a column (models,) is not finite or below its floor."""
    for parameter in declared:
        values, floor = column[parameter.name], parameter.floor
        refuse(parameter.name, ~np.isfinite(values), values, "must be finite")
        if parameter.reaches_floor or parameter.limit_at_floor:
            requirement = "must not be negative" if floor == 0 else f"must be at least {floor:g}"
            refuse(parameter.name, values < floor, values, requirement)
        else:
            requirement = "must be positive" if floor == 0 else f"must be above {floor:g}"
            refuse(parameter.name, values <= floor, values, requirement)


def refuse(name: str, wrong: BoolArray, values: FloatArray, demand: str) -> None:
    """Raise an InputError that names the first model (models,) whose parameter is ``wrong``."""
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(f"{name}: {values[row]:.6g} in model {row}; {demand}")


def lognormal(median: float, sigma: float) -> Distribution:
    """Return a lognormal prior with rounded arguments."""
    return Distribution(
        "lognormal", {"median": round_to_scale(median), "sigma": round_to_scale(sigma)}
    )


def normal(mean: float, sd: float) -> Distribution:
    """Return a normal prior with rounded arguments; the mean need not be more exact than the sd."""
    return Distribution("normal", {"mean": round_to_scale(mean, sd), "sd": round_to_scale(sd)})


def round_to_scale(value: float, scale: float | None = None) -> float:
    """Keep three digits of the value, or of another ``scale`` that it need not be more exact than.

    A default prior is not more exact than that, and people read it.
    """
    size = abs(value if scale is None else scale)
    if not size > 0:
        return value
    return round(value, 2 - math.floor(math.log10(size)))
