"""Mode finding: up from starts nearby to the modes of a posterior, several side by side.

The physical parameters enter the displacement, the noise's parameters do not, so that at the mode
the information about the two separates: Fisher scoring climbs in the physical ones, Newton steps in
the noise's ones with the residual as it is, until neither gains (:func:`climb`). Newton steps in
all of them then lead to the mode itself, and give the Hessian there (:func:`refine`).

Derivatives are finite differences with one step rule each. The coordinates z are standard normal
under the prior, so that models vary over distances of order one, and one step h suits all
parameters. Central differences have the error

    h² |f‴| / 6 + ε |f| / h,   ε = 2⁻⁵²,

for h = :data:`STEP` about 2e-9 of f‴ and 2e-12 of f.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.posterior import Posterior
from bwbayes.watching import Watch, unwatched, watched

# A round that gains less, nats, is the last one; and rounds at most.
GAIN, ROUNDS = 0.05, 20

# Rounds from every start, and how many times what a round gained all later ones may gain.
FIRST_ROUNDS, AHEAD = 2, 20.0

# Step of first derivatives, in prior sds.
STEP = 1e-4

# Steps of differences: in the noise's coordinates, whose sds are hundredths of the prior's; and in
# the posterior's sds.
NOISE_STEP, SCALED_STEP = 2e-2, 0.1

# Parts of a step that are tried.
FRACTIONS = 0.5 ** np.arange(8)

# Newton steps at most, and the least curvature of units that the last ones left.
REFINEMENTS, FLATTEST = 40, 1e-2

# A density of zero, nats: a finite wall keeps differences numbers.
WALL = -1e12

Function = Callable[[FloatArray], FloatArray]


def value_and_jacobian(
    function: Function,
    coordinates: FloatArray,
    moving: IntArray | None = None,
    value: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return a function at coordinates (models, free), (models, ...), and (models, moving, ...).

    Parameters
    ----------
    function
        Maps coordinates (models, free) to (models, ...), in one call for all steps; nan, or −∞,
        where there is no model. A derivative is one-sided where one side has none, and zero where
        neither has.
    coordinates
        Where.
    moving
        The coordinates to differentiate in, all by default.
    value
        The function there, if it is known.
    """
    models, free = coordinates.shape
    steps = STEP * np.eye(free)[slice(None) if moving is None else moving]
    center = np.zeros((int(value is None), free))
    places = coordinates[:, np.newaxis] + np.concatenate([steps, -steps, center])
    values = function(places.reshape(-1, free))
    values = values.reshape(models, places.shape[1], *values.shape[1:])
    forth, back, here = np.split(values, [len(steps), 2 * len(steps)], axis=1)
    here = here if value is None else value[:, np.newaxis]
    with np.errstate(invalid="ignore"):  # no number less none
        slopes: FloatArray = (forth - back) / (2 * STEP)
        if not np.isfinite(slopes).all():
            for one_sided in ((forth - here) / STEP, (here - back) / STEP, np.zeros_like(forth)):
                slopes = np.where(np.isfinite(slopes), slopes, one_sided)
    return here[:, 0], slopes


def gradient_and_hessian(
    function: Function, free: int, step: float, value: float | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return a function's gradient (free,) and Hessian (free, free) at w = 0.

    ``function`` maps (models, free) to (models,), in one call; ``value`` is f(0), if it is known.
    If ``function`` is several side by side, (models, functions), these come last in the results:
    (free, functions) and (free, free, functions).
    With f± a ``step`` h along a coordinate, or along two,

        gᵢ = (fᵢ₊ − fᵢ₋) / 2h,   Hᵢⱼ = (fᵢⱼ₊ + fᵢⱼ₋ − fᵢ₊ − fᵢ₋ − fⱼ₊ − fⱼ₋ + 2f) / 2h²,

    with errors of h² times the third and fourth derivatives, and of 8 ε |f| / h² by rounding: so a
    step is a fiftieth to a tenth of what the function varies over.
    """
    i, j = np.tril_indices(free, -1)
    single = step * np.eye(free)
    steps = np.concatenate([single, single[i] + single[j]])
    center = np.zeros((int(value is None), free))
    values = function(np.concatenate([steps, -steps, center]))
    forth, back, here = np.split(values, [len(steps), 2 * len(steps)])
    second = forth + back - 2 * (here if value is None else value)
    hessian, diagonal = np.zeros((free, free, *second.shape[1:])), np.arange(free)
    hessian[diagonal, diagonal] = second[:free]
    hessian[i, j] = hessian[j, i] = (second[free:] - second[i] - second[j]) / 2
    return (forth - back)[:free] / (2 * step), hessian / step**2


@dataclass(frozen=True)
class Linearization:
    """A displacement and a log likelihood, linearized at models, in the physical coordinates.

    Attributes
    ----------
    slopes
        ∂x/∂z, (models, physical, readings), um; the readings of all records one after the other.
    residual
        (models, readings), um, from rest.
    gradient
        ∂ log p(readings | z)/∂z, (models, physical), the noise and the unknown starts held.
    fisher_information
        (models, physical, physical), the same held.
    """

    slopes: FloatArray
    residual: FloatArray
    gradient: FloatArray
    fisher_information: FloatArray


@dataclass(frozen=True)
class Iterate:
    """Where a climb is: coordinates (size,), log density, displacement (readings,), um."""

    coordinates: FloatArray
    density: float
    displacement: FloatArray


@dataclass(frozen=True)
class Mode:
    """A mode: coordinates (free,), covariance (free, free) by the Hessian, log density, nats."""

    coordinates: FloatArray
    covariance: FloatArray
    log_density: float


@dataclass(frozen=True)
class Target:
    """The log density of a posterior in its coordinates (models, size), and steps to its modes."""

    posterior: Posterior

    @property
    def size(self) -> int:
        """How many coordinates there are."""
        return len(self.posterior.names)

    @cached_property
    def noise(self) -> IntArray:
        """Which coordinates are those of the noise's parameters."""
        physical = self.posterior.table.physical
        return np.flatnonzero([name not in physical for name in self.posterior.names])

    @cached_property
    def physical(self) -> IntArray:
        """Which coordinates move the displacement."""
        return np.setdiff1d(np.arange(self.size), self.noise)

    def prior(self, coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """θ (models, parameters) and log prior (models,) of coordinates (models, size)."""
        return self.posterior.prior.theta_at(coordinates)

    def noise_density(self, coordinates: FloatArray, displacement: FloatArray) -> FloatArray:
        """Log density (models,) where models have these displacements (any, readings) in turn."""
        theta, density = self.prior(coordinates)
        possible = np.flatnonzero(np.isfinite(density))
        if possible.size < len(theta):
            displacement = displacement[possible % len(displacement)]
        if possible.size:
            density[possible] += self.posterior.log_likelihood(theta[possible], displacement)
        return np.where(np.isfinite(density), density, -np.inf)

    def at(self, coordinates: FloatArray) -> list[Iterate]:
        """Return the states at coordinates (states, size)."""
        theta, density = self.prior(coordinates)
        possible, moved = np.isfinite(density), self.posterior.displacement(theta, density)
        if possible.any():
            score = self.posterior.score(theta[possible], moved[:0], moved[possible])
            density[possible] += score.log_density
        density = np.where(np.isfinite(density), density, -np.inf)
        return [Iterate(*state) for state in zip(coordinates, density.tolist(), moved, strict=True)]

    def round(self, states: Sequence[Iterate]) -> list[Iterate]:
        """Climb a round from states side by side: in the noise's coordinates, then in the others.

        Some steps in the noise's, one of Fisher scoring in the others.
        """
        states = self.step_noise(states)
        coordinates = np.stack([state.coordinates for state in states])
        linear = self.linearize(coordinates, np.stack([state.displacement for state in states]))
        gradients = linear.gradient - coordinates[:, self.physical]
        informations = linear.fisher_information + np.eye(self.physical.size)
        steps = np.zeros_like(coordinates)
        steps[:, self.physical] = np.linalg.solve(informations, gradients[..., np.newaxis])[..., 0]
        remaining = [*range(len(states))]
        for fraction in FRACTIONS:
            tried = np.stack([states[i].coordinates + fraction * steps[i] for i in remaining])
            for i, ahead in zip([*remaining], self.at(tried), strict=True):
                if ahead.density > states[i].density:
                    states[i] = ahead
                    remaining.remove(i)
            if not remaining:
                break
        return states

    def linearize(
        self,
        coordinates: FloatArray,
        displacement: FloatArray | None = None,
        *,
        expected: bool = False,
    ) -> Linearization:
        """Linearize at coordinates (models, size) that are possible, all steps side by side.

        :meth:`~bwbayes.inference.likelihood.Likelihood.score` has the equations. ``displacement``
        (models, readings), um, is given where it is known. If ``expected``, readings are those that
        each model predicts: of a record that is not measured yet.
        """

        def simulate(places: FloatArray) -> FloatArray:
            return self.posterior.displacement(*self.prior(places))

        here, slopes = value_and_jacobian(simulate, coordinates, self.physical, displacement)
        readings = np.concatenate([record.readings.values for record in self.posterior.datasets])
        read = np.broadcast_to(readings, here.shape)
        theta, _ = self.prior(coordinates)
        score = self.posterior.score(theta, slopes, read if expected else here)
        return Linearization(slopes, read - here, score.gradient, score.fisher_information)

    def covariance(self, state: Iterate) -> tuple[FloatArray, float]:
        """Covariance (size, size) at a mode, and its log determinant.

        Noise and physical parameters are uncorrelated. Directions that the record leaves open keep
        their prior; the noise's Hessian is of differences. A state that is not possible has that of
        the prior.
        """
        covariance, log_determinant = np.eye(self.size), 0.0
        if not np.isfinite(state.density):
            return covariance, log_determinant
        linear = self.linearize(state.coordinates[np.newaxis], state.displacement[np.newaxis])
        information = linear.fisher_information[0] + np.eye(self.physical.size)
        _, hessians = self._noise_hessians([state])
        for rows, curvature, flattest in (
            (self.physical, information, 1.0),
            (self.noise, -hessians[..., 0], 1e-2),
        ):
            values, vectors = np.linalg.eigh(curvature)
            values = np.maximum(values, flattest)
            covariance[np.ix_(rows, rows)] = (vectors / values) @ vectors.T
            log_determinant -= float(np.sum(np.log(values)))
        return covariance, log_determinant

    def step_noise(self, states: Sequence[Iterate], count: int = 6) -> list[Iterate]:
        """Step in the noise's coordinates from states side by side.

        By Newton's method where the density bends down.
        """
        states, climbing = [*states], [*range(len(states))]
        for _ in range(count if self.noise.size else 0):
            here = [states[i] for i in climbing]
            if not here or not (steps := self._noise_steps(here)).any():
                break
            tried = FRACTIONS[:, np.newaxis, np.newaxis] * steps
            gains = self._noise_gains(here, tried)
            gained = []
            for number, best in enumerate(np.argmax(gains, axis=0).tolist()):
                state, gain = here[number], float(gains[best, number])
                if gain > GAIN / 4:
                    coordinates = state.coordinates.copy()
                    coordinates[self.noise] += tried[best, number]
                    ahead = Iterate(coordinates, state.density + gain, state.displacement)
                    states[climbing[number]] = ahead
                    gained.append(climbing[number])
            climbing = gained
        return states

    def _noise_steps(self, states: Sequence[Iterate]) -> FloatArray:
        """Return a step (states, noise) from each state, zero where it gains next to nothing."""
        gradients, hessians = self._noise_hessians(states)
        steps = np.zeros((len(states), self.noise.size))
        for number, gradient in enumerate(gradients.T):
            step = newton_step(gradient, hessians[..., number], 1.0)
            step /= max(1.0, float(np.max(np.abs(step))) / 0.5)
            if gradient @ step > GAIN / 4:
                steps[number] = step
        return steps

    def _noise_gains(self, states: Sequence[Iterate], steps: FloatArray) -> FloatArray:
        """By how much steps (any, states, noise) in the noise's coordinates raise log densities.

        Returns (any, states).
        """
        here = np.stack([state.coordinates for state in states])
        coordinates = np.tile(here, (len(steps), 1, 1))
        coordinates[..., self.noise] += steps
        moved = np.stack([state.displacement for state in states])
        density = self.noise_density(coordinates.reshape(-1, self.size), moved)
        before = np.array([state.density for state in states])
        gains: FloatArray = np.maximum(density, WALL).reshape(-1, len(states)) - before
        return gains

    def _noise_hessians(self, states: Sequence[Iterate]) -> tuple[FloatArray, FloatArray]:
        """Gradients (noise, states) and Hessians (noise, noise, states) in noise coordinates."""
        return gradient_and_hessian(
            lambda steps: self._noise_gains(states, steps[:, np.newaxis]),
            self.noise.size,
            NOISE_STEP,
            0.0,
        )


def climb(
    target: Target,
    starts: FloatArray,
    least: float = -np.inf,
    watch: Watch = unwatched,
) -> Iterate:
    """Climb from starts (starts, size) side by side, to a state near the mode of the best one.

    The one that leads after :data:`FIRST_ROUNDS` goes on alone. Each ends where it gains so little
    that it would never reach a log density of ``least``. Where no start is possible, that is the
    state. ``watch`` is called with the share of the most rounds that is done.
    """
    initial_states = target.at(starts)
    climbing = [state for state in initial_states if np.isfinite(state.density)]
    ended: list[Iterate] = []
    for number in watched(range(1, ROUNDS + FIRST_ROUNDS + 1), watch):
        if not climbing:
            break
        ahead = target.round(climbing)
        gains = [
            state.density - before.density for state, before in zip(ahead, climbing, strict=True)
        ]
        if number == FIRST_ROUNDS:
            best = int(np.argmax([state.density for state in ahead]))
            ended += ahead
            ahead, gains = [ahead[best]], [gains[best]]
        climbing = []
        for state, gain in zip(ahead, gains, strict=True):
            leads = gain >= max(GAIN, (least - state.density) / AHEAD)
            (climbing if leads else ended).append(state)
    return max(ended + climbing or initial_states, key=lambda state: state.density)


def refine(posterior: Posterior, coordinates: FloatArray, covariance: FloatArray) -> Mode:
    """Find the mode that coordinates (free,) lead to by Newton steps in all of them.

    In units of a ``covariance`` (free, free) that is about that of the mode, and then of that of
    each step. A direction that is flat, or bends the wrong way, grows tenfold at most.
    """
    axes = np.linalg.cholesky(covariance)
    log_density = float(posterior.log_density(coordinates[np.newaxis])[0])

    def gains(w: FloatArray) -> FloatArray:
        density = posterior.log_density(coordinates + w @ axes.T)
        return np.asarray(np.maximum(density, WALL) - log_density)

    longest = 1.0  # sds; it grows while it leads up, so that the mode is that of the start's valley
    for _ in range(REFINEMENTS):
        gradient, hessian = gradient_and_hessian(gains, coordinates.size, SCALED_STEP, 0.0)
        step = newton_step(gradient, hessian, FLATTEST)
        step *= min(1.0, longest / max(float(np.linalg.norm(step)), 1e-12))
        steps = FRACTIONS[:, np.newaxis] * step
        gained = gains(steps)
        best = int(np.argmax(gained))
        longest *= 1.0 if best else 2.0
        values, vectors = np.linalg.eigh(-hessian)
        if gained[best] > 0:
            coordinates = coordinates + axes @ steps[best]
            log_density += float(gained[best])
        axes = axes @ (vectors / np.sqrt(np.maximum(values, FLATTEST)))
        is_converged = gained[best] <= 0 or np.linalg.norm(step) < 1e-2
        if is_converged and np.allclose(values, 1.0, atol=0.2):
            break
    return Mode(coordinates, _definite(axes @ axes.T), log_density)


def _definite(covariance: FloatArray) -> FloatArray:
    """Return a covariance (free, free) that rounding leaves positive definite.

    One that is not has grown along directions that bend the wrong way: none is wider than the
    prior, whose sds are 1.
    """
    values, vectors = np.linalg.eigh(covariance)
    if values[0] > 1e-13 * values[-1]:
        return covariance
    bounded = np.minimum(values, 1.0)
    return np.asarray((vectors * np.maximum(bounded, 1e-12 * bounded[-1])) @ vectors.T)


def newton_step(gradient: FloatArray, hessian: FloatArray, flattest: float) -> FloatArray:
    """Step (size,) up a density, with curvatures by their size, and ``flattest`` at least."""
    values, vectors = np.linalg.eigh(-hessian)
    step: FloatArray = vectors @ (vectors.T @ gradient / np.maximum(np.abs(values), flattest))
    return step
