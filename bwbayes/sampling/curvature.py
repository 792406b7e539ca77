"""Coordinates in which a curved posterior is straight.

Along a ridge that a record hardly tells, other parameters follow the one that is free, and seldom
in a straight line: the ridge is a hundred times as long as wide, and bent by many times its width.
No few ellipsoids cover it. A :class:`QuadraticMap` takes the draws' principal coordinates, longest
first, and lets each bend quadratically with those before it. That changes no volume, so a
distribution of the straight coordinates is one of the bent ones, density and all.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bwbayes.arrays import FloatArray, IntArray

__all__ = ["QuadraticMap", "pairs", "rows_of", "subsample"]

# A coordinate bends if that explains so much of its variance.
LEAST_EXPLAINED = 0.1

# Only the longest coordinates bend others: so many, and fewer if a coefficient has fewer draws.
LONGEST = 12
DRAWS_EACH = 50

# Draws that a bend is fitted to, and places that are straightened at once: products take memory.
FITTED = 20_000
AT_ONCE = 4096

# Added to the coefficients' information, in units of that of all draws: few draws tell little.
RIDGE = 1e-3

# A bend goes on straight beyond so many sds, where no draws have shown it.
FARTHEST = 5.0


@dataclass(frozen=True)
class QuadraticMap:
    """The map from straight coordinates z to bent ones x.

    With c = clip(z) to five sds, over coordinates in the order of their lengths,

        yⱼ = zⱼ + Σ_{i ≤ k < j} bᵢₖⱼ (cᵢ cₖ − δᵢₖ),   x = μ + y Fᵀ.

    Parameters
    ----------
    center
        μ, (free,).
    factor
        F, (free, free): its columns are the principal axes of the draws, as long as their sds.
    bends
        bᵢₖⱼ, (pairs, free), zero unless i ≤ k < j; the pairs (0, 0), (0, 1), (1, 1), (0, 2), … of
        the first twelve coordinates.
    """

    center: FloatArray
    factor: FloatArray
    bends: FloatArray

    @classmethod
    def fitted(cls, draws: FloatArray) -> QuadraticMap | None:
        """Fit to draws (count, free), or some of many, by least squares; None if not bent.

        Raises
        ------
        numpy.linalg.LinAlgError
            The decomposition of the draws does not converge.
        """
        draws = subsample(draws, FITTED)
        count, free = draws.shape
        center = np.mean(draws, axis=0)
        # Singular values keep the digits of directions that variances would lose.
        _, lengths, axes = np.linalg.svd(np.linalg.qr(draws - center, mode="r"))
        factor = axes.T * (lengths / np.sqrt(count))
        z = np.linalg.solve(factor, (draws - center).T).T
        bends = np.zeros((pairs(free), free))
        products = np.empty((count, 0))
        for j in range(1, free):
            if j <= LONGEST and (products.shape[1] + j) * DRAWS_EACH <= count:
                products = np.concatenate([products, _products(z, j - 1)], axis=1)
            terms = products.shape[1]
            information = products.T @ products / count + RIDGE * np.eye(terms)
            coefficients = np.linalg.solve(information, products.T @ z[:, j] / count)
            straight = z[:, j] - products @ coefficients
            if np.var(straight) < (1 - LEAST_EXPLAINED) * np.var(z[:, j]):
                z[:, j], bends[:terms, j] = straight, coefficients
        return cls(center, factor, bends) if bends.any() else None

    @classmethod
    def of(cls, numbers: FloatArray) -> QuadraticMap | None:
        """Return the bend of ``numbers``; None if they are zero."""
        free = numbers.shape[1]
        return cls(numbers[0], *np.split(numbers[1:], [free])) if numbers.any() else None

    @property
    def numbers(self) -> FloatArray:
        """μ, F and b as one table, (1 + free + pairs, free)."""
        return np.vstack([self.center, self.factor, self.bends])

    @cached_property
    def log_volume(self) -> float:
        """Log |det F|: what a density loses on the way to x."""
        return float(np.linalg.slogdet(self.factor)[1])

    @cached_property
    def _inverse(self) -> FloatArray:
        return np.ascontiguousarray(np.linalg.inv(self.factor).T)

    @cached_property
    def _pairs(self) -> tuple[IntArray, IntArray]:
        """Every i and k of the rows of ``bends``."""
        longest = np.arange(min(self.center.size, LONGEST))
        k = np.repeat(longest, longest + 1)
        return np.concatenate([longest[: last + 1] for last in longest]), k

    @cached_property
    def _curved(self) -> tuple[tuple[int, int], ...]:
        """The coordinates that bend, and how many pairs bend them."""
        ends = [
            int(np.flatnonzero(column)[-1]) + 1 if column.any() else 0 for column in self.bends.T
        ]
        return tuple((j, end) for j, end in enumerate(ends) if end)

    def to_curved(self, straight: FloatArray) -> FloatArray:
        """Return x (..., free) of z (..., free)."""
        i, k = self._pairs
        near = np.clip(straight, -FARTHEST, FARTHEST)
        products = near[..., i] * near[..., k] - (i == k)
        x: FloatArray = self.center + (straight + products @ self.bends) @ self.factor.T
        return x

    def to_straight(self, bent: FloatArray) -> FloatArray:
        """Return z (..., free) of x (..., free)."""
        places = bent.reshape(-1, bent.shape[-1])
        chunks = [places[i : i + AT_ONCE] for i in range(0, len(places), AT_ONCE)]
        z = np.concatenate([self._straight(chunk) for chunk in chunks]) if chunks else places
        return z.reshape(bent.shape)

    def _straight(self, bent: FloatArray) -> FloatArray:
        """Do it for places (count, free), one coordinate after the other."""
        z: FloatArray = (bent - self.center) @ self._inverse
        products = np.empty((len(z), 0))
        last = 0
        for j, end in self._curved:
            while products.shape[1] < end:
                products = np.concatenate([products, _products(z, last)], axis=1)
                last += 1
            z[:, j] -= products[:, :end] @ self.bends[:end, j]
        return z


def subsample(draws: FloatArray, count: int) -> FloatArray:
    """Return so many of draws (count, free) at most, evenly from first to last."""
    # An odd stride, or the same few walkers might be taken at every step.
    return draws[:: -(-len(draws) // count) | 1]


def pairs(free: int) -> int:
    """Return how many pairs of so many coordinates may bend others."""
    longest = min(free, LONGEST)
    return longest * (longest + 1) // 2


def rows_of(free: int) -> int:
    """Return how many rows the numbers of a bend have."""
    return 1 + free + pairs(free)


def _products(z: FloatArray, last: int) -> FloatArray:
    """Return cᵢ cₖ − δᵢₖ (count, k + 1) of one k, the ``last``, and every i up to it."""
    near = np.clip(z[:, : last + 1], -FARTHEST, FARTHEST)
    products: FloatArray = near * near[:, -1:]
    products[:, -1] -= 1.0
    return products
