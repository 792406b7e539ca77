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
from itertools import combinations, product

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.posterior import Posterior

__all__ = ["NONE", "Effect", "LocalFit", "Simulate", "climb"]

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

    def error(self, windows: Sequence[slice]) -> float:
        """Root mean square, um, of what it misses of the readings in windows; nan of none."""
        record = self.posterior.only
        simulated = _Target(self.posterior, self.effect).simulate(self.coordinates[np.newaxis])[0]
        missed = record.displacement - simulated
        inside = np.concatenate([np.empty(0), *(missed[window] for window in windows)])
        return float(np.sqrt(np.nanmean(inside**2))) if np.isfinite(inside).any() else np.nan


def climb(
    posterior: Posterior, places: FloatArray, effect: Effect = NONE, least: float = -np.inf
) -> LocalFit:
    """Fit from the best of coordinates (places, free) of a posterior of one record nearby.

    Two rounds from each of them, with each of an effect's starts, tell which one leads. The climb
    ends where it gains so little that it would never reach a log density of ``least``.
    """
    target = _Target(posterior, effect)
    starts = [np.concatenate(pair) for pair in product(np.atleast_2d(places), effect.starts)]
    states = [target.climb(target.at(start), 2, least) for start in starts]
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

    def __init__(self, posterior: Posterior, effect: Effect) -> None:
        self.posterior, self.effect, self.likelihood = posterior, effect, posterior.likelihood
        self.free = len(posterior.names)
        noise = np.array([name not in posterior.table.physical for name in posterior.names])
        sizes = self.free + np.arange(effect.starts.shape[1])
        self.noise = np.flatnonzero(noise)
        self.physical = np.concatenate([np.flatnonzero(~noise), sizes])

    def prior(self, coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """θ (models, parameters) and log prior (models,) of coordinates (models, free + sizes)."""
        free, density = self.posterior.prior.constrain(coordinates[:, : self.free])
        sizes = coordinates[:, self.free :]
        return self.posterior.prior.theta(free), density - 0.5 * np.sum(sizes**2, axis=1)

    def simulate(self, coordinates: FloatArray, samples: int | None = None) -> FloatArray:
        """Displacement (models, samples) along the record, or its first samples."""
        theta, _ = self.prior(coordinates)
        voltage = self.likelihood.voltage[:samples]
        moved = np.empty((len(theta), voltage.size))
        # An effect is worked out once for all models that have the same sizes.
        every, which = np.unique(coordinates[:, self.free :], axis=0, return_inverse=True)
        for number, sizes in enumerate(every):
            rows = np.flatnonzero(which.ravel() == number)
            model = self.likelihood.table.actuator(theta[rows])
            simulate = partial(self.likelihood.simulate, model)
            moved[rows] = self.effect.apply(simulate, voltage, sizes)
        return moved

    def displacement(self, coordinates: FloatArray) -> FloatArray:
        """Displacement (models, readings), um."""
        readings = self.likelihood.readings
        return self.simulate(coordinates, readings.samples)[:, readings.where]

    def at(self, coordinates: FloatArray) -> _State:
        """Return the state at coordinates (free + sizes,)."""
        theta, prior = self.prior(coordinates[np.newaxis])
        if not np.isfinite(prior[0]):
            return _State(coordinates, -np.inf, np.empty(0))
        moved = self.displacement(coordinates[np.newaxis])
        score = self.likelihood.score(theta, np.empty((0, moved.shape[1])), moved)
        density = float(score.log_density[0] + prior[0])
        return _State(coordinates, density if np.isfinite(density) else -np.inf, moved[0])

    def climb(self, state: _State, rounds: int, least: float) -> _State:
        """Climb for so many rounds at most, as long as these may reach ``least``."""
        if not np.isfinite(state.density):
            return state
        for _ in range(rounds):
            before = state.density
            state = self._with_physics(self._with_noise(state))
            if state.density < before + max(GAIN, (least - state.density) / ROUNDS):
                break
        return state

    def fitted(self, state: _State) -> LocalFit:
        """Put the evidence together."""
        covariance, log_evidence = np.eye(state.coordinates.size), state.density
        # What the record does not tell keeps its prior; the noise's bend is a finite difference.
        for places, curvature, flattest in (
            (self.physical, self._physical_bend(state)[1], 1.0),
            (self.noise, self._noise_bend(state)[1], 1e-2),
        ):
            values, vectors = np.linalg.eigh(curvature)
            values = np.maximum(values, flattest)
            covariance[np.ix_(places, places)] = (vectors / values) @ vectors.T
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

    def _with_physics(self, state: _State) -> _State:
        """Step in the physical coordinates and the sizes, by Fisher scoring."""
        slope, curvature = self._physical_bend(state)
        step = np.linalg.solve(curvature, slope)
        for fraction in FRACTIONS:
            coordinates = state.coordinates.copy()
            coordinates[self.physical] += fraction * step
            tried = self.at(coordinates)
            if tried.density > state.density:
                return tried
        return state

    def _physical_bend(self, state: _State, step: float = 1e-4) -> tuple[FloatArray, FloatArray]:
        """Slope and curvature of the log density in the physical coordinates.

        ``step`` may be small: a simulation has no noise but rounding.
        """
        steps = step * np.eye(state.coordinates.size)[self.physical]
        sides = np.concatenate([state.coordinates + steps, state.coordinates - steps])
        possible = np.isfinite(self.prior(sides)[1])
        moved = np.tile(state.displacement, (len(sides), 1))
        moved[possible] = self.displacement(sides[possible])
        width = step * np.maximum(np.sum(possible.reshape(2, -1), axis=0), 1)
        slopes = (moved[: len(steps)] - moved[len(steps) :]) / width[:, np.newaxis]
        theta, _ = self.prior(state.coordinates[np.newaxis])
        score = self.likelihood.score(theta, slopes, state.displacement[np.newaxis])
        slope = score.pull[0] - state.coordinates[self.physical]
        return slope, score.information[0] + np.eye(slope.size)

    def _with_noise(self, state: _State) -> _State:
        """Step in the noise's coordinates, by Newton's method where the density bends down."""
        for _ in range(6 if self.noise.size else 0):
            slope, curvature = self._noise_bend(state)
            values, vectors = np.linalg.eigh(curvature)
            step = vectors @ ((vectors.T @ slope) / np.maximum(np.abs(values), 1.0))
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
        """By how much steps (models, noise) in the noise's coordinates raise the log density."""
        coordinates = np.tile(state.coordinates, (len(steps), 1))
        coordinates[:, self.noise] += steps
        theta, density = self.prior(coordinates)
        possible = np.isfinite(density)
        moved = np.broadcast_to(state.displacement, (int(possible.sum()), state.displacement.size))
        shapes = np.empty((0, moved.shape[1]))
        density[possible] += self.likelihood.score(theta[possible], shapes, moved).log_density
        return np.where(np.isfinite(density), density, -1e12) - state.density

    def _noise_bend(self, state: _State, step: float = 2e-2) -> tuple[FloatArray, FloatArray]:
        """Slope and curvature of the log density in the noise's coordinates.

        The posterior's sds are hundredths of the prior's, which are one.
        """
        size = self.noise.size
        if not size:
            return np.zeros(0), np.zeros((0, 0))
        single, pairs = np.eye(size), [*combinations(range(size), 2)]
        steps = step * np.stack([*single, *(single[i] + single[j] for i, j in pairs)])
        plus, minus = np.split(self._noise_gains(state, np.concatenate([steps, -steps])), 2)
        bend = plus + minus
        curvature = np.diag(bend[:size])
        for (i, j), together in zip(pairs, bend[size:], strict=True):
            curvature[i, j] = curvature[j, i] = (together - bend[i] - bend[j]) / 2
        return (plus - minus)[:size] / (2 * step), -curvature / step**2
