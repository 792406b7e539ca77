"""Toy targets whose draws and moments are known.

:func:`worst_score` tests whether moves leave a target as it is. Its walkers start as exact draws; a
right move keeps them so: the expected mean and mean square of every coordinate stay what they are
at every step. Twelve independent ensembles give each an error, so a t-score with 11 degrees of
freedom; |t| > ``ALARM`` = 7 is an alarm, which a right move gives in one of 2,000 tests of 18
statistics. For the Gaussian the standard errors are 0.5% (Student-t) and 3% (snooker) of a
variance, so a variance that is wrong by 6 or 30% is found nearly always; the banana's tails are
known only 14% well.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.parameters import Parameter
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.moves import WeightedMoves, advance, start
from bwbayes.sampling.proposals import StudentMixture

REPLICATES = 12
ALARM = 7.0


@dataclass(frozen=True)
class Unchanged:
    """A prior whose coordinates are the parameters, none of them a noise's."""

    dimensions: int
    free: tuple[Parameter, ...] = ()

    def constrain(self, coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the coordinates (models, free), and no density."""
        return coordinates, np.zeros(coordinates.shape[0])


@dataclass(frozen=True)
class Target:
    """A density with the interface that the sampler needs of a posterior."""

    log_density: Callable[[FloatArray], FloatArray]
    prior: Unchanged


@dataclass(frozen=True)
class Gaussian:
    """log N(x; 0, C) up to a constant, given the precision C⁻¹ (free, free)."""

    precision: FloatArray = field(repr=False)

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return (models,) at x (models, free)."""
        density: FloatArray = -0.5 * np.sum((x @ self.precision) * x, axis=1)
        return density


def target(log_density: Callable[[FloatArray], FloatArray], free: int) -> Posterior:
    return cast(Posterior, Target(log_density, Unchanged(free)))


def gaussian(free: int, correlation: float = 0.5) -> tuple[Posterior, MAPEstimate]:
    """Return a Gaussian target of unit variances and equal correlations, and its point fit."""
    covariance = np.full((free, free), correlation) + (1 - correlation) * np.eye(free)
    posterior = target(Gaussian(np.linalg.inv(covariance)), free)
    mode = np.zeros(free)
    return posterior, MAPEstimate(mode, covariance, 0.0, mode[np.newaxis], 25 * np.eye(free))


@dataclass(frozen=True)
class Known:
    """A target of which log density, exact draws and moments are known.

    ``moments`` are the means and mean squares (2, free) of what ``view`` makes of the coordinates.
    """

    free: int
    log_density: Callable[[FloatArray], FloatArray]
    draw: Callable[[np.random.Generator, int], FloatArray]
    proposal: StudentMixture
    moments: FloatArray
    view: Callable[[FloatArray], FloatArray] = lambda x: x


def student(center: FloatArray, factor: FloatArray) -> StudentMixture:
    return StudentMixture(np.ones(1), center[np.newaxis], factor[np.newaxis])


def nine_dimensional_gaussian() -> Known:
    posterior, point = gaussian(9, 0.6)
    factor = np.linalg.cholesky(point.covariance)
    return Known(
        9,
        posterior.log_density,
        lambda generator, count: generator.standard_normal((count, 9)) @ factor.T,
        student(np.full(9, 0.1), factor),
        np.array([[0.0] * 9, [1.0] * 9]),
    )


def banana() -> Known:
    def log_density(x: FloatArray) -> FloatArray:
        bend = (x[:, 1] - x[:, 0] ** 2) / 0.5
        density: FloatArray = -0.5 * (x[:, 0] ** 2 + bend**2)
        return density

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        first, second = generator.standard_normal((2, count))
        return np.stack([first, first**2 + 0.5 * second], axis=1)

    proposal = student(np.array([0.0, 1.0]), np.diag([1.2, 1.6]))
    return Known(2, log_density, draw, proposal, np.array([[0.0, 1.0], [1.0, 3.25]]))


def bounded() -> Known:
    """Return an exponential and a uniform coordinate, both with hard walls."""

    def log_density(x: FloatArray) -> FloatArray:
        inside = (x[:, 0] > 0) & (x[:, 1] > 0) & (x[:, 1] < 1)
        return np.where(inside, -x[:, 0], -np.inf)

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        return np.stack([generator.exponential(size=count), generator.uniform(size=count)], axis=1)

    proposal = student(np.array([1.0, 0.5]), np.diag([1.0, 0.3]))
    return Known(2, log_density, draw, proposal, np.array([[1.0, 0.5], [2.0, 1 / 3]]))


def normals(weights: list[float], places: list[float], sd: float, proposal_sd: float) -> Known:
    """Return normal distributions that lie apart in the first of three coordinates."""
    centers, sds = np.zeros((len(places), 3)), np.ones(3)
    centers[:, 0], sds[0] = places, sd

    def log_density(x: FloatArray) -> FloatArray:
        squares = np.sum(((x[:, np.newaxis] - centers) / sds) ** 2, axis=2)
        density: FloatArray = np.logaddexp.reduce(np.log(weights) - squares / 2, axis=1)
        return density

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        which = generator.choice(len(weights), size=count, p=weights)
        return centers[which] + sds * generator.standard_normal((count, 3))

    moments = np.stack([weights @ centers, weights @ (centers**2 + sds**2)])
    proposal = student(np.zeros(3), np.diag([proposal_sd, 1.0, 1.0]))
    return Known(3, log_density, draw, proposal, moments)


def wedge() -> Known:
    """Return a coordinate near one, and another just below it, as gamma near beta: a wall askew."""

    def log_density(x: FloatArray) -> FloatArray:
        gap = x[:, 0] - x[:, 1]
        inside = (gap > 0) & (gap < 2 * x[:, 0])
        return np.where(inside, -0.5 * ((x[:, 0] - 1) / 0.1) ** 2 - gap / 0.02, -np.inf)

    def draw(generator: np.random.Generator, count: int) -> FloatArray:
        first = generator.normal(1, 0.1, count)
        return np.stack([first, first - generator.exponential(0.02, count)], axis=1)

    # Shaped as the ridge: the second coordinate follows the first.
    proposal = student(np.array([1.0, 0.98]), np.array([[0.1, 0.0], [0.1, 0.02]]))
    moments = np.array([[1.0, 0.02], [1.01, 8e-4]])
    return Known(2, log_density, draw, proposal, moments, _with_gap)


def _with_gap(x: FloatArray) -> FloatArray:
    """Return the first coordinate and its gap to the second, (..., 2)."""
    return np.stack([x[..., 0], x[..., 0] - x[..., 1]], axis=-1)


TARGETS = {
    "gaussian": nine_dimensional_gaussian(),
    "banana": banana(),
    "bounded": bounded(),
    "wedge": wedge(),
    "bimodal": normals([0.3, 0.7], [-2.0, 2.0], 0.7, 2.0),
    # No step that is local goes across.
    "far modes": normals([0.3, 0.7], [-10.0, 10.0], 1.0, 10.0),
}


def worst_score(known: Known, moves: WeightedMoves, steps: int) -> float:
    walkers = 200
    posterior = target(known.log_density, known.free)
    _, point = gaussian(known.free)
    result = []
    for child in np.random.SeedSequence(1).spawn(REPLICATES):
        generator = np.random.default_rng(child)
        draws = known.draw(generator, walkers)
        flat = target(lambda x: np.zeros(len(x)), known.free)
        state = start(flat, point, 0, walkers, generator)
        state = replace(state, coordinates=draws, log_density=known.log_density(draws))
        chain = known.view(advance(posterior, [state], [moves], steps)[0].coordinates)
        result.append([np.mean(chain**power, axis=(0, 1)) for power in (1, 2)])
    means = np.array(result)
    error = np.std(means, axis=0, ddof=1) / np.sqrt(REPLICATES)
    scores: FloatArray = np.abs(np.mean(means, axis=0) - known.moments) / error
    return float(np.max(scores))
