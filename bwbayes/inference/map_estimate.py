"""The point fit: where the posterior is, how wide it is, and what the data leave open.

Least squares from several prior draws finds the optima of the physical parameters, of residuals and
of their steps; from the best ones the posterior's own modes follow by Newton steps, with all noise
parameters. The curvature there is the Gaussian approximation: it starts the sampler and is never
the answer itself. The modes of a long record are looked for in a thinned one.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.least_squares import LeastSquares
from bwbayes.inference.thinning import thinned
from bwbayes.shown import brief
from bwbayes.watching import Watch, part, unwatched, watched

if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior

# Prior draws that are tried, and the best of them that each least squares starts from.
DRAWS, STARTS = 128, 5

# Part of the sum of squares that least squares leaves where a climb goes on from it.
NEARBY = 1e-4

# Samples of a record in which modes are looked for, and prior draws that tell whether a longer one
# can be thinned to so many.
SAMPLES, PROBES = 20_000, 8


@dataclass(frozen=True)
class PointFit:
    """The posterior's mode and its Gaussian approximation, in unconstrained coordinates.

    ``mode`` (free,), ``covariance`` (free, free), ``log_density`` at the mode; ``optima``
    (modes, free) are the distinct local modes, the best first; ``prior_covariance`` (free, free)
    is that of the prior's draws.
    """

    __repr__ = brief

    mode: FloatArray
    covariance: FloatArray
    log_density: float
    optima: FloatArray
    prior_covariance: FloatArray


def fit(posterior: Posterior, generator: np.random.Generator, watch: Watch = unwatched) -> PointFit:
    """Find the mode of a posterior and the Gaussian approximation there.

    ``watch`` is called with the share that is done.

    Raises
    ------
    InputError
        No prior draw has a finite posterior density.
    """
    # Drawn aside: what a short record is fitted from does not depend on them.
    probes = posterior.prior.theta(posterior.prior.draw(generator.spawn(1)[0], PROBES))
    short = thinned(posterior, probes, SAMPLES)
    if short is posterior:
        places, noise, spread = _places(posterior, generator, watch=part(watch, 0.0, 0.5))
    else:
        point = fit(short, generator, part(watch, 0.0, 0.5))
        places, noise, spread = [*point.optima], np.empty((0, 0)), point.prior_covariance
    modes: list[_Mode] = []

    def climb(position: FloatArray) -> None:
        mode = _mode(posterior, position, spread, modes)
        if mode is not None:
            modes.append(mode)
            modes.sort(key=lambda mode: -mode.log_density)

    for position in watched(places, part(watch, 0.5, 0.9)):
        climb(position)
    # A mode that is less probable than the best one by so many nats holds nothing of the posterior,
    # and an ensemble that starts there stays for hundreds of steps.
    negligible = 30.0
    for position, log_density in _at_rest(posterior, modes[0].position, noise):
        if log_density > modes[0].log_density - 2 * negligible:  # it may yet climb
            climb(position)
    watch(1.0)
    best = modes[0]
    worth = [m.position for m in modes if m.log_density > best.log_density - negligible]
    optima = distinct(worth, best.covariance)
    return PointFit(best.position, best.covariance, best.log_density, optima, spread)


def valleys(
    posterior: Posterior, generator: np.random.Generator, starts: int = STARTS
) -> FloatArray:
    """Find coordinates (places, free) near every mode of a posterior: those of least squares.

    From so many starts: a few find the best of them, if not all. A long record is looked at until
    its voltage has been nearly everywhere, and :data:`SAMPLES` on.

    Raises
    ------
    InputError
        As :func:`fit`.
    """
    known = posterior.only
    covered = np.maximum.accumulate(known.voltage) - np.minimum.accumulate(known.voltage)
    everywhere = int(np.searchsorted(covered, 0.9 * covered[-1]))
    last = max(everywhere, int(known.readings.rows[0])) + SAMPLES
    if known.readings.samples > last:
        windows = (slice(w.start, min(w.stop, last)) for w in known.training if w.start < last)
        posterior = posterior.altered(training=tuple(windows))
    return np.stack(_places(posterior, generator, starts, least=NEARBY)[0])


def peaks(posterior: Posterior, point: PointFit) -> tuple[FloatArray, FloatArray]:
    """Return covariances (modes, free, free) at a point fit's optima, and their shares (modes,).

    A mode's share of the posterior is guessed from its height and width (Laplace's approximation).
    """
    if len(point.optima) == 1:
        return point.covariance[np.newaxis], np.ones(1)
    # Climbed to once more: a chain's file keeps the covariance of the best alone.
    climbs = (_mode(posterior, position, point.prior_covariance) for position in point.optima)
    modes = [mode for mode in climbs if mode is not None]
    covariances = np.stack([mode.covariance for mode in modes])
    log_evidence = np.array([mode.log_density for mode in modes])
    log_evidence += np.linalg.slogdet(covariances)[1] / 2
    return covariances, scipy.special.softmax(log_evidence)


def _places(
    posterior: Posterior,
    generator: np.random.Generator,
    starts: int = STARTS,
    watch: Watch = unwatched,
    least: float = 1e-8,
) -> tuple[list[FloatArray], FloatArray, FloatArray]:
    """Return places (free,) to climb from; of prior draws, the noise and the covariance."""
    prior = posterior.prior
    draws = prior.unconstrain(prior.draw(generator, 4 * DRAWS))
    center, spread = np.median(draws, axis=0), np.atleast_2d(np.cov(draws, rowvar=False))
    density = posterior.log_density(draws[:DRAWS])
    if not np.isfinite(density).any():
        raise InputError("priors: no draw has a finite posterior density; check priors and record")
    optima = []
    for steps in watched((False, True), watch):
        least_squares = LeastSquares(posterior, center, np.sqrt(np.diag(spread)), steps=steps)
        order = np.argsort(least_squares.costs(draws[:DRAWS]), kind="stable")
        optima += _valleys(least_squares, least_squares.optima(draws[order[:starts]], least))
    noise = draws[:DRAWS, ~least_squares.physical]
    places = [_with_noise(posterior, optimum, noise, generator) for optimum in optima]
    # A place that least squares allows may still have no density: the noise is another one there.
    possible = np.isfinite(posterior.log_density(np.stack(places)))
    likeliest = draws[int(np.argmax(density))]
    climbed = [position for position, is_so in zip(places, possible, strict=True) if is_so]
    return climbed or [likeliest], noise, spread


def _at_rest(
    posterior: Posterior, position: FloatArray, noise: FloatArray
) -> Iterator[tuple[FloatArray, float]]:
    """Yield a place (free,) with one noise parameter at its prior's center, and its log density.

    Few readings may leave open whether a discrepancy is there at all. Where it is next to nothing,
    as its prior's center is, all is the sensor's noise: another mode, which no step from the first
    one finds. The other noise parameters are the most probable of prior draws (draws, noise).
    """
    size = noise.shape[1]
    physical = np.tile(position[: position.size - size], (len(noise), 1))
    for column in range(size):
        resting = noise.copy()
        resting[:, column] = 0.0
        places = np.hstack([physical, resting])
        density = posterior.log_density(places)
        best = int(np.argmax(density))
        yield places[best], float(density[best])


def _with_noise(
    posterior: Posterior, position: FloatArray, noise: FloatArray, generator: np.random.Generator
) -> FloatArray:
    """Give a place (free,) the most probable noise parameters, from prior draws (draws, noise).

    The best draw alone may lie next to a lesser mode, such as the one where all is the sensor's
    noise: so draws around the best few are tried, closer and closer.
    """
    size, retained = noise.shape[1], 8
    physical = np.tile(position[: position.size - size], (len(noise), 1))
    best = np.empty((0, position.size))
    density = np.empty(0)
    for _ in range(4):
        best = np.concatenate([best, np.hstack([physical, noise])])
        density = np.concatenate([density, _noise_densities(posterior, best[-len(noise) :])])
        order = np.argsort(-density, kind="stable")[:retained]
        best, density = best[order], density[order]
        if not size:
            break
        top = best[:, -size:]
        chosen = top[generator.integers(retained, size=len(noise))]
        noise = chosen + np.std(top, axis=0) * generator.standard_normal(noise.shape)
    winner: FloatArray = best[0]
    return winner


def _noise_densities(posterior: Posterior, places: FloatArray) -> FloatArray:
    """Log density (places,) at places (places, free) that differ in their noise parameters alone.

    Where a record has few readings for its samples, these are simulated once for all.
    """
    likelihoods = posterior.likelihoods
    if any(2 * known.readings.rows.size > known.readings.samples for known in likelihoods):
        return posterior.log_density(places)
    free, density = posterior.prior.constrain(places)
    possible = np.isfinite(density)
    theta = posterior.prior.theta(free[possible])
    of_records = zip(posterior.datasets, likelihoods, strict=True)
    for dataset, likelihood in of_records if possible.any() else ():
        models, readings = posterior.table.of(theta, dataset.name), likelihood.readings
        actuator = likelihood.table.actuator(models[:1])
        moved = likelihood.simulate(actuator, dataset.voltage[: readings.samples])
        shared = np.broadcast_to(moved[:, readings.where], (len(models), readings.rows.size))
        density[possible] += likelihood.score(models, shared[:0], shared).log_density
    return np.where(np.isfinite(density), density, -np.inf)


def _valleys(least_squares: LeastSquares, places: FloatArray) -> list[FloatArray]:
    """Keep one place for each distinct optimum of least squares, the best first."""
    same = 1e-2  # optima whose sums of squares and coordinates agree to this part are one
    costs = least_squares.costs(places)
    distinct: list[int] = []
    for i in np.argsort(costs, kind="stable").tolist():
        separate = [
            np.max(np.abs(places[i] - places[j]) / least_squares.spread) > same
            or costs[i] > (1 + same) * costs[j]
            for j in distinct
        ]
        if all(separate):
            distinct.append(i)
    return [places[i] for i in distinct]


@dataclass(frozen=True)
class _Mode:
    position: FloatArray
    covariance: FloatArray
    log_density: float


def _mode(
    posterior: Posterior, start: FloatArray, spread: FloatArray, modes: Sequence[_Mode] = ()
) -> _Mode | None:
    """Climb from a start (free,) to the mode it leads to, by Newton steps within a trust region.

    None as soon as it is seen to lead to one that is known.
    """
    surface = _Surface(posterior, start, _units(posterior, start, np.sqrt(np.diag(spread))))
    position, curvature = start, None
    path = np.linspace(0.0, 1.0, 33)[:, np.newaxis]
    for _ in range(4):
        for mode in modes:
            # It leads there if the density rises all the way, but for dips of half a nat.
            density = posterior.log_density(position + path * (mode.position - position))
            if np.all(density > np.maximum.accumulate(density) - 0.5):
                return None
        # Each round measures in the units of the last curvature: finite differences need them.
        solution = scipy.optimize.minimize(
            surface.value,
            np.zeros(position.size),
            jac=surface.gradient,
            hess=surface.hessian,
            method="trust-exact",
            options={"gtol": 1e-2, "maxiter": 60},
        )
        position = surface.outwards(solution.x)
        curvature = surface.hessian(solution.x)
        settled = solution.success and np.allclose(np.diag(curvature), 1, atol=0.2)
        surface = surface.rescaled(position, curvature)
        if settled:
            break
    height = -surface.value(np.zeros(position.size))
    return _Mode(position, surface.axes @ surface.axes.T, height)


def _units(posterior: Posterior, position: FloatArray, spread: FloatArray) -> FloatArray:
    """Return the step (free,) of each coordinate that costs about a nat, ``spread`` at most.

    The mean cost of a step either way: a slope at the place does not count.
    """
    parts = 10.0 ** np.arange(0, -5, -0.5)
    steps = parts[:, np.newaxis, np.newaxis] * np.diag(spread)
    sides = np.concatenate([position + steps, position - steps]).reshape(-1, position.size)
    forth, back = posterior.log_density(sides).reshape(2, parts.size, position.size)
    with np.errstate(invalid="ignore"):  # a density of zero here and there has no cost
        cost = posterior.log_density(position[np.newaxis]) - (forth + back) / 2
    cheap = cost < 1
    cheap[-1] = True
    units: FloatArray = spread * parts[np.argmax(cheap, axis=0)]
    return units


class _Surface:
    """Minus the log density over w, coordinates = center + axes w, with batched differences."""

    STEP = 0.1

    def __init__(self, posterior: Posterior, center: FloatArray, axes: FloatArray) -> None:
        self.posterior, self.center = posterior, center
        self.axes = np.diag(axes) if axes.ndim == 1 else axes
        size = center.size
        steps = self.STEP * np.eye(size)
        pairs = [(i, j) for i in range(size) for j in range(i)]
        self._pairs = tuple(np.array(pairs, dtype=int).reshape(-1, 2).T)
        sides = steps[self._pairs[0]], steps[self._pairs[1]]
        self._star = np.concatenate([np.zeros((1, size)), steps, -steps])
        self._cross = np.concatenate([sides[0] + sides[1], -sides[0] - sides[1]])

    def outwards(self, w: FloatArray) -> FloatArray:
        position: FloatArray = self.center + w @ self.axes.T
        return position

    def values(self, w: FloatArray) -> FloatArray:
        # A finite wall keeps the trust region's arithmetic alive where the density is zero.
        return np.minimum(-self.posterior.log_density(self.outwards(w)), 1e12)

    def value(self, w: FloatArray) -> float:
        return float(self.values(w[np.newaxis])[0])

    def gradient(self, w: FloatArray) -> FloatArray:
        _, plus, minus = np.split(self.values(w + self._star), [1, 1 + w.size])
        slope: FloatArray = (plus - minus) / (2 * self.STEP)
        return slope

    def hessian(self, w: FloatArray) -> FloatArray:
        here, plus, minus = np.split(self.values(w + self._star), [1, 1 + w.size])
        forth, back = np.split(self.values(w + self._cross), 2)
        i, j = self._pairs
        cross = forth + back - plus[i] - plus[j] - minus[i] - minus[j] + 2 * here
        result = np.diag((plus + minus - 2 * here) / self.STEP**2)
        result[i, j] = result[j, i] = cross / (2 * self.STEP**2)
        return result

    def rescaled(self, center: FloatArray, curvature: FloatArray) -> _Surface:
        """Return the same surface, measured so that its curvature is the identity."""
        size, directions = scipy.linalg.eigh((curvature + curvature.T) / 2)
        # Where the surface is flat or bends the wrong way, keep the old unit of length.
        axes = self.axes @ (directions / np.sqrt(np.maximum(size, 1e-2)))
        return _Surface(self.posterior, center, axes)


def distinct(places: list[FloatArray], covariance: FloatArray) -> FloatArray:
    """Keep the places (free,) that lie more than an sd or so from those before them."""
    with warnings.catch_warnings():
        # A discrepancy of which a record shows nothing is far less sure than a gain.
        warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)
        inverse = scipy.linalg.inv(covariance)
    distinct: list[FloatArray] = []
    for position in places:
        distances = [(position - other) @ inverse @ (position - other) for other in distinct]
        if all(distance > position.size for distance in distances):
            distinct.append(position)
    return np.stack(distinct)
