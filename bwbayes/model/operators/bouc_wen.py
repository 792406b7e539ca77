"""Bouc-Wen hysteresis as a part: w = d u − h, equations (5) and (6) of the paper.

The mathematics is in :mod:`bwbayes.model.boucwen`; here is what its parameters are called, in which
unit, where they may lie, and what is known of them beforehand. With U half the range of the voltage
and Y that of the displacement, d is Y/U or twice that, α a part of it, β near 1/U.

With half a range below about a third of 1/β a small drive shows no loop that closes; then the
priors, not the record, say how large β is, and leave room for the value that a large drive shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray
from bwbayes.model.boucwen import ceiling, hysteresis
from bwbayes.model.declaration import (
    Context,
    Declaration,
    Ranges,
    Values,
    lognormal,
    normal,
    refuse,
)
from bwbayes.model.distributions import Distribution
from bwbayes.model.operator import Span
from bwbayes.model.operators.one_state import (
    HIGHEST_CEILING,
    OneState,
    alpha,
    below_d,
    d,
    initial,
)
from bwbayes.model.power import PowerStep
from bwbayes.model.relaxing import RelaxingStep
from bwbayes.model.step import HysteresisStep

__all__ = ["BoucWen"]

SHAPE = ("alpha", "beta", "gamma", "exponent")

# Of β and γ, in units of the rate scale. |γ| ≤ β cuts the joint prior, which takes small β away:
# what remains for β has its median a little above 1/U, and room for a factor of thirty either way.
BETA, BETA_SIGMA = 0.15, 2.3
GAMMA = 4.0

# Beyond this the hysteresis hardly changes: a prior that goes further still gets a scale for this.
LARGEST_EXPONENT = 20.0

# γ presses against β when more than this share of draws lies within the margin below it.
PRESSING_SHARE = 0.25
PRESSING_MARGIN = 0.05

# The remedy where γ presses against ±β.
NOT_PASSIVE = "this actuator may need a gamma beyond it: give passive = false under [model]"


@dataclass(frozen=True)
class BoucWen(OneState):
    """Bouc-Wen hysteresis, w = d u − h, for any n ≥ 1.

    The hysteretic displacement h in um follows the voltage u in V by

        dh = α du − β |du| h |h|^(n−1) − γ du |h|^n,

    equation (6) of the paper, rate-independent, with d and α in um/V and β and γ in um^(1−n)/V.
    It is exact for n = 1; for any other n the error is below 1e-9 of the largest |h|.

    Parameters
    ----------
    passive
        Whether |γ| ≤ β: then the hysteresis never gives out more energy than it has taken in. Some
        published actuators have a larger γ; without the constraint only β + γ ≥ 0 holds, beyond
        which h runs away.

    Notes
    -----
    Y. K. Wen, Method for random vibration of hysteretic systems, Journal of the Engineering
    Mechanics Division 102, 249-263 (1976), doi:10.1061/JMCEA3.0002106; T. S. Low, W. Guo, Modeling
    of a three-layer piezoelectric bimorph beam with hysteresis, Journal of
    Microelectromechanical Systems 4, 230-237 (1995).
    """

    passive: bool = True

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, α, β, γ, n and the initial h."""
        pressed = {"lower": NOT_PASSIVE, "upper": NOT_PASSIVE} if self.passive else {}
        return (
            d(),
            alpha(),
            Declaration(
                "beta",
                "1/V",
                r"\beta",
                "hysteresis loop shape",
                _beta,
                floor=0.0,
                bounds=self._beta_bounds,
                loop=True,
                unit_given=_rate_unit,
            ),
            Declaration(
                "gamma",
                "1/V",
                r"\gamma",
                "hysteresis loop shape, loading against unloading",
                _gamma,
                bounds=self._gamma_bounds,
                stated_bounds="|gamma| <= beta" if self.passive else "beta + gamma >= 0",
                pressed=pressed,
                loop=True,
                unit_given=_rate_unit,
            ),
            Declaration(
                "exponent",
                "-",
                r"n",
                "smoothness of the transition",
                lambda _: 1.0,
                floor=1.0,
                reaches_floor=True,
                loop=True,
                aliases=("n",),
            ),
            replace(initial(), bounds=_initial_bounds),
        )

    def check(self, column: Values) -> None:
        """Raise an InputError where d is not finite; :func:`hysteresis` sees to the rest."""
        refuse("d", ~np.isfinite(column["d"]), column["d"], "must be finite")

    def trace(
        self, column: Values, voltage: FloatArray, state: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return w = d u − h (models, samples), and h at the end."""
        h = hysteresis(voltage, **{name: column[name] for name in SHAPE}, initial=state)
        after = h[:, -1].copy()
        np.subtract(column["d"][:, np.newaxis] * voltage, h, out=h)
        return h, after

    def gain(self, column: Values, span: Span) -> FloatArray:  # noqa: ARG002  # the same anywhere
        """Return d."""
        return column["d"]

    def holds(self, column: Values) -> BoolArray:
        """Tell where α < d, and h does not run away from the initial state.

        That is where γ ≤ β, or the initial state lies below the ceiling.
        """
        inside = below_d(column)
        names = {*SHAPE, "initial"}
        if self.passive or not names <= column.keys() or not np.any(column["initial"]):
            return inside
        start = np.abs(column["initial"])
        return inside & ((column["gamma"] <= column["beta"]) | (start <= _top(column)))

    def remarks(self, column: Values, free: tuple[str, ...]) -> list[str]:
        """Say that a posterior presses against γ ≤ β, if it does."""
        if not self.passive or "gamma" not in free:
            return []
        share = float(np.mean(column["gamma"] > (1 - PRESSING_MARGIN) * column["beta"]))
        if not share > PRESSING_SHARE:
            return []
        return [
            f"the posterior presses against |gamma| <= beta ({share:.0%} of the draws have gamma "
            f"within {PRESSING_MARGIN:.0%} of beta); if the actuator need not be passive, set "
            "[model] passive = false"
        ]

    def step(self, column: Values) -> HysteresisStep:
        """Return that of n = 1, or of any exponent."""
        d, alpha, beta, gamma = (column[name] for name in ("d", *SHAPE[:3]))
        exponent = column.get("exponent", np.ones_like(d))
        if np.all(exponent == 1.0):
            return RelaxingStep.alike(d, alpha, beta - gamma, beta + gamma)
        return PowerStep(d, alpha, beta, gamma, exponent)

    def opening(self, column: Values, half_range: float) -> FloatArray | None:
        """Return β U for n = 1."""
        return column["beta"] * half_range if np.all(column["exponent"] == 1.0) else None

    def _beta_bounds(self, earlier: Values) -> tuple[ArrayLike, ArrayLike]:
        if "gamma" not in earlier:
            return -np.inf, np.inf
        return np.abs(earlier["gamma"]) if self.passive else -earlier["gamma"], np.inf

    def _gamma_bounds(self, earlier: Values) -> tuple[ArrayLike, ArrayLike]:
        if "beta" not in earlier:
            return -np.inf, np.inf
        return -earlier["beta"], earlier["beta"] if self.passive else np.inf


def _initial_bounds(earlier: Values) -> tuple[ArrayLike, ArrayLike]:
    if not all(name in earlier for name in SHAPE):
        return -np.inf, np.inf
    top = _top(earlier)
    return -top, top


def _top(column: Values) -> FloatArray:
    """Highest |h| (models,), um, not beyond a number that can be worked with."""
    # Not a number where β + γ < 0 or α = 0, which is outside already; fmin prefers the number.
    with np.errstate(invalid="ignore"):
        top = ceiling(*(column[name] for name in SHAPE))
    return np.fmin(top, HIGHEST_CEILING)


def _rate_unit(stated: Mapping[str, float | Distribution]) -> str:
    return "1/V" if stated.get("exponent", 1.0) == 1.0 else "um^(1-n)/V"


def _beta(context: Context) -> Distribution:
    """Return β's default prior; its scale follows the exponent, and it allows for γ's cut."""
    low, center, high = (_log_rate(n, context.ranges) for n in _likely(context))
    factor = BETA if context.value("gamma") is None else 1.0
    return lognormal(factor * _exp(center), math.hypot(BETA_SIGMA, (high - low) / 4))


def _gamma(context: Context) -> Distribution:
    low, _, high = (_log_rate(n, context.ranges) for n in _likely(context))
    return normal(0.0, GAMMA * _exp(max(low, high)))


def _log_rate(exponent: float, ranges: Ranges) -> float:
    """Return the logarithm of the scale of β and γ, um^(1-n)/V.

    β |h|^(n-1) is a rate per volt, about 1/U; h is some fifth of the displacement.
    """
    return (1 - exponent) * math.log(0.2 * ranges.displacement) - math.log(ranges.voltage)


def _exp(logarithm: float) -> float:
    """Return the exponential, or a number that is out of proportion instead of an overflow."""
    return math.exp(min(logarithm, 700.0))


def _likely(context: Context) -> tuple[float, float, float]:
    """Return the exponent's 2.5 %, 50 % and 97.5 % quantiles above one."""
    exponent = context.stated.get("exponent", 1.0)
    if not isinstance(exponent, Distribution):
        return exponent, exponent, exponent
    below = float(exponent.frozen.cdf(1.0))
    if below >= 1:
        return 1.0, 1.0, 1.0
    likely = exponent.frozen.ppf(below + (1 - below) * np.array([0.025, 0.5, 0.975]))
    low, center, high = (float(n) for n in np.minimum(likely, LARGEST_EXPONENT))
    return low, center, high
