"""Population mean and spread of one parameter where each specimen's likelihood is normal.

The closed form that everything else here leans on: a specimen's parameter y is drawn from
N(μ, τ²), and its record says N(m; y, s²). Given the spread τ all else is normal, so the only
integral is one over τ, done on a grid.

A specimen may be an outlier, with the probability ε. Then y is drawn from a Cauchy distribution
around μ that is ten times as wide, whose tails allow it anywhere.

Source: A. Gelman et al., Bayesian Data Analysis, third edition, section 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray

# ε, the probability of a specimen to be an outlier, and how many times as wide these are spread.
ODD, WIDER = 0.15, 10.0


def population_density(z: FloatArray) -> FloatArray:
    """Density of a specimen at z = (y − μ)/τ: (1 − ε) N(z; 0, 1) + ε c/(π (c² + z²)), c = 10."""
    square = z * z
    density: FloatArray = np.exp(-0.5 * square)
    density *= (1 - ODD) / np.sqrt(2 * np.pi)
    square += WIDER**2
    density += ODD * WIDER / np.pi / square
    return density


@dataclass(frozen=True)
class Hyperprior:
    """The prior of a population: μ ~ N(mean, sd²), τ ~ half-normal(scale)."""

    mean: float
    sd: float
    scale: float

    def log_density(self, mean: FloatArray, spread: FloatArray) -> FloatArray:
        """Log density of means and spreads, arrays of one shape; −∞ for spreads below zero."""
        z, t = (mean - self.mean) / self.sd, spread / self.scale
        constant = np.log(self.sd * self.scale * np.pi)
        return np.where(spread < 0, -np.inf, -0.5 * (z**2 + t**2) - constant)


@dataclass(frozen=True)
class NormalLikelihoods:
    """The specimens' likelihoods N(mean; y, 1/precision), (specimens,) each.

    A precision of zero is that of a record that tells nothing of the parameter.
    """

    mean: FloatArray
    precision: FloatArray

    def marginal(self, mean: FloatArray, spread: FloatArray) -> FloatArray:
        """Log density (specimens, n) of each record given means and spreads (n,) of populations.

        ∫ N(m; y, s²) N(y; μ, τ²) dy = N(m; μ, s² + τ²); zero of a record that tells nothing.
        """
        weight = self.weight(spread)
        with np.errstate(divide="ignore"):
            logs = np.where(weight > 0, np.log(weight / (2 * np.pi)), 0.0)
        return 0.5 * (logs - weight * (self.mean[:, np.newaxis] - mean) ** 2)

    def outlying(self, mean: FloatArray, spread: FloatArray) -> FloatArray:
        """Log density (specimens, n) of each record as :meth:`marginal`'s, if it is an outlier.

        The convolution of a normal and a Cauchy distribution is Voigt's profile.
        """
        precision = self.precision[:, np.newaxis]
        sd = np.maximum(precision, 1e-300) ** -0.5
        away = self.mean[:, np.newaxis] - mean
        density = scipy.special.voigt_profile(away, sd, WIDER * np.broadcast_to(spread, away.shape))
        logs: FloatArray = np.where(precision > 0, np.log(np.maximum(density, 1e-300)), 0.0)
        return logs

    def mixture_log_density(self, mean: FloatArray, spread: FloatArray) -> FloatArray:
        """Log density (specimens, n) of each record, which may be an outlier."""
        sound, odd = self.marginal(mean, spread), self.outlying(mean, spread)
        logs: FloatArray = np.logaddexp(np.log1p(-ODD) + sound, np.log(ODD) + odd)
        return logs

    def weight(self, spread: FloatArray) -> FloatArray:
        """1/(s² + τ²), (specimens, n)."""
        precision = self.precision[:, np.newaxis]
        weight: FloatArray = precision / (1 + precision * spread**2)
        return weight

    def only(self, chosen: BoolArray) -> NormalLikelihoods:
        """Return those of the chosen specimens (specimens,)."""
        return NormalLikelihoods(self.mean[chosen], self.precision[chosen])

    def shrunk(
        self, specimen: int, mean: FloatArray, spread: FloatArray, generator: np.random.Generator
    ) -> FloatArray:
        """Draw a specimen's parameter (n,), one for each population (n,).

        Given μ and τ it is normal, with the precision 1/s² + 1/τ² and the mean
        (m τ² + μ s²) / (s² + τ²).
        """
        precision = self.precision[specimen]
        fraction = 1 / (1 + precision * spread**2)  # of the population's mean
        center = fraction * mean + (1 - fraction) * self.mean[specimen]
        sd = spread * np.sqrt(fraction)
        drawn: FloatArray = center + sd * generator.standard_normal(mean.size)
        return drawn


@dataclass(frozen=True)
class Spreads:
    """The posterior of the spread on its grid, and of the mean given each spread, (cells,) each.

    ``spread`` are the cells' middles, ``edges`` (cells + 1,) their borders (the last is infinite),
    ``probability`` what they hold; given a spread the mean is N(``mean``, ``variance``).
    """

    spread: FloatArray
    edges: FloatArray
    probability: FloatArray
    mean: FloatArray
    variance: FloatArray

    def draw(self, generator: np.random.Generator, size: int) -> tuple[FloatArray, FloatArray]:
        """Draw means and spreads, (size,) each."""
        cell = generator.choice(self.spread.size, size, p=self.probability)
        low = self.edges[cell]
        width = np.minimum(self.edges[cell + 1], 2 * self.spread[cell] - low) - low
        spread = low + width * generator.uniform(size=size)
        mean = self.mean[cell] + np.sqrt(self.variance[cell]) * generator.standard_normal(size)
        return mean, spread


def spreads(likelihoods: NormalLikelihoods, prior: Hyperprior) -> Spreads:
    """Return the posterior of a population's spread, and of its mean given the spread.

    With wᵢ = 1/(sᵢ² + τ²), and the prior of the mean counted as one more specimen:

        V = 1/Σ wᵢ,   μ̂ = V Σ wᵢ mᵢ,   log p(τ) = log p₀(τ) + ½ (log V + Σ (log wᵢ − wᵢ (mᵢ −
        μ̂)²))

    up to a constant.
    """
    informative = likelihoods.precision > 0
    centers = likelihoods.mean[informative]
    extent = np.std(centers) if informative.any() else 0.0
    errors = (
        np.median(likelihoods.precision[informative] ** -0.5) if informative.any() else prior.scale
    )
    # Values of the spread: at u/(1 − u) of their scale, for even u.
    u = np.linspace(0, 1, 401)
    center = (u[1:] + u[:-1]) / 2
    size = min(extent + errors, prior.scale)
    with np.errstate(divide="ignore"):
        edges = size * u / (1 - u)
    spread = size * center / (1 - center)
    weight = likelihoods.weight(spread)
    prior_precision = 1 / prior.sd**2
    variance = 1 / (prior_precision + np.sum(weight, axis=0))
    mean = variance * (prior_precision * prior.mean + weight.T @ likelihoods.mean)
    squares = weight * (likelihoods.mean[:, np.newaxis] - mean) ** 2
    with np.errstate(divide="ignore"):
        logs = np.where(weight > 0, np.log(weight), 0.0)
    density = 0.5 * (np.log(variance) + np.sum(logs - squares, axis=0))
    density -= 0.5 * prior_precision * (prior.mean - mean) ** 2 + 0.5 * (spread / prior.scale) ** 2
    density -= 2 * np.log1p(-center)  # dτ/du
    probability = np.exp(density - np.max(density))
    probability /= np.sum(probability)
    return Spreads(spread, edges, probability, mean, variance)


def left_out(
    likelihoods: NormalLikelihoods, prior: Hyperprior, inside: BoolArray | None = None
) -> FloatArray:
    """Two-sided p (specimens,) of each record, given the population that the others show.

    Only specimens ``inside`` (specimens,) count, by default all. Under the model each is uniform
    from 0 to 1, whatever the population. One for a record that tells nothing.
    """
    count = likelihoods.mean.size
    p = np.ones(count)
    for specimen in np.flatnonzero(likelihoods.precision > 0):
        others = np.arange(count) != specimen
        if inside is not None:
            others &= inside
        posterior = spreads(likelihoods.only(others), prior)
        sd = np.sqrt(1 / likelihoods.precision[specimen] + posterior.spread**2 + posterior.variance)
        z = (likelihoods.mean[specimen] - posterior.mean) / sd
        # From the nearer tail, which keeps its digits.
        tails = [np.sum(posterior.probability * scipy.stats.norm.cdf(side * z)) for side in (1, -1)]
        p[specimen] = 2 * min(tails)
    return p
