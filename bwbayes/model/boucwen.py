"""Bouc-Wen hysteresis, exact, without time stepping.

The hysteretic displacement h follows the voltage u by equation (6) of the paper, and by equation
(5) for an exponent n other than one:

    dh = α du − β |du| h |h|^(n−1) − γ du |h|^n

Time does not appear: h depends on the path of the voltage alone. So the record is cut where the
voltage turns, and every stretch between two turns is one array expression for all samples and all
models at once. The only loop runs over turning points.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.drive import PIECE, monotone_stretches
from bwbayes.model.exponent import ExponentFlow
from bwbayes.model.relaxing import RelaxingStep

__all__ = ["ceiling", "hysteresis"]

# A state carried over from an earlier piece may exceed the ceiling by its rounding.
CEILING_SLACK = 1 + 1e-9


class Flow(Protocol):
    """How g = s h evolves along a stretch with direction s."""

    def advance(self, start: FloatArray, travel: FloatArray) -> FloatArray:
        """Return g (models, points) after each ``travel`` (points,) from ``start`` (models,)."""


def ceiling(
    alpha: FloatArray, beta: FloatArray, gamma: FloatArray, exponent: FloatArray
) -> FloatArray:
    """Return the largest |h| the model reaches, (α / (β + γ))^(1/n) in um, for starts inside it.

    All arrays are (models,), units as in :func:`hysteresis`; infinite where β + γ = 0.
    """
    with np.errstate(divide="ignore", over="ignore"):
        bound: FloatArray = np.power(alpha / (beta + gamma), 1 / exponent)
    return bound


def hysteresis(
    voltage: ArrayLike,
    alpha: ArrayLike,
    beta: ArrayLike,
    gamma: ArrayLike,
    exponent: ArrayLike = 1.0,
    initial: ArrayLike = 0.0,
) -> FloatArray:
    """Hysteretic displacement of a batch of Bouc-Wen models along one voltage path.

    Along a stretch of direction s, with v = |u − u₀| and g = s h, equation (6) becomes linear on
    either side of zero,

        dg/dv = α − c g,   c = β − γ while g < 0,   c = β + γ while g ≥ 0,

    and its solution g₀ exp(−c v) + α (1 − exp(−c v)) / c is used as it stands. For n > 1 the
    equation is separable and solved with a relative error below 1e-9 of the largest |h|.

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
        h at the first sample, (models,) or scalar, um.

    Returns
    -------
    FloatArray
        h, (models, samples), um.

    Raises
    ------
    InputError
        Outside the model's domain, naming the argument: α ≤ 0, β < 0, β + γ < 0, n < 1, anything
        not finite, or γ > β with |initial| beyond the ceiling (α / (β + γ))^(1/n), from where h
        would run away.

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
    arguments = {"alpha": alpha, "beta": beta, "gamma": gamma, "exponent": exponent}
    models = _models({**arguments, "initial": initial})
    _check_domain(**models)

    result = np.empty((models["alpha"].size, path.size))
    linear = models["exponent"] == 1.0
    for rows, flow_of in ((linear, _LinearFlow), (~linear, ExponentFlow)):
        if rows.any():
            columns = {name: values[rows] for name, values in models.items()}
            start = columns.pop("initial")
            result[rows] = _follow(path, flow_of(**columns), start)
    return result


def _follow(path: FloatArray, flow: Flow, initial: FloatArray) -> FloatArray:
    """Chain the stretches of a voltage path (samples,) to h (models, samples)."""
    h = np.repeat(initial[:, np.newaxis], path.size, axis=1)
    if np.ptp(path) == 0:
        return h  # no direction to go in, so not even the rounding of a start on the ceiling
    for first, last, direction in monotone_stretches(path, max(PIECE // initial.size, 1)):
        travel = direction * (path[first + 1 : last + 1] - path[first])
        g = flow.advance(direction * h[:, first], travel)
        np.multiply(g, direction, out=h[:, first + 1 : last + 1])
    return h


class _LinearFlow:
    """The closed form for n = 1."""

    def __init__(
        self, alpha: FloatArray, beta: FloatArray, gamma: FloatArray, exponent: FloatArray
    ) -> None:
        assert (exponent == 1.0).all()
        self.step = RelaxingStep.alike(np.zeros_like(alpha), alpha, beta - gamma, beta + gamma)

    def advance(self, start: FloatArray, travel: FloatArray) -> FloatArray:
        return -self.step.along(0.0, start, travel)[0]


def _models(arguments: dict[str, ArrayLike]) -> dict[str, FloatArray]:
    """Bring all arguments to float arrays of one shape (models,)."""
    rows = {name: np.atleast_1d(np.asarray(v, dtype=np.float64)) for name, v in arguments.items()}
    size = max(values.size for values in rows.values())
    for name, values in rows.items():
        if values.ndim != 1 or values.size not in (1, size):
            raise InputError(
                f"{name}: has shape {values.shape}; give one number, or ({size},) as the others"
            )
        rows[name] = np.broadcast_to(values, (size,))
    return rows


def _check_domain(
    alpha: FloatArray,
    beta: FloatArray,
    gamma: FloatArray,
    exponent: FloatArray,
    initial: FloatArray,
) -> None:
    def refuse(name: str, wrong: BoolArray, demand: str, values: FloatArray) -> None:
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(f"{name}: {values[row]:.6g} in model {row}; {demand}")

    named = {"alpha": alpha, "beta": beta, "gamma": gamma, "exponent": exponent, "initial": initial}
    for name, values in named.items():
        refuse(name, ~np.isfinite(values), "must be finite", values)
    refuse("alpha", alpha <= 0, "must be positive", alpha)
    refuse("beta", beta < 0, "must not be negative", beta)
    refuse("gamma", beta + gamma < 0, "beta + gamma must not be negative", gamma)
    refuse("exponent", exponent < 1, "must be at least 1", exponent)
    highest = CEILING_SLACK * ceiling(alpha, beta, gamma, exponent)
    away = (gamma > beta) & (np.abs(initial) > highest)
    refuse("gamma", away, "with gamma > beta, initial must lie inside the ceiling", gamma)
