"""The hysteretic displacement along one monotone stretch of voltage, for any exponent n >= 1.

Along such a stretch the Bouc-Wen equation is separable: in units of its ceiling the displacement
follows one of a few master curves that depend on the exponent alone, and a stretch is a shift in
time along its curve. The curves are tabulated once, by quadrature, and every stretch of every model
is then read off by interpolation: no time stepping, and an error below 1e-11 of the largest |h|.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bwbayes.arrays import FloatArray, IntArray

__all__ = ["ExponentFlow"]

# All curves share the coordinate w = log(y / (1 - y)), where y in (0, 1) is z^n below the ceiling
# and z^-n above it. Beyond |w| = 36, y or 1 - y is lost against one.
_REACH = 36.0
_STEP = 0.2
_FAR_STEP = 0.12
_WIDEST = 3.0
_NODES, _WEIGHTS = (array / 2 for array in np.polynomial.legendre.leggauss(8))
# Beyond this the ceiling is out of every stretch's reach, and its powers are still finite.
_FARTHEST_CEILING = 1e100
# Elements worked on at once, so that the intermediate arrays stay in the processor's cache.
_BLOCK = 16384


class ExponentFlow:
    """The flow of dg/dv = alpha - beta g |g|^(n-1) - gamma |g|^n along monotone stretches.

    Equation (6) of the paper with a general exponent: v = |u - u0| is the voltage travelled since
    the stretch began and g = s h the hysteretic displacement in the direction of travel s. With
    lambda = beta + gamma and G = (alpha / lambda)^(1/n), z = g / G follows dz/dtau = 1 - z^n in
    tau = v alpha / G from g >= 0 on; while g < 0, the same holds for -g with mu = beta - gamma.

    An object depends on the parameters alone; it is built once and used for every stretch.

    Parameters
    ----------
    alpha : FloatArray, shape (models,)
        In um/V, above zero.
    beta, gamma : FloatArray, shape (models,)
        In um^(1-n)/V, with beta >= 0 and beta + gamma >= 0.
    exponent : FloatArray, shape (models,)
        The exponent n >= 1, which may differ from model to model.

    Notes
    -----
    The caller validates the parameters; nothing is checked here.
    """

    def __init__(
        self, alpha: FloatArray, beta: FloatArray, gamma: FloatArray, exponent: FloatArray
    ) -> None:
        mu = beta - gamma
        self._exponent, self._row = np.unique(exponent, return_inverse=True)
        self._up = _ceiling(alpha, beta + gamma, exponent)
        self._down = _ceiling(alpha, np.abs(mu), exponent)
        self._up_rate = alpha / self._up
        self._down_rate = alpha / self._down
        self._softening = mu >= 0
        self._near = self._join_at_zero()

    def advance(self, start: FloatArray, travel: FloatArray) -> FloatArray:
        """Hysteretic displacement after some travel along one monotone stretch.

        Parameters
        ----------
        start : FloatArray, shape (models,)
            Displacement g0 at the start of the stretch, in um, in the direction of travel. It may
            lie above the ceiling G, but where gamma > beta its size must stay below.
        travel : FloatArray, shape (points,)
            Voltage travelled |u - u0| in V: ascending, zero or above.

        Returns
        -------
        FloatArray, shape (models, points)
            Displacement g in um, in the direction of travel.
        """
        origin = self._clock(start)
        below = np.flatnonzero((start < -self._down) & self._softening)
        if below.size:
            height, fall = -start[below] / self._down[below], self._fall_below
            origin[below] -= fall.duration(below, height)
        displacement = self._near.evaluate(np.arange(start.size), origin, travel)
        if below.size:
            falling = origin[below, None] + travel < self._near.knots[below, :1]
            depth = -self._down[below, None] * fall.advance(below, height, travel)
            displacement[below] = np.where(falling, depth, displacement[below])
        above = np.flatnonzero(start > self._up)
        if above.size:
            height = start[above] / self._up[above]
            falls = self._fall_above.advance(above, height, travel)
            displacement[above] = self._up[above, None] * falls
        unmoved = np.searchsorted(travel, 0.0, side="right")
        displacement[:, :unmoved] = start[:, None]
        return displacement

    @cached_property
    def _rising(self) -> _Curve:
        """From zero up to the ceiling: dz/dtau = 1 - z^n, the time counted from z = 0."""
        return _Curve.inside(self._exponent, 1.0)

    @cached_property
    def _relaxing(self) -> _Curve:
        """From one down to zero, dz/dtau = -(1 + z^n), the time counted back from z = 0."""
        return _Curve.inside(self._exponent, -1.0)

    @cached_property
    def _fall_above(self) -> _Fall:
        """From above down to the ceiling: dz/dtau = 1 - z^n."""
        return _Fall(_Curve.outside(self._exponent, 1.0), self._row, self._up_rate)

    @cached_property
    def _fall_below(self) -> _Fall:
        """From above down to one: dz/dtau = -(1 + z^n)."""
        return _Fall(_Curve.outside(self._exponent, -1.0), self._row, self._down_rate)

    def _join_at_zero(self) -> _Pieces:
        """Both sides of g = 0 on one clock, in V, that reads zero there."""
        row, up, down = self._row, self._up[:, None], self._down[:, None]
        rising, relaxing = self._rising, self._relaxing
        soft = self._softening[:, None]
        before = np.where(soft, relaxing.time[row], rising.time[row]) / self._down_rate[:, None]
        after = rising.time[row] / self._up_rate[:, None]
        mirrored = np.where(soft, relaxing.coefficients[:, row], rising.coefficients[:, row])
        return _Pieces(
            knots=np.hstack((-before[:, :0:-1], after[:, :-1])),
            anchors=np.hstack((-before[:, -2::-1], after[:, :-1])),
            widths=np.hstack((-_widths(before)[:, ::-1], _widths(after))),
            coefficients=np.concatenate(
                (-down * mirrored[:, :, ::-1], up * rising.coefficients[:, row]), axis=2
            ),
        )

    def _clock(self, start: FloatArray) -> FloatArray:
        """Clock reading (V) at which the joined curve passes each start, kept to its ends."""
        size = np.abs(start)
        back = np.where(
            self._softening,
            self._relaxing.time_at(size / self._down, self._row),
            self._rising.time_at(size / self._down, self._row),
        )
        ahead = self._rising.time_at(size / self._up, self._row)
        return np.where(start < 0, -back / self._down_rate, ahead / self._up_rate)


@dataclass(frozen=True)
class _Pieces:
    """Piecewise polynomials of degree seven in time, one set of cells per model.

    Within a cell the polynomial's variable is (time - anchor) / width, from 0 to 1. Before the
    first and after the last cell the value stays what it is there.

    knots, anchors, widths : shape (models, cells), in V; knots ascend and are the cells' left ends
    coefficients : shape (8, models, cells), lowest power first
    """

    knots: FloatArray
    anchors: FloatArray
    widths: FloatArray
    coefficients: FloatArray

    def evaluate(self, models: IntArray, origin: FloatArray, travel: FloatArray) -> FloatArray:
        """Values of these models (rows,) at origin (rows,) + travel (points,) V: (rows, points)."""
        values = np.empty((models.size, travel.size))
        block = max(1, _BLOCK // max(1, travel.size))
        for first in range(0, models.size, block):
            rows = slice(first, first + block)
            self._evaluate_block(models[rows], origin[rows, None], travel, values[rows])
        return values

    def _evaluate_block(
        self, models: IntArray, origin: FloatArray, travel: FloatArray, values: FloatArray
    ) -> None:
        cells = self.knots.shape[1]
        # Travel ascends and is common to all models, so cells are sought among the points.
        arrival = np.searchsorted(travel, self.knots[models, 1:] - origin)
        runs = np.diff(arrival, axis=1, prepend=0, append=travel.size)
        labels = models[:, None] * cells + np.arange(cells)
        cell = np.repeat(labels.ravel(), runs.ravel()).reshape(values.shape)
        fraction = origin + travel
        fraction -= self.anchors.take(cell)
        fraction /= self.widths.take(cell)
        np.clip(fraction, 0.0, 1.0, out=fraction)
        self.coefficients[7].take(cell, out=values, mode="clip")
        for coefficient in self.coefficients[6::-1]:
            values *= fraction
            values += coefficient.take(cell)


@dataclass(frozen=True)
class _Curve:
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
    def inside(cls, exponent: FloatArray, sign: float) -> _Curve:
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
    def outside(cls, exponent: FloatArray, sign: float) -> _Curve:
        """Curves down from z^n = e^36 towards 1; the time is counted from this top."""
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
        logit = _logit_of_log(n * np.log(np.clip(z, 1e-300, 1.0)))
        return np.where(logit <= self.logit[0], z, self.time_at_logit(logit, row, skip=1))

    def time_at_logit(self, logit: FloatArray, row: IntArray, skip: int = 0) -> FloatArray:
        """Time at the coordinates logit (models,), kept within the nodes."""
        within = np.clip(logit, self.logit[0], self.logit[-1])
        cell = np.searchsorted(self.logit[1:-1], within, side="right")
        left = self.logit[cell]
        partial = _integral(left, within, self.power[row], self.exponent[row], self.sign)
        return self.time[row, cell + skip] + partial


@dataclass(frozen=True)
class _Fall:
    """Models that start above z = 1 and come down, all models on row[i] of the curve.

    row, rate : shape (models,); the rate is that of tau, in 1/V
    """

    curve: _Curve
    row: IntArray
    rate: FloatArray

    @cached_property
    def _pieces(self) -> _Pieces:
        """The curve in each model's own time in V, counted from the curve's top."""
        time = self.curve.time[self.row] / self.rate[:, None]
        return _Pieces(
            knots=time[:, :-1],
            anchors=time[:, :-1],
            widths=_widths(time),
            coefficients=self.curve.coefficients[:, self.row],
        )

    def duration(self, models: IntArray, height: FloatArray) -> FloatArray:
        """Voltage (V) from height z0 (rows,) down to z = 1 for these models (rows,)."""
        whole = self.curve.time[self.row[models], -1] / self.rate[models]
        descent: FloatArray = whole - self._clock(models, height)
        return descent

    def advance(self, models: IntArray, height: FloatArray, travel: FloatArray) -> FloatArray:
        """Height z after travel (points,) V from height (rows,): shape (rows, points)."""
        origin = self._clock(models, height)
        z = self._pieces.evaluate(models, origin, travel)
        higher = np.flatnonzero(origin < 0)
        if higher.size:
            early = origin[higher, None] + travel < 0
            power_law = self._power_law(models[higher], height[higher], travel)
            z[higher] = np.where(early, power_law, z[higher])
        return z

    def _clock(self, models: IntArray, height: FloatArray) -> FloatArray:
        """Time (V) since the curve's top; below zero for starts above the top."""
        row = self.row[models]
        power, n = self.curve.power[row], self.curve.exponent[row]
        logit = _logit_of_log(-n * np.log(height))
        excess = np.maximum(self.curve.logit[0] - logit, 0.0)
        power = np.maximum(power, 1e-100)  # n = 1: the limit, -excess
        lead = np.exp(power * self.curve.logit[0]) * np.expm1(-power * excess) / (power * n)
        clock: FloatArray = (self.curve.time_at_logit(logit, row) + lead) / self.rate[models]
        return clock

    def _power_law(self, models: IntArray, height: FloatArray, travel: FloatArray) -> FloatArray:
        """Height while z^n drowns the one beside it: dz/dtau = -z^n."""
        order = np.maximum(self.curve.exponent[self.row[models]] - 1.0, 1e-100)[:, None]
        log_height = np.log(height)[:, None]
        time = np.maximum(travel * self.rate[models, None], 1e-300)
        # z^(1-n) grows linearly; by logarithms, so that no power overflows.
        log_growth = np.log(order) + order * log_height + np.log(time)
        return np.asarray(np.exp(log_height - np.logaddexp(0.0, log_growth) / order))


def _ceiling(alpha: FloatArray, slope: FloatArray, exponent: FloatArray) -> FloatArray:
    """(alpha / slope)^(1/n), or a value out of reach where that is larger; shape (models,)."""
    log_slope = np.log(np.where(slope > 0, slope, 1.0))
    log_ceiling = np.where(slope > 0, (np.log(alpha) - log_slope) / exponent, np.inf)
    return np.exp(np.minimum(log_ceiling, np.log(_FARTHEST_CEILING)))


def _graded_half(step: float) -> FloatArray:
    """Cell ends from w = 0 to the reach, wider outwards as what they resolve fades like e^-w."""
    ends = [0.0]
    while ends[-1] < _REACH:
        ends.append(ends[-1] + min(step * np.exp(ends[-1] / 8), _WIDEST))
    return np.array(ends)


def _widths(time: FloatArray) -> FloatArray:
    """Lengths of the cells; none is zero, though time may stand still between the last nodes."""
    return np.maximum(np.diff(time), 1e-290)


def _logit_of_log(log_y: FloatArray) -> FloatArray:
    """Return w = log(y / (1 - y)) from log y <= 0; y = 1 counts as just below one."""
    log_y = np.minimum(log_y, -1e-17)
    return np.asarray(log_y - np.log(-np.expm1(log_y)))


def _integral(
    left: FloatArray, right: FloatArray, power: FloatArray, exponent: FloatArray, sign: float
) -> FloatArray:
    """Time from logit `left` to `right` (arrays that broadcast with power and exponent)."""
    width = right - left
    w = (left + width / 2)[..., None] + width[..., None] * _NODES
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
