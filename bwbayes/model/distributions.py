"""Prior distributions by the names engineers use, all of them scipy's.

``normal``, ``lognormal``, ``uniform``, ``halfnormal`` and ``beta`` take the arguments one would
write on paper; any other continuous distribution of ``scipy.stats`` goes by scipy's name, with
scipy's shape arguments and ``loc`` and ``scale``.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from scipy.special import ndtr, ndtri

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.closed import Form, Frozen, Scored, closed

__all__ = ["Distribution"]

FAMILIAR = {
    "normal": ("mean", "sd"),
    "lognormal": ("median", "sigma"),
    "uniform": ("lower", "upper"),
    "halfnormal": ("scale",),
    "beta": ("a", "b"),
}


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
        with np.errstate(invalid="ignore"):
            quantiles = self.form.ppf(np.array([0.1, 0.5, 0.9]))
        if not np.isfinite(quantiles).all() or not quantiles[0] < quantiles[2]:
            raise InputError(f"{self}: no proper distribution; check its arguments")

    def __str__(self) -> str:
        inside = ", ".join(f"{key} = {value:.6g}" for key, value in self.arguments.items())
        return f"{self.name}({inside})"

    def to_normal(self, x: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
        """Return the normal scores z of values x, with the distribution cut at both bounds.

        z = Φ⁻¹((F(x) − F(lower)) / (F(upper) − F(lower))), from whichever tail is nearer, so that
        it keeps its precision in both. All arrays are (models,) or scalar.
        """
        below, above = self._between(lower, x), self._between(x, upper)
        with np.errstate(divide="ignore", invalid="ignore"):
            near = np.minimum(below, above) / (below + above)
        score: FloatArray = np.where(below <= above, 1, -1) * ndtri(np.clip(near, 0, 1))
        return score

    def from_normal(
        self, z: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return values x of normal scores z, and the probability between the bounds.

        The inverse of :meth:`to_normal`; where the bounds leave nothing, x is the lower one.
        """
        scalar = np.ndim(lower) == np.ndim(upper) == 0
        if scalar and self.support == (float(lower), float(upper)):  # the bounds cut nothing
            return self._uncut(z), np.ones_like(z)
        if isinstance(self.form, Scored):
            return self._cut_score(self.form, z, lower, upper)
        mass = np.maximum(self._between(lower, upper), 0.0)
        below = self.form.cdf(lower) + ndtr(z) * mass
        above = self.form.sf(upper) + ndtr(-z) * mass
        # The smaller probability is the one that keeps its precision.
        x = np.where(below < above, self.form.ppf(below), self.form.isf(above))
        return np.minimum(np.maximum(x, lower), np.maximum(lower, upper)), mass

    @staticmethod
    def _cut_score(
        form: Scored, z: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Do the same for what a formula maps to a standard normal, whose tails are alike."""
        low, high = form.score(lower), form.score(upper)
        start, end = ndtr(low), ndtr(-high)
        mass = np.where(start < 0.5, ndtr(high) - start, ndtr(-low) - end)
        mass = np.maximum(mass, 0.0)
        below, above = start + ndtr(z) * mass, end + ndtr(-z) * mass
        score = ndtri(np.minimum(below, above))
        x = form.value(np.where(below < above, score, -score))
        return np.minimum(np.maximum(x, lower), np.maximum(lower, upper)), mass

    def _between(self, low: FloatArray, high: FloatArray) -> FloatArray:
        """Probability between two values, from the tail in which they lie."""
        start = self.form.cdf(low)
        rising = self.form.cdf(high) - start
        falling = self.form.sf(low) - self.form.sf(high)
        return np.where(start < 0.5, rising, falling)

    def _uncut(self, z: FloatArray) -> FloatArray:
        """Return the values of normal scores, without bounds."""
        if isinstance(self.form, Scored):
            return self.form.value(z)
        return np.where(z < 0, self.form.ppf(ndtr(z)), self.form.isf(ndtr(-z)))

    @cached_property
    def form(self) -> Form:
        """Distribution functions, in closed form if there is one."""
        self._require_arguments()
        return closed(self.name, self.arguments) or Frozen(self.frozen)

    @cached_property
    def support(self) -> tuple[float, float]:
        """The least and the largest value."""
        low, high = self.form.ppf(np.array([0.0, 1.0]))
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
        return self._by_scipy_name(arguments)

    def _require_arguments(self) -> None:
        """Refuse arguments that a familiar distribution does not have."""
        arguments = self.arguments
        if self.name not in FAMILIAR:
            return
        required, optional = FAMILIAR[self.name], ("lower", "upper") if self.name == "beta" else ()
        missing = [key for key in required if key not in arguments]
        unknown = [key for key in arguments if key not in (*required, *optional)]
        if missing or unknown:
            wrong = f"{missing[0]} is missing" if missing else f"{unknown[0]} is unknown"
            raise InputError(f"{self.name}: {wrong}; it takes {', '.join((*required, *optional))}")
        lower, upper = arguments.get("lower", 0.0), arguments.get("upper", 1.0)
        if not lower < upper:
            raise InputError(
                f"{self.name}: lower {lower:g} is not below upper {upper:g}; swap them"
            )

    def _by_scipy_name(self, arguments: dict[str, float]) -> Any:
        family = getattr(scipy.stats, self.name, None)
        if not isinstance(family, scipy.stats.rv_continuous):
            names = [
                *FAMILIAR,
                *(
                    n
                    for n, f in vars(scipy.stats).items()
                    if isinstance(f, scipy.stats.rv_continuous)
                ),
            ]
            near = difflib.get_close_matches(self.name, names, n=1)
            familiar = f"use one of {', '.join(FAMILIAR)}"
            hint = f"did you mean {near[0]}? Else {familiar}" if near else familiar
            raise InputError(f"{self.name}: unknown distribution; {hint}")
        try:
            return family(**arguments)
        except TypeError:
            takes = ", ".join(filter(None, [family.shapes, "loc", "scale"]))
            raise InputError(f"{self.name}: wrong arguments; scipy's takes {takes}") from None
