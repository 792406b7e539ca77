"""Least squares of the physical parameters, from several starts side by side.

Its optima are where climbs to a posterior's modes begin: they do not depend on the noise, and are
cheap to find.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.linearization import value_and_jacobian
from bwbayes.watching import Watch, unwatched, watched

if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior


class LeastSquares:
    """Least squares in the coordinates of the physical parameters, with a weak pull to the prior.

    An impossible place has no residuals, and no step leads there. The noise parameters do not
    enter; they stay at the prior's median. Squares are those of the residuals, or of their
    ``steps`` from row to row: with a discrepancy that forgets slowly these are the ones that are
    independent, and where the first have one optimum they may have two.
    """

    def __init__(
        self, posterior: Posterior, center: FloatArray, spread: FloatArray, *, steps: bool
    ) -> None:
        self.posterior, self.center, self.spread, self.steps = posterior, center, spread, steps
        self.physical = np.array([n in posterior.table.physical for n in posterior.names])
        # More residuals would not move an optimum that is only to be found.
        stride = 1000 // len(posterior.datasets)
        training = [dataset.readings.rows for dataset in posterior.datasets]
        self.rows = [rows[:: max(rows.size // stride, 1)] for rows in training]
        total = sum(rows.size for rows in self.rows)
        self.size = total + np.count_nonzero(self.physical)
        self.targets, self.scales = [], []
        for dataset, rows in zip(posterior.datasets, self.rows, strict=True):
            self.targets.append(dataset.displacement[rows])
            # A hundredth of the range is about what a Bouc-Wen model misses.
            self.scales.append(0.01 * float(np.ptp(self.targets[-1])) * np.sqrt(total))

    def residuals(self, coordinates: FloatArray) -> FloatArray:
        """Residuals (models, rows + physical) at coordinates (models, free); nan if impossible."""
        free, density = self.posterior.prior.constrain(coordinates)
        possible = np.isfinite(density)
        if not possible.all():
            residuals = np.full((len(free), self.size), np.nan)
            if possible.any():
                residuals[possible] = self.residuals(coordinates[possible])
            return residuals
        theta = self.posterior.prior.theta(free)
        pull = ((coordinates - self.center) / self.spread)[:, self.physical]
        missed = [
            (self.posterior.simulate(theta, rows, dataset.name) - target) / scale
            for dataset, rows, target, scale in zip(
                self.posterior.datasets, self.rows, self.targets, self.scales, strict=True
            )
        ]
        if self.steps:
            missed = [np.diff(residual, axis=1, prepend=0.0) for residual in missed]
        return np.concatenate([*missed, 1e-2 * pull], axis=1)

    def costs(self, coordinates: FloatArray) -> FloatArray:
        """Sum of squares (models,)."""
        return np.sum(self.residuals(coordinates) ** 2, axis=1)

    def optima(
        self, starts: FloatArray, least: float = 1e-8, watch: Watch = unwatched
    ) -> FloatArray:
        """Return the coordinates (starts, free) of the optima that starts (starts, free) lead to.

        The last step is one that takes less than the ``least`` part of the sum of squares away.
        ``watch`` is called with the share of the most steps that is done.

        By Levenberg and Marquardt's steps, all starts side by side: to simulate a record for many
        models takes hardly longer than for one. Lengths are in spreads; the damping follows how
        much of the expected descent a step brings.

        Notes
        -----
        K. Madsen, H. B. Nielsen, O. Tingleff, Methods for Non-Linear Least Squares Problems,
        Technical University of Denmark (2004), algorithm 3.16.
        """
        optima = np.tile(self.center, (len(starts), 1))
        if not self.physical.any():
            return optima[:1]
        optima[:, self.physical] = starts[:, self.physical]
        residual, slopes = self._linearize(optima)
        costs = np.sum(residual**2, axis=1)
        curvature = slopes @ np.swapaxes(slopes, 1, 2)
        damping = 1e-3 * np.max(np.diagonal(curvature, axis1=1, axis2=2), axis=1)
        growth = np.full(len(starts), 2.0)
        moving = np.flatnonzero(np.isfinite(costs))
        unit, length = np.eye(slopes.shape[1]), self.spread[self.physical]
        for _ in watched(range(60), watch):
            if not moving.size:
                break
            gradient = slopes[moving] @ residual[moving, :, np.newaxis]
            damped = curvature[moving] + damping[moving, np.newaxis, np.newaxis] * unit
            step = -np.linalg.solve(damped, gradient)[:, :, 0]
            trial = optima[moving]
            trial[:, self.physical] += step * length
            tried, tried_slopes = self._linearize(trial)
            cost = np.sum(tried**2, axis=1)
            descent = costs[moving] - cost
            descends = descent > 0  # not where the place is impossible
            settled = np.linalg.norm(step, axis=1) < 1e-8
            settled |= descends & (descent < least * costs[moving])
            worse, better, step = moving[~descends], moving[descends], step[descends]
            damping[worse] *= growth[worse]
            growth[worse] *= 2.0
            expected = np.sum(
                step * (damping[better, np.newaxis] * step - gradient[descends, :, 0]), axis=1
            )
            gain = descent[descends] / expected
            damping[better] *= np.maximum(1 / 3, 1 - (2 * gain - 1) ** 3)
            growth[better] = 2.0
            optima[better], residual[better] = trial[descends], tried[descends]
            slopes[better], costs[better] = tried_slopes[descends], cost[descends]
            curvature[better] = slopes[better] @ np.swapaxes(slopes[better], 1, 2)
            moving = moving[~settled]
        return optima[np.isfinite(costs)]

    def _linearize(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (places, rows) and their slopes (places, physical, rows), per spread."""
        physical = np.flatnonzero(self.physical)
        residual, slopes = value_and_jacobian(self.residuals, places, physical)
        return residual, slopes * self.spread[physical, np.newaxis]
