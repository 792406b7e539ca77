"""Distributions that propose places independently of where a walker is.

A Student-t distribution around the draws of a pilot covers a posterior that is nearly Gaussian.
Other posteriors need a few of them: a mixture fitted by expectation maximization, in coordinates
with straight ridges and equal tails (:mod:`bwbayes.sampling.curvature`). Heavy tails of every
component keep the ratio of posterior to proposal bounded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.sampling.curvature import (
    Map,
    PolynomialMap,
    SkewMap,
    TotalRatioMap,
    apply_maps,
    fit_maps,
    invert_maps,
    subsample,
)
from bwbayes.sampling.secant import SecantMap
from bwbayes.shown import brief

if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior

# Maps by their names in a file, in the order in which they are applied.
_MAPS: dict[str, type[Map]] = {
    "secant": SecantMap,
    "totals": TotalRatioMap,
    "skew": SkewMap,
    "bend": PolynomialMap,
}


@dataclass(frozen=True)
class StudentMixture:
    """A mixture of multivariate Student-t distributions as an independence proposal.

    Over p straight coordinates z of x, with ν degrees of freedom,

        log q = log Σ wⱼ |Lⱼ|⁻¹ (1 + |Lⱼ⁻¹(z − μⱼ)|² / ν)^(−(ν + p)/2) + log |∂z/∂x| + constant.

    Parameters
    ----------
    weights
        wⱼ, (components,), adding up to one.
    centers
        μⱼ, (components, free).
    factors
        Lⱼ, lower triangular, (components, free, free).
    maps
        Maps to the straight coordinates, applied one after the other.
    freedom
        ν; small enough for tails heavier than the posterior's.
    """

    __repr__ = brief

    weights: FloatArray
    centers: FloatArray
    factors: FloatArray
    maps: tuple[Map, ...] = ()
    freedom: float = 12.0

    @classmethod
    def fitted(
        cls,
        draws: FloatArray,
        log_density: FloatArray | None = None,
        guess: StudentMixture | None = None,
    ) -> StudentMixture:
        """Fit to draws (count, free), by expectation maximization of a Gaussian mixture.

        The mixture has three components, or up to six for many draws: it would follow few draws too
        closely. With their log densities (count,) under the distribution that they are drawn from,
        it gets one more component, of the draws with the largest log p − log q: a walker there
        would hardly ever leave. Each mode of a first ``guess`` besides the most probable one gets a
        component of the guess's shape with a weight of a twentieth: a mode that is not proposed is
        not found again. The coordinates are those in which the first mode is straight; pairs of sds
        are in line as in the guess.

        Raises
        ------
        numpy.linalg.LinAlgError
            The draws do not span the space.
        """
        _require_spread(draws)
        maps, modes = [], []
        if guess is not None:
            lesser = [guess._modes.index(mode) for mode in range(1, max(guess._modes) + 1)]
            maps = [*guess.maps]
            # With the columns lₖ of L, the points μ ± lₖ √p have a component's mean and covariance.
            for component in lesser:
                steps = np.sqrt(draws.shape[1]) * guess.factors[component].T
                modes.append(guess.centers[component] + np.concatenate([steps, -steps]))
        draws, log_slope = apply_maps(maps, draws)
        first = draws
        if guess is not None and modes:
            likeliest = np.argmax(guess.log_parts(guess.squares(draws)), axis=0)
            first = draws[np.asarray(guess._modes)[likeliest] == 0]
        further = fit_maps(first)
        draws, slope = apply_maps(further, draws)
        modes = [apply_maps(further, mode)[0] for mode in modes]
        # Fit first to so few of the draws that they cost little, then to more.
        sample = subsample(draws, 1024)
        # Each draw first belongs to the nearest of a few draws and modes, in units of their sds.
        at = np.linspace(0, len(sample) - 1, min(max(len(draws) // 4_000, 3), 6)).astype(int)
        few = np.stack([*sample[at], *(np.mean(mode, axis=0) for mode in modes)])
        away = (few[:, np.newaxis] - sample) / np.std(sample, axis=0)
        nearest = np.argmin(np.sum(away**2, axis=2), axis=0)
        mixture = _of_shares(sample, np.equal.outer(np.arange(len(few)), nearest))
        for _ in range(25):
            mixture = mixture._fitted_on(sample)
        sample = subsample(draws, 10_000)
        for _ in range(5):
            mixture = mixture._fitted_on(sample)
        for mode in modes:
            mixture = mixture._with(_of_shares(mode, np.ones((1, len(mode)))), 0.05)
        if log_density is not None:
            log_ratio = log_density - log_slope - slope - mixture.log_density(draws)
            # Add a component for the 2% of draws with the largest log p − log q.
            worst = log_ratio >= np.quantile(log_ratio, 0.98)
            mixture = mixture._with(_of_shares(draws, np.stack([worst, ~worst])), 0.1)
        return replace(mixture, maps=(*maps, *further))

    @classmethod
    def around(
        cls,
        optima: FloatArray,
        covariances: FloatArray,
        shares: FloatArray,
        totals: TotalRatioMap | None = None,
    ) -> StudentMixture:
        """Make a mixture of modes (modes, free), covariances (modes, free, free), shares (modes,).

        It has the first three modes; fewer modes are repeated, twice and three times as wide. Each
        component gets at least a twelfth, because the shares of modes are a guess.
        """
        if totals is not None:
            slopes = totals.slopes(optima)
            covariances = slopes @ covariances @ slopes.transpose(0, 2, 1)
            optima = totals.forward(optima)[0]
        modes = np.arange(3) % len(optima)
        widths = 1.0 + np.arange(3) // len(optima)
        factors = widths[:, np.newaxis, np.newaxis] * np.linalg.cholesky(covariances)[modes]
        split_shares = shares[modes] / np.bincount(modes)[modes]
        weights = 0.75 * split_shares / np.sum(split_shares) + 0.25 / 3
        maps = () if totals is None else (totals,)
        return cls(weights, optima[modes], factors, maps, freedom=6.0)

    def arrays(self) -> dict[str, Any]:
        """Return the arrays of the mixture by name, to be written to a file."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "maps"}
        names = {kind: name for name, kind in _MAPS.items()}
        for map_ in self.maps:
            named = {f"{names[type(map_)]}_{f.name}": getattr(map_, f.name) for f in fields(map_)}
            arrays |= {n: array for n, array in named.items() if isinstance(array, np.ndarray)}
        return arrays

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, Any]) -> StudentMixture | None:
        """Return the mixture that a file holds as :meth:`arrays`, or None."""
        if "weights" not in arrays:
            return None
        maps: list[Map] = []
        for map_name, kind in _MAPS.items():
            keys = {field.name: f"{map_name}_{field.name}" for field in fields(kind)}
            stored = {key: arrays[name] for key, name in keys.items() if name in arrays}
            if stored:
                maps.append(kind(**stored))
        parts = {f.name: arrays[f.name] for f in fields(cls) if f.name in arrays}
        return cls(**parts, maps=tuple(maps))

    def of_posterior(self, posterior: Posterior) -> StudentMixture:
        """Return the mixture with the posterior set in its maps; a file does not keep it."""
        maps = [
            replace(m, posterior=posterior) if isinstance(m, SecantMap) else m for m in self.maps
        ]
        return replace(self, maps=tuple(maps)) if self.has_secant else self

    @property
    def has_secant(self) -> bool:
        """True if one of its maps needs the model: a :class:`SecantMap`."""
        return any(isinstance(map_, SecantMap) for map_ in self.maps)

    def behind(self, first: Map) -> StudentMixture:
        """Return a guess for a fit that applies another map first, without further modes."""
        weights, centers, factors = self.weights[:1], self.centers[:1], self.factors[:1]
        return replace(
            self, weights=weights, centers=centers, factors=factors, maps=(first, *self.maps)
        )

    @cached_property
    def _whitening(self) -> FloatArray:
        # Store the transpose: a row times it is one product for all coordinates.
        return np.ascontiguousarray(np.linalg.inv(self.factors).transpose(0, 2, 1))

    @cached_property
    def _log_volumes(self) -> FloatArray:
        """The log determinants of the factors, (components,)."""
        return np.sum(np.log(np.diagonal(self.factors, axis1=1, axis2=2)), axis=1)

    def squares(self, whitened: FloatArray) -> FloatArray:
        """Return distances |Lⱼ⁻¹(z − μⱼ)|² (components, ...) of coordinates (..., free)."""
        pairs = zip(self.centers, self._whitening, strict=True)
        white = [(whitened - center) @ whitening for center, whitening in pairs]
        return np.stack([np.einsum("...j,...j->...", z, z) for z in white])

    def log_parts(self, squares: FloatArray) -> FloatArray:
        """Return the components' weighted log densities from :meth:`squares`, in their shape."""
        freedom, free = self.freedom, self.centers.shape[1]
        # The normalization of a Student-t distribution.
        constant = scipy.special.gammaln((freedom + free) / 2) - scipy.special.gammaln(freedom / 2)
        constant -= 0.5 * free * np.log(freedom * np.pi)
        scales = np.log(self.weights) - self._log_volumes + constant
        scales = scales.reshape(-1, *[1] * (squares.ndim - 1))
        parts: FloatArray = scales - 0.5 * (freedom + free) * np.log1p(squares / freedom)
        return parts

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Return the log density (..., count) at coordinates (..., count, free)."""
        flat = coordinates.reshape(-1, coordinates.shape[-1])
        density = np.empty(len(flat))
        for start in range(0, len(flat), 1 << 15):  # maps and components take memory
            rows = slice(start, start + (1 << 15))
            whitened, log_slope = apply_maps(self.maps, flat[rows])
            density[rows] = self._whitened_density(whitened) + log_slope
        return density.reshape(coordinates.shape[:-1])

    def evaluate(self, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return coordinates (count, free) of straight ones, and their log density (count,)."""
        coordinates, log_slope = invert_maps(self.maps, whitened)
        return coordinates, self._whitened_density(whitened) - log_slope

    def draw(self, random: np.random.RandomState, count: int) -> FloatArray:
        """Draw straight coordinates (count, free) with emcee's generator."""
        # The same as ``random.choice`` with these weights, without its checks of them.
        ends = np.cumsum(self.weights)
        chosen = (ends / ends[-1]).searchsorted(random.random_sample(count), side="right")
        normal = random.standard_normal((count, self.centers.shape[1]))
        spread = np.sqrt(self.freedom / random.chisquare(self.freedom, count))
        steps = (self.factors[chosen] @ (normal * spread[:, np.newaxis])[:, :, np.newaxis])[:, :, 0]
        whitened: FloatArray = self.centers[chosen] + steps
        return whitened

    def _whitened_density(self, whitened: FloatArray) -> FloatArray:
        """Return the log density (count,) of straight coordinates (count, free)."""
        density: FloatArray = np.logaddexp.reduce(self.log_parts(self.squares(whitened)))
        return density

    @cached_property
    def _modes(self) -> list[int]:
        """The mode of each component, (components,): components with one center are one mode."""
        centers = [tuple(center) for center in self.centers]
        return [list(dict.fromkeys(centers)).index(center) for center in centers]

    def _with(self, other: StudentMixture, weight: float) -> StudentMixture:
        """Return the mixture with the first component of another one added, with a weight."""
        return StudentMixture(
            np.append((1 - weight) * self.weights, weight),
            np.concatenate([self.centers, other.centers[:1]]),
            np.concatenate([self.factors, other.factors[:1]]),
        )

    def _fitted_on(self, draws: FloatArray) -> StudentMixture:
        """Make one round of expectation maximization."""
        logs = np.log(self.weights) - self._log_volumes
        logs = logs[:, np.newaxis] - 0.5 * self.squares(draws)
        density = np.exp(logs - np.max(logs, axis=0))
        return _of_shares(draws, density / np.sum(density, axis=0))


def _require_spread(draws: FloatArray) -> None:
    """Refuse draws (count, free) that do not span the space."""
    # Rounding gives some variance to draws that lie in a plane, or do not differ at all.
    plane = np.column_stack([np.ones(len(draws)), draws])
    # The triangle has the singular values of all draws, and is small.
    sizes = np.linalg.svd(np.linalg.qr(plane, mode="r"), compute_uv=False)
    if np.sum(sizes > sizes[0] * max(plane.shape) * np.finfo(float).eps) < plane.shape[1]:
        raise np.linalg.LinAlgError("the draws do not span the space")


def _of_shares(draws: FloatArray, share: FloatArray) -> StudentMixture:
    """Return the mixture whose components have these shares (components, count) of draws.

    Every component gets a thousandth of each draw, so that none becomes empty, and a tenth of the
    mean covariance, since draws are few. The covariance of all draws would be far too wide if
    components are separate modes.
    """
    share = (share + 1e-3) / (1 + 1e-3 * len(share))
    weights = share.mean(axis=1)
    parts = share / share.sum(axis=1, keepdims=True)
    centers = parts @ draws
    deviations = [(draws - center).T for center in centers]
    covariances = np.stack([(p * d) @ d.T for p, d in zip(parts, deviations, strict=True)])
    together = np.average(covariances, axis=0, weights=weights)
    return StudentMixture(weights, centers, np.linalg.cholesky(0.9 * covariances + 0.1 * together))
