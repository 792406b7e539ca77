"""Duhem hysteresis in the form of Coleman and Hodgdon, with polynomials, exact.

Its loops may be curved and wider where the voltage is far from zero, which plain Bouc-Wen loops
are not: the gain behind the hysteresis and the strength of the hysteresis are polynomials of the
voltage. With constants for both, it is the backlash-like model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray
from bwbayes.model.boucwen import PIECE
from bwbayes.model.declaration import Context, Declaration, Values, normal, rounded
from bwbayes.model.distributions import Distribution
from bwbayes.model.drive import monotone_stretches
from bwbayes.model.elementwise import anywhere, select
from bwbayes.model.operator import Span
from bwbayes.model.operators.one_state import (
    OneState,
    alpha,
    below_d,
    beta,
    d,
    initial_anywhere,
    refuse,
)

__all__ = ["Duhem", "phi_functions"]

# Below this argument the φ functions are summed as a series of so many terms, which is exact there;
# above it nothing cancels in their recursion.
NEAR, SERIES_TERMS = 1.0, 16
TERMS = tuple(1 / math.factorial(order) for order in range(SERIES_TERMS + 2, 2, -1))

# Bounds that other parameters put on one may be rounded.
SLACK = 1e-12


@dataclass(frozen=True)
class Duhem(OneState):
    """Duhem hysteresis in the form of Coleman and Hodgdon, exact.

    The displacement y in um follows the voltage u in V by

        dy = β |du| (f(u) − y) + g(u) du,

    with f and g polynomials, f cubic and g quadratic. With h = f(u) − y and α(u) = f′(u) − g(u)
    this is Bouc-Wen hysteresis with γ = 0, n = 1 and a strength that depends on the voltage,

        y = f(u) − h,   dh = α(u) du − β |du| h,
        f(u) = d u + d₂ u² + d₃ u³,   α(u) = α + α₁ u + α₂ u²,

    with d, α in um/V, d₂, α₁ in um/V², d₃, α₂ in um/V³ and β in 1/V. It takes no energy from
    nowhere where 2 β α(u) ≥ |α′(u)| at any voltage, which is β² (4 α α₂ − α₁²) ≥ α₂² (all of
    them zero is allowed); this is enforced. The initial curve rises where f′(u) ≥ α(u): at zero
    volts (α < d), and at any voltage if besides 3 d₃ ≥ α₂, without the even terms.

    Parameters
    ----------
    odd
        Whether d₂ = α₁ = 0: then a mirrored voltage gives the mirrored displacement.

    Notes
    -----
    B. D. Coleman, M. L. Hodgdon, A constitutive relation for rate-independent hysteresis in
    ferromagnetically soft materials, International Journal of Engineering Science 24 (1986).

    A cubic gain beside it can hardly be told from d₃.
    """

    odd: bool = True

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, d₃, α, β, α₂ and the initial h; with even terms d₂ and α₁ as well."""
        gains = _coefficient("d3", 3, "d_3", "cubic piezoelectric coefficient", 0.1)
        strengths = Declaration(
            "alpha2",
            "um/V^3",
            r"\alpha_2",
            "growth of the hysteresis with the voltage's square",
            _growth,
            floor=0.0,
            reaches_floor=True,
            bounds=_alpha2_bounds,
            stated_bounds="alpha2 <= 4 alpha beta^2",
            loop=True,
        )
        # The bounds of α₂ and α₁ cut the joint prior, which takes small β away.
        first, last = (d(), gains, alpha(), beta(0.3, _beta_bounds), strengths), initial_anywhere()
        if self.odd:
            return *first, last
        even = _coefficient("d2", 2, "d_2", "quadratic piezoelectric coefficient", 0.1)
        tilt = Declaration(
            "alpha1",
            "um/V^2",
            r"\alpha_1",
            "growth of the hysteresis with the voltage",
            lambda known: normal(0.0, 0.2 * known.ranges.gain / _farthest(known)),
            bounds=_alpha1_bounds,
            stated_bounds="beta^2 (4 alpha alpha2 - alpha1^2) >= alpha2^2",
            loop=True,
        )
        return *first, even, tilt, last

    def check(self, column: Values) -> None:
        """Raise an InputError where a parameter is not finite, α ≤ 0, β < 0, or energy comes in."""
        for declared in self.parameters:
            name = declared.name
            refuse(column, name, ~np.isfinite(column[name]), "must be finite")
        refuse(column, "alpha", column["alpha"] <= 0, "must be positive")
        refuse(column, "beta", column["beta"] < 0, "must not be negative")
        refuse(column, "alpha2", column["alpha2"] < 0, "must not be negative")
        demand = "must not be above 4 alpha beta^2"
        if not self.odd:
            demand = "beta^2 (4 alpha alpha2 - alpha1^2) must be at least alpha2^2"
        refuse(column, "alpha2", ~_passive(column), demand)

    def holds(self, column: Values) -> BoolArray:
        """Tell where α < d and the hysteresis is passive at any voltage."""
        inside = below_d(column)
        if not {"alpha", "beta", "alpha2"} <= set(column):
            return inside
        return inside & _passive(column)

    def trace(
        self, column: Values, voltage: FloatArray, state: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return y = f(u) − h (models, samples), and h at the end.

        Along a stretch of direction s from u₀, with v = |u − u₀|, s α(u) is a polynomial of v, and

            h = h₀ exp(−β v) + Σ k! p_k v^(k+1) φ_(k+1)(−β v),   s α(u₀ + s v) = Σ p_k v^k.
        """
        h = np.repeat(state[:, np.newaxis], voltage.size, axis=1)
        rate = column["beta"][:, np.newaxis]
        for first, last, s in monotone_stretches(voltage, max(PIECE // state.size, 1)):
            start, u0 = h[:, first, np.newaxis], voltage[first]
            v = s * (voltage[first + 1 : last + 1] - u0)
            strength, slope, half = (p[:, np.newaxis] for p in self._about(column, u0))
            one, two, three = phi_functions(rate * v)
            # By Horner's rule; h₀ exp(−z) is h₀ (1 − z φ₁).
            step = (2 * s * half) * three
            step *= v
            step += slope * two
            step *= v
            step += (s * strength - rate * start) * one
            step *= v
            np.add(start, step, out=h[:, first + 1 : last + 1])
        after = h[:, -1].copy()
        np.subtract(self.polynomial(column, voltage), h, out=h)
        return h, after

    def _about(self, column: Values, u: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return α, α′ and α″/2 (models,) at a voltage."""
        alpha0, alpha2 = column["alpha"], column["alpha2"]
        alpha1 = 0.0 if self.odd else column["alpha1"]
        return alpha0 + u * (alpha1 + u * alpha2), alpha1 + 2 * u * alpha2, alpha2

    def polynomial(self, column: Values, voltage: FloatArray) -> FloatArray:
        """Return f (models, samples), um."""
        curve = column["d3"][:, np.newaxis] * voltage
        if not self.odd:
            curve += column["d2"][:, np.newaxis]
        curve *= voltage
        curve += column["d"][:, np.newaxis]
        curve *= voltage
        return curve

    def gain(self, column: Values, span: Span) -> FloatArray:
        """Return the mean of f′ over the span."""
        low, high = span
        even = 0.0 if self.odd else column["d2"]
        mean = column["d"] + even * (low + high)
        return np.asarray(mean + column["d3"] * (low**2 + low * high + high**2))

    def opening(self, column: Values, half_range: float) -> FloatArray:
        """Return β U."""
        return column["beta"] * half_range


def phi_functions(z: Any) -> tuple[Any, Any, Any]:
    """Return φ₁, φ₂ and φ₃ at −z, for z ≥ 0, a number or an array, to rounding.

    φ₁(−z) = (1 − exp(−z))/z, φ₂(−z) = (1 − φ₁)/z, φ₃(−z) = (1/2 − φ₂)/z; at zero they are 1, 1/2
    and 1/6. Each falls with z and stays positive.
    """
    near = np.minimum(z, NEAR)
    three = 0.0 * near
    for term in TERMS:
        three *= -near
        three += term
    two = 0.5 - near * three
    one = 1.0 - near * two
    if anywhere(z > NEAR):
        far = np.maximum(z, NEAR)
        one_far = -np.expm1(-far) / far
        two_far = (1.0 - one_far) / far
        three = select(z > NEAR, (0.5 - two_far) / far, three)
        two, one = select(z > NEAR, two_far, two), select(z > NEAR, one_far, one)
    return one, two, three


def _coefficient(name: str, power: int, label: str, description: str, part: float) -> Declaration:
    """Declare a gain's coefficient that adds about ``part`` of d u at the farthest voltage."""
    return Declaration(
        name,
        f"um/V^{power}",
        label,
        description,
        lambda known: normal(0.0, part * known.ranges.gain / _farthest(known) ** (power - 1)),
        loop=True,
    )


def _farthest(known: Context) -> float:
    """Return the largest |u| of the record, V."""
    return known.ranges.voltage + abs(known.ranges.bias)


def _growth(known: Context) -> Distribution:
    scale = 0.3 * known.ranges.gain / _farthest(known) ** 2
    return Distribution("halfnormal", {"scale": rounded(scale)})


def _beta_bounds(earlier: Values) -> tuple[ArrayLike, ArrayLike]:
    if "alpha" not in earlier or "alpha2" not in earlier:
        return 0.0, np.inf
    return np.sqrt(np.maximum(earlier["alpha2"], 0.0) / (4 * earlier["alpha"])), np.inf


def _alpha2_bounds(earlier: Values) -> tuple[ArrayLike, ArrayLike]:
    if "alpha" not in earlier or "beta" not in earlier:
        return 0.0, np.inf
    return 0.0, 4 * earlier["alpha"] * earlier["beta"] ** 2


def _alpha1_bounds(earlier: Values) -> tuple[ArrayLike, ArrayLike]:
    if not {"alpha", "beta", "alpha2"} <= set(earlier):
        return -np.inf, np.inf
    alpha2 = earlier["alpha2"]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        top = np.sqrt(alpha2 * (4 * earlier["alpha"] - alpha2 / earlier["beta"] ** 2))
    top = np.nan_to_num(top, nan=0.0)
    return -top, top


def _passive(column: Values) -> BoolArray:
    alpha2, rate2 = column["alpha2"], column["beta"] ** 2
    alpha1 = column.get("alpha1", np.zeros(1))
    most = 4 * column["alpha"] * alpha2 * (1 + SLACK) - alpha1**2
    inside: BoolArray = rate2 * most >= alpha2**2 * (1 - SLACK)
    return inside
