"""Parameters: what they are called, what is known of them, and where they may lie.

Each parameter is either fixed or has a prior. The priors are independent but for the physical
constraints, which cut the joint prior: 0 < α < d, |γ| ≤ β, an initial state inside the hysteresis
ceiling. With |γ| ≤ β the hysteresis is passive, taking no energy from nowhere on any path; some
published actuators have larger γ, and that constraint can be left at β + γ ≥ 0, without which h
runs away. :class:`JointPrior` draws from the cut prior and gives its log density, up to the one
constant that the cut leaves. It also maps parameters to coordinates without bounds and back: the
normal scores of each prior between the bounds that hold there. In them every prior is nearly a
standard normal, whatever its scale and bounds, and so a posterior has Gaussian tails even where it
leans on a bound (γ near β, a discrepancy near zero).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.boucwen import ceiling
from bwbayes.model.distributions import Distribution

__all__ = ["COORDINATES", "FLOORS", "POSITIVE", "JointPrior", "Parameter", "passive_remark"]

# The version of the map from parameters to coordinates: a chain of another one means other draws.
COORDINATES = 1

Values = dict[str, FloatArray]

POSITIVE = (
    "d",
    "alpha",
    "beta",
    "lag",
    "mass",
    "damping",
    "stiffness",
    "sensor_sd",
    "discrepancy_sd",
    "discrepancy_time",
)

# No parameter may be lower. What is positive does not reach its floor, an exponent of one does.
FLOORS = {**dict.fromkeys(POSITIVE, 0.0), "exponent": 1.0}

# γ presses against β when more than this share of draws lies within the margin below it.
PRESSING_SHARE = 0.25
PRESSING_MARGIN = 0.05

# Normal scores beyond this have no probability that a float can hold.
FARTHEST = 37.0

# Stands for an infinite ceiling (β + γ = 0), um.
HIGHEST_CEILING = 1e9


@dataclass(frozen=True)
class Parameter:
    """One parameter: names for people, and a prior or a fixed value.

    ``lower`` and ``upper`` cut the prior; physical bounds hold besides. ``unit`` and ``label``
    (LaTeX, without the dollar signs) go to tables and pictures.

    Raises
    ------
    InputError
        Neither prior nor fixed value, both, or bounds that leave nothing of the prior.
    """

    name: str
    unit: str
    label: str
    description: str
    prior: Distribution | None = None
    fixed: float | None = None
    lower: float = -np.inf
    upper: float = np.inf

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
        if not _above_floor(self.name, np.array(value)):
            least = "above" if self.name in POSITIVE else "at least"
            raise InputError(
                f"{self.name}: fixed at {value:g}; must be {least} {FLOORS[self.name]:g}"
            )

    @cached_property
    def support(self) -> tuple[float, float]:
        """Where prior, bounds and sign allow the parameter."""
        assert self.prior is not None
        low, high = self.prior.support
        return max(low, self.lower, FLOORS.get(self.name, -np.inf)), min(high, self.upper)

    @cached_property
    def mass_between(self) -> tuple[float, float]:
        """The prior's cumulative probability at both ends of the support."""
        assert self.prior is not None
        low, high = self.support
        return float(self.prior.frozen.cdf(low)), float(self.prior.frozen.cdf(high))


class JointPrior:
    """The joint prior of the parameters, cut by the physical constraints.

    Parameters
    ----------
    parameters
        All parameters of the model and the noise, in the order of θ's columns; α after d, γ after
        β, and the initial state after both, because their bounds depend on those.
    passive
        Whether |γ| ≤ β, and not only β + γ ≥ 0.
    """

    def __init__(self, parameters: Iterable[Parameter], *, passive: bool = True) -> None:
        self.parameters = tuple(parameters)
        self.passive = passive
        self.names = tuple(p.name for p in self.parameters)
        self.free = tuple(p for p in self.parameters if p.fixed is None)
        self.free_names = tuple(p.name for p in self.free)
        self._fixed = {p.name: p.fixed for p in self.parameters if p.fixed is not None}
        self._check_fixed_pairs()

    def _check_fixed_pairs(self) -> None:
        fixed = self._fixed
        if fixed.get("alpha", 0.0) >= fixed.get("d", np.inf):
            raise InputError("alpha: fixed at or above d; must be below it")
        if fixed.get("beta", np.inf) < self._least_beta(fixed.get("gamma", 0.0)):
            demand = "must lie between -beta and beta" if self.passive else "must be above -beta"
            raise InputError(f"gamma: fixed beyond beta; {demand}")

    def _least_beta(self, gamma: float) -> float:
        return abs(gamma) if self.passive else -gamma

    @property
    def dimensions(self) -> int:
        """The number of free parameters."""
        return len(self.free)

    def theta(self, free: FloatArray) -> FloatArray:
        """Put free parameters (models, free) and fixed ones together: (models, parameters)."""
        columns = dict(zip(self.free_names, free.T, strict=True))
        ones = np.ones(free.shape[0])
        return np.stack(
            [columns[n] if n in columns else self._fixed[n] * ones for n in self.names], axis=1
        )

    def log_density(self, free: FloatArray) -> FloatArray:
        """Log density (models,) of free parameters (models, free), up to a constant."""
        values = self._values(free)
        result = np.zeros(free.shape[0])
        inside = np.ones(free.shape[0], dtype=bool)
        for parameter in self.free:
            assert parameter.prior is not None
            result += parameter.prior.frozen.logpdf(values[parameter.name])
            inside &= self._inside(parameter, values)
        inside &= self._start_holds(values)
        return np.where(inside, result, -np.inf)

    def draw(self, generator: np.random.Generator, size: int) -> FloatArray:
        """Draw ``size`` vectors of free parameters, (size, free), from the cut prior.

        Raises
        ------
        InputError
            Fewer than one in ten thousand draws of the single priors meets the constraints.
        """
        kept = np.empty((0, self.dimensions))
        tried = 0
        while kept.shape[0] < size:
            batch = np.stack([_draw_single(p, generator, size) for p in self.free], axis=1)
            kept = np.concatenate([kept, batch[np.isfinite(self.log_density(batch))]])
            tried += size
            if kept.shape[0] < 1e-4 * tried - 10:
                bound = "|gamma| <= beta" if self.passive else "beta + gamma >= 0"
                raise InputError(f"priors: hardly a draw has 0 < alpha < d and {bound}")
        return kept[:size]

    def unconstrain(self, free: FloatArray) -> FloatArray:
        """Map free parameters (models, free), inside their bounds, to coordinates."""
        values = self._values(free)
        scores = []
        for parameter in self.free:
            assert parameter.prior is not None
            bounds = self._limits(parameter, values)
            scores.append(parameter.prior.to_normal(values[parameter.name], *bounds))
        return np.clip(np.stack(scores, axis=1), -FARTHEST, FARTHEST)

    def constrain(self, coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates (models, free) to free parameters and their log prior density (models,).

        A parameter with prior distribution function F between bounds l and u, which depend on
        earlier parameters alone, is x = F⁻¹(F(l) + Φ(z) (F(u) − F(l))). The Jacobian is triangular
        and turns the joint prior into

            log p(z) = Σ log φ(z) + Σ log(F(u) − F(l)) + constant,

        −∞ where earlier parameters leave no room, or z is beyond anything that can be told apart.
        """
        values = self._values(None, rows=coordinates.shape[0])
        safe = np.clip(coordinates, -FARTHEST, FARTHEST)
        room = np.ones(coordinates.shape[0])
        for parameter, z in zip(self.free, safe.T, strict=True):
            assert parameter.prior is not None
            bounds = self._limits(parameter, values)
            x, between = parameter.prior.from_normal(z, *bounds)
            # Rounding may put a positive parameter on its open bound, where there is no model.
            room = room * np.where(_above_floor(parameter.name, x), between, 0)
            values[parameter.name] = x
        room = np.where(self._start_holds(values), room, 0)
        with np.errstate(divide="ignore"):
            log_prior = np.log(room) - 0.5 * np.sum(safe**2, axis=1)
        log_prior = np.where((safe == coordinates).all(axis=1), log_prior, -np.inf)
        return np.stack([values[name] for name in self.free_names], axis=1), log_prior

    def _values(self, free: FloatArray | None, rows: int = 0) -> Values:
        size = rows if free is None else free.shape[0]
        values = {name: np.full(size, value) for name, value in self._fixed.items()}
        if free is not None:
            values.update(zip(self.free_names, free.T, strict=True))
        return values

    def _limits(self, parameter: Parameter, values: Values) -> tuple[FloatArray, FloatArray]:
        """Bounds (models,) of a parameter, given those that come before it."""
        support_low, support_high = parameter.support
        low = np.asarray(support_low)
        high = np.asarray(support_high)
        match parameter.name:
            case "d" if "alpha" in self._fixed:
                low = np.maximum(low, self._fixed["alpha"])
            case "alpha" if "d" in values:
                high = np.minimum(high, values["d"])
            case "beta" if "gamma" in self._fixed:
                low = np.maximum(low, self._least_beta(self._fixed["gamma"]))
            case "gamma" if "beta" in values:
                low = np.maximum(low, -values["beta"])
                high = np.minimum(high, values["beta"]) if self.passive else high
            case "initial":
                top = _ceiling(values)
                low, high = np.maximum(low, -top), np.minimum(high, top)
        return low, high

    def _inside(self, parameter: Parameter, values: Values) -> BoolArray:
        low, high = self._limits(parameter, values)
        x = values[parameter.name]
        inside: BoolArray = (low <= x) & (x <= high) & _above_floor(parameter.name, x)
        if parameter.name in ("d", "alpha"):
            inside &= values["alpha"] < values["d"]
        return inside

    def _start_holds(self, values: Values) -> BoolArray | np.bool_:
        """Tell where h does not run away from an initial state that is fixed: γ ≤ β or below top.

        A free one has its bounds.
        """
        start = abs(self._fixed.get("initial", 0.0))
        if self.passive or start == 0 or "gamma" not in values:
            return np.True_
        return (values["gamma"] <= values["beta"]) | (start <= _ceiling(values))


def passive_remark(prior: JointPrior, draws: FloatArray) -> str | None:
    """Say that a posterior presses against γ ≤ β, if it does.

    Parameters
    ----------
    prior
        The prior of the draws.
    draws
        (..., free), parameters in their own units.
    """
    if not prior.passive or "gamma" not in prior.free_names:
        return None
    values = dict(zip(prior.names, prior.theta(draws.reshape(-1, prior.dimensions)).T, strict=True))
    share = float(np.mean(values["gamma"] > (1 - PRESSING_MARGIN) * values["beta"]))
    if not share > PRESSING_SHARE:
        return None
    return (
        f"the posterior presses against |gamma| <= beta ({share:.0%} of the draws have gamma "
        f"within {PRESSING_MARGIN:.0%} of beta); if the actuator need not be passive, set "
        "[model] passive = false"
    )


def _above_floor(name: str, x: FloatArray) -> BoolArray:
    floor = FLOORS.get(name, -np.inf)
    return np.asarray(x > floor if name in POSITIVE else x >= floor)


def _ceiling(values: Values) -> FloatArray:
    """Highest |h| (models,), um, not beyond a number that can be worked with."""
    # Not a number where β + γ < 0 or α = 0, which is outside already; fmin prefers the number.
    with np.errstate(invalid="ignore"):
        top = ceiling(*(values[n] for n in ("alpha", "beta", "gamma", "exponent")))
    return np.fmin(top, HIGHEST_CEILING)


def _draw_single(parameter: Parameter, generator: np.random.Generator, size: int) -> FloatArray:
    assert parameter.prior is not None
    uniform = generator.uniform(*parameter.mass_between, size)
    draws: FloatArray = np.asarray(parameter.prior.frozen.ppf(uniform), dtype=np.float64)
    return draws
