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
from functools import cached_property
from itertools import product

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.likelihood import Likelihood, batches
from bwbayes.inference.linearization import gradient_and_hessian, value_and_jacobian
from bwbayes.inference.posterior import Posterior

# A round that gains less, nats, is the last one; and rounds at most.
GAIN, ROUNDS = 0.05, 20

# Rounds from every start, and how many times what a round gained all later ones may gain.
FIRST_ROUNDS, AHEAD = 2, 10.0

# Steps in the noise's coordinates a round; and where many starts of an effect go side by side.
NOISE_STEPS, FEW_STEPS = 6, 2

# Step of differences in the noise's coordinates: the posterior's sds are hundredths of the prior's.
NOISE_STEP = 2e-2

# Parts of a step that are tried.
FRACTIONS = 0.5 ** np.arange(8)


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
            driven = self.drive(voltage, sizes[rows[0]])
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
        sizes = self.sizes[np.newaxis]
        missed = record.displacement
        missed = missed - self.effect.displacement(likelihood, model, record.voltage, sizes)[0]
        inside = np.concatenate([missed[window] for window in windows])
        return float(np.sqrt(np.nanmean(inside**2))) if np.isfinite(inside).any() else np.nan


def climb(
    posterior: Posterior, places: FloatArray, effect: Effect = NONE, least: float = -np.inf
) -> LocalFit:
    """Fit from the best of coordinates (places, free) of a posterior of one record nearby.

    Two rounds from each of them, with each of an effect's starts, side by side, tell which one
    leads. The climb ends where it gains so little that it would never reach a log density of
    ``least``.
    """
    target = _Target(posterior, effect)
    starts = [np.concatenate(pair) for pair in product(np.atleast_2d(places), effect.starts)]
    states = target.at(np.stack(starts))
    possible = [state for state in states if np.isfinite(state.density)]
    for number in range(1, ROUNDS + FIRST_ROUNDS + 1) if possible else ():
        ahead = target.round(possible)
        # One that leads after some rounds goes on alone.
        best = int(np.argmax([state.density for state in ahead]))
        gain = ahead[best].density - possible[best].density
        possible = ahead if number < FIRST_ROUNDS else [ahead[best]]
        missing = least - ahead[best].density
        if len(possible) == 1 and gain < max(GAIN, missing / AHEAD):
            break
    return target.fitted(max(possible or states, key=lambda state: state.density))


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

    def displacement(self, coordinates: FloatArray) -> FloatArray:
        """Displacement (models, readings), um, at coordinates; nan where the prior is zero."""
        return self.simulate(*self.prior(coordinates), coordinates)

    def simulate(
        self, theta: FloatArray, log_prior: FloatArray, coordinates: FloatArray
    ) -> FloatArray:
        """Return :meth:`displacement`, with θ and log prior of the coordinates."""
        likelihood, possible = self.posterior.likelihood, np.isfinite(log_prior)
        readings = likelihood.readings
        moved = np.full((len(theta), readings.rows.size), np.nan)
        if possible.any():
            model, sizes = likelihood.table.actuator(theta), coordinates[:, self.free :]
            voltage = likelihood.voltage[: readings.samples]
            moved[possible] = self.effect.displacement(
                likelihood, model[possible], voltage, sizes[possible]
            )[:, readings.where]
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

    def at(self, coordinates: FloatArray) -> list[_State]:
        """Return the states at coordinates (states, free + sizes)."""
        theta, density = self.prior(coordinates)
        possible, moved = np.isfinite(density), self.simulate(theta, density, coordinates)
        if possible.any():
            score = self.posterior.likelihood.score(theta[possible], moved[:0], moved[possible])
            density[possible] += score.log_density
        density = np.where(np.isfinite(density), density, -np.inf)
        return [_State(*state) for state in zip(coordinates, density.tolist(), moved, strict=True)]

    def round(self, states: Sequence[_State]) -> list[_State]:
        """Climb a round from states side by side: in the noise's coordinates, then in the others.

        In these by Fisher scoring.
        """
        many = len(states) > 1 and self.effect is not NONE
        count = FEW_STEPS if many else NOISE_STEPS
        states = [self._step_noise(state, count) for state in states]
        gradients, informations = self._linearize(states)
        steps = np.zeros((len(states), states[0].coordinates.size))
        steps[:, self.physical] = np.linalg.solve(informations, gradients[..., np.newaxis])[..., 0]
        left = [*range(len(states))]
        for fraction in FRACTIONS:
            tried = np.stack([states[i].coordinates + fraction * steps[i] for i in left])
            for i, ahead in zip([*left], self.at(tried), strict=True):
                if ahead.density > states[i].density:
                    states[i] = ahead
                    left.remove(i)
            if not left:
                break
        return states

    def fitted(self, state: _State) -> LocalFit:
        """Put the evidence at a mode together."""
        log_evidence, covariance = state.density, np.eye(state.coordinates.size)
        # What the record does not tell keeps its prior; the noise's Hessian is of differences.
        # A model that is possible at none of its starts has no evidence, and no curvature.
        parts: list[tuple[IntArray, FloatArray, float]] = []
        if np.isfinite(state.density):
            parts.append((self.physical, self._linearize([state])[1][0], 1.0))
            parts.append((self.noise, self._noise_hessian(state)[1], 1e-2))
        for rows, curvature, flattest in parts:
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

    def _linearize(self, states: Sequence[_State]) -> tuple[FloatArray, FloatArray]:
        """Gradient and Fisher information of states' log density in the physical coordinates."""
        coordinates = np.stack([state.coordinates for state in states])
        here = np.stack([state.displacement for state in states])
        _, slopes = value_and_jacobian(self.displacement, coordinates, self.physical, here)
        score = self.posterior.likelihood.score(self.prior(coordinates)[0], slopes, here)
        gradient = score.gradient - coordinates[:, self.physical]
        return gradient, score.fisher_information + np.eye(self.physical.size)

    def _step_noise(self, state: _State, count: int) -> _State:
        """Step in the noise's coordinates, by Newton's method where the density bends down."""
        for _ in range(count if self.noise.size else 0):
            gradient, hessian = self._noise_hessian(state)
            values, vectors = np.linalg.eigh(hessian)
            step = vectors @ (vectors.T @ gradient / np.maximum(np.abs(values), 1.0))
            step /= max(1.0, float(np.max(np.abs(step))) / 0.5)
            if gradient @ step <= GAIN / 4:
                break
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

    def _noise_hessian(self, state: _State) -> tuple[FloatArray, FloatArray]:
        """Gradient of the log density in the noise's coordinates, and minus its Hessian."""
        gradient, hessian = gradient_and_hessian(
            lambda steps: self._noise_gains(state, steps), self.noise.size, NOISE_STEP, 0.0
        )
        return gradient, -hessian
