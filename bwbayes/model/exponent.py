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
from bwbayes.model.exponent_curves import MasterCurve, cells_of, logit_of_log, widths

__all__ = ["ExponentFlow"]

# Beyond this the ceiling is out of every stretch's reach, and its powers are still finite.
_FARTHEST_CEILING = 1e100
# Elements worked on at once, so that the intermediate arrays stay in the processor's cache.
_BLOCK = 16384


class ExponentFlow:
    """The flow of dg/dv = alpha - beta g |g|^(n-1) - gamma |g|^n along monotone stretches.

    Equation (6) of the paper with a general exponent: v = |u - u0| is the voltage traveled since
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
            Voltage traveled |u - u0| in V: ascending, zero or above.

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
    def _rising(self) -> MasterCurve:
        """From zero up to the ceiling: dz/dtau = 1 - z^n, the time counted from z = 0."""
        return MasterCurve.inside(self._exponent, 1.0)

    @cached_property
    def _relaxing(self) -> MasterCurve:
        """From one down to zero, dz/dtau = -(1 + z^n), the time counted back from z = 0."""
        return MasterCurve.inside(self._exponent, -1.0)

    @cached_property
    def _fall_above(self) -> _Fall:
        """From above down to the ceiling: dz/dtau = 1 - z^n."""
        return _Fall(MasterCurve.outside(self._exponent, 1.0), self._row, self._up_rate)

    @cached_property
    def _fall_below(self) -> _Fall:
        """From above down to one: dz/dtau = -(1 + z^n)."""
        return _Fall(MasterCurve.outside(self._exponent, -1.0), self._row, self._down_rate)

    @property
    def scales(self) -> tuple[FloatArray, FloatArray]:
        """The ceilings (models,) that z is in units of below zero and above, um."""
        return self._down, self._up

    def table(self) -> FloatArray:
        """Curves through z = 0 by themselves, (models, 2, 4 + 8, cells), for what goes in steps.

        That of rising, dz/dτ = 1 − zⁿ, and the one that g < 0 is on, backwards. In each cell are
        the time and the height at its beginning, the anchor and width of the polynomials' variable
        (:class:`_Pieces`), and their coefficients. There is a power of two of cells; those to spare
        begin at infinity.
        """
        rising, relaxing = cells_of(self._rising), cells_of(self._relaxing)
        highest = float(np.max((self._up / self._down)[self._softening], initial=0.0))
        if highest > 1:
            fall = MasterCurve.outside(self._exponent, -1.0)
            first = int(np.searchsorted(-fall.coefficients[0].max(axis=0), -highest))
            relaxing = np.concatenate(
                (
                    relaxing,
                    cells_of(fall, self._relaxing.time[:, -1:])[..., : fall.logit.size - first],
                ),
                axis=2,
            )
        longest = max(rising.shape[2], relaxing.shape[2])
        curves = np.zeros((self._row.size, 2, 12, 1 << (longest - 1).bit_length()))
        curves[:, :, :2] = np.inf
        curves[:, 0, :, : rising.shape[2]] = rising[self._row]
        soft = np.flatnonzero(self._softening)
        curves[:, 1] = curves[:, 0]
        curves[soft, 1, :, : relaxing.shape[2]] = relaxing[self._row[soft]]
        return curves

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
            widths=np.hstack((-widths(before)[:, ::-1], widths(after))),
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
class _Fall:
    """Models that start above z = 1 and come down, all models on row[i] of the curve.

    row, rate : shape (models,); the rate is that of tau, in 1/V
    """

    curve: MasterCurve
    row: IntArray
    rate: FloatArray

    @cached_property
    def _pieces(self) -> _Pieces:
        """The curve in each model's own time in V, counted from the curve's top."""
        time = self.curve.time[self.row] / self.rate[:, None]
        return _Pieces(
            knots=time[:, :-1],
            anchors=time[:, :-1],
            widths=widths(time),
            coefficients=self.curve.coefficients[:, self.row],
        )

    def duration(self, models: IntArray, height: FloatArray) -> FloatArray:
        """Voltage (V) from height z0 (rows,) down to z = 1 for these models (rows,)."""
        total = self.curve.time[self.row[models], -1] / self.rate[models]
        descent: FloatArray = total - self._clock(models, height)
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
        logit = logit_of_log(-n * np.log(height))
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
