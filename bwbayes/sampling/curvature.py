"""Coordinates in which a curved posterior is straight, and nearly normal.

Along a ridge that a record hardly determines, other parameters follow the free one, and seldom in a
straight line: the ridge is a hundred times as long as wide, and bent by many times its width. Tails
are longer on one side, and an offset is the less certain the larger the discrepancy. A few
ellipsoids do not cover such a shape, least of all with few draws. Three maps straighten it, one
after the other. A record may determine hardly more than the total of two sds, or of two lags in a
row: the ridge then has two legs at a right angle, which a :class:`TotalRatioMap` puts in line. A
:class:`SkewMap` makes both tails of each coordinate alike. A :class:`PolynomialMap` takes the part
of each coordinate that those before it leave open, longest first, and lets it bend with them, and
widen. Each map returns how much it stretches, so that a density of the straight
coordinates gives one of the bent ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import NamedTuple, Self

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.noise import DISCREPANCY_SD, SENSOR_SD
from bwbayes.inference.parameters import JointPrior
from bwbayes.model.stages.lags import TIME_CONSTANTS
from bwbayes.sampling.secant import SecantMap

# A polynomial has so many terms at most, of the longest coordinates, and of this degree at most.
TERMS, LONGEST, DEGREE = 128, 12, 4
FARTHEST = 5.0  # sds beyond which a bend continues straight: no draws show it there


@dataclass(frozen=True)
class PolynomialMap:
    """The map from straight coordinates z to bent ones x.

    With u = F⁻¹(x − μ), c = clip(u) to five sds, and the coordinates ordered so that each next one
    is the one that those before it leave open most,

        zⱼ = (uⱼ − Σₜ bₜⱼ Π c) exp(−Σ_{i < j} sᵢⱼ cᵢ),

    where the product of term t is of up to four cᵢ with i < j. A record determines a smooth
    function of the parameters well, of which this is the Taylor series.

    Parameters
    ----------
    center
        μ, (free,).
    factor
        F, (free, free), F Fᵀ the covariance of the draws; lower triangular in the order of the
        coordinates.
    terms
        The coordinates that each term multiplies, (terms, 4); -1 where it has fewer. Terms are in
        the order of their last coordinate.
    bends
        bₜⱼ, (terms, free), zero unless all coordinates of t come before j.
    scales
        sᵢⱼ, (twelve at most, free), zero unless i < j.
    """

    center: FloatArray
    factor: FloatArray
    terms: IntArray
    bends: FloatArray
    scales: FloatArray

    @classmethod
    def fitted(cls, draws: FloatArray) -> PolynomialMap | None:
        """Fit to draws (count, free), or 20,000 of them; None if not bent and of one width.

        A coordinate bends with the largest terms, where u is as long as the draws in units of x, of
        the number with which each half of the draws predicts the other best by least squares, but
        no more than leave fifty draws to a coefficient. It bends, and it widens, only if that makes
        the draws more probable by a hundredth of a nat each.

        Raises
        ------
        numpy.linalg.LinAlgError
            The decomposition of the draws does not converge.
        """
        draws = subsample(draws, 20_000)
        count, free = draws.shape
        center = np.mean(draws, axis=0)
        # Decompose the draws, not their covariance, which would lose digits.
        triangle, order = scipy.linalg.qr(draws - center, mode="r", pivoting=True)
        factor = np.empty((free, free))
        factor[order] = triangle[:free].T / np.sqrt(count)
        u = np.linalg.solve(factor, (draws - center).T).T
        near = _near(u)
        lengths = np.abs(np.diagonal(triangle))[: near.shape[1] - 1] / np.sqrt(count)
        terms = np.array([*combinations_with_replacement(range(-1, len(lengths)), DEGREE)])
        sizes = np.append(np.minimum(lengths, 1.0), 1.0)[terms].prod(axis=1)
        terms = terms[np.argsort(-sizes, kind="stable")[: min(count // 50, TERMS)]]
        products = _products(near, terms)
        halves = [
            _Regression.of(products[rows], u[rows])
            for rows in (slice(count // 2), slice(count // 2, None))
        ]
        bends, scales = np.zeros((len(terms), free)), np.zeros((len(lengths), free))
        for j in range(1, free):
            known = np.flatnonzero(terms[:, -1] < j)
            if used := _best_size(halves, known, j):
                known = known[:used]
                bends[known, j] = (halves[0] + halves[1]).coefficients(known, j)
                u[:, j] -= products[:, known] @ bends[known, j]
            others = min(j, len(lengths))
            scales[:others, j] = _fit_log_scales(near[:, :others], u[:, j])
        if not bends.any() and not scales.any():
            return None
        by_last = np.argsort(terms[:, -1], kind="stable")
        return cls(center, factor, terms[by_last], bends[by_last], scales)

    @cached_property
    def _inverse(self) -> FloatArray:
        return np.ascontiguousarray(np.linalg.inv(self.factor).T)

    @cached_property
    def _log_volume(self) -> float:
        """The logarithm of |det F|."""
        return float(np.linalg.slogdet(self.factor)[1])

    def inverse(self, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x (..., free) of z (..., free), and log |∂x/∂z| (...)."""
        z = whitened.reshape(-1, self.center.size)
        u, longest = np.empty_like(z), len(self.scales)
        near, bent = np.ones((len(z), longest + 1)), np.zeros(z.shape)
        ends = np.searchsorted(self.terms[:, -1], np.arange(-1, longest), side="right")
        begin, log_slope = 0, np.full(len(z), self._log_volume)
        for j in range(z.shape[1]):
            if j <= longest:  # the terms of those before it are known
                rows, begin = slice(begin, ends[j]), ends[j]
                bent += _products(near, self.terms[rows]) @ self.bends[rows]
            width = self._widths(near[:, : min(j, longest)], j)
            u[:, j] = z[:, j] * np.exp(width) + bent[:, j]
            log_slope += width
            if j < longest:
                near[:, j] = np.clip(u[:, j], -FARTHEST, FARTHEST)
        x = self.center + u @ self.factor.T
        return x.reshape(whitened.shape), log_slope.reshape(whitened.shape[:-1])

    def _widths(self, near: FloatArray, j: int | slice = slice(None)) -> FloatArray:
        """Return Σ sᵢⱼ cᵢ, within the five that draws may show, of the coordinates before j."""
        return np.clip(near @ self.scales[: near.shape[1], j], -FARTHEST, FARTHEST)

    def forward(self, bent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z (..., free) of x (..., free), and log |∂z/∂x| (...)."""
        z = ((bent - self.center) @ self._inverse).reshape(-1, self.center.size)
        log_slope = np.empty(len(z))
        for start in range(0, len(z), 4096):  # products take memory
            chunk = z[start : start + 4096]
            near = _near(chunk)
            widths = self._widths(near[:, :-1])
            chunk -= _products(near, self.terms) @ self.bends
            chunk *= np.exp(-widths)
            log_slope[start : start + 4096] = -self._log_volume - np.sum(widths, axis=1)
        return z.reshape(bent.shape), log_slope.reshape(bent.shape[:-1])


@dataclass(frozen=True)
class SkewMap:
    """The map from straight coordinates y to coordinates x with one longer tail, each by itself.

    With z = (x − μ) / σ and a power e = λ where z is positive, 2 − λ where not,

        |y| = σ ((1 + |z|)ᵉ − 1) / e,

    of the sign of z, after Yeo and Johnson (2000), Biometrika 87, 954-959.

    Parameters
    ----------
    center
        μ, (free,).
    scale
        σ, (free,).
    powers
        λ, (free,), between 0 and 2; 1 where both tails are alike.
    """

    center: FloatArray
    scale: FloatArray
    powers: FloatArray

    @classmethod
    def fitted(cls, draws: FloatArray) -> SkewMap:
        """Fit to draws (count, free), or 5,000 of them, so that each coordinate becomes normal.

        The fit is by maximum likelihood. Powers keep away from 0 and 2, where a tail would be
        exponential.
        """
        draws = subsample(draws, 5_000)
        center, scale = np.median(draws, axis=0), np.std(draws, axis=0)
        powers = [
            scipy.optimize.minimize_scalar(
                lambda power, z=z: -float(scipy.stats.yeojohnson_llf(power, z)),
                bounds=(0.1, 1.9),
                method="bounded",
                options={"xatol": 0.01},
            ).x
            for z in ((draws - center) / scale).T
        ]
        return cls(center, scale, np.array(powers))

    def inverse(self, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x (..., free) of y (..., free), and log |∂x/∂y| (...)."""
        power = self._power(whitened)
        log = np.log1p(power * np.abs(whitened) / self.scale) / power
        x = self.center + self.scale * np.sign(whitened) * np.expm1(log)
        return x, np.sum((1 - power) * log, axis=-1)

    def forward(self, bent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return y (..., free) of x (..., free), and log |∂y/∂x| (...)."""
        z = (bent - self.center) / self.scale
        power, log = self._power(z), np.log1p(np.abs(z))
        y = np.sign(z) * self.scale * np.expm1(power * log) / power
        return y, np.sum((power - 1) * log, axis=-1)

    def _power(self, values: FloatArray) -> FloatArray:
        return np.where(values >= 0, self.powers, 2 - self.powers)


@dataclass(frozen=True)
class TotalRatioMap:
    """The map from straight coordinates y to those x of pairs a and b that add up.

    The squares of sds add up, p = 2, and time constants add up themselves, p = 1. With
    ln a = c₁ + s₁ x₁ and ln b = c₂ + s₂ x₂,

        s₁ y₁ = ln (aᵖ + bᵖ) / p,   s₂ y₂ = ln (b / a),

    and all other coordinates stay what they are.

    Parameters
    ----------
    rows
        The coordinates of a and b, (pairs, 2).
    center
        c, (pairs, 2).
    scale
        s, (pairs, 2).
    powers
        p, (pairs,).
    """

    rows: IntArray
    center: FloatArray
    scale: FloatArray
    powers: FloatArray

    @classmethod
    def of_prior(cls, prior: JointPrior) -> TotalRatioMap | None:
        """Map the sds of each record's sensor and discrepancy, and the first two lags in a row.

        Only pairs count that are free and lognormal; None if there are none.
        """
        forms = {
            (p.plain, p.record): (row, p.formula)
            for row, p in enumerate(prior.free)
            if p.formula is not None and p.formula.logarithmic
        }
        pairs, powers = [], []
        for record in dict.fromkeys(record for _, record in forms):
            sds = SENSOR_SD.name, DISCREPANCY_SD.name  # their squares add up
            for names, power in ((sds, 2.0), (TIME_CONSTANTS, 1.0)):
                pair = [forms[name, record] for name in names if (name, record) in forms][:2]
                if len(pair) == 2:
                    pairs.append(pair)
                    powers.append(power)
        if not pairs:
            return None
        rows = [[row for row, _ in pair] for pair in pairs]
        scales = [[(math.log(form.center), form.scale) for _, form in pair] for pair in pairs]
        center, scale = np.moveaxis(np.array(scales), -1, 0)
        return cls(np.array(rows), center, scale, np.array(powers))

    def inverse(self, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x (..., free) of y (..., free), and log |∂x/∂y| (...), which is zero."""
        x = whitened.copy()
        total, ratio = np.moveaxis(self.scale * whitened[..., self.rows], -1, 0)
        a = total - np.logaddexp(0.0, self.powers * ratio) / self.powers
        x[..., self.rows] = (np.stack([a, a + ratio], axis=-1) - self.center) / self.scale
        return x, np.zeros(whitened.shape[:-1])

    def forward(self, bent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return y (..., free) of x (..., free), and log |∂y/∂x| (...), which is zero."""
        y = bent.copy()
        a, b = np.moveaxis(self.center + self.scale * bent[..., self.rows], -1, 0)
        total = np.logaddexp(self.powers * a, self.powers * b) / self.powers
        together = np.stack([total, b - a], axis=-1)
        y[..., self.rows] = together / self.scale
        return y, np.zeros(bent.shape[:-1])

    def slopes(self, bent: FloatArray) -> FloatArray:
        """Return ∂y/∂x (places, free, free) at x (places, free)."""
        free = bent.shape[1]
        slopes = np.broadcast_to(np.eye(free), (len(bent), free, free)).copy()
        pairs = zip(self.rows, self.center, self.scale, self.powers, strict=True)
        for (i, j), center, (s_i, s_j), power in pairs:
            a, b = (center + (s_i, s_j) * bent[:, [i, j]]).T
            share = scipy.special.expit(power * (b - a))
            slopes[:, i, i], slopes[:, i, j] = 1 - share, share * s_j / s_i
            slopes[:, j, i] = -s_i / s_j
        return slopes


type Map = TotalRatioMap | SkewMap | PolynomialMap | SecantMap


def fit_maps(draws: FloatArray) -> list[Map]:
    """Return the maps, one after the other, that make draws (count, free) straight.

    A tail may be longer because of a bend, and counts as a bend then: there are skews only if they
    make the draws more probable as those of a normal distribution, by a hundredth of a nat each.
    """
    candidates: list[tuple[float, list[Map]]] = []
    without: list[Map] = []
    for skews in (without, [*without, SkewMap.fitted(draws)]):
        bend = PolynomialMap.fitted(apply_maps(skews, draws)[0])
        maps: list[Map] = [*skews, *([] if bend is None else [bend])]
        whitened, log_slope = apply_maps(maps, draws)
        _, log_volume = np.linalg.slogdet(np.atleast_2d(np.cov(whitened, rowvar=False)))
        candidates.append((float(np.mean(log_slope) - 0.5 * log_volume), maps))
    (log_density, bends), (log_density_skewed, bends_and_skews) = candidates
    return bends_and_skews if log_density_skewed > log_density + 0.01 else bends


def apply_maps(maps: Sequence[Map], bent: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return coordinates z (..., free) of x (..., free) after all maps, and log |∂z/∂x| (...)."""
    log_slope = np.zeros(bent.shape[:-1])
    for map_ in maps:
        bent, slope = map_.forward(bent)
        log_slope = log_slope + slope
    return bent, log_slope


def invert_maps(maps: Sequence[Map], whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return coordinates x (..., free) of z (..., free) before all maps, and log |∂x/∂z| (...)."""
    log_slope = np.zeros(whitened.shape[:-1])
    for map_ in reversed(maps):
        whitened, slope = map_.inverse(whitened)
        log_slope = log_slope + slope
    return whitened, log_slope


def subsample(draws: FloatArray, count: int) -> FloatArray:
    """Return at most ``count`` of the draws (draws, free), evenly from first to last."""
    # An odd stride avoids taking the same few walkers at every step.
    return draws[:: -(-len(draws) // count) | 1]


def _near(u: FloatArray) -> FloatArray:
    """Return c (count, twelve at most) of u (count, free), and a column of ones at the end."""
    near = np.clip(u[:, :LONGEST], -FARTHEST, FARTHEST)
    return np.column_stack([near, np.ones(len(u))])


class _Regression(NamedTuple):
    """Sums over draws for least squares of coordinates by terms: of terms, of both, of squares."""

    terms: FloatArray
    responses: FloatArray
    squares: FloatArray

    @classmethod
    def of(cls, products: FloatArray, u: FloatArray) -> Self:
        """Return the sums of terms (count, terms) and coordinates (count, free)."""
        return cls(products.T @ products, products.T @ u, np.sum(u**2, axis=0))

    def __add__(self, other: _Regression) -> _Regression:  # type: ignore[override]
        return _Regression(*(a + b for a, b in zip(self, other, strict=True)))

    def coefficients(self, known: IntArray, j: int) -> FloatArray:
        """Return the coefficients of the ``known`` terms for coordinate j.

        Each is shrunk to zero, with the weight of a thousandth of all draws.
        """
        information = self.terms[np.ix_(known, known)]
        information = information + 1e-3 * np.diag(np.diagonal(information))
        coefficients: FloatArray = np.linalg.solve(information, self.responses[known, j])
        return coefficients

    def error(self, known: IntArray, coefficients: FloatArray, j: int) -> float:
        """Return the sum of squares that these coefficients leave."""
        explained = self.terms[np.ix_(known, known)] @ coefficients - 2 * self.responses[known, j]
        return float(self.squares[j] + coefficients @ explained)


def _best_size(halves: Sequence[_Regression], known: IntArray, j: int) -> int:
    """Return how many of the ``known`` terms predict coordinate j of each half from the other."""
    without = np.exp(-0.02) * sum(half.squares[j] for half in halves), 0
    errors = [
        (
            sum(
                other.error(known[:size], half.coefficients(known[:size], j), j)
                for half, other in (halves, halves[::-1])
            ),
            size,
        )
        for size in (*2 ** np.arange(int(np.log2(max(known.size, 1)))), known.size)
    ]
    return int(min([without, *errors])[1])


def _products(near: FloatArray, terms: IntArray) -> FloatArray:
    """Return the terms (count, terms) of :func:`_near` coordinates."""
    product = near[:, terms[:, 0]]
    for column in terms.T[1:]:
        product = product * near[:, column]
    return product


def _fit_log_scales(near: FloatArray, values: FloatArray) -> FloatArray:
    """Return s (others,) for values (count,) as wide as exp(s·c) with c (count, others).

    The fit is by maximum likelihood of normal values; s is zero unless values are more probable
    with it than with one width, by a hundredth of a nat on average.
    """
    count, others = near.shape
    design = np.column_stack([np.ones(count), near])
    # Clip values far out, which would outweigh all others.
    squares = np.minimum(np.abs(values) / np.std(values), FARTHEST) ** 2

    def loss(logs: FloatArray) -> tuple[float, FloatArray]:
        width = design @ logs
        with np.errstate(over="ignore"):
            scaled = squares * np.exp(-2 * width)
        # Shrink the coefficients to zero, with a hundredth of each draw's weight.
        value = np.mean(width + 0.5 * scaled) + 0.005 * logs @ logs
        return float(value), design.T @ (1 - scaled) / count + 0.01 * logs

    optimum = scipy.optimize.minimize(loss, np.zeros(1 + others), jac=True, method="L-BFGS-B")
    gain = 0.5 + 0.5 * np.log(np.mean(squares)) - optimum.fun
    return optimum.x[1:] if gain > 0.01 else np.zeros(others)
