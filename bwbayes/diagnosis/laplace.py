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

from bwbayes.arrays import BoolArray, FloatArray, IntArray
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

    def error(self, windows: Sequence[slice]) -> float:
        """Root mean square, um, of what it misses of the readings in windows; nan of none."""
        record = self.posterior.only
        likelihood = self.posterior.likelihood
        model = likelihood.table.actuator(self.posterior.prior.theta(self.free[np.newaxis]))
        simulate = partial(likelihood.simulate, model)
        missed = record.displacement - self.effect.apply(simulate, record.voltage, self.sizes)[0]
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
    states = target.climb(target.at(np.stack(starts)), 2, least)
    best = states.rows(np.array([np.argmax(states.density)]))
    return target.fitted(target.climb(best, ROUNDS, least))


def climb_each(posterior: Posterior, places: FloatArray) -> list[LocalFit]:
    """Fit from each of coordinates (places, free) of a posterior of one record."""
    target = _Target(posterior, NONE)
    states = target.climb(target.at(places.copy()), ROUNDS, -np.inf)
    return [target.fitted(states.rows(np.array([row]))) for row in range(len(places))]


@dataclass(frozen=True)
class _States:
    """Where climbers are: they go side by side, because a call costs more than a model in it.

    Coordinates (climbers, free + sizes), their log density (climbers,) without the constant, and
    the displacement there (climbers, readings).
    """

    coordinates: FloatArray
    density: FloatArray
    displacement: FloatArray

    def rows(self, rows: IntArray | BoolArray) -> _States:
        """Return some of them."""
        return _States(self.coordinates[rows], self.density[rows], self.displacement[rows])

    def put(self, rows: IntArray, states: _States) -> None:
        """Put others in the place of some."""
        self.coordinates[rows], self.density[rows] = states.coordinates, states.density
        self.displacement[rows] = states.displacement


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

    def displacement(self, coordinates: FloatArray) -> FloatArray:
        """Displacement (models, readings), um."""
        theta, _ = self.prior(coordinates)
        readings = self.likelihood.readings
        voltage = self.likelihood.voltage[: readings.samples]
        moved = np.empty((len(theta), readings.rows.size))
        # An effect is worked out once for all models that have the same sizes.
        every, which = np.unique(coordinates[:, self.free :], axis=0, return_inverse=True)
        for number, sizes in enumerate(every):
            alike = np.flatnonzero(which.ravel() == number)
            for batch in batches(alike.size, voltage.size):
                rows = alike[batch]
                model = self.likelihood.table.actuator(theta[rows])
                simulate = partial(self.likelihood.simulate, model)
                moved[rows] = self.effect.apply(simulate, voltage, sizes)[:, readings.where]
        return moved

    def at(self, coordinates: FloatArray) -> _States:
        """Return the states at coordinates (climbers, free + sizes)."""
        theta, density = self.prior(coordinates)
        possible = np.isfinite(density)
        moved = np.zeros((len(theta), self.likelihood.readings.rows.size))
        if possible.any():
            moved[possible] = self.displacement(coordinates[possible])
            density[possible] += self._log_likelihood(theta[possible], moved[possible])
        return _States(coordinates, np.where(np.isfinite(density), density, -np.inf), moved)

    def _log_likelihood(self, theta: FloatArray, displacement: FloatArray) -> FloatArray:
        """Log likelihood (models,) of models θ with a displacement (models, readings)."""
        shapes = np.empty((0, displacement.shape[1]))
        return self.likelihood.score(theta, shapes, displacement).log_density

    def climb(self, states: _States, rounds: int, least: float) -> _States:
        """Climb from each for so many rounds at most, as long as these may reach ``least``."""
        going = np.flatnonzero(np.isfinite(states.density))
        for _ in range(rounds):
            if not going.size:
                break
            before, now = states.density[going], states.rows(going)
            self._step_noise(now)
            self._step_physics(now)
            states.put(going, now)
            enough = np.maximum(GAIN, (least - now.density) / ROUNDS)
            going = going[now.density >= before + enough]
        return states

    def fitted(self, state: _States) -> LocalFit:
        """Put the evidence of a single state together."""
        coordinates, log_evidence = state.coordinates[0], float(state.density[0])
        covariance = np.eye(coordinates.size)
        # What the record does not tell keeps its prior; the noise's bend is a finite difference.
        for places, curvature, flattest in (
            (self.physical, self._physical_bend(state)[1][0], 1.0),
            (self.noise, self._noise_bend(state)[1][0], 1e-2),
        ):
            values, vectors = np.linalg.eigh(curvature)
            values = np.maximum(values, flattest)
            covariance[np.ix_(places, places)] = (vectors / values) @ vectors.T
            log_evidence -= 0.5 * float(np.sum(np.log(values)))
        return LocalFit(
            self.posterior,
            self.effect,
            coordinates,
            covariance,
            float(state.density[0]),
            log_evidence,
            state.displacement[0],
        )

    def _step_physics(self, states: _States) -> None:
        """Step in the physical coordinates and the sizes, by Fisher scoring."""
        slope, curvature = self._physical_bend(states)
        step = np.linalg.solve(curvature, slope[:, :, np.newaxis])[:, :, 0]
        waiting = np.arange(len(step))
        for fraction in FRACTIONS:
            if not waiting.size:
                break
            coordinates = states.coordinates[waiting]
            coordinates[:, self.physical] += fraction * step[waiting]
            tried = self.at(coordinates)
            higher = tried.density > states.density[waiting]
            states.put(waiting[higher], tried.rows(higher))
            waiting = waiting[~higher]

    def _physical_bend(self, states: _States, step: float = 1e-4) -> tuple[FloatArray, FloatArray]:
        """Slope and curvature of the log density in the physical coordinates.

        ``step`` may be small: a simulation has no noise but rounding.
        """
        steps = step * np.eye(states.coordinates.shape[1])[self.physical]
        sides = states.coordinates[:, np.newaxis, np.newaxis] + np.stack([steps, -steps])
        shape, sides = sides.shape[:3], sides.reshape(-1, sides.shape[3])
        possible = np.isfinite(self.prior(sides)[1])
        moved = np.repeat(states.displacement, 2 * len(steps), axis=0)
        moved[possible] = self.displacement(sides[possible])
        forth, back = np.moveaxis(moved.reshape(*shape, -1), 1, 0)
        width = step * np.maximum(np.sum(possible.reshape(shape), axis=1), 1)
        slopes = (forth - back) / width[:, :, np.newaxis]
        theta, _ = self.prior(states.coordinates)
        score = self.likelihood.score(theta, slopes, states.displacement)
        slope = score.pull - states.coordinates[:, self.physical]
        return slope, score.information + np.eye(len(steps))

    def _step_noise(self, states: _States) -> None:
        """Step in the noise's coordinates, by Newton's method where the density bends down."""
        going = np.arange(len(states.density))
        for _ in range(6 if self.noise.size else 0):
            now = states.rows(going)
            slope, curvature = self._noise_bend(now)
            values, vectors = np.linalg.eigh(curvature)
            along = np.einsum("mji,mj->mi", vectors, slope) / np.maximum(np.abs(values), 1.0)
            step = np.einsum("mij,mj->mi", vectors, along)
            step /= np.maximum(1.0, np.max(np.abs(step), axis=1, keepdims=True) / 0.5)
            steps = FRACTIONS[:, np.newaxis] * step[:, np.newaxis]
            gains = self._noise_gains(now, steps)
            best, every = np.argmax(gains, axis=1), np.arange(going.size)
            higher = gains[every, best] > GAIN / 4
            going, every, best = going[higher], every[higher], best[higher]
            if not going.size:
                break
            states.coordinates[going[:, np.newaxis], self.noise] += steps[every, best]
            states.density[going] += gains[every, best]

    def _noise_gains(self, states: _States, steps: FloatArray) -> FloatArray:
        """By how much steps in the noise's coordinates raise the log density.

        ``steps`` are (climbers or 1, steps, noise), the gains (climbers, steps).
        """
        count = steps.shape[1]
        coordinates = np.repeat(states.coordinates[:, np.newaxis], count, axis=1)
        coordinates[:, :, self.noise] += steps
        theta, density = self.prior(coordinates.reshape(-1, coordinates.shape[2]))
        possible = np.isfinite(density)
        moved = np.repeat(states.displacement, count, axis=0)
        density[possible] += self._log_likelihood(theta[possible], moved[possible])
        density = np.where(np.isfinite(density), density, -1e12).reshape(-1, count)
        return density - states.density[:, np.newaxis]

    def _noise_bend(self, states: _States, step: float = 2e-2) -> tuple[FloatArray, FloatArray]:
        """Slope and curvature of the log density in the noise's coordinates.

        The posterior's sds are hundredths of the prior's, which are one.
        """
        size, climbers = self.noise.size, len(states.density)
        if not size:
            return np.zeros((climbers, 0)), np.zeros((climbers, 0, 0))
        single, pairs = np.eye(size), [*combinations(range(size), 2)]
        steps = step * np.stack([*single, *(single[i] + single[j] for i, j in pairs)])
        sides = np.concatenate([steps, -steps])[np.newaxis]
        plus, minus = np.split(self._noise_gains(states, sides), 2, axis=1)
        bend = plus + minus
        curvature = bend[:, :size, np.newaxis] * np.eye(size)
        for (i, j), together in zip(pairs, bend.T[size:], strict=True):
            curvature[:, i, j] = curvature[:, j, i] = (together - bend[:, i] - bend[:, j]) / 2
        return (plus - minus)[:, :size] / (2 * step), -curvature / step**2
