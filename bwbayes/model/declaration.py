"""How a part of a model declares its parameters: once, with all that anybody asks of them.

A :class:`Declaration` is a parameter before anything is measured: what it is called, in which unit,
where it may lie, what is known of it beforehand. A part (a hysteresis operator, a filter, a noise)
lists its own; nobody else keeps names, units, bounds or default priors.

A default prior may know what a :class:`Context` holds: the ranges of a record, and what the config
states of other parameters. It is a :class:`Distribution` of scipy's, by the name engineers use:
``normal``, ``lognormal``, ``uniform``, ``halfnormal`` and ``beta`` take the arguments one would
write on paper; any other continuous distribution of ``scipy.stats`` goes by scipy's name, with
scipy's shape arguments and ``loc`` and ``scale``. scipy's frozen distributions check and broadcast
their arguments at every call, which costs more than the likelihood of a short record: those that
priors mostly are have closed forms here.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import scipy

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray
from bwbayes.errors import InputError
from bwbayes.shown import brief

FAMILIAR = {
    "normal": ("mean", "sd"),
    "lognormal": ("median", "sigma"),
    "uniform": ("lower", "upper"),
    "halfnormal": ("scale",),
    "beta": ("a", "b"),
}


@dataclass(frozen=True)
class Scored:
    """Normal, x = c + s z, or lognormal, x = c exp(s z), of a standard normal z."""

    center: float
    scale: float
    logarithmic: bool

    def score(self, x: FloatArray) -> FloatArray:
        """Return z of values x."""
        if not self.logarithmic:
            return (x - self.center) / self.scale
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(np.maximum(x, 0.0) / self.center) / self.scale)

    def value(self, score: FloatArray) -> FloatArray:
        """Return x of scores z."""
        if not self.logarithmic:
            return self.center + self.scale * score
        return np.asarray(self.center * np.exp(self.scale * score))


@dataclass(frozen=True)
class Tails:
    """Any distribution, by F, 1 − F and their inverses: z = Φ⁻¹(F(x)), exact in both tails."""

    cdf: Callable[[FloatArray], FloatArray]
    sf: Callable[[FloatArray], FloatArray]
    ppf: Callable[[FloatArray], FloatArray]
    isf: Callable[[FloatArray], FloatArray]

    def score(self, x: FloatArray) -> FloatArray:
        """Return z of values x."""
        below, above = self.cdf(x), self.sf(x)
        return np.where(below < above, scipy.special.ndtri(below), -scipy.special.ndtri(above))

    def value(self, score: FloatArray) -> FloatArray:
        """Return x of scores z."""
        ndtr = scipy.special.ndtr
        return np.where(score < 0, self.ppf(ndtr(score)), self.isf(ndtr(-score)))


def _mass(low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the probability between two normal scores, from the tail in which they lie."""
    ndtr = scipy.special.ndtr
    between = np.where(low < 0, ndtr(high) - ndtr(low), ndtr(-low) - ndtr(-high))
    return np.maximum(between, 0.0)


@dataclass(frozen=True)
class Distribution:
    """A continuous distribution: its name and its arguments.

    ``normal(mean, sd)``; ``lognormal(median, sigma)`` with sigma the sd of the logarithm;
    ``uniform(lower, upper)``; ``halfnormal(scale)``; ``beta(a, b)`` on 0 to 1 or, with ``lower``
    and ``upper``, between those; or a name and arguments of ``scipy.stats``.

    Raises
    ------
    InputError
        Unknown name, wrong arguments, or arguments outside the distribution's domain.

    Examples
    --------
    >>> print(Distribution("lognormal", {"median": 0.7, "sigma": 0.5}))
    lognormal(median = 0.7, sigma = 0.5)
    """

    name: str
    arguments: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key, value in self.arguments.items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise InputError(f"{self.name}: {key} is {value!r}; give a number")
            if not np.isfinite(value):
                raise InputError(f"{self.name}: {key} is {value}; give a finite number")
        if self.name in FAMILIAR:
            optional = ("lower", "upper") if self.name == "beta" else ()
            names = (*FAMILIAR[self.name], *optional)
            missing = [key for key in FAMILIAR[self.name] if key not in self.arguments]
            unknown = [key for key in self.arguments if key not in names]
            if missing or unknown:
                wrong = f"{missing[0]} is missing" if missing else f"{unknown[0]} is unknown"
                raise InputError(f"{self.name}: {wrong}; it takes {', '.join(names)}")
            lower, upper = self.arguments.get("lower", 0.0), self.arguments.get("upper", 1.0)
            if not lower < upper:
                raise InputError(
                    f"{self.name}: lower {lower:g} is not below upper {upper:g}; swap them"
                )
        with np.errstate(invalid="ignore"):
            low, high = self.form.value(np.array([-1.0, 1.0])).tolist()
        if not -math.inf < low < high < math.inf:
            raise InputError(f"{self}: no proper distribution; check its arguments")

    def __reduce__(self) -> tuple[Any, ...]:
        return Distribution, (self.name, self.arguments)  # without what is worked out from them

    def __str__(self) -> str:
        inside = ", ".join(f"{key} = {value:.6g}" for key, value in self.arguments.items())
        return f"{self.name}({inside})"

    def to_normal(self, x: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
        """Return the normal scores z of values x, with the distribution cut at both bounds.

        z = Φ⁻¹((F(x) − F(lower)) / (F(upper) − F(lower))), from whichever tail is nearer, so that
        it keeps its precision in both. All arrays are (models,) or scalar.
        """
        low, score, high = (self.form.score(values) for values in (lower, x, upper))
        below, above = _mass(low, score), _mass(score, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            near = np.minimum(below, above) / (below + above)
        score = scipy.special.ndtri(np.clip(near, 0, 1))
        return np.asarray(np.where(below <= above, 1, -1) * score)

    def from_normal(
        self, z: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return values x of normal scores z, and the probability between the bounds.

        The inverse of :meth:`to_normal`; where the bounds leave nothing, x is the lower one.
        """
        scalar = np.ndim(lower) == np.ndim(upper) == 0
        if scalar and self.support == (float(lower), float(upper)):  # the bounds cut nothing
            return self.form.value(z), np.ones_like(z)
        low, high = self.form.score(lower), self.form.score(upper)
        mass, ndtr = _mass(low, high), scipy.special.ndtr
        below, above = ndtr(low) + ndtr(z) * mass, ndtr(-high) + ndtr(-z) * mass
        # The smaller probability is the one that keeps its precision.
        score = scipy.special.ndtri(np.minimum(below, above))
        x = self.form.value(np.where(below < above, score, -score))
        return np.minimum(np.maximum(x, lower), np.maximum(lower, upper)), mass

    @cached_property
    def form(self) -> Scored | Tails:
        """The map to a standard normal, in closed form if there is one."""
        get = self.arguments.__getitem__
        match self.name:
            case "normal":
                return Scored(get("mean"), get("sd"), logarithmic=False)
            case "lognormal":
                return Scored(get("median"), get("sigma"), logarithmic=True)
            case "uniform":
                lower, upper = get("lower"), get("upper")
                width = upper - lower
                return Tails(
                    lambda x: np.clip((x - lower) / width, 0.0, 1.0),
                    lambda x: np.clip((upper - x) / width, 0.0, 1.0),
                    lambda p: lower + p * width,
                    lambda p: upper - p * width,
                )
            case "halfnormal":
                scale = math.sqrt(2) * get("scale")
                return Tails(
                    lambda x: scipy.special.erf(np.maximum(x, 0.0) / scale),
                    lambda x: scipy.special.erfc(np.maximum(x, 0.0) / scale),
                    lambda p: scale * scipy.special.erfinv(p),
                    lambda p: scale * scipy.special.erfcinv(p),
                )
        return Tails(self.frozen.cdf, self.frozen.sf, self.frozen.ppf, self.frozen.isf)

    @cached_property
    def support(self) -> tuple[float, float]:
        """The least and the largest value."""
        low, high = self.form.value(np.array([-np.inf, np.inf]))
        return float(low), float(high)

    @cached_property
    def frozen(self) -> Any:
        """The frozen distribution of scipy."""
        arguments = dict(self.arguments)
        lower, upper = arguments.get("lower", 0.0), arguments.get("upper", 1.0)
        match self.name:
            case "normal":
                return scipy.stats.norm(arguments["mean"], arguments["sd"])
            case "lognormal":
                return scipy.stats.lognorm(arguments["sigma"], scale=arguments["median"])
            case "uniform":
                return scipy.stats.uniform(lower, upper - lower)
            case "halfnormal":
                # The same as scipy's halfnorm, which loses its precision near zero.
                return scipy.stats.chi(1, scale=arguments["scale"])
            case "beta":
                return scipy.stats.beta(arguments["a"], arguments["b"], lower, upper - lower)
        family = getattr(scipy.stats, self.name, None)
        if not isinstance(family, scipy.stats.rv_continuous):
            scipys = vars(scipy.stats).items()
            names = [n for n, f in scipys if isinstance(f, scipy.stats.rv_continuous)] + [*FAMILIAR]
            near = difflib.get_close_matches(self.name, names, n=1)
            familiar = f"use one of {', '.join(FAMILIAR)}"
            hint = f"did you mean {near[0]}? Else {familiar}" if near else familiar
            raise InputError(f"{self.name}: unknown distribution; {hint}")
        try:
            return family(**arguments)
        except TypeError:
            takes = ", ".join(filter(None, [family.shapes, "loc", "scale"]))
            raise InputError(f"{self.name}: wrong arguments; scipy's takes {takes}") from None


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
    um; 0 where they show it. ``covariates`` are the least and the largest value of each, by name;
    :meth:`covariate` has those of one.
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

    def covariate(self, name: str) -> tuple[float, float]:
        """Return a covariate's least and largest value; 0 and 1 where none was recorded.

        A model that needs a covariate is not fitted without it, but shows its default priors.
        """
        return self.covariates.get(name, (0.0, 1.0))

    def middle_of(self, covariate: str) -> float:
        """Return the middle of a covariate's range."""
        return sum(self.covariate(covariate)) / 2

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
    summed_with
        Parameters in the same unit, of which a record determines the sum with this one far better
        than each. Its coordinate is that of the sum, if its prior is normal.
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
    left
        What an earlier drive leaves of a parameter of one record, (models,), in a record that was
        not fitted: of the other columns (models,), the width of the displacements, um, and how far
        through its course the drive is, 0 to 1 (models,). By default quantiles of the prior.
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
    summed_with: tuple[str, ...] = ()
    pressed: Mapping[str, str] = field(default_factory=dict)
    scope: Scope = "actuator"
    loop: bool = False
    aliases: tuple[str, ...] = ()
    at_rest: float | None = None
    left: Callable[[Values, float, FloatArray], FloatArray] | None = None
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


def each_model(column: Values) -> Iterator[dict[str, FloatArray]]:
    """Yield the columns of one model after the other, (1,) each."""
    for row in range(next(iter(column.values())).size):
        yield {name: values[row : row + 1] for name, values in column.items()}
