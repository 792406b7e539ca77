"""Bouc-Wen hysteresis, w = d u − h, equations (5) and (6) of the paper, without time stepping.

Time does not appear in them: h depends on the path of the voltage alone. So a record is cut where
the voltage turns, and every stretch between two turns is one array expression for all samples and
all models at once (:mod:`bwbayes.model.relaxing` for n = 1, :mod:`bwbayes.model.power` for any n).

Default priors follow from U, half the range of the voltage, and Y, that of the displacement: d is
Y/U or twice that, α a part of it, β near 1/U.

With half a range below about a third of 1/β a small drive shows no loop that closes; then the
priors, not the record, say how large β is, and leave room for the value that a large drive shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray
from bwbayes.errors import InputError
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
from bwbayes.model.operators.scalar_memory import (
    HIGHEST_CEILING,
    OneState,
    alpha,
    beta,
    d,
    gamma,
    initial,
)
from bwbayes.model.power import PowerStep
from bwbayes.model.relaxing import RelaxingStep
from bwbayes.model.step import HysteresisStep

SHAPE = ("alpha", "beta", "gamma", "exponent")


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
        advice = "this actuator may need a gamma beyond it: give passive = false under [model]"
        pressed = dict.fromkeys(("lower", "upper"), advice) if self.passive else {}
        stated = "|gamma| <= beta" if self.passive else "beta + gamma >= 0"
        return (
            d(),
            alpha(),
            replace(
                beta(bounds=lambda e: (abs(e["gamma"]) if self.passive else -e["gamma"], np.inf)),
                default=_beta,
                unit_given=_rate_unit,
            ),
            replace(
                gamma(
                    _gamma, lambda e: (-e["beta"], e["beta"] if self.passive else np.inf), stated
                ),
                pressed=pressed,
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
            initial(lambda earlier: (-(top := _top(earlier)), top)),
        )

    def check(self, column: Values) -> None:
        """Raise an InputError where a model is outside of the domain, or h may run away."""
        super().check(column)
        gamma, initial = column["gamma"], column["initial"]
        refuse("gamma", column["beta"] + gamma < 0, gamma, "beta + gamma must not be negative")
        # A state may exceed the ceiling by its rounding.
        above = ~_anywhere(column) & (np.abs(initial) > (1 + 1e-9) * _top(column))
        demand = "must lie inside the ceiling (alpha/(beta + gamma))^(1/n)"
        refuse("initial", above, initial, f"{demand}, unless n = 1 and gamma <= beta")

    def holds(self, column: Values) -> BoolArray:
        """Tell where α < d, and h is where the model has a solution: see ``check``."""
        inside = super().holds(column)
        if not {*SHAPE, "initial"} <= column.keys() or not np.any(column["initial"]):
            return inside
        return inside & (_anywhere(column) | (np.abs(column["initial"]) <= _top(column)))

    def step(self, column: Values) -> HysteresisStep:
        """Return that of n = 1, or of any exponent."""
        d, alpha, beta, gamma = (column[name] for name in ("d", *SHAPE[:3]))
        exponent = column.get("exponent", np.ones_like(d))
        if np.all(exponent == 1.0):
            return RelaxingStep.of([d], [alpha], beta - gamma, beta + gamma)
        return PowerStep.of(d, alpha, beta, gamma, exponent)

    def opening(self, column: Values, half_range: float) -> FloatArray | None:
        """Return β U for n = 1."""
        return column["beta"] * half_range if np.all(column["exponent"] == 1.0) else None


def ceiling(
    alpha: FloatArray, beta: FloatArray, gamma: FloatArray, exponent: FloatArray
) -> FloatArray:
    """Return the largest |h| the model reaches, (α / (β + γ))^(1/n) in um, for starts inside it.

    All arrays are (models,), units as in :class:`BoucWen`; infinite where β + γ = 0.
    """
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray(np.power(alpha / (beta + gamma), 1 / exponent))


def hysteresis(
    voltage: ArrayLike,
    alpha: ArrayLike,
    beta: ArrayLike,
    gamma: ArrayLike,
    exponent: ArrayLike = 1.0,
    initial: ArrayLike = 0.0,
) -> FloatArray:
    """Hysteretic displacement of a batch of Bouc-Wen models along one voltage path.

    Parameters
    ----------
    voltage
        (samples,) in V, finite; any path, plateaus and constant voltages included.
    alpha
        (models,) or scalar, um/V, positive.
    beta, gamma
        (models,) or scalar, um^(1−n)/V (1/V for n = 1); β ≥ 0 and β + γ ≥ 0.
    exponent
        n, (models,) or scalar, at least 1.
    initial
        h at the first sample, (models,) or scalar, um: not beyond the ceiling
        (α / (β + γ))^(1/n), unless n = 1 and γ ≤ β.

    Returns
    -------
    FloatArray
        h, (models, samples), um.

    Raises
    ------
    InputError
        Outside the model's domain, or not finite, naming the argument.

    Notes
    -----
    Equations (5) and (6) of the paper; its equation (8) prints the last term as γ u |dh|, which
    is a misprint: read so it would define dh by itself, with two solutions or none.

    Examples
    --------
    >>> h = hysteresis([0.0, 100.0, -100.0], alpha=[0.3, 0.36], beta=0.027, gamma=0.017)
    >>> h.round(2)
    array([[ 0.  ,  6.73, -6.82],
           [ 0.  ,  8.08, -8.18]])
    """
    path = np.asarray(voltage, dtype=np.float64)
    if path.ndim != 1 or path.size == 0 or not np.isfinite(path).all():
        raise InputError("voltage: must be a non-empty row of finite numbers; check the record")
    arguments = {
        "alpha": alpha, "beta": beta, "gamma": gamma, "exponent": exponent, "initial": initial,
    }  # fmt: skip
    rows = {name: np.atleast_1d(np.asarray(v, dtype=np.float64)) for name, v in arguments.items()}
    size, column = max(values.size for values in rows.values()), {}
    for name, values in rows.items():
        if values.ndim != 1 or values.size not in (1, size):
            raise InputError(
                f"{name}: has shape {values.shape}; give one number, or ({size},) as the others"
            )
        column[name] = np.broadcast_to(values, (size,))
    column["d"] = np.zeros(size)
    operator = BoucWen(passive=False)
    operator.check(column)
    # The difference, because the negative has −0 for 0.
    h: FloatArray = 0.0 - operator.trace(column, path, column["initial"])[0]
    return h


def _anywhere(column: Values) -> BoolArray:
    """Tell which models (models,) follow the voltage from any h."""
    return np.asarray((column["exponent"] == 1.0) & (column["gamma"] <= column["beta"]))


def _top(column: Values) -> FloatArray:
    """Highest |h| (models,), um, not beyond a number that can be worked with."""
    # It is nan where β + γ < 0 or α = 0, which is outside already; fmin prefers the number.
    with np.errstate(invalid="ignore"):
        top = ceiling(*(column[name] for name in SHAPE))
    return np.fmin(top, HIGHEST_CEILING)


def _rate_unit(stated: Mapping[str, float | Distribution]) -> str:
    return "1/V" if stated.get("exponent", 1.0) == 1.0 else "um^(1-n)/V"


def _beta(context: Context) -> Distribution:
    """Return β's default prior; its scale follows the exponent, and it allows for γ's cut."""
    low, center, high = (_log_rate(n, context.ranges) for n in _likely(context))
    # |γ| ≤ β cuts the joint prior, which takes small β away: what remains for β has its median a
    # little above 1/U, and room for a factor of thirty either way.
    factor = 0.15 if context.value("gamma") is None else 1.0
    return lognormal(factor * _exp(center), math.hypot(2.3, (high - low) / 4))


def _gamma(context: Context) -> Distribution:
    low, _, high = (_log_rate(n, context.ranges) for n in _likely(context))
    return normal(0.0, 4.0 * _exp(max(low, high)))


def _log_rate(exponent: float, ranges: Ranges) -> float:
    """Return the logarithm of the scale of β and γ, um^(1-n)/V.

    β |h|^(n-1) is a rate per volt, about 1/U; h is some fifth of the displacement.
    """
    return (1 - exponent) * math.log(0.2 * ranges.displacement) - math.log(ranges.voltage)


def _exp(logarithm: float) -> float:
    """Return the exponential, or a number that is out of proportion instead of an overflow."""
    return math.exp(min(logarithm, 700.0))


def _likely(context: Context) -> tuple[float, float, float]:
    """Return the exponent's 2.5%, 50% and 97.5% quantiles above one."""
    exponent = context.stated.get("exponent", 1.0)
    if not isinstance(exponent, Distribution):
        return exponent, exponent, exponent
    below = float(exponent.frozen.cdf(1.0))
    if below >= 1:
        return 1.0, 1.0, 1.0
    likely = exponent.frozen.ppf(below + (1 - below) * np.array([0.025, 0.5, 0.975]))
    # Beyond 20 the hysteresis hardly changes: a prior that goes further gets the scale for that.
    low, center, high = (float(n) for n in np.minimum(likely, 20.0))
    return low, center, high
