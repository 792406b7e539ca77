"""Fit a model from a mode nearby, with its evidence.

All coordinates have standard normal priors, so that Laplace's approximation of the evidence is

    log Z = log p(readings | z) − ½ |z|² + log room − ½ log det H,

with the curvature H of minus the log density at the mode z
(:mod:`~bwbayes.inference.mode_finding`). A fit takes some tens of simulations.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference import map_estimate, mode_finding
from bwbayes.inference.mode_finding import Target
from bwbayes.inference.posterior import Posterior
from bwbayes.watching import Watch, unwatched


@dataclass(frozen=True)
class LocalFit:
    """A mode of a posterior of one record: ``coordinates`` (free,).

    ``log_evidence`` and ``log_density`` in nats; ``covariance`` (free, free) has no correlation of
    noise and physical parameters; ``displacement`` (readings,) um, from the most probable start.
    """

    posterior: Posterior
    coordinates: FloatArray
    covariance: FloatArray
    log_density: float
    log_evidence: float
    displacement: FloatArray

    @property
    def free(self) -> FloatArray:
        """The model's free parameters (free,), in their own units."""
        free: FloatArray = self.posterior.prior.constrain(self.coordinates[np.newaxis])[0][0]
        return free

    @property
    def by_name(self) -> dict[str, float]:
        """The coordinates by the names of their parameters."""
        return dict(zip(self.posterior.names, self.coordinates.tolist(), strict=True))

    @property
    def rmse(self) -> float:
        """Root mean square of the readings minus the displacement, um."""
        residual = self.posterior.single_record.readings.values - self.displacement
        return float(np.sqrt(np.mean(residual**2)))

    @property
    def follows(self) -> bool:
        """True if its RMSE is below that of a constant: else the noise takes up the readings."""
        return self.rmse < float(np.std(self.posterior.single_record.readings.values))

    def distinct(self, places: Iterable[FloatArray]) -> FloatArray:
        """Return the fit's coordinates, and those places (free,) with another displacement.

        Places that differ in the noise alone are left out: a climb returns from them.
        """
        physical = Target(self.posterior).physical
        return map_estimate.distinct([self.coordinates, *places], self.covariance, physical)

    def error(self, windows: Sequence[slice]) -> float:
        """Return the root mean square of the residual in windows, um; nan without any."""
        if not windows:
            return np.nan
        record = self.posterior.single_record
        likelihood = self.posterior.likelihood
        theta = self.posterior.prior.theta(self.free[np.newaxis])
        start = likelihood.start(theta).mean if likelihood.unknowns else None
        model = likelihood.table.actuator(theta)
        missed = record.displacement - likelihood.simulate(model, record.inputs, start)[0]
        inside = np.concatenate([missed[window] for window in windows])
        return float(np.sqrt(np.nanmean(inside**2))) if np.isfinite(inside).any() else np.nan


def climb(
    posterior: Posterior,
    places: FloatArray,
    least: float = -np.inf,
    watch: Watch = unwatched,
) -> LocalFit:
    """Fit a posterior of one record from the best of several places (places, free) nearby.

    Two rounds from each of them, side by side, choose the best one. The climb ends when it gains
    so little that it would never reach a log density of ``least``. ``watch`` is called with the
    share that is done.
    """
    target = Target(posterior)
    state = mode_finding.climb(target, np.atleast_2d(places), least, watch=watch)
    covariance, log_determinant = target.covariance(state)
    displacement = state.displacement
    if posterior.likelihood.unknowns:
        # The climb's displacement is from rest, where the record may start moving.
        theta = posterior.prior.theta(posterior.prior.constrain(state.coordinates[np.newaxis])[0])
        displacement = posterior.simulate(theta, posterior.single_record.readings.rows)[0]
    return LocalFit(
        posterior,
        state.coordinates,
        covariance,
        state.density,
        state.density + log_determinant / 2,
        displacement,
    )
