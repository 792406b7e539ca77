"""Coordinates in which a curved posterior is straight.

Along a ridge that a record hardly tells, other parameters follow the one that is free, and seldom
in a straight line: the ridge is a hundred times as long as wide, and bent by many times its width.
No few ellipsoids cover it. A :class:`QuadraticMap` takes the draws' principal coordinates, longest
first, and lets each bend quadratically with those before it. Of two sds a record may tell hardly
more than what they are together: the ridge is then two legs at a right angle, which a
:class:`TotalMap` puts in line. Neither changes volumes, but for the units of the first, so a
distribution of the straight coordinates is one of the bent ones, density and all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.noise import DISCREPANCY_SD, SENSOR_SD
from bwbayes.inference.parameters import JointPrior

LONGEST = 12  # only the longest coordinates bend others
FARTHEST = 5.0  # sds beyond which a bend goes on straight: no draws have shown it


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
        """Fit to draws (count, free), or 20,000 of them, by least squares; None if not bent.

        A coordinate bends if that explains a tenth of its variance, and with as many others as
        leave fifty draws to a coefficient.

        Raises
        ------
        numpy.linalg.LinAlgError
            The decomposition of the draws does not converge.
        """
        draws = subsample(draws, 20_000)
        count, free = draws.shape
        center = np.mean(draws, axis=0)
        # Singular values keep the digits of directions that variances would lose.
        _, lengths, axes = np.linalg.svd(np.linalg.qr(draws - center, mode="r"))
        factor = axes.T * (lengths / np.sqrt(count))
        z = np.linalg.solve(factor, (draws - center).T).T
        longest = min(free, LONGEST)
        bends = np.zeros((longest * (longest + 1) // 2, free))
        products = np.empty((count, 0))
        for j in range(1, free):
            if j <= LONGEST and (products.shape[1] + j) * 50 <= count:
                products = np.concatenate([products, _products(z, j - 1)], axis=1)
            terms = products.shape[1]
            # Few draws tell little: each coefficient is drawn to zero by a thousandth of them all.
            information = products.T @ products / count + 1e-3 * np.eye(terms)
            coefficients = np.linalg.solve(information, products.T @ z[:, j] / count)
            straight = z[:, j] - products @ coefficients
            if np.var(straight) < 0.9 * np.var(z[:, j]):
                z[:, j], bends[:terms, j] = straight, coefficients
        return cls(center, factor, bends) if bends.any() else None

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
        k, i = np.tril_indices(min(self.center.size, LONGEST))
        return i, k

    @cached_property
    def _curved(self) -> tuple[tuple[int, int], ...]:
        """The coordinates that bend, and how many pairs bend them."""
        bent = [(j, np.flatnonzero(column)) for j, column in enumerate(self.bends.T)]
        return tuple((j, int(rows[-1]) + 1) for j, rows in bent if rows.size)

    def to_curved(self, straight: FloatArray) -> FloatArray:
        """Return x (..., free) of z (..., free)."""
        i, k = self._pairs
        near = np.clip(straight, -FARTHEST, FARTHEST)
        products = near[..., i] * near[..., k] - (i == k)
        x: FloatArray = self.center + (straight + products @ self.bends) @ self.factor.T
        return x

    def to_straight(self, bent: FloatArray) -> FloatArray:
        """Return z (..., free) of x (..., free)."""
        z = ((bent - self.center) @ self._inverse).reshape(-1, self.center.size)
        for start in range(0, len(z), 4096):  # products take memory
            chunk = z[start : start + 4096]
            products = np.empty((len(chunk), 0))
            last = 0
            for j, end in self._curved:
                while products.shape[1] < end:
                    products = np.concatenate([products, _products(chunk, last)], axis=1)
                    last += 1
                chunk[:, j] -= products[:, :end] @ self.bends[:end, j]
        return z.reshape(bent.shape)


@dataclass(frozen=True)
class TotalMap:
    """The map from straight coordinates y to those x of pairs of sds a and b that add up.

    With ln a = c₁ + s₁ x₁ and ln b = c₂ + s₂ x₂,

        s₁ y₁ = ln √(a² + b²),   s₂ y₂ = ln (b / a),

    and all other coordinates stay what they are.

    Parameters
    ----------
    rows
        The coordinates of a and b, (pairs, 2).
    center
        c, (pairs, 2).
    scale
        s, (pairs, 2).
    """

    rows: IntArray
    center: FloatArray
    scale: FloatArray

    @classmethod
    def of_noise(cls, prior: JointPrior) -> TotalMap | None:
        """Take the sds of each record's sensor and discrepancy, where both are free and lognormal.

        None if there are no such pairs.
        """
        forms = {
            (p.plain, p.record): (row, p.formula)
            for row, p in enumerate(prior.free)
            if p.formula is not None and p.formula.logarithmic
        }
        records = dict.fromkeys(record for _, record in forms)
        wanted = [[(sd.name, record) for sd in (SENSOR_SD, DISCREPANCY_SD)] for record in records]
        pairs = [[forms[key] for key in pair] for pair in wanted if forms.keys() >= {*pair}]
        if not pairs:
            return None
        rows = [[row for row, _ in pair] for pair in pairs]
        scales = [[(math.log(form.center), form.scale) for _, form in pair] for pair in pairs]
        center, scale = np.moveaxis(np.array(scales), -1, 0)
        return cls(np.array(rows), center, scale)

    def to_curved(self, straight: FloatArray) -> FloatArray:
        """Return x (..., free) of y (..., free)."""
        x = straight.copy()
        total, ratio = np.moveaxis(self.scale * straight[..., self.rows], -1, 0)
        a = total - 0.5 * np.logaddexp(0.0, 2 * ratio)
        x[..., self.rows] = (np.stack([a, a + ratio], axis=-1) - self.center) / self.scale
        return x

    def to_straight(self, bent: FloatArray) -> FloatArray:
        """Return y (..., free) of x (..., free)."""
        y = bent.copy()
        a, b = np.moveaxis(self.center + self.scale * bent[..., self.rows], -1, 0)
        together = np.stack([0.5 * np.logaddexp(2 * a, 2 * b), b - a], axis=-1)
        y[..., self.rows] = together / self.scale
        return y

    def slopes(self, bent: FloatArray) -> FloatArray:
        """Return ∂y/∂x (places, free, free) at x (places, free)."""
        free = bent.shape[1]
        slopes = np.broadcast_to(np.eye(free), (len(bent), free, free)).copy()
        for (i, j), center, (s_i, s_j) in zip(self.rows, self.center, self.scale, strict=True):
            a, b = (center + (s_i, s_j) * bent[:, [i, j]]).T
            share = scipy.special.expit(2 * (b - a))
            slopes[:, i, i], slopes[:, i, j] = 1 - share, share * s_j / s_i
            slopes[:, j, i] = -s_i / s_j
        return slopes


def subsample(draws: FloatArray, count: int) -> FloatArray:
    """Return so many of draws (count, free) at most, evenly from first to last."""
    # An odd stride, or the same few walkers might be taken at every step.
    return draws[:: -(-len(draws) // count) | 1]


def _products(z: FloatArray, last: int) -> FloatArray:
    """Return cᵢ cₖ − δᵢₖ (count, k + 1) of one k, the ``last``, and every i up to it."""
    near = np.clip(z[:, : last + 1], -FARTHEST, FARTHEST)
    products: FloatArray = near * near[:, -1:]
    products[:, -1] -= 1.0
    return products
