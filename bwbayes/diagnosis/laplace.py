"""Fit a model, or an extension of it, from a mode nearby, with its evidence.

The physical parameters enter the displacement, the noise's parameters do not, so that at the mode
the information about the two separates: Fisher scoring climbs in the physical ones with the slopes
of the simulation, Newton steps in the noise's ones with the residual as it is, until neither gains.
All coordinates have standard normal priors, so that Laplace's approximation of the evidence is

    log Z = log p(readings | z) − ½ |z|² + log room − ½ log det H,

with the curvature H of minus the log density at the mode z. A fit takes some tens of simulations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.likelihood import batches
from bwbayes.inference.posterior import Posterior

# A round that gains less, nats, is the last one; and rounds at most.
GAIN, ROUNDS = 0.05, 20

# Parts of a step that are tried.
FRACTIONS = 0.5 ** np.arange(8)

# What simulates a voltage (samples,): displacements (models, samples), um, from rest.
Simulate = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Effect:
    """An addition to a model, with sizes whose priors are standard normal.

    ``apply(simulate, voltage, sizes)`` returns the displacement (models, samples), um, of models
    that all have these sizes (sizes,); ``starts`` (starts, sizes) are those to climb from.
    """

    apply: Callable[[Simulate, FloatArray, FloatArray], FloatArray]
    starts: FloatArray


NONE = Effect(lambda simulate, voltage, _: simulate(voltage), np.zeros((1, 0)))


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
        residual = self.posterior.only.readings.values - self.displacement
        return float(np.sqrt(np.mean(residual**2)))

    @property
    def follows(self) -> bool:
        """Whether it misses less than a constant would: else the noise takes up the readings."""
        return self.rmse < float(np.std(self.posterior.only.readings.values))

    def error(self, windows: Sequence[slice]) -> float:
        """Root mean square, um, of what it misses of the readings in windows; nan of none."""
        if not windows:
            return np.nan
        record = self.posterior.only
        likelihood = self.posterior.likelihood
        model = likelihood.table.actuator(self.posterior.prior.theta(self.free[np.newaxis]))
        simulate = partial(likelihood.simulate, model)
        missed = record.displacement - self.effect.apply(simulate, record.voltage, self.sizes)[0]
        inside = np.concatenate([missed[window] for window in windows])
        return float(np.sqrt(np.nanmean(inside**2))) if np.isfinite(inside).any() else np.nan


def climb(
    posterior: Posterior, places: FloatArray, effect: Effect = NONE, least: float = -np.inf
) -> LocalFit:
    """Fit from the best of coordinates (places, free) of a posterior of one record nearby.

    Two rounds from each of them, with each of an effect's starts, tell which one leads. The climb
    ends where it gains so little that it would never reach a log density of ``least``.
    """
    target = _Target(posterior, effect, least)
    starts = [np.concatenate(pair) for pair in product(np.atleast_2d(places), effect.starts)]
    climbed = [target.climb(target.at(start), 2) for start in starts]
    return target.fitted(target.climb(max(climbed, key=lambda state: state.density), ROUNDS))


@dataclass(frozen=True)
class _State:
    """Where a climb is: coordinates (free + sizes,), log density, displacement (readings,)."""

    coordinates: FloatArray
    density: float
    displacement: FloatArray


@dataclass(frozen=True)
class _Target:
    """The log density of a model with an effect, and steps up to its mode."""

    posterior: Posterior
    effect: Effect
    least: float = -np.inf

    @property
    def free(self) -> int:
        """How many of the coordinates are the model's, the first ones."""
        return len(self.posterior.names)

    @cached_property
    def noise(self) -> IntArray:
        """Which coordinates are those of the noise's parameters."""
        physical = self.posterior.table.physical
        return np.flatnonzero([name not in physical for name in self.posterior.names])

    @cached_property
    def physical(self) -> IntArray:
        """Which coordinates move the displacement."""
        return np.setdiff1d(np.arange(self.free + self.effect.starts.shape[1]), self.noise)

    def prior(self, coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """θ (models, parameters) and log prior (models,) of coordinates (models, free + sizes)."""
        free, density = self.posterior.prior.constrain(coordinates[:, : self.free])
        sizes = coordinates[:, self.free :]
        return self.posterior.prior.theta(free), density - 0.5 * np.sum(sizes**2, axis=1)

    def displacement(self, theta: FloatArray, coordinates: FloatArray) -> FloatArray:
        """Displacement (models, readings), um, of θ and coordinates that are possible."""
        likelihood = self.posterior.likelihood
        readings = likelihood.readings
        voltage = likelihood.voltage[: readings.samples]
        moved = np.empty((len(theta), readings.rows.size))
        # An effect is worked out once for all models that have the same sizes.
        distinct, which = np.unique(coordinates[:, self.free :], axis=0, return_inverse=True)
        for number, sizes in enumerate(distinct):
            models = np.flatnonzero(which.ravel() == number)
            for batch in batches(models.size, voltage.size):
                rows = models[batch]
                model = likelihood.table.actuator(theta[rows])
                simulate = partial(likelihood.simulate, model)
                moved[rows] = self.effect.apply(simulate, voltage, sizes)[:, readings.where]
        return moved

    def density(
        self, theta: FloatArray, log_prior: FloatArray, displacement: FloatArray
    ) -> FloatArray:
        """Log density (models,), less a constant, where the displacement (readings,) is known."""
        possible, density = np.isfinite(log_prior), log_prior.copy()
        likelihood, theta = self.posterior.likelihood, theta[possible]
        readings = likelihood.readings
        if not possible.any():
            return density
        if likelihood.engine == "numba" and 2 * readings.rows.size > readings.samples:
            # To simulate again is faster than to pass whitened series through the memory. What an
            # effect does to the displacement is taken from the readings.
            plain = displacement
            if self.effect is not NONE:
                model = likelihood.table.actuator(theta[:1])
                voltage = likelihood.voltage[: readings.samples]
                plain = likelihood.simulate(model, voltage)[0, readings.where]
            readings = replace(readings, values=readings.values + (plain - displacement))
            density[possible] += replace(likelihood, readings=readings).log_density(theta)
        else:
            moved = np.tile(displacement, (len(theta), 1))
            density[possible] += likelihood.score(theta, moved[:0], moved).log_density
        return np.where(np.isfinite(density), density, -np.inf)

    def at(self, coordinates: FloatArray) -> _State:
        """Return the state at the coordinates (free + sizes,)."""
        theta, density = self.prior(coordinates[np.newaxis])
        moved = np.zeros((1, self.posterior.likelihood.readings.rows.size))
        if np.isfinite(density).all():
            moved = self.displacement(theta, coordinates[np.newaxis])
            density = self.density(theta, density, moved[0])
        return _State(coordinates, float(density[0]), moved[0])

    def climb(self, state: _State, rounds: int) -> _State:
        """Climb for so many rounds at most, as long as these may reach ``least``."""
        for _ in range(rounds if np.isfinite(state.density) else 0):
            before, state = state.density, self._step_noise(state)
            # In the physical coordinates and the sizes, by Fisher scoring.
            slope, curvature = self._physical_bend(state)
            step = np.zeros(state.coordinates.size)
            step[self.physical] = np.linalg.solve(curvature, slope)
            tried = (self.at(state.coordinates + fraction * step) for fraction in FRACTIONS)
            state = next((ahead for ahead in tried if ahead.density > state.density), state)
            if state.density < before + max(GAIN, (self.least - state.density) / ROUNDS):
                break
        return state

    def fitted(self, state: _State) -> LocalFit:
        """Put the evidence at a mode together."""
        log_evidence, covariance = state.density, np.eye(state.coordinates.size)
        # What the record does not tell keeps its prior; the noise's bend is a finite difference.
        parts = (
            (self.physical, self._physical_bend, 1.0),
            (self.noise, self._noise_bend, 1e-2),
        )
        # A model that is possible at none of its starts has no evidence, and no curvature.
        for rows, bend, flattest in parts if np.isfinite(state.density) else ():
            curvature = bend(state)[1]
            values, vectors = np.linalg.eigh(curvature)
            values = np.maximum(values, flattest)
            covariance[np.ix_(rows, rows)] = (vectors / values) @ vectors.T
            log_evidence -= 0.5 * float(np.sum(np.log(values)))
        return LocalFit(
            self.posterior,
            self.effect,
            state.coordinates,
            covariance,
            state.density,
            log_evidence,
            state.displacement,
        )

    def _physical_bend(self, state: _State) -> tuple[FloatArray, FloatArray]:
        """Slope and curvature of the log density in the physical coordinates."""
        step = 1e-4  # a simulation has no noise but rounding
        steps = step * np.eye(state.coordinates.size)[self.physical]
        sides = state.coordinates + np.concatenate([steps, -steps])
        theta, log_prior = self.prior(np.concatenate([state.coordinates[np.newaxis], sides]))
        possible = np.isfinite(log_prior[1:])
        moved = np.tile(state.displacement, (len(sides), 1))
        moved[possible] = self.displacement(theta[1:][possible], sides[possible])
        forth, back = np.split(moved, 2)
        width = step * np.maximum(np.sum(possible.reshape(2, -1), axis=0), 1)
        slopes, here = (forth - back) / width[:, np.newaxis], state.displacement[np.newaxis]
        score = self.posterior.likelihood.score(theta[:1], slopes, here)
        slope = score.pull[0] - state.coordinates[self.physical]
        return slope, score.information[0] + np.eye(len(steps))

    def _step_noise(self, state: _State) -> _State:
        """Step in the noise's coordinates, by Newton's method where the density bends down."""
        for _ in range(6 if self.noise.size else 0):
            slope, curvature = self._noise_bend(state)
            values, vectors = np.linalg.eigh(curvature)
            step = vectors @ (vectors.T @ slope / np.maximum(np.abs(values), 1.0))
            step /= max(1.0, float(np.max(np.abs(step))) / 0.5)
            steps = FRACTIONS[:, np.newaxis] * step
            gains = self._noise_gains(state, steps)
            best = int(np.argmax(gains))
            if gains[best] <= GAIN / 4:
                break
            coordinates = state.coordinates.copy()
            coordinates[self.noise] += steps[best]
            state = _State(coordinates, state.density + float(gains[best]), state.displacement)
        return state

    def _noise_gains(self, state: _State, steps: FloatArray) -> FloatArray:
        """By how much steps (steps, noise) in the noise's coordinates raise the log density."""
        coordinates = np.tile(state.coordinates, (len(steps), 1))
        coordinates[:, self.noise] += steps
        density = self.density(*self.prior(coordinates), state.displacement)
        return np.maximum(density, -1e12) - state.density

    def _noise_bend(self, state: _State) -> tuple[FloatArray, FloatArray]:
        """Slope and curvature of the log density in the noise's coordinates."""
        step = 2e-2  # the posterior's sds are hundredths of the prior's, which are one
        size, (i, j) = self.noise.size, np.tril_indices(self.noise.size, -1)
        single = step * np.eye(size)
        # Along each coordinate, then along each two of them.
        steps = np.concatenate([single, single[i] + single[j]])
        plus, minus = np.split(self._noise_gains(state, np.concatenate([steps, -steps])), 2)
        bend = plus + minus
        curvature = np.diag(bend[:size])
        curvature[i, j] = curvature[j, i] = (bend[size:] - bend[i] - bend[j]) / 2
        return (plus - minus)[:size] / (2 * step), -curvature / step**2
