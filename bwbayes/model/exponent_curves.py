"""The curves that Bouc-Wen hysteresis of any exponent n > 1 is on, tabulated once for each.

In units of its ceiling the displacement follows dz/dτ = 1 ∓ zⁿ, whatever the other parameters
(:class:`~bwbayes.model.exponent.ExponentFlow`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray, IntArray

__all__ = ["MasterCurve", "cells_of", "logit_of_log", "widths"]

# All curves share the coordinate w = log(y / (1 - y)), where y in (0, 1) is z^n below the ceiling
# and z^-n above it. Beyond |w| = 36, y or 1 - y is lost against one.
_REACH = 36.0
_STEP = 0.2
_FAR_STEP = 0.12
_WIDEST = 3.0
_NODES, _WEIGHTS = (array / 2 for array in np.polynomial.legendre.leggauss(8))


@dataclass(frozen=True)
class MasterCurve:
    """One master curve per exponent: z(time) where |dz/dtime| = |1 - sign z^n|, tabulated.

    The time to a node is the integral of dz / |1 - sign z^n|, which in the coordinate w is the
    integral of y^power / (n (1 + (1 - sign) e^w)) with power 1/n inside and 1 - 1/n outside: it is
    smooth, and Gauss-Legendre quadrature on each cell is exact to rounding.

    exponent : shape (curves,)
    logit : shape (nodes,), the nodes' w
    time : shape (curves, nodes) for a curve outside; one more node, at zero, for one inside
    coefficients : shape (8, curves, cells), of z in the fraction of each cell's time
    """

    exponent: FloatArray
    sign: float
    power: FloatArray
    logit: FloatArray
    time: FloatArray
    coefficients: FloatArray

    @classmethod
    def inside(cls, exponent: FloatArray, sign: float) -> MasterCurve:
        """Curves through 0 <= z < 1; the time is counted from z = 0, where it equals z."""
        half = _graded_half(_STEP)
        logit = np.concatenate((-half[:0:-1], half))
        n = exponent[:, None]
        z = np.exp(-np.logaddexp(0.0, -logit) / n)
        y = np.exp(-np.logaddexp(0.0, -logit))
        complement = np.exp(-np.logaddexp(0.0, logit))
        speed = complement + (1.0 - sign) * y
        time = z[:, :1] + _durations(logit, 1.0 / exponent, exponent, sign)
        coefficients = _hermite(time, _derivatives(z, speed, -sign * y, n))
        # Between zero and the first node z^n is lost against one: z is the time itself.
        first = np.zeros((8, exponent.size, 1))
        first[1, :, 0] = z[:, 0]
        return cls(
            exponent,
            sign,
            1.0 / exponent,
            logit,
            np.hstack((np.zeros_like(n), time)),
            np.concatenate((first, coefficients), axis=2),
        )

    @classmethod
    def outside(cls, exponent: FloatArray, sign: float) -> MasterCurve:
        """Curves down from z^n = e^36 toward 1; the time is counted from this top."""
        even = np.linspace(-_REACH, 0.0, round(_REACH / _FAR_STEP) + 1)
        logit = np.concatenate((even, _graded_half(_FAR_STEP)[1:]))
        n = exponent[:, None]
        z = np.exp(np.logaddexp(0.0, -logit) / n)
        y_inverse = np.exp(np.logaddexp(0.0, -logit))
        speed = -np.exp(-logit) - (1.0 - sign)
        time = _durations(logit, 1.0 - 1.0 / exponent, exponent, sign)
        coefficients = _hermite(time, _derivatives(z, speed, -y_inverse, n))
        return cls(exponent, sign, 1.0 - 1.0 / exponent, logit, time, coefficients)

    def time_at(self, z: FloatArray, row: IntArray) -> FloatArray:
        """Time at which curve row[i] passes z[i], all of shape (models,), on an inside curve."""
        n = self.exponent[row]
        logit = logit_of_log(n * np.log(np.clip(z, 1e-300, 1.0)))
        return np.where(logit <= self.logit[0], z, self.time_at_logit(logit, row, skip=1))

    def time_at_logit(self, logit: FloatArray, row: IntArray, skip: int = 0) -> FloatArray:
        """Time at the coordinates logit (models,), kept within the nodes."""
        within = np.clip(logit, self.logit[0], self.logit[-1])
        cell = np.searchsorted(self.logit[1:-1], within, side="right")
        lower = self.logit[cell]
        partial = _integral(lower, within, self.power[row], self.exponent[row], self.sign)
        return self.time[row, cell + skip] + partial


def cells_of(curve: MasterCurve, since: FloatArray | None = None) -> FloatArray:
    """Return a curve's cells (curves, 4 + 8, cells) by rising height.

    One outside goes on backwards from a time ``since`` (curves, 1). What is in a cell says
    :meth:`~bwbayes.model.exponent.ExponentFlow.table`.
    """
    begin, width, coefficients = curve.time[:, :-1], widths(curve.time), curve.coefficients
    begin = np.broadcast_to(begin, width.shape)
    low, anchor = coefficients[0], begin
    if since is not None:
        begin = since + curve.time[:, -1:] - curve.time[:, 1:]
        low, anchor, width = coefficients.sum(axis=0), begin + width, -width
    rows = np.concatenate((np.stack((begin, low, anchor, width)), coefficients))
    return np.asarray(np.moveaxis(rows, 0, 1)[..., :: -1 if since is not None else 1])


def _graded_half(step: float) -> FloatArray:
    """Cell ends from w = 0 to the reach, wider outwards as what they resolve fades like e^-w."""
    ends = [0.0]
    while ends[-1] < _REACH:
        ends.append(ends[-1] + min(step * np.exp(ends[-1] / 8), _WIDEST))
    return np.array(ends)


def widths(time: FloatArray) -> FloatArray:
    """Lengths of the cells; none is zero, though time may stand still between the last nodes."""
    return np.maximum(np.diff(time), 1e-290)


def logit_of_log(log_y: FloatArray) -> FloatArray:
    """Return w = log(y / (1 - y)) from log y <= 0; y = 1 counts as just below one."""
    log_y = np.minimum(log_y, -1e-17)
    return np.asarray(log_y - np.log(-np.expm1(log_y)))


def _integral(
    lower: FloatArray, upper: FloatArray, power: FloatArray, exponent: FloatArray, sign: float
) -> FloatArray:
    """Time from logit `lower` to `right` (arrays that broadcast with power and exponent)."""
    width = upper - lower
    w = (lower + width / 2)[..., None] + width[..., None] * _NODES
    log_y = -np.logaddexp(0.0, -w)
    speed = 1.0 + (1.0 - sign) * np.exp(w)
    return np.asarray(width * ((np.exp(power[..., None] * log_y) / speed) @ _WEIGHTS) / exponent)


def _durations(
    logit: FloatArray, power: FloatArray, exponent: FloatArray, sign: float
) -> FloatArray:
    """Time from the first node to each node, shape (curves, nodes)."""
    steps = _integral(logit[:-1], logit[1:], power[:, None], exponent[:, None], sign)
    return np.hstack((np.zeros((exponent.size, 1)), np.cumsum(steps, axis=1)))


def _derivatives(
    z: FloatArray, speed: FloatArray, powered: FloatArray, n: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return z and its first three time derivatives: dz/dtime = speed = constant + powered."""
    # The powered part goes as z^n, so its derivatives by z are n/z, (n-1)/z, ... times it.
    slope = n * powered / z
    curvature = (n - 1.0) * slope / z
    first = np.broadcast_to(speed, z.shape)
    return z, first, first * slope, first * (slope**2 + first * curvature)


def _hermite(
    time: FloatArray, derivatives: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
) -> FloatArray:
    """Coefficients (8, curves, cells) of the polynomials that match both ends of each cell."""
    powers = [np.diff(time) ** order / factorial for order, factorial in enumerate((1, 1, 2, 6))]
    a0, a1, a2, a3 = (p * d[:, :-1] for p, d in zip(powers, derivatives, strict=True))
    b0, b1, b2, b3 = (p * d[:, 1:] for p, d in zip(powers, derivatives, strict=True))
    # What the cubic from the left end misses at the right end fixes the four upper coefficients.
    missed = (b0 - a0 - a1 - a2 - a3, b1 - a1 - 2 * a2 - 3 * a3, b2 - a2 - 3 * a3, b3 - a3)
    weights = ((35, -15, 5, -1), (-84, 39, -14, 3), (70, -34, 13, -3), (-20, 10, -4, 1))
    upper = (sum(m * r for m, r in zip(row, missed, strict=True)) for row in weights)
    return np.stack((a0, a1, a2, a3, *upper))
