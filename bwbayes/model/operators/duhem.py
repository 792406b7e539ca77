"""Duhem hysteresis in the form of Coleman and Hodgdon, with polynomials, exact.

Its loops may be curved and wider where the voltage is far from zero, which plain Bouc-Wen loops
are not: the gain behind the hysteresis and the strength of the hysteresis are polynomials of the
voltage. With constants for both, it is backlash-like hysteresis: a loop that opens and settles at
the same rate in both directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray
from bwbayes.model.declaration import (
    Declaration,
    Distribution,
    Values,
    normal,
    refuse,
    round_to_scale,
)
from bwbayes.model.inputs import Span
from bwbayes.model.operator import HysteresisStep
from bwbayes.model.operators.scalar_memory import (
    SLACK,
    OneState,
    RelaxingStep,
    alpha,
    beta,
    ceiling,
    d,
    initial,
)


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
        gains = _coefficient("d3", 3, "d_3", "cubic piezoelectric coefficient")
        strengths = Declaration(
            "alpha2",
            "um/V^3",
            r"\alpha_2",
            "growth of the hysteresis with the voltage's square",
            lambda context: Distribution(
                "halfnormal",
                {"scale": round_to_scale(0.3 * context.ranges.slope / context.ranges.farthest**2)},
            ),
            floor=0.0,
            reaches_floor=True,
            bounds=lambda earlier: (0.0, 4 * earlier["alpha"] * earlier["beta"] ** 2),
            stated_bounds="alpha2 <= 4 alpha beta^2",
            loop=True,
        )
        # The bounds of α₂ and α₁ cut the joint prior, which takes small β away.
        shape = beta(
            0.3,
            lambda earlier: (
                np.sqrt(np.maximum(earlier["alpha2"], 0.0) / (4 * earlier["alpha"])),
                np.inf,
            ),
        )
        first, last = (d(), gains, alpha(), shape, strengths), initial()
        if self.odd:
            return *first, last
        even = _coefficient("d2", 2, "d_2", "quadratic piezoelectric coefficient")
        tilt = Declaration(
            "alpha1",
            "um/V^2",
            r"\alpha_1",
            "growth of the hysteresis with the voltage",
            lambda context: normal(0.0, 0.2 * context.ranges.slope / context.ranges.farthest),
            bounds=_alpha1_bounds,
            stated_bounds="beta^2 (4 alpha alpha2 - alpha1^2) >= alpha2^2",
            loop=True,
        )
        return *first, even, tilt, last

    def check(self, column: Values) -> None:
        """Raise an InputError where a parameter is not finite, α ≤ 0, β < 0, or energy comes in."""
        super().check(column)
        demand = "must not be above 4 alpha beta^2"
        if not self.odd:
            demand = "beta^2 (4 alpha alpha2 - alpha1^2) must be at least alpha2^2"
        refuse("alpha2", ~_passive(column), column["alpha2"], demand)

    def holds(self, column: Values) -> BoolArray:
        """Tell where α < d and the hysteresis is passive at any voltage."""
        inside = super().holds(column)
        if not {"alpha", "beta", "alpha2"} <= set(column):
            return inside
        return inside & _passive(column)

    def step(self, column: Values) -> HysteresisStep:
        """Return that of f and α."""
        nothing = np.zeros_like(column["d"])
        names = ("d", "d2", "d3"), ("alpha", "alpha1", "alpha2")
        curve, strength = ([column.get(name, nothing) for name in group] for group in names)
        return DuhemStep.of(curve, strength, column["beta"], column["beta"])

    def typical_slope(self, column: Values, span: Span) -> FloatArray:
        """Return the mean of f′ over the span."""
        low, high = span
        even = 0.0 if self.odd else column["d2"]
        mean = column["d"] + even * (low + high)
        return np.asarray(mean + column["d3"] * (low**2 + low * high + high**2))


class DuhemStep(RelaxingStep):
    """w = f(u) − h with Duhem hysteresis h, exact: dg/dv = α(u) − β g, g = s h."""

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return f′ − α(u) ∓ β h, with h on the loop over all of the limits: none is larger."""
        numbers = self.parameters.T[:, :, np.newaxis]
        rate, nothing = self.parameters[:, 10], np.zeros(len(self.parameters))
        beta = np.maximum(rate, 1e-6 / (limits.high - limits.low))  # a rate may be zero
        loop = self.of(self.parameters.T[:3], self.parameters.T[3:6], beta, beta)
        rising = np.linspace(*limits, 1001)
        _, rise = loop.along(limits.low, nothing, rising[-1:])
        _, fall = loop.along(limits.high, nothing, rising[:1])
        decay = np.exp(-beta * (limits.high - limits.low))
        at_high = (decay * fall[:, 0] + rise[:, 0]) / (1 - decay**2)
        _, up = loop.along(limits.low, decay * at_high + fall[:, 0], rising)
        _, down = loop.along(limits.high, at_high, rising[::-1])
        farthest = rate[:, np.newaxis] * np.maximum(up, -down[:, ::-1])
        d, d2, d3, alpha, alpha1, alpha2 = numbers[:6]
        slope = d - alpha + rising * (2 * d2 - alpha1 + rising * (3 * d3 - alpha2))
        return (slope - farthest).min(axis=1), (slope + farthest).max(axis=1)


@dataclass(frozen=True)
class BacklashLike(OneState):
    """Backlash-like hysteresis of Su and others, exact.

    The displacement w in um follows the voltage u in V by

        dw = a |du| (c u − w) + b du.

    With h = c u − w this is dh = (c − b) du − a |du| h: n = 1 Bouc-Wen hysteresis with d = c,
    α = c − b, β = a and γ = 0, so d, α (um/V) and β (1/V) are its parameters. The slope at rest, b,
    is positive where α < d.

    Notes
    -----
    C.-Y. Su, Y. Stepanenko, J. Svoboda, T. P. Leung, Robust adaptive control of a class of
    nonlinear systems with unknown backlash-like hysteresis, IEEE Transactions on Automatic Control
    45 (2000).
    """

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, α, β and the initial h."""

        def bounds(earlier: Values) -> tuple[ArrayLike, ArrayLike]:
            top = ceiling(earlier["alpha"], earlier["beta"])
            return -top, top

        return d(), alpha(), beta(), initial(bounds)

    def step(self, column: Values) -> HysteresisStep:
        """Return that of n = 1 Bouc-Wen hysteresis with γ = 0."""
        return RelaxingStep.of([column["d"]], [column["alpha"]], column["beta"], column["beta"])


def _coefficient(name: str, power: int, label: str, description: str) -> Declaration:
    """Declare a gain's coefficient that adds about a tenth of d u at the farthest voltage."""
    return Declaration(
        name,
        f"um/V^{power}",
        label,
        description,
        lambda context: normal(
            0.0, 0.1 * context.ranges.slope / context.ranges.farthest ** (power - 1)
        ),
        loop=True,
    )


def _alpha1_bounds(earlier: Values) -> tuple[ArrayLike, ArrayLike]:
    alpha2 = earlier["alpha2"]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        top = np.sqrt(alpha2 * (4 * earlier["alpha"] - alpha2 / earlier["beta"] ** 2))
    top = np.nan_to_num(top, nan=0.0)
    return -top, top


def _passive(column: Values) -> BoolArray:
    alpha2, rate2 = column["alpha2"], column["beta"] ** 2
    alpha1 = column.get("alpha1", np.zeros(1))
    bound = 4 * column["alpha"] * alpha2 * (1 + SLACK) - alpha1**2
    inside: BoolArray = rate2 * bound >= alpha2**2 * (1 - SLACK)
    return inside
