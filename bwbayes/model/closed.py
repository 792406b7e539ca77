"""Distribution functions in closed form, for those that priors mostly are.

scipy's frozen distributions check and broadcast their arguments at every call, which costs more
than the likelihood of a short record. Here is what a map between values and probabilities needs and
no more: F, 1 − F and their inverses, each exact in its own tail. :func:`closed` gives them for a
distribution by its name; what it does not know is asked of scipy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.special import erf, erfc, erfcinv, erfinv, ndtr, ndtri

from bwbayes.arrays import FloatArray

__all__ = ["Form", "Frozen", "HalfNormal", "Level", "Scored", "closed"]


class Form(Protocol):
    """F, 1 − F and their inverses, of arrays of any shape."""

    def cdf(self, x: FloatArray) -> FloatArray:
        """Probability below x."""

    def sf(self, x: FloatArray) -> FloatArray:
        """Probability above x."""

    def ppf(self, p: FloatArray) -> FloatArray:
        """Return the value below which there is a probability p."""

    def isf(self, p: FloatArray) -> FloatArray:
        """Return the value above which there is a probability p."""


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
            logs = np.log(np.maximum(x, 0.0) / self.center)
        return np.asarray(logs / self.scale)

    def value(self, score: FloatArray) -> FloatArray:
        """Return x of scores z."""
        if not self.logarithmic:
            return self.center + self.scale * score
        return np.asarray(self.center * np.exp(self.scale * score))

    def cdf(self, x: FloatArray) -> FloatArray:
        """Φ(z)."""
        return np.asarray(ndtr(self.score(x)))

    def sf(self, x: FloatArray) -> FloatArray:
        """Φ(−z)."""
        return np.asarray(ndtr(-self.score(x)))

    def ppf(self, p: FloatArray) -> FloatArray:
        """Return the value at Φ⁻¹(p)."""
        return self.value(ndtri(p))

    def isf(self, p: FloatArray) -> FloatArray:
        """Return the value at −Φ⁻¹(p)."""
        return self.value(-ndtri(p))


@dataclass(frozen=True)
class Level:
    """Uniform from ``lower`` to ``upper``."""

    lower: float
    upper: float

    def cdf(self, x: FloatArray) -> FloatArray:
        """(x − l)/(u − l), between 0 and 1."""
        return np.clip((x - self.lower) / (self.upper - self.lower), 0.0, 1.0)

    def sf(self, x: FloatArray) -> FloatArray:
        """(u − x)/(u − l), between 0 and 1."""
        return np.clip((self.upper - x) / (self.upper - self.lower), 0.0, 1.0)

    def ppf(self, p: FloatArray) -> FloatArray:
        """Return l + p (u − l)."""
        return self.lower + p * (self.upper - self.lower)

    def isf(self, p: FloatArray) -> FloatArray:
        """Return u − p (u − l)."""
        return self.upper - p * (self.upper - self.lower)


@dataclass(frozen=True)
class HalfNormal:
    """The absolute value of a normal number of sd ``scale``."""

    scale: float

    def cdf(self, x: FloatArray) -> FloatArray:
        """Return erf(x/(s √2)), zero below zero."""
        return np.asarray(erf(np.maximum(x, 0.0) / (np.sqrt(2) * self.scale)))

    def sf(self, x: FloatArray) -> FloatArray:
        """Return erfc(x/(s √2)), one below zero."""
        return np.asarray(erfc(np.maximum(x, 0.0) / (np.sqrt(2) * self.scale)))

    def ppf(self, p: FloatArray) -> FloatArray:
        """Return s √2 erf⁻¹(p)."""
        return np.asarray(np.sqrt(2) * self.scale * erfinv(p))

    def isf(self, p: FloatArray) -> FloatArray:
        """Return s √2 erfc⁻¹(p)."""
        return np.asarray(np.sqrt(2) * self.scale * erfcinv(p))


@dataclass(frozen=True)
class Frozen:
    """Any distribution of scipy's."""

    frozen: Any

    def cdf(self, x: FloatArray) -> FloatArray:
        """As scipy has it."""
        return np.asarray(self.frozen.cdf(x))

    def sf(self, x: FloatArray) -> FloatArray:
        """As scipy has it."""
        return np.asarray(self.frozen.sf(x))

    def ppf(self, p: FloatArray) -> FloatArray:
        """As scipy has it."""
        return np.asarray(self.frozen.ppf(p))

    def isf(self, p: FloatArray) -> FloatArray:
        """As scipy has it."""
        return np.asarray(self.frozen.isf(p))


def closed(name: str, arguments: Mapping[str, float]) -> Form | None:
    """Return the closed form of a distribution by the name that engineers use; None without one."""
    match name:
        case "normal":
            return Scored(arguments["mean"], arguments["sd"], logarithmic=False)
        case "lognormal":
            return Scored(arguments["median"], arguments["sigma"], logarithmic=True)
        case "uniform":
            return Level(arguments["lower"], arguments["upper"])
        case "halfnormal":
            return HalfNormal(arguments["scale"])
    return None
