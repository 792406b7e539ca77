"""Parameters: what they are called, what is known of them, and where they may lie.

Each parameter is either fixed or has a prior. The priors are independent except for the physical
constraints that the model's parts declare, which cut the joint prior: for Bouc-Wen 0 < α < d,
|γ| ≤ β, an initial state inside the hysteresis ceiling. :class:`JointPrior` draws from the cut
prior and gives its log density, up to the one constant that the cut leaves. It also maps parameters
to coordinates without bounds and back: the normal scores of each prior between the bounds that hold
there. In them every prior is nearly a standard normal, whatever its scale and bounds, and so a
posterior has Gaussian tails even where it leans on a bound (γ near β, a discrepancy near zero).
Where a record determines only the sum of parameters, as of a delay and a lag, the sum takes the
place of one of them: lags are logarithms there, and the posterior would be thin and curved.

A table gives θ's columns one order, and names to ask for them. The actuator's parameters come
first, then the noise's, each in the order in which their parts declare them. Several records of one
actuator share the actuator's parameters. Each record has its own initial state and offset, side by
side, named after it: ``offset[step_10]``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.state_space import Noise
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Declaration, Distribution, Scope, Scored, Values
from bwbayes.shown import brief

# The version of the map from parameters to coordinates: a chain of another one means other draws.
COORDINATES = 1

Constraint = Callable[[Values], BoolArray | np.bool_]
"""Tells which models (models,) meet what the bounds of single parameters do not say."""

# Normal scores beyond this have no probability that a float can hold.
FARTHEST = 37.0


@dataclass(frozen=True)
class Parameter:
    """One parameter: names for people, and a prior or a fixed value.

    ``lower`` and ``upper`` cut the prior; the bounds that its part has ``declared`` hold besides.
    ``unit`` and ``label`` (LaTeX, without the dollar signs) go to tables and pictures. ``record``
    is the one of several records that the parameter belongs to, empty if to all.

    Raises
    ------
    InputError
        Neither prior nor fixed value, both, or bounds that leave nothing of the prior.
    """

    __repr__ = brief

    name: str
    unit: str
    label: str
    description: str
    declared: Declaration = field(compare=False, repr=False)
    prior: Distribution | None = None
    fixed: float | None = None
    lower: float = -np.inf
    upper: float = np.inf
    record: str = ""

    @classmethod
    def of(cls, declared: Declaration, value: Distribution | float) -> Parameter:
        """Return a declared parameter with a prior or a fixed value."""
        names = declared.name, declared.unit, declared.label, declared.description
        if isinstance(value, Distribution):
            return cls(*names, declared, prior=value)
        return cls(*names, declared, fixed=value)

    def __post_init__(self) -> None:
        if (self.prior is None) == (self.fixed is None):
            raise InputError(f"{self.name}: give either a prior or a fixed value")
        if self.fixed is not None:
            self._check_fixed(self.fixed)
        elif not self.mass_between[0] < self.mass_between[1]:
            raise InputError(f"{self.name}: the bounds leave nothing of its prior; widen them")

    def _check_fixed(self, value: float) -> None:
        if not np.isfinite(value) or not self.lower <= value <= self.upper:
            raise InputError(f"{self.name}: fixed at {value}; give a finite value in its bounds")
        if not self.above_floor(np.array(value)):
            relation = "above" if self.positive else "at least"
            raise InputError(f"{self.name}: fixed at {value:g}; must be {relation} {self.floor:g}")

    @property
    def plain(self) -> str:
        """Its name without that of its record."""
        return self.declared.name

    @property
    def floor(self) -> float:
        """The lowest value of the parameter."""
        return self.declared.floor

    @property
    def positive(self) -> bool:
        """Whether it lies above zero."""
        return self.declared.positive

    @property
    def distribution(self) -> Distribution:
        """The prior of a parameter that is free."""
        assert self.prior is not None
        return self.prior

    def above_floor(self, x: FloatArray) -> BoolArray:
        """Tell which values are not too low. Some parameters reach their floor."""
        return np.asarray(x >= self.floor if self.declared.reaches_floor else x > self.floor)

    @cached_property
    def support(self) -> tuple[float, float]:
        """Where prior, bounds and sign allow the parameter."""
        low, high = self.distribution.support
        return max(low, self.lower, self.floor), min(high, self.upper)

    @property
    def formula(self) -> Scored | None:
        """The formula that maps normal scores to values, if there is one and nothing cuts it."""
        form, uncut = self.distribution.form, self.support == self.distribution.support
        free = self.declared.bounds is None
        return form if isinstance(form, Scored) and uncut and free else None

    @cached_property
    def mass_between(self) -> tuple[float, float]:
        """The prior's cumulative probability at both ends of the support."""
        ends = scipy.special.ndtr(self.distribution.form.score(np.array(self.support)))
        return float(ends[0]), float(ends[1])

    def draw(self, generator: np.random.Generator, size: int) -> FloatArray:
        """Draw from its own prior between its bounds, whatever others are, (size,)."""
        return self.at(generator.uniform(size=size))

    def at(self, probability: FloatArray) -> FloatArray:
        """Return quantiles (any,) of its own prior between its bounds."""
        low, high = self.mass_between
        value = self.distribution.frozen.ppf(low + (high - low) * probability)
        return np.asarray(value, dtype=np.float64)


class JointPrior:
    """The joint prior of the parameters, cut by the physical constraints.

    Parameters
    ----------
    parameters
        All parameters of the model and the noise, in the order of θ's columns. Bounds depend on
        those that come before and on fixed ones.
    constraint
        Further constraint, on each of several records.
    """

    def __init__(
        self, parameters: Iterable[Parameter], constraint: Constraint | None = None
    ) -> None:
        self.parameters = tuple(parameters)
        self.constraint = constraint
        self.names = tuple(p.name for p in self.parameters)
        self.free = tuple(p for p in self.parameters if p.fixed is None)
        self.free_names = tuple(p.name for p in self.free)
        self._fixed = {p.name: p.fixed for p in self.parameters if p.fixed is not None}
        self.records = tuple(dict.fromkeys(p.record for p in self.parameters if p.record))
        self._own = {
            record: [(p.plain, p.name) for p in self.parameters if p.record == record]
            for record in self.records
        }
        # Parameters that the bounds of each parameter may know.
        self._known = {
            p.name: (*self._fixed, *self.free_names[: self.free.index(p)]) for p in self.free
        }
        self._free_rows = [self.names.index(name) for name in self.free_names]
        self._template = np.array([np.nan if p.fixed is None else p.fixed for p in self.parameters])
        # A formula maps most of the free parameters, and nothing cuts them, so that it is done at
        # once: their rows; and, as columns, whether x = c exp(s z) instead of c + s z, c, and s.
        forms = {row: p.formula for row, p in enumerate(self.free)}
        table = np.array(
            [(k, f.logarithmic, f.center, f.scale) for k, f in forms.items() if f is not None]
        ).reshape(-1, 4)
        rows, logarithmic, center, scale = table.T[:, :, np.newaxis]
        self._formulas = rows[:, 0].astype(np.int64), logarithmic > 0, center, scale
        self._cut = [(row, self.free[row]) for row, f in forms.items() if f is None]
        # Parameters whose coordinates are those of a sum, and the rows of the others in it.
        self._sums = []
        for row, form in forms.items():
            parameter = self.free[row]
            others = [
                other
                for other, p in enumerate(self.free)
                if p.plain in parameter.declared.summed_with and p.record in ("", parameter.record)
            ]
            if others and form is not None and not form.logarithmic:
                self._sums.append((row, form, others))
        # Values that free parameters must exceed, or reach: two columns.
        floors = np.array([p.floor for p in self.free])[:, np.newaxis]
        reaches = [p.declared.reaches_floor for p in self.free]
        reached = np.array(reaches, dtype=np.bool_)[:, np.newaxis]
        self._above = np.where(reached, -np.inf, floors)
        self._at_least = np.where(reached, floors, -np.inf)
        self._check_fixed()

    def _check_fixed(self) -> None:
        """Refuse values that are fixed where others leave them no room."""
        fixed = {name: np.array([value]) for name, value in self._fixed.items()}
        for parameter in self.parameters:
            if parameter.fixed is None:
                continue
            others = {name: value for name, value in fixed.items() if name != parameter.name}
            low, high = self._between(parameter, others)
            stated = parameter.declared.stated_bounds
            if stated and not (low <= parameter.fixed) & (parameter.fixed <= high):
                raise InputError(
                    f"{parameter.name}: fixed at {parameter.fixed:g}; must hold: {stated}"
                )
        if not np.all(self._possible(fixed)):
            raise InputError(f"priors: fixed values must have {self._constraint_text()}")

    def _constraint_text(self) -> str:
        """Return the physical constraints in words."""
        stated = (p.declared.stated_bounds for p in self.parameters)
        return " and ".join(filter(None, stated))

    @property
    def dimensions(self) -> int:
        """The number of free parameters."""
        return len(self.free)

    def theta(self, free: FloatArray) -> FloatArray:
        """Put free parameters (models, free) and fixed ones together: (models, parameters)."""
        theta = np.repeat(self._template[:, np.newaxis], len(free), axis=1)
        theta[self._free_rows] = free.T
        return theta.T

    def log_density(self, free: FloatArray) -> FloatArray:
        """Log density (models,) of free parameters (models, free), up to a constant."""
        values = self._values(free)
        result = np.zeros(free.shape[0])
        inside = np.ones(free.shape[0], dtype=bool)
        for parameter in self.free:
            result += parameter.distribution.frozen.logpdf(values[parameter.name])
            x, (low, high) = values[parameter.name], self._limits(parameter, values)
            inside &= (low <= x) & (x <= high) & parameter.above_floor(x)
        inside &= self._possible(values)
        return np.where(inside, result, -np.inf)

    def draw(self, generator: np.random.Generator, size: int) -> FloatArray:
        """Draw ``size`` vectors of free parameters, (size, free), from the cut prior.

        Raises
        ------
        InputError
            Fewer than one in ten thousand draws of the single priors meets the constraints.
        """
        accepted = np.empty((0, self.dimensions))
        tried = 0
        while accepted.shape[0] < size:
            batch = np.stack([p.draw(generator, size) for p in self.free], axis=1)
            accepted = np.concatenate([accepted, batch[np.isfinite(self.log_density(batch))]])
            tried += size
            if accepted.shape[0] < 1e-4 * tried - 10:
                raise InputError(f"priors: hardly any draw has {self._constraint_text()}")
        return accepted[:size]

    def unconstrain(self, free: FloatArray) -> FloatArray:
        """Map free parameters (models, free), inside their bounds, to coordinates."""
        values, summed = self._values(free), free.T.copy()
        for row, _, others in self._sums:
            summed[row] += summed[others].sum(axis=0)
        scores = []
        for parameter, x in zip(self.free, summed, strict=True):
            bounds = self._limits(parameter, values)
            scores.append(parameter.distribution.to_normal(x, *bounds))
        return np.clip(np.stack(scores, axis=1), -FARTHEST, FARTHEST)

    def constrain(self, coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates (models, free) to free parameters and their log prior density (models,).

        A parameter with prior distribution function F between bounds l and u, which depend on
        earlier parameters alone, is x = F⁻¹(F(l) + Φ(z) (F(u) − F(l))). The Jacobian is triangular
        and turns the joint prior into

            log p(z) = Σ log φ(z) + Σ log(F(u) − F(l)) + constant,

        −∞ where earlier parameters leave no room, or z is beyond anything that can be told apart.
        Where the coordinate is that of a sum, the others are taken from x, and φ is that of x.
        """
        # A parameter is a row here, so that what is done with one is done with neighbors.
        unclipped = np.ascontiguousarray(coordinates.T)
        safe = np.clip(unclipped, -FARTHEST, FARTHEST)
        free, possible = np.empty_like(safe), np.equal(safe, unclipped).all(axis=0)
        rows, logarithmic, center, scale = self._formulas
        scaled = scale * safe[rows]
        grown = center * np.exp(np.where(logarithmic, scaled, 0.0))
        free[rows] = np.where(logarithmic, grown, center + scaled)
        values = self._values(free.T)  # as they are found
        room = np.ones(coordinates.shape[0])
        for row, parameter in self._cut:
            bounds = self._limits(parameter, values)
            free[row], between = parameter.distribution.from_normal(safe[row], *bounds)
            room *= between
        for row, form, others in self._sums:
            free[row] -= free[others].sum(axis=0)
            safe[row] = form.score(free[row])
        # Rounding may put a positive parameter on its open bound, where there is no model.
        possible &= ((free > self._above) & (free >= self._at_least)).all(axis=0)
        possible &= self._possible(values)
        with np.errstate(divide="ignore"):
            log_prior = np.log(room) - 0.5 * np.sum(safe * safe, axis=0)
        return free.T, np.where(possible, log_prior, -np.inf)

    def theta_at(self, coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates (models, free) to θ (models, parameters) and the log prior (models,)."""
        free, log_prior = self.constrain(coordinates)
        return self.theta(free), log_prior

    def _values(self, free: FloatArray) -> dict[str, FloatArray]:
        values = {name: np.full(len(free), value) for name, value in self._fixed.items()}
        return values | dict(zip(self.free_names, free.T, strict=True))

    def _limits(self, parameter: Parameter, values: Values) -> tuple[FloatArray, FloatArray]:
        """Bounds (models,) of a parameter, given those that come before it."""
        low, high = parameter.support
        if parameter.declared.bounds is None:
            return np.asarray(low), np.asarray(high)
        earlier = {name: values[name] for name in self._known[parameter.name]}
        lower, upper = self._between(parameter, earlier)
        # Bounds that cut nothing stay numbers: the map is then the prior's own.
        return (
            np.asarray(low) if lower.ndim == 0 and lower <= low else np.maximum(low, lower),
            np.asarray(high) if upper.ndim == 0 and upper >= high else np.minimum(high, upper),
        )

    def values_for_record(self, values: Values, record: str) -> Values:
        """Return values by the names that the parts declare, as one record has them.

        ``values`` are by the parameters' names, and some may be missing; ``record`` is empty if
        there is one alone.
        """
        if not record:
            return values
        specific = {plain: values[name] for plain, name in self._own[record] if name in values}
        return {**values, **specific}

    def _between(self, parameter: Parameter, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the bounds (models,) that other values set; of several records, the tightest."""
        # Those of a parameter that all records have depend on the values of each.
        views = (parameter.record,) if parameter.record or not self.records else self.records
        limits = [
            parameter.declared.limits(self.values_for_record(values, record)) for record in views
        ]
        low, high = limits[0]
        for lower, upper in limits[1:]:
            low, high = np.maximum(low, lower), np.minimum(high, upper)
        return low, high

    def _possible(self, values: Values) -> BoolArray:
        """Tell which models (models,) meet the constraint."""
        possible = np.asarray(True)
        if self.constraint is not None:
            for record in self.records or ("",):
                possible = possible & self.constraint(self.values_for_record(values, record))
        return possible


class Column(NamedTuple):
    """A column of θ: its name, what its part declares, and whose it is.

    ``record`` is empty for what all records share.
    """

    name: str
    declaration: Declaration
    record: str


@dataclass(frozen=True)
class ParameterTable:
    """The parameters of a model and its records, in the order of θ's columns.

    Parameters
    ----------
    actuator_part, noise_part
        The model's parts, which all records have.
    records
        The records' names; of one alone, or none, all parameters have plain names.
    per_record, shared
        Parameters that each record has of its own, or that all share, whatever scope their part
        declares.

    Raises
    ------
    InputError
        A parameter that no part has, or that is to be both; bounds that ask for one.
    """

    __repr__ = brief

    actuator_part: Actuator
    noise_part: Noise
    records: tuple[str, ...] = ()
    per_record: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        plain = [declaration.name for declaration in self.declarations]
        for key, names in (("per_record", self.per_record), ("shared", self.shared)):
            for name in names:
                if name not in plain:
                    hint = suggestion(name, plain)
                    raise InputError(f"model.{key}: no part here has {name!r}; {hint}")
        repeated = [name for name in self.per_record if name in self.shared]
        if repeated:
            raise InputError(
                f"model.per_record: {repeated[0]!r} is in model.shared too; "
                "remove it from one of them"
            )
        unit_values = {name: np.ones(1) for name in plain}
        for declaration in self.declarations:
            if declaration.bounds is None:
                continue
            try:
                with np.errstate(all="ignore"):
                    declaration.bounds(unit_values)
            except KeyError as unknown:
                raise InputError(
                    f"model: the bounds of {declaration.name} ask for {unknown}, which no part "
                    "here declares; declare it"
                ) from None

    @cached_property
    def declarations(self) -> tuple[Declaration, ...]:
        """The parameters of one record as their parts declare them."""
        return (*self.actuator_part.declarations, *self.noise_part.declarations)

    @cached_property
    def layout(self) -> tuple[Column, ...]:
        """The columns of θ, in their order."""
        columns = []
        for declared in self.declarations:
            by_record = declared.scope != "actuator" and declared.name not in self.shared
            if len(self.records) > 1 and (by_record or declared.name in self.per_record):
                for record in self.records:
                    columns.append(Column(f"{declared.name}[{record}]", declared, record))
            else:
                columns.append(Column(declared.name, declared, ""))
        return tuple(columns)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of θ's columns."""
        return tuple(column.name for column in self.layout)

    @property
    def loop(self) -> tuple[str, ...]:
        """Names of the parameters that shape the loop."""
        return tuple(column.name for column in self.layout if column.declaration.loop)

    @property
    def physical(self) -> tuple[str, ...]:
        """Names of the parameters that are the actuator's parts', not the noise's."""
        names = self.actuator_part.parameters
        return tuple(column.name for column in self.layout if column.declaration.name in names)

    def of_scope(self, *scopes: Scope) -> tuple[str, ...]:
        """Return the names of parameters of the actuator, of one record, or of its events."""
        return tuple(c.name for c in self.layout if c.declaration.scope in scopes)

    def columns(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return the columns (models,) of θ (models, parameters) by name."""
        return dict(zip(self.names, theta.T, strict=True))

    def actuator(self, theta: FloatArray) -> FloatArray:
        """Return the columns of one record's θ that the actuator takes, (models, parameters)."""
        return theta[:, : len(self.actuator_part.parameters)]

    def noise(self, theta: FloatArray) -> FloatArray:
        """Return the columns of one record's θ that the noise takes, (models, parameters)."""
        return theta[:, len(self.actuator_part.parameters) :]

    def with_values(self, theta: FloatArray, name: str, values: FloatArray) -> FloatArray:
        """Return a copy of θ (models, parameters) with other values (models,) of one parameter."""
        theta = theta.copy()
        theta[:, self.names.index(name)] = values
        return theta

    @cached_property
    def columns_of(self) -> dict[str, list[int]]:
        """Where each record's own θ has its columns in the joint one, by record."""
        return {
            record: [i for i, column in enumerate(self.layout) if column.record in ("", record)]
            for record in self.records
        }

    def of(self, theta: FloatArray, record: str) -> FloatArray:
        """Return θ of one record (models, its parameters) from the joint one."""
        columns: FloatArray = theta[:, self.columns_of[record]]
        return columns

    def name_of(self, name: str, record: str) -> str:
        """Return the name of the column that is a record's parameter ``name``."""
        plain = [declaration.name for declaration in self.declarations]
        return self.names[self.columns_of[record][plain.index(name)]]
