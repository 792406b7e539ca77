"""Distributions that propose places independently of where a walker is.

A Student-t distribution around the draws of a pilot covers a posterior that is nearly Gaussian. A
skewed one, with a long tail along some ridge, takes a few of them: a mixture fitted by expectation
maximization, in coordinates that straighten the ridge if it is curved
(:class:`~bwbayes.sampling.curvature.QuadraticMap`). Heavy tails on every component keep the ratio
of posterior to proposal bounded.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.sampling.curvature import QuadraticMap, subsample
from bwbayes.shown import brief

_ARRAYS = ("weights", "centers", "factors", "freedom")


@dataclass(frozen=True)
class StudentMixture:
    """A mixture of multivariate Student-t distributions as an independence proposal.

    Over p coordinates z, straight ones if there is a bend, with ν degrees of freedom,

        log q = log Σ wⱼ |Lⱼ|⁻¹ (1 + |Lⱼ⁻¹(z − μⱼ)|² / ν)^(−(ν + p)/2) + constant.

    Parameters
    ----------
    weights
        wⱼ, (components,), adding up to one.
    centers
        μⱼ, (components, free).
    factors
        Lⱼ, lower triangular, (components, free, free).
    bend
        What makes the coordinates in which they are straight; None for the coordinates themselves.
    freedom
        ν; small enough for tails heavier than the posterior's.
    """

    __repr__ = brief

    weights: FloatArray
    centers: FloatArray
    factors: FloatArray
    bend: QuadraticMap | None = None
    freedom: float = 6.0

    @classmethod
    def fitted(
        cls,
        draws: FloatArray,
        log_density: FloatArray | None = None,
        guess: StudentMixture | None = None,
    ) -> StudentMixture:
        """Fit to draws (count, free), by expectation maximization of a Gaussian mixture.

        Of three components, or up to six where draws are many: few would be followed too closely.
        With their log densities (count,) under what they are drawn from, the mixture gets one more
        component, of the draws where log p − log q is largest: a walker that is there would hardly
        be led away. Modes that a first ``guess`` has beside the most probable one get a component
        each, and as much as a twentieth of the draws would give it, however few there are: a mode
        that is not proposed is not found again. What bends the coordinates is the first mode.

        Raises
        ------
        numpy.linalg.LinAlgError
            The draws do not span the space.
        """
        _require_spread(draws)
        count, straightened, modes = len(draws), draws, draws[:0]
        if guess is not None and guess._lesser:
            likeliest = np.argmax(guess.log_parts(guess.squares(draws)), axis=0)
            straightened = draws[np.asarray(guess._modes)[likeliest] == 0]
            draws = np.concatenate([draws, guess._stand_ins(count // 20)])
            modes = guess.centers[guess._lesser]
        bend = QuadraticMap.fitted(straightened)
        if bend is not None:
            draws, modes = bend.to_straight(draws), bend.to_straight(modes)
        # First with so few of the draws that they cost little, then with all.
        sample = subsample(draws, 1024)
        # A draw belongs at first to the nearest of a few, or of the modes, in units of their sds.
        at = np.linspace(0, len(sample) - 1, min(max(count // 4_000, 3), 6)).astype(int)
        few = np.concatenate([sample[at], modes])
        away = (few[:, np.newaxis] - sample) / np.std(sample, axis=0)
        nearest = np.argmin(np.sum(away**2, axis=2), axis=0)
        mixture = _of_shares(sample, np.equal.outer(np.arange(len(few)), nearest))
        for _ in range(25):
            mixture = mixture._fitted_on(sample)
        sample = subsample(draws, 10_000)
        for _ in range(5):
            mixture = mixture._fitted_on(sample)
        if log_density is not None:
            draws = draws[:count]
            log_ratio = log_density - mixture.log_density(draws)
            # The 2% of draws with the largest log p − log q.
            worst = log_ratio >= np.quantile(log_ratio, 0.98)
            added = _of_shares(draws, np.stack([worst, ~worst]))
            mixture = StudentMixture(
                np.append(0.9 * mixture.weights, 0.1),
                np.concatenate([mixture.centers, added.centers[:1]]),
                np.concatenate([mixture.factors, added.factors[:1]]),
            )
        return replace(mixture, bend=bend)

    @classmethod
    def around(
        cls, optima: FloatArray, covariances: FloatArray, shares: FloatArray
    ) -> StudentMixture:
        """Take modes' places (modes, free), covariances (modes, free, free) and shares (modes,).

        The first three modes; of fewer, the same ones again, twice and three times as wide. No
        component gets less than a twelfth: the shares of modes are a guess.
        """
        modes = np.arange(3) % len(optima)
        widths = 1.0 + np.arange(3) // len(optima)
        factors = widths[:, np.newaxis, np.newaxis] * np.linalg.cholesky(covariances)[modes]
        split_shares = shares[modes] / np.bincount(modes)[modes]
        weights = 0.75 * split_shares / np.sum(split_shares) + 0.25 / 3
        return cls(weights, optima[modes], factors)

    def arrays(self) -> dict[str, Any]:
        """Return what it is made of, by name, to be written to a file."""
        arrays = {name: value for name, value in vars(self).items() if name in _ARRAYS}
        if self.bend is None:
            return arrays
        return arrays | {f"bend_{f.name}": getattr(self.bend, f.name) for f in fields(self.bend)}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, Any]) -> StudentMixture | None:
        """Return the mixture that was written to a file as :meth:`arrays`, if any was."""
        if "weights" not in arrays:
            return None
        bend = None
        if "bend_bends" in arrays:
            bend = QuadraticMap(**{f.name: arrays[f"bend_{f.name}"] for f in fields(QuadraticMap)})
        return cls(**{name: arrays[name] for name in _ARRAYS}, bend=bend)

    @cached_property
    def _whitening(self) -> FloatArray:
        # Its transpose times a row is one product for all coordinates.
        return np.ascontiguousarray(np.linalg.inv(self.factors).transpose(0, 2, 1))

    @cached_property
    def _log_volumes(self) -> FloatArray:
        """The log determinants of the factors, (components,)."""
        return np.sum(np.log(np.diagonal(self.factors, axis1=1, axis2=2)), axis=1)

    def squares(self, straight: FloatArray) -> FloatArray:
        """Squared distances |Lⱼ⁻¹(z − μⱼ)|² (components, ...) of coordinates (..., free)."""
        pairs = zip(self.centers, self._whitening, strict=True)
        white = [(straight - center) @ whitening for center, whitening in pairs]
        return np.stack([np.einsum("...j,...j->...", z, z) for z in white])

    def log_parts(self, squares: FloatArray) -> FloatArray:
        """Log densities times weights, of :meth:`squares` and shaped alike."""
        freedom, free = self.freedom, self.centers.shape[1]
        # Of a Student-t distribution.
        constant = scipy.special.gammaln((freedom + free) / 2) - scipy.special.gammaln(freedom / 2)
        constant -= 0.5 * free * np.log(freedom * np.pi)
        scales = np.log(self.weights) - self._log_volumes + constant
        scales = scales.reshape(-1, *[1] * (squares.ndim - 1))
        parts: FloatArray = scales - 0.5 * (freedom + free) * np.log1p(squares / freedom)
        return parts

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Log density (..., count) at coordinates (..., count, free)."""
        flat = coordinates.reshape(-1, coordinates.shape[-1])
        density, lost = np.empty(len(flat)), 0.0 if self.bend is None else self.bend.log_volume
        for start in range(0, len(flat), 1 << 15):  # the components take memory
            chunk = flat[start : start + (1 << 15)]
            straight = chunk if self.bend is None else self.bend.to_straight(chunk)
            parts = self.log_parts(self.squares(straight))
            density[start : start + len(chunk)] = np.logaddexp.reduce(parts) - lost
        return density.reshape(coordinates.shape[:-1])

    def draw(self, random: np.random.RandomState, count: int) -> FloatArray:
        """Draw coordinates (count, free) with emcee's generator."""
        # As ``random.choice`` does with these weights, without its checks of them.
        ends = np.cumsum(self.weights)
        chosen = (ends / ends[-1]).searchsorted(random.random_sample(count), side="right")
        normal = random.standard_normal((count, self.centers.shape[1]))
        spread = np.sqrt(self.freedom / random.chisquare(self.freedom, count))
        steps = (self.factors[chosen] @ (normal * spread[:, np.newaxis])[:, :, np.newaxis])[:, :, 0]
        drawn: FloatArray = self.centers[chosen] + steps
        return drawn if self.bend is None else self.bend.to_curved(drawn)

    @cached_property
    def _modes(self) -> list[int]:
        """Which mode each component stands for, (components,): those of one center, one mode."""
        centers = [tuple(center) for center in self.centers]
        return [list(dict.fromkeys(centers)).index(center) for center in centers]

    @property
    def _lesser(self) -> list[int]:
        """The first component of each mode but the first."""
        return [self._modes.index(mode) for mode in range(1, max(self._modes) + 1)]

    def _stand_ins(self, count: int) -> FloatArray:
        """Return points (some, free) that stand for ``count`` draws of each mode but the first.

        With the columns lₖ of L, the points μ ± lₖ √p have the component's mean and covariance.
        """
        points = [self.centers[:0]]
        for component in self._lesser:
            steps = np.sqrt(self.centers.shape[1]) * self.factors[component].T
            around = self.centers[component] + np.concatenate([steps, -steps])
            points.append(np.tile(around, (math.ceil(count / len(around)), 1)))
        return np.concatenate(points)

    def _fitted_on(self, draws: FloatArray) -> StudentMixture:
        """Take a round of expectation maximization."""
        logs = np.log(self.weights) - self._log_volumes
        logs = logs[:, np.newaxis] - 0.5 * self.squares(draws)
        density = np.exp(logs - np.max(logs, axis=0))
        return _of_shares(draws, density / np.sum(density, axis=0))


def _require_spread(draws: FloatArray) -> None:
    """Refuse draws (count, free) that do not span the space."""
    # Rounding leaves some variance to draws that lie in a plane, or do not differ at all.
    plane = np.column_stack([np.ones(len(draws)), draws])
    # The triangle has the singular values of all draws, and is small.
    sizes = np.linalg.svd(np.linalg.qr(plane, mode="r"), compute_uv=False)
    if np.sum(sizes > sizes[0] * max(plane.shape) * np.finfo(float).eps) < plane.shape[1]:
        raise np.linalg.LinAlgError("the draws do not span the space")


def _of_shares(draws: FloatArray, share: FloatArray) -> StudentMixture:
    """Return the mixture whose components have these shares (components, count) of draws.

    Every component gets a thousandth of each draw, so that none starves, and a tenth of the mean
    covariance: the draws are few. That of all draws would be far too wide where components are
    modes apart.
    """
    share = (share + 1e-3) / (1 + 1e-3 * len(share))
    weights = share.mean(axis=1)
    parts = share / share.sum(axis=1, keepdims=True)
    centers = parts @ draws
    deviations = [(draws - center).T for center in centers]
    covariances = np.stack([(p * d) @ d.T for p, d in zip(parts, deviations, strict=True)])
    together = np.average(covariances, axis=0, weights=weights)
    return StudentMixture(weights, centers, np.linalg.cholesky(0.9 * covariances + 0.1 * together))
