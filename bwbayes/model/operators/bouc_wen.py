"""Bouc-Wen hysteresis, w = d u − h, equations (5) and (6) of the paper, without time stepping.

Time does not appear in them: h depends on the path of the voltage alone. So a record is cut where
the voltage turns, and every stretch between two turns is one array expression for all samples and
all models at once (:class:`~bwbayes.model.operators.scalar_memory.RelaxingStep` for n = 1,
:class:`PowerStep` for any n).

For any n, along a stretch of direction s, with v = |u − u₀|, g = s h obeys dg/dv = α − (β + γ) gⁿ
from zero on, and below it −g does the same with γ − β, backwards. In units of its ceiling g is then
on one of two curves that depend on n alone,

    dz/dτ = 1 − zⁿ  or, where γ < β below zero,  dz/dτ = 1 + zⁿ,

both through z = 0 at τ = 0. They are tabulated once, by quadrature; a step adds to the time on its
curve. No time stepping, and an error below 1e-9 of the largest |h|.

Default priors follow from U, half the range of the voltage, and Y, that of the displacement: d is
Y/U or twice that, α a part of it, β near 1/U.

With half a range below about a third of 1/β a small drive shows no loop that closes; then the
priors, not the record, say how large β is, and leave room for the value that a large drive shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray, anywhere, look_up, select
from bwbayes.errors import InputError
from bwbayes.model.declaration import (
    Context,
    Declaration,
    Distribution,
    Ranges,
    Values,
    lognormal,
    normal,
    refuse,
)
from bwbayes.model.inputs import Span
from bwbayes.model.operator import HysteresisStep, OneStateStep
from bwbayes.model.operators.scalar_memory import (
    HIGHEST_CEILING,
    OneState,
    RelaxingStep,
    alpha,
    beta,
    d,
    gamma,
    initial,
)

# Where the tables of the two curves begin among the numbers of a step, and the rows of a table: the
# time at which each cell begins, how long it lasts, and the coefficients of its polynomial.
TABLE, ROWS = 7, 10


class PowerStep(OneStateStep):
    """w = d u − h with Bouc-Wen hysteresis h of any exponent n ≥ 1.

    Besides voltage and h it remembers the direction and the time on the curve, V, negative where g
    is; the time is looked up where the voltage turns.
    """

    ROW: ClassVar = "d, α, c/α, scales and rates below zero and above, n, and the curves' tables"
    remembers: ClassVar = 4

    @classmethod
    def of(
        cls,
        d: FloatArray,
        alpha: FloatArray,
        beta: FloatArray,
        gamma: FloatArray,
        exponent: FloatArray,
    ) -> Self:
        """Return the step of d, α, β, γ and n, (models,), as of Bouc-Wen hysteresis."""
        rates = (gamma - beta) / alpha, (beta + gamma) / alpha
        # Units of z below zero and above, |c/α|^(−1/n), um; kept finite.
        with np.errstate(divide="ignore"):
            logs = [-np.log(np.abs(rate)) / exponent for rate in rates]
        below, above = (np.exp(np.minimum(values, np.log(1e100))) for values in logs)
        exponents, row = np.unique(exponent, return_inverse=True)
        soft = gamma < beta
        # How far above one z may be on the soft curve.
        farthest = np.log(above / below)[soft] * exponent[soft]
        rising = tabulate(exponents, saturating=True)
        falling = tabulate(exponents, saturating=False, top=max(farthest, default=0.0))
        cells = 1 << (max(rising.shape[2], falling.shape[2]) - 1).bit_length()
        parameters = np.full((d.size, TABLE + 2 * ROWS * cells), np.inf)
        numbers = d, alpha, *rates, below, above, exponent
        parameters[:, :TABLE] = np.stack(numbers, axis=1)
        tables = parameters[:, TABLE:].reshape(d.size, 2, ROWS, cells)
        tables[:, 0, :, : rising.shape[2]] = rising[row]
        tables[~soft, 1, :, : rising.shape[2]] = rising[row[~soft]]
        tables[soft, 1, :, : falling.shape[2]] = falling[row[soft]]
        return cls(parameters)

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return d u − h and its slope d − α + c gⁿ."""
        d, alpha, n = parameters[0], parameters[1], parameters[6]
        s, still = select(voltage < memory[0], -1.0, 1.0), voltage == memory[0]
        time = memory[3]
        if anywhere(s != memory[2]):
            time = select(s != memory[2], clock(parameters, s * memory[1]), time)
        time = time + np.abs(voltage - memory[0])
        scale = select(time < 0.0, parameters[4], parameters[5])
        height = scale * height_at(parameters, time < 0.0, np.abs(time) * alpha / scale)
        h = select(still, memory[1], s * select(time < 0.0, -height, height))
        after[0], after[1] = voltage, h
        after[2], after[3] = select(still, memory[2], s), select(still, memory[3], time)
        x = select(time < 0.0, parameters[2], parameters[3]) * height**n
        return d * voltage - h, d - alpha * (1 - x)

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return d − max(α, 2 α β / (β + γ)) and d: h is steepest just after a turn."""
        d, alpha, below, _, _, scale, n = self.parameters.T[:TABLE]
        top = np.minimum(scale, alpha * (limits.high - limits.low))
        return d - alpha * np.maximum(1 - below * top**n, 1.0), d

    def coefficients(self) -> dict[str, tuple[Any, str]]:
        """Return d, α, c/α below zero and above, and n."""
        d, alpha, below, above, _, _, n = self.parameters[0, :TABLE].tolist()
        slopes = {"d": (d, "um/V"), "alpha": (alpha, "um/V")}
        rates = {"below": (below, "um^-n"), "above": (above, "um^-n")}
        return {**slopes, **rates, "exponent": (n, "-")}


def clock(parameters: Any, g: Any) -> Any:
    """Return the time, V, at which the curves are at g, um."""
    scale = select(g < 0.0, parameters[4], parameters[5])
    time = time_at(parameters, g < 0.0, np.abs(g) / scale) * scale / parameters[1]
    return select(g < 0.0, -time, time)


def time_at(parameters: Any, below: Any, height: Any) -> Any:
    """Return the time at which the curve below zero, or above, is at a height."""
    cells = (len(parameters) - TABLE) / 20
    cell = find_cell(parameters, below, 2, height)
    rise = 0.0 * height
    for order in range(1, 8):
        rise = rise + look_up(parameters, cell + (2 + order) * cells)
    low = look_up(parameters, cell + 2 * cells)
    fraction = (height - low) / select(rise == 0.0, 1.0, rise)
    for _ in range(4):  # of Newton's rule
        fraction = np.minimum(np.maximum(fraction, 0.0), 1.0)
        value, slope = 0.0 * low, 0.0 * low
        for order in range(7, -1, -1):
            slope = slope * fraction + value
            value = value * fraction + look_up(parameters, cell + (2 + order) * cells)
        fraction = fraction - (value - height) / select(slope == 0.0, 1.0, slope)
    fraction = np.minimum(np.maximum(fraction, 0.0), 1.0)
    return look_up(parameters, cell + 0 * cells) + look_up(parameters, cell + cells) * fraction


def height_at(parameters: Any, below: Any, time: Any) -> Any:
    """Return the height at which the curve below zero, or above, is at a time."""
    cells = (len(parameters) - TABLE) / 20
    cell = find_cell(parameters, below, 0, time)
    fraction = (time - look_up(parameters, cell + 0 * cells)) / look_up(parameters, cell + cells)
    fraction, value = np.minimum(np.maximum(fraction, 0.0), 1.0), 0.0 * time
    for order in range(7, -1, -1):
        value = value * fraction + look_up(parameters, cell + (2 + order) * cells)
    return value


def find_cell(parameters: Any, below: Any, row: int, value: Any) -> Any:
    """Return where the cell of a curve begins in whose range a value of the row lies."""
    cells = (len(parameters) - TABLE) / 20
    cell, half = select(below, TABLE + 10.0 * cells, 1.0 * TABLE), np.floor(cells / 2)
    while half > 0:
        later = cell + half
        cell = select(look_up(parameters, later + row * cells) <= value, later, cell)
        half = np.floor(half / 2)
    return cell


def tabulate(exponent: FloatArray, *, saturating: bool, top: float = 0.0) -> FloatArray:
    """Return the cells (curves, ROWS, cells) of dz/dτ = 1 ∓ zⁿ, by rising time.

    The time to a node is the integral of dz / (1 ∓ zⁿ). In x = log zⁿ, or in x = log zⁿ/(1 − zⁿ)
    where the curve saturates, it is smooth, and quadrature on each cell is exact to rounding. One
    that grows on is followed to x = ``top``.
    """
    # Curves are followed to log zⁿ, or where they saturate log zⁿ/(1 − zⁿ), of so much: the rest is
    # lost against one. Cells are wider outwards, as what they resolve fades like exp(−|x|).
    reach = 36.0
    half = [0.0]
    while half[-1] < reach:
        half.append(half[-1] + min(0.2 * np.exp(half[-1] / 8), 3.0))
    beyond = half[1:] if saturating else np.arange(0.0, min(max(top, 0.0), reach) + 0.3, 0.15)[1:]
    x, n, sign = np.array([*-np.array(half[::-1]), *beyond]), exponent[:, None], 1 - 2 * saturating

    def log_power(x: FloatArray) -> FloatArray:
        return -np.logaddexp(0.0, -x) if saturating else x

    # In x, dτ is z/n dx where the curve saturates, and z / (1 + zⁿ) dx/n else.
    nodes, weights = np.polynomial.legendre.leggauss(8)
    inside = x[:-1, None] + np.diff(x)[:, None] * (nodes + 1) / 2
    rate = np.exp(log_power(inside) / n[..., None]) / n[..., None]
    rate /= 1.0 if saturating else 1 + np.exp(inside)
    z, power = np.exp(log_power(x) / n), np.exp(log_power(x))
    # Up to the first node zⁿ is lost against one: z is the time.
    widths = np.concatenate([z[:, :1], (rate @ weights) / 2 * np.diff(x)], axis=1)
    time = np.concatenate([np.zeros_like(n), np.cumsum(widths, axis=1)], axis=1)
    # z and its derivatives in time: zⁿ has n zⁿ/z, (n − 1)/z of that, ... by z.
    speed = np.exp(-np.logaddexp(0.0, x)) if saturating else 1 + power
    slope = sign * n * power / z
    curvature = (n - 1) * slope / z
    derivatives = z, speed + 0 * z, speed * slope, speed * (slope**2 + speed * curvature)
    ends = [
        np.diff(time)[:, 1:] ** order / factorial for order, factorial in enumerate((1, 1, 2, 6))
    ]
    a = [scale * values[:, :-1] for scale, values in zip(ends, derivatives, strict=True)]
    b = [scale * values[:, 1:] for scale, values in zip(ends, derivatives, strict=True)]
    # The error of the left end's cubic at the right end fixes the four upper coefficients.
    missed = (
        b[0] - a[0] - a[1] - a[2] - a[3],
        b[1] - a[1] - 2 * a[2] - 3 * a[3],
        b[2] - a[2] - 3 * a[3],
        b[3] - a[3],
    )
    hermite = ((35, -15, 5, -1), (-84, 39, -14, 3), (70, -34, 13, -3), (-20, 10, -4, 1))
    upper = [sum(m * gap for m, gap in zip(row, missed, strict=True)) for row in hermite]
    table = np.zeros((exponent.size, ROWS, widths.shape[1]))
    # None lasts no time, though it may stand still between the last nodes.
    table[:, 0], table[:, 1] = time[:, :-1], np.maximum(widths, 1e-290)
    table[:, 3, 0] = z[:, 0]
    table[:, 2:, 1:] = np.stack([*a, *upper], axis=1)
    return table


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
            initial(lambda earlier: (-_top(earlier), _top(earlier))),
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
