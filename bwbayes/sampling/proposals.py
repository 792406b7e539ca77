"""Distributions that propose places independently of where a walker is.

A Student-t distribution around the draws of a pilot covers a posterior that is nearly Gaussian. A
skewed one, with a long tail along some ridge, takes a few of them: a mixture fitted by expectation
maximization, in coordinates that straighten the ridge if it is curved
(:class:`~bwbayes.sampling.curvature.QuadraticMap`). Heavy tails on every component keep the ratio
of posterior to proposal bounded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.sampling.curvature import QuadraticMap, subsample
from bwbayes.shown import brief

__all__ = ["COMPONENTS", "Proposal", "StudentMixture", "StudentProposal"]

# Where the draws are first cut, along their most skewed coordinate: body, flank and tail.
CUTS = (0.5, 0.85)
PARTS = len(CUTS) + 1
COMPONENTS = PARTS + 1  # at most: one more for the draws that these cover worst

# Which part of the draws that is, and how often it proposes.
WORST = 0.02
WORST_SHARE = 0.1

# Part of a first guess that goes to all components alike.
LEAST_GUESS = 0.25

# Rounds of the fit: first with so few of the draws that they cost little, then with all.
ROUGH_ROUNDS = 25
ROUGH_DRAWS = 1024
ROUNDS = 5

# Part of the covariance of all components together that each keeps: the draws of a pilot are few.
# That of all draws would be far too wide where components are modes apart.
SHRINKAGE = 0.1

# Share of every draw that every component keeps, so that none starves.
LEAST_SHARE = 1e-3


@runtime_checkable
class Proposal(Protocol):
    """An independence proposal, as ``emcee.moves.MHMove`` takes it."""

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Log density (..., count) at coordinates (..., count, free), up to a constant."""

    def draw(self, random: np.random.RandomState, count: int) -> FloatArray:
        """Draw coordinates (count, free) with emcee's generator."""

    def __call__(
        self, coordinates: FloatArray, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose for ``coordinates`` (walkers, free): places and log q(old) − log q(new)."""


@dataclass(frozen=True)
class StudentProposal:
    """A multivariate Student-t distribution as an independence proposal.

    With ν degrees of freedom, center μ and covariance-like scale LLᵀ over p coordinates,

        log q(x) = −(ν + p)/2 log(1 + |L⁻¹(x − μ)|² / ν) − log det L + constant.

    Parameters
    ----------
    center
        μ, (free,).
    factor
        L, lower triangular, (free, free).
    freedom
        ν; small enough for tails heavier than the posterior's.
    """

    __repr__ = brief

    center: FloatArray
    factor: FloatArray
    freedom: float = 6.0

    @classmethod
    def fitted(cls, draws: FloatArray) -> StudentProposal:
        """Fit to draws (count, free) by their mean and covariance.

        The scale is the covariance itself, a little wider than the t of that covariance: a
        proposal that is too wide costs acceptance, one that is too narrow costs mixing.

        Raises
        ------
        numpy.linalg.LinAlgError
            The draws do not span the space.
        """
        _require_spread(draws)
        return cls(
            np.mean(draws, axis=0), np.linalg.cholesky(np.atleast_2d(np.cov(draws, rowvar=False)))
        )

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Log density (..., count) at coordinates (..., count, free), up to a constant."""
        power = 0.5 * (self.freedom + self.center.size)
        tails = power * np.log1p(self.squares(coordinates) / self.freedom)
        density: FloatArray = -tails - self.log_volume
        return density

    def squares(self, coordinates: FloatArray) -> FloatArray:
        """Squared distances |L⁻¹(x − μ)|² (..., count) of coordinates (..., count, free) from μ."""
        white = (coordinates - self.center) @ self._whitening
        distances: FloatArray = np.einsum("...j,...j->...", white, white)
        return distances

    @cached_property
    def log_volume(self) -> float:
        """The log determinant of L."""
        return float(np.sum(np.log(np.diag(self.factor))))

    @cached_property
    def _whitening(self) -> FloatArray:
        # Its transpose times a row is one product for all coordinates.
        return np.ascontiguousarray(np.linalg.inv(self.factor).T)

    def draw(self, random: np.random.RandomState, count: int) -> FloatArray:
        """Draw coordinates (count, free) with emcee's generator."""
        normal = random.standard_normal((count, self.center.size))
        spread = np.sqrt(self.freedom / random.chisquare(self.freedom, count))
        coordinates: FloatArray = self.center + (normal * spread[:, np.newaxis]) @ self.factor.T
        return coordinates

    def __call__(
        self, coordinates: FloatArray, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose, as ``emcee.moves.MHMove`` asks: places and log q(old) − log q(new)."""
        proposed = self.draw(random, coordinates.shape[0])
        return proposed, self.log_density(coordinates) - self.log_density(proposed)


@dataclass(frozen=True)
class StudentMixture:
    """A mixture of Student-t distributions, log q(x) = log Σ wⱼ qⱼ(x).

    Parameters
    ----------
    weights
        wⱼ, (components,), adding up to one.
    components
        The distributions, of one number of degrees of freedom.
    bend
        What makes the coordinates in which they are straight; None for the coordinates themselves.
    """

    __repr__ = brief

    weights: FloatArray
    components: tuple[StudentProposal, ...]
    bend: QuadraticMap | None = None

    @classmethod
    def fitted(cls, draws: FloatArray, log_density: FloatArray | None = None) -> StudentMixture:
        """Fit to draws (count, free), by expectation maximization of a Gaussian mixture.

        With their log densities (count,) under what they are drawn from, the mixture gets one more
        component, of the draws where log p − log q is largest: a walker that is there would hardly
        be led away.

        Raises
        ------
        numpy.linalg.LinAlgError
            The draws do not span the space.
        """
        _require_spread(draws)
        bend = QuadraticMap.fitted(draws)
        if bend is not None:
            draws = bend.to_straight(draws)
        sample = subsample(draws, ROUGH_DRAWS)
        mixture = _first_cut(sample)
        for _ in range(ROUGH_ROUNDS):
            mixture = mixture._fitted_on(sample)
        for _ in range(ROUNDS):
            mixture = mixture._fitted_on(draws)
        if log_density is not None:
            mixture = mixture._with_worst(draws, log_density - mixture.log_density(draws))
        return replace(mixture, bend=bend)

    @classmethod
    def around(
        cls, optima: FloatArray, covariances: FloatArray, shares: FloatArray
    ) -> StudentMixture:
        """Take modes' places (modes, free), covariances (modes, free, free) and shares (modes,).

        The first three modes; of fewer, the same ones again, twice and three times as wide. No
        component gets less than a twelfth: the shares of modes are a guess.
        """
        modes = np.arange(PARTS) % len(optima)
        factors = np.linalg.cholesky(covariances)
        parts = (
            StudentProposal(optima[mode], (1 + i // len(optima)) * factors[mode])
            for i, mode in enumerate(modes)
        )
        split_shares = shares[modes] / np.bincount(modes)[modes]
        weights = (1 - LEAST_GUESS) * split_shares / np.sum(split_shares) + LEAST_GUESS / PARTS
        return cls(weights, tuple(parts))

    @cached_property
    def _ends(self) -> FloatArray:
        """Where each component's part of the numbers from 0 to 1 ends."""
        ends = np.cumsum(self.weights)
        return np.asarray(ends / ends[-1])

    @cached_property
    def _places(self) -> tuple[FloatArray, FloatArray]:
        """The components' centers (components, free) and factors (components, free, free)."""
        centers, factors = zip(*((c.center, c.factor) for c in self.components), strict=True)
        return np.stack(centers), np.stack(factors)

    def _fitted_on(self, draws: FloatArray) -> StudentMixture:
        """Take a round of expectation maximization."""
        parts = [_gaussian(component, draws) for component in self.components]
        logs = np.log(self.weights)[:, np.newaxis] + np.stack(parts)
        density = np.exp(logs - np.max(logs, axis=0))
        return _of_shares(draws, _kept_alive(density / np.sum(density, axis=0)))

    def _with_worst(self, draws: FloatArray, log_ratio: FloatArray) -> StudentMixture:
        """Add the component of the draws (count, free) with the largest log p − log q (count,)."""
        worst = log_ratio >= np.quantile(log_ratio, 1 - WORST)
        component = _components(draws, _kept_alive(np.stack([worst, ~worst])))[0]
        weights = np.append((1 - WORST_SHARE) * self.weights, WORST_SHARE)
        return StudentMixture(weights, (*self.components, component))

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Log density (..., count) at coordinates (..., count, free), up to a constant."""
        lost = 0.0
        if self.bend is not None:
            coordinates, lost = self.bend.to_straight(coordinates), self.bend.log_volume
        parts = [component.log_density(coordinates) for component in self.components]
        logs = np.stack(
            [log + values for log, values in zip(np.log(self.weights), parts, strict=True)]
        )
        density: FloatArray = np.logaddexp.reduce(logs) - lost
        return density

    def draw(self, random: np.random.RandomState, count: int) -> FloatArray:
        """Draw coordinates (count, free) with emcee's generator."""
        # As ``random.choice`` does with these weights, without its checks of them.
        chosen = self._ends.searchsorted(random.random_sample(count), side="right")
        centers, factors = self._places
        freedom = self.components[0].freedom
        normal = random.standard_normal((count, centers.shape[1]))
        spread = np.sqrt(freedom / random.chisquare(freedom, count))
        away = (factors[chosen] @ (normal * spread[:, np.newaxis])[:, :, np.newaxis])[:, :, 0]
        drawn: FloatArray = centers[chosen] + away
        return drawn if self.bend is None else self.bend.to_curved(drawn)

    def __call__(
        self, coordinates: FloatArray, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose, as ``emcee.moves.MHMove`` asks: places and log q(old) − log q(new)."""
        proposed = self.draw(random, coordinates.shape[0])
        old, new = np.split(self.log_density(np.concatenate([coordinates, proposed])), 2)
        return proposed, old - new


def _require_spread(draws: FloatArray) -> None:
    """Refuse draws (count, free) that do not span the space."""
    # Rounding leaves some variance to draws that lie in a plane, or do not differ at all.
    plane = np.column_stack([np.ones(len(draws)), draws])
    # The triangle has the singular values of all draws, and is small.
    sizes = np.linalg.svd(np.linalg.qr(plane, mode="r"), compute_uv=False)
    if np.sum(sizes > sizes[0] * max(plane.shape) * np.finfo(float).eps) < plane.shape[1]:
        raise np.linalg.LinAlgError("the draws do not span the space")


def _first_cut(draws: FloatArray) -> StudentMixture:
    """Cut draws (count, free) along their most skewed coordinate."""
    shape = np.asarray(scipy.stats.skew(draws, axis=0))
    axis = int(np.argmax(np.abs(shape)))
    # Ranks from the body of the distribution to its longer tail.
    along = draws[:, axis] * (1 if shape[axis] >= 0 else -1)
    start = np.searchsorted(np.quantile(along, CUTS), along)
    return _of_shares(draws, _kept_alive(np.equal.outer(np.arange(PARTS), start)))


def _of_shares(draws: FloatArray, share: FloatArray) -> StudentMixture:
    """Return the mixture whose components have these shares (components, count) of draws."""
    return StudentMixture(share.mean(axis=1), tuple(_components(draws, share)))


def _kept_alive(share: FloatArray) -> FloatArray:
    """Give every component something of each draw; its weight says how little it matters."""
    raised: FloatArray = (share + LEAST_SHARE) / (1 + LEAST_SHARE * len(share))
    return raised


def _components(draws: FloatArray, share: FloatArray) -> list[StudentProposal]:
    """Weighted means and covariances, one component for each row of ``share``."""
    parts = share / share.sum(axis=1, keepdims=True)
    centers = parts @ draws
    deviations = [(draws - center).T for center in centers]
    covariances = np.stack(
        [(weights * away) @ away.T for weights, away in zip(parts, deviations, strict=True)]
    )
    together = np.average(covariances, axis=0, weights=share.mean(axis=1))
    factors = np.linalg.cholesky((1 - SHRINKAGE) * covariances + SHRINKAGE * together)
    return [StudentProposal(*pair) for pair in zip(centers, factors, strict=True)]


def _gaussian(component: StudentProposal, draws: FloatArray) -> FloatArray:
    """Log density of the normal distribution with a component's center and scale."""
    density: FloatArray = -0.5 * component.squares(draws) - component.log_volume
    return density
