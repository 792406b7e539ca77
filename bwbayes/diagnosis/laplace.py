"""Fit a model, or an extension of it, from a mode nearby, with its evidence.

All coordinates have standard normal priors, so that Laplace's approximation of the evidence is

    log Z = log p(readings | z) − ½ |z|² + log room − ½ log det H,

with the curvature H of minus the log density at the mode z
(:mod:`~bwbayes.inference.mode_finding`). A fit takes some tens of simulations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference import map_estimate, mode_finding
from bwbayes.inference.likelihood import Likelihood, batches
from bwbayes.inference.mode_finding import NOISE_STEPS, Target
from bwbayes.inference.posterior import Posterior
from bwbayes.watching import Watch, unwatched


def _same(series: FloatArray, _: FloatArray) -> FloatArray:
    return series


@dataclass(frozen=True)
class Effect:
    """An addition to a model, with sizes whose priors are standard normal.

    The actuator is driven by ``drive(voltage, sizes)`` (samples,), V, and what it does, (models,
    samples), um, is read as ``read(displacement, sizes)``, um, with one vector of sizes (sizes,);
    ``starts`` (starts, sizes) are those to climb from.
    """

    starts: FloatArray
    drive: Callable[[FloatArray, FloatArray], FloatArray] = _same
    read: Callable[[FloatArray, FloatArray], FloatArray] = _same

    def displacement(
        self, likelihood: Likelihood, model: FloatArray, voltage: FloatArray, sizes: FloatArray
    ) -> FloatArray:
        """Displacement (models, samples), um, of models (models, parameters of the actuator).

        Each has sizes of its own, (models, sizes). What they share is worked out once.
        """
        moved = np.empty((len(model), voltage.size))
        distinct, which = np.unique(sizes, axis=0, return_inverse=True)
        groups = [np.flatnonzero(which.ravel() == number) for number in range(len(distinct))]
        together = [np.arange(len(model))] if self.drive is _same else groups
        for rows in together:
            driven = replace(
                likelihood.inputs[: voltage.size], voltage=self.drive(voltage, sizes[rows[0]])
            )
            for batch in batches(rows.size, voltage.size):
                moved[rows[batch]] = likelihood.simulate(model[rows[batch]], driven)
        for rows in groups if self.read is not _same else ():
            moved[rows] = self.read(moved[rows], sizes[rows[0]])
        return moved


NONE = Effect(np.zeros((1, 0)))


@dataclass(frozen=True)
class LocalFit:
    """A mode of a posterior of one record: ``coordinates`` (free + sizes,), an effect's sizes last.

    ``log_evidence`` and ``log_density`` in nats; ``covariance`` (free + sizes, free + sizes) has no
    correlation of noise and physical parameters; ``displacement`` (readings,) um.
    """

    posterior: Posterior
    effect: Effect
    coordinates: FloatArray
    covariance: FloatArray
    log_density: float
    log_evidence: float
    displacement: FloatArray

    @property
    def free(self) -> FloatArray:
        """The model's free parameters (free,), in their own units."""
        coordinates = self.coordinates[np.newaxis, : len(self.posterior.names)]
        free: FloatArray = self.posterior.prior.constrain(coordinates)[0][0]
        return free

    @property
    def sizes(self) -> FloatArray:
        """The effect's sizes (sizes,), in prior sds."""
        return self.coordinates[len(self.posterior.names) :]

    @property
    def rmse(self) -> float:
        """Root mean square of readings less displacement, um."""
        residual = self.posterior.single_record.readings.values - self.displacement
        return float(np.sqrt(np.mean(residual**2)))

    @property
    def follows(self) -> bool:
        """Whether it misses less than a constant would: else the noise takes up the readings."""
        return self.rmse < float(np.std(self.posterior.single_record.readings.values))

    def distinct(self, places: Iterable[FloatArray]) -> FloatArray:
        """Return where it is, and those places (free,) where the displacement is another one.

        To those of its noise alone a climb finds back.
        """
        physical = Target(self.posterior).physical
        return map_estimate.distinct([self.coordinates, *places], self.covariance, physical)

    def error(self, windows: Sequence[slice]) -> float:
        """Root mean square, um, of what it misses of the readings in windows; nan of none."""
        if not windows:
            return np.nan
        record = self.posterior.single_record
        likelihood = self.posterior.likelihood
        model = likelihood.table.actuator(self.posterior.prior.theta(self.free[np.newaxis]))
        sizes = self.sizes[np.newaxis]
        missed = record.displacement
        missed = missed - self.effect.displacement(likelihood, model, record.voltage, sizes)[0]
        inside = np.concatenate([missed[window] for window in windows])
        return float(np.sqrt(np.nanmean(inside**2))) if np.isfinite(inside).any() else np.nan


def climb(
    posterior: Posterior,
    places: FloatArray,
    effect: Effect = NONE,
    least: float = -np.inf,
    watch: Watch = unwatched,
) -> LocalFit:
    """Fit from the best of coordinates (places, free) of a posterior of one record nearby.

    Two rounds from each of them, with each of an effect's starts, side by side, tell which one
    leads. The climb ends where it gains so little that it would never reach a log density of
    ``least``. ``watch`` is called with the share that is done.
    """
    target = _EffectTarget(posterior, effect)
    starts = [np.concatenate(pair) for pair in product(np.atleast_2d(places), effect.starts)]
    # An effect has many starts, and few of them lead far.
    steps = NOISE_STEPS if effect is NONE else 2
    state = mode_finding.climb(target, np.stack(starts), least, steps, watch)
    covariance, log_determinant = target.covariance(state)
    return LocalFit(
        posterior,
        effect,
        state.coordinates,
        covariance,
        state.density,
        state.density + log_determinant / 2,
        state.displacement,
    )


@dataclass(frozen=True)
class _EffectTarget(Target):
    """The log density of a model with an effect; coordinates are the model's, then the sizes."""

    effect: Effect

    @property
    def size(self) -> int:
        return len(self.posterior.names) + int(self.effect.starts.shape[1])

    def prior(self, coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        theta, density = super().prior(coordinates[:, : len(self.posterior.names)])
        return theta, density - 0.5 * np.sum(self._sizes(coordinates) ** 2, axis=1)

    def simulate(
        self, theta: FloatArray, log_prior: FloatArray, coordinates: FloatArray
    ) -> FloatArray:
        if self.effect is NONE:
            return super().simulate(theta, log_prior, coordinates)
        likelihood, possible = self.posterior.likelihood, np.isfinite(log_prior)
        readings = likelihood.readings
        moved = np.full((len(theta), readings.rows.size), np.nan)
        if possible.any():
            model, sizes = likelihood.table.actuator(theta), self._sizes(coordinates)
            voltage = likelihood.voltage[: readings.samples]
            moved[possible] = self.effect.displacement(
                likelihood, model[possible], voltage, sizes[possible]
            )[:, readings.where]
        return moved

    def _sizes(self, coordinates: FloatArray) -> FloatArray:
        """Return the effect's sizes (models, sizes)."""
        return coordinates[:, len(self.posterior.names) :]
