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
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.posterior import Posterior

__all__ = ["Effect", "LocalFit", "Simulate", "climb"]

# Steps of the finite differences: in the noise's coordinates, whose posterior sds are hundredths of
# the prior's, and in those of the simulation, which has no noise but rounding.
NOISE_STEP, STEP = 2e-2, 1e-4

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


@dataclass(frozen=True)
class LocalFit:
    """A mode of a posterior of one record, with an effect's sizes behind its coordinates.

    ``coordinates`` (free + sizes,); ``log_evidence`` and ``log_density`` in nats; ``covariance``
    (free + sizes, free + sizes) has no correlation of noise and physical parameters;
    ``displacement`` (readings,) um.
    """

    posterior: Posterior
    effect: Effect | None
    coordinates: FloatArray
    covariance: FloatArray
    log_density: float
    log_evidence: float
    displacement: FloatArray

    @property
    def sizes(self) -> FloatArray:
        """The effect's sizes (sizes,), in prior sds."""
        return self.coordinates[len(self.posterior.names) :]

    @property
    def theta(self) -> FloatArray:
        """The model's parameters (1, parameters)."""
        free = self.coordinates[np.newaxis, : len(self.posterior.names)]
        return self.posterior.prior.theta(self.posterior.prior.constrain(free)[0])

    @property
    def residual(self) -> FloatArray:
        """Readings less displacement (readings,), um."""
        return self.posterior.only.readings.values - self.displacement

    @property
    def rmse(self) -> float:
        """Root mean square of the residual, um."""
        return float(np.sqrt(np.mean(self.residual**2)))

    def error(self, windows: Sequence[slice]) -> float:
        """Root mean square, um, of what it misses of the readings in windows; nan of none."""
        simulated = _Target(self.posterior, self.effect).simulated(self.theta, self.sizes)[0]
        missed = self.posterior.only.displacement - simulated
        inside = np.concatenate([np.empty(0), *(missed[window] for window in windows)])
        return float(np.sqrt(np.nanmean(inside**2))) if np.isfinite(inside).any() else np.nan


def climb(
    posterior: Posterior, places: FloatArray, effect: Effect | None = None, least: float = -np.inf
) -> LocalFit:
    """Fit from the best of coordinates (places, free) of a posterior of one record nearby.

    Two rounds from each of them, with each of an effect's starts, tell which one leads. The climb
    ends where it gains so little that it would never reach a log density of ``least``.
    """
    target = _Target(posterior, effect)
    starts = np.zeros((1, 0)) if effect is None else effect.starts
    states = [target.at(np.concatenate(pair)) for pair in product(np.atleast_2d(places), starts)]
    states = [target.climb(state, 2, least) for state in states if np.isfinite(state.density)]
    best = max(states, key=lambda state: state.density)
    return target.fitted(target.climb(best, ROUNDS, least))


@dataclass(frozen=True)
class _State:
    """Coordinates, their log density without the constant, and the displacement there."""

    coordinates: FloatArray
    density: float
    displacement: FloatArray


class _Target:
    """The log density of a model with an effect, and steps up to its mode."""

    def __init__(self, posterior: Posterior, effect: Effect | None) -> None:
        self.posterior, self.effect = posterior, effect
        self.likelihood: Likelihood = posterior.likelihood
        self.free = len(posterior.names)
        noise = np.array([name not in posterior.table.physical for name in posterior.names])
        extra = 0 if effect is None else effect.starts.shape[1]
        self.noise = np.flatnonzero(noise)
        self.physical = np.concatenate([np.flatnonzero(~noise), self.free + np.arange(extra)])

    def prior(self, coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """θ (models, parameters) and log prior (models,) of coordinates (models, free + sizes)."""
        free, density = self.posterior.prior.constrain(coordinates[:, : self.free])
        sizes = coordinates[:, self.free :]
        return self.posterior.prior.theta(free), density - 0.5 * np.sum(sizes**2, axis=1)

    def displacement(self, theta: FloatArray, sizes: FloatArray) -> FloatArray:
        """Displacement (models, readings) of models that all have the same sizes (sizes,)."""
        readings = self.likelihood.readings
        return self.simulated(theta, sizes, readings.samples)[:, readings.where]

    def simulated(
        self, theta: FloatArray, sizes: FloatArray, samples: int | None = None
    ) -> FloatArray:
        """Displacement (models, samples) along the record, or its first samples."""
        likelihood = self.likelihood
        simulate = partial(likelihood.simulate, likelihood.table.actuator(theta))
        voltage = likelihood.voltage[:samples]
        if self.effect is None:
            return simulate(voltage)
        return self.effect.apply(simulate, voltage, sizes)

    def at(self, coordinates: FloatArray) -> _State:
        """Return the state at coordinates (free + sizes,)."""
        theta, prior = self.prior(coordinates[np.newaxis])
        if not np.isfinite(prior[0]):
            return _State(coordinates, -np.inf, np.empty(0))
        moved = self.displacement(theta, coordinates[self.free :])
        score = self.likelihood.score(theta, np.empty((0, moved.shape[1])), moved)
        density = float(score.log_density[0] + prior[0])
        return _State(coordinates, density if np.isfinite(density) else -np.inf, moved[0])

    def climb(self, state: _State, rounds: int, least: float) -> _State:
        """Climb for so many rounds at most, as long as these may reach ``least``."""
        for _ in range(rounds):
            before = state.density
            state = self._with_noise(state)
            state = self._with_physics(state)
            if state.density < before + max(GAIN, (least - state.density) / ROUNDS):
                break
        return state

    def fitted(self, state: _State) -> LocalFit:
        """Put the evidence together."""
        covariance = np.eye(state.coordinates.size)
        log_volume = 0.0
        for places, curvature in (
            (self.physical, self._curvature(state)[1]),
            (self.noise, self._noise_curvature(state)[1]),
        ):
            values, vectors = np.linalg.eigh(curvature)
            values = np.maximum(values, 1.0 if places is self.physical else 1e-2)
            covariance[np.ix_(places, places)] = (vectors / values) @ vectors.T
            log_volume -= 0.5 * float(np.sum(np.log(values)))
        return LocalFit(
            self.posterior,
            self.effect,
            state.coordinates,
            covariance,
            state.density,
            state.density + log_volume,
            state.displacement,
        )

    def _with_physics(self, state: _State) -> _State:
        """Step in the physical coordinates and the sizes, by Fisher scoring."""
        slope, curvature = self._curvature(state)
        step = np.linalg.solve(curvature, slope)
        for fraction in FRACTIONS:
            coordinates = state.coordinates.copy()
            coordinates[self.physical] += fraction * step
            tried = self.at(coordinates)
            if tried.density > state.density:
                return tried
        return state

    def _curvature(self, state: _State) -> tuple[FloatArray, FloatArray]:
        """Slope and curvature of the log density in the physical coordinates."""
        theta, _ = self.prior(state.coordinates[np.newaxis])
        score = self.likelihood.score(theta, self._slopes(state), state.displacement[np.newaxis])
        slope = score.pull[0] - state.coordinates[self.physical]
        return slope, score.information[0] + np.eye(slope.size)

    def _slopes(self, state: _State) -> FloatArray:
        """Slopes (physical, readings) of the displacement, um."""
        free = self.physical[self.physical < self.free]
        sizes = state.coordinates[self.free :]
        steps = np.zeros((free.size, state.coordinates.size))
        steps[np.arange(free.size), free] = STEP
        sides = state.coordinates + np.concatenate([steps, -steps])
        theta, prior = self.prior(sides)
        possible = np.isfinite(prior)
        moved = np.tile(state.displacement, (len(sides), 1))
        if possible.any():
            moved[possible] = self.displacement(theta[possible], sizes)
        width = STEP * np.maximum(np.sum(possible.reshape(2, -1), axis=0), 1)
        slopes = (moved[: free.size] - moved[free.size :]) / width[:, np.newaxis]
        here = self.prior(state.coordinates[np.newaxis])[0]
        extra = [
            (self.displacement(here, sizes + step)[0] - self.displacement(here, sizes - step)[0])
            / (2 * STEP)
            for step in STEP * np.eye(sizes.size)
        ]
        return np.concatenate([slopes, *(slope[np.newaxis] for slope in extra)])

    def _noise_densities(self, state: _State, steps: FloatArray) -> FloatArray:
        """Log density (models,) with steps (models, noise) in the noise's coordinates."""
        coordinates = np.tile(state.coordinates, (len(steps), 1))
        coordinates[:, self.noise] += steps
        theta, density = self.prior(coordinates)
        possible = np.isfinite(density)
        moved = np.broadcast_to(state.displacement, (int(possible.sum()), state.displacement.size))
        shapes = np.empty((0, moved.shape[1]))
        density[possible] += self.likelihood.score(theta[possible], shapes, moved).log_density
        return np.where(np.isfinite(density), density, -1e12)

    def _noise_curvature(self, state: _State) -> tuple[FloatArray, FloatArray]:
        size = self.noise.size
        if not size:
            return np.zeros(0), np.zeros((0, 0))
        single = NOISE_STEP * np.eye(size)
        first, second = np.tril_indices(size, -1)
        pairs = single[first] + single[second]
        steps = np.concatenate([single, -single, pairs, -pairs])
        densities = self._noise_densities(state, steps) - state.density
        plus, minus, forth, back = np.split(densities, [size, 2 * size, 2 * size + first.size])
        curvature = np.diag(-(plus + minus)) / NOISE_STEP**2
        cross = -(forth + back - plus[first] - plus[second] - minus[first] - minus[second])
        curvature[first, second] = curvature[second, first] = cross / (2 * NOISE_STEP**2)
        return (plus - minus) / (2 * NOISE_STEP), curvature

    def _with_noise(self, state: _State) -> _State:
        """Step in the noise's coordinates, by Newton's method where the density bends down."""
        if not self.noise.size:
            return state
        for _ in range(6):
            slope, curvature = self._noise_curvature(state)
            values, vectors = np.linalg.eigh(curvature)
            step = vectors @ ((vectors.T @ slope) / np.maximum(np.abs(values), 1.0))
            step /= max(1.0, float(np.max(np.abs(step))) / 0.5)
            steps = FRACTIONS[:, np.newaxis] * step
            densities = self._noise_densities(state, steps)
            best = int(np.argmax(densities))
            if densities[best] <= state.density + GAIN / 4:
                break
            coordinates = state.coordinates.copy()
            coordinates[self.noise] += steps[best]
            state = _State(coordinates, float(densities[best]), state.displacement)
        return state
