"""A Gaussian mixture over posterior draws: quantiles, distribution function and CRPS.

Given a draw the value at a sample is Gaussian, so over all draws it is a mixture with as many
components as draws, at every sample another one. Its characteristic function falls off like a
Gaussian. A Fourier series of some tens of terms therefore holds the whole distribution to eight
digits, and serves all probabilities at once, where a root search evaluates the Gaussian
distribution function for each. The search follows where the series does not suffice: components
far narrower than the mixture, a gap between two modes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from bwbayes.arrays import BoolArray, FloatArray

__all__ = ["judged", "log_density", "pieces", "quantiles_and_spread"]

ComplexArray = NDArray[np.complex128]

# Probability that the series may leave out.
TOLERANCE = 3e-9

# Terms after which the series is cut even if it has not converged.
LARGEST_SERIES = 128

# Half a period in units of the farthest draw's distance, at least: a step at its very end would
# show at both ends.
MARGIN = 1.2

# Nodes of the tabulated distribution per term of the series.
NODES_PER_TERM = 16

# Errors of a quantile in units of the mixture's standard deviation: what the series may have, and
# the last step of the root search, where sds are not taken as smaller than that either.
ACCURACY = 5e-7
LAST_STEP = 1e-7

# Draws up to which the mean distance of two sums over all pairs.
FEW_DRAWS = 64

# Draws times samples of one piece: what stays in a core's own cache.
PIECE = 32_768

# Halvings that end any root search; Newton steps end nearly all after two or three.
LONGEST_SEARCH = 100


def quantiles_and_spread(
    means: FloatArray, sds: FloatArray, probabilities: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Quantiles of the mixture, F(x) = p, and half the mean distance of two draws from it.

    Parameters
    ----------
    means
        (draws, samples) mean given a draw, um.
    sds
        (draws,) standard deviation given a draw, um, zero or positive. If all are zero the
        quantiles are those of the draws, interpolated as `numpy.quantile` does.
    probabilities
        (q,) inside (0, 1), in any order.

    Returns
    -------
    tuple[FloatArray, FloatArray]
        (q, samples), um; the error is at most 1e-6 of the mixture's standard deviation at the
        sample. And E|X - X'| / 2, (samples,), um: exact for up to 64 draws, as the mean of A over
        all pairs (see :func:`judged`), and if all sds are zero. Otherwise it is the integral of
        F (1 - F), taken from the Fourier series of F: the error is below 1e-6 of the mixture's
        standard deviation where the series converges, mostly below 1e-4 where sds are too small
        for that (a fiftieth and less), and some 1e-2 if one draw lies thousands of its sds away
        from all others.

    Notes
    -----
    F is recovered from the characteristic function as by F. Fang and C. W. Oosterlee, SIAM J.
    Sci. Comput. 31 (2008) 826-848, here with the whole Fourier series.
    """
    quantiles = np.empty((probabilities.size, means.shape[1]))
    spread = np.empty(means.shape[1])
    for piece in pieces(means):
        part = np.ascontiguousarray(means[:, piece])
        if sds.any():
            series = _Series.of(part, sds)
            quantiles[:, piece] = _quantiles(series, part, sds, probabilities)
            spread[piece] = series.spread() if sds.size > FEW_DRAWS else _pairs_spread(part, sds)
        else:
            ranked = np.sort(part, axis=0)
            quantiles[:, piece] = np.quantile(ranked, probabilities, axis=0)
            spread[piece] = (2 * np.arange(sds.size) - sds.size + 1.0) / sds.size**2 @ ranked
    # Where F is level (a gap between modes) neighbours may swap within the accuracy.
    order = np.argsort(probabilities)
    quantiles[order] = np.maximum.accumulate(quantiles[order], axis=0)
    return quantiles, spread


def judged(means: FloatArray, sds: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distribution function of the mixture at ``values``, and its mean distance from them.

    The first is the values' probability integral transform. The second, E|X - y|, is the mean
    over draws of A(y - mean, sd) with A(m, s) = m (2 Phi(m/s) - 1) + 2 s phi(m/s); less half the
    mean distance of two draws it is their continuous ranked probability score.

    Parameters
    ----------
    means
        (draws, samples) mean given a draw, um.
    sds
        (draws,) standard deviation given a draw, um, zero or positive. A draw with zero counts
        as a half of the distribution function where its mean is the value.
    values
        (samples,) y, um.

    Returns
    -------
    tuple[FloatArray, FloatArray]
        (samples,) the mean over draws of Phi((value - mean) / sd), and E|X - y| (samples,), um.

    Notes
    -----
    T. Gneiting and A. E. Raftery, J. Am. Stat. Assoc. 102 (2007) 359-378, section 4.2;
    E. P. Grimit et al., Q. J. R. Meteorol. Soc. 132 (2006) 2925-2942, for A.
    """
    probability, distance = np.empty((2, values.size))
    for piece in pieces(means):
        probability[piece], distance[piece] = _judged(means[:, piece], sds, values[piece])
    return probability, distance


@dataclass(frozen=True)
class _Series:
    """The distribution over one period of u = x - centre, -period/2 <= u < period/2.

        f(u) = (1 + 2 sum_j Re(c_j exp(-i j w u))) / period,    w = 2 pi / period

    ``centre`` and ``sd`` are (samples,), the mixture's mean and standard deviation;
    ``coefficients`` (terms, samples) are the characteristic function of u at j w; ``remainder``
    is the size of the first coefficient left out, or the probability outside of the period.
    """

    centre: FloatArray
    sd: FloatArray
    period: float
    coefficients: ComplexArray
    remainder: float

    @classmethod
    def of(cls, means: FloatArray, sds: FloatArray) -> _Series:
        """Take the series from the draws."""
        centre = means.mean(axis=0)
        deviation = means - centre
        variances = sds**2
        sd = np.sqrt((deviation**2).mean(axis=0) + variances.mean())
        reach = -ndtri(TOLERANCE / 2) * sds[:, None]
        farthest = np.abs(deviation)
        period = 2 * float(max((farthest + reach).max(), MARGIN * farthest.max()))
        frequency = 2 * np.pi / period
        deviation *= frequency
        phase = np.empty(means.shape, dtype=np.complex128)
        np.cos(deviation, out=phase.real)
        np.sin(deviation, out=phase.imag)
        power = phase.copy()
        coefficients = []
        for j in range(1, LARGEST_SERIES + 1):
            weights = np.exp(-0.5 * (j * frequency) ** 2 * variances) / sds.size
            coefficients.append((weights @ power.view(np.float64)).view(np.complex128))
            remainder = float(weights.sum())
            if remainder < TOLERANCE:
                break
            power *= phase
        return cls(centre, sd, period, np.array(coefficients), max(remainder, TOLERANCE))

    @cached_property
    def table(self) -> FloatArray:
        """Tabulate F on equally spaced nodes from u = -period/2: (nodes, samples)."""
        terms = len(self.coefficients)
        nodes = NODES_PER_TERM * terms
        j = np.arange(1, terms + 1)[:, None]
        sign = np.where(j % 2, -1, 1)
        harmonics = np.zeros((terms + 1, self.centre.size), dtype=np.complex128)
        harmonics[1:] = -1j * sign * self.coefficients.conj() * (nodes / (2 * np.pi * j))
        table = np.fft.irfft(harmonics, nodes, axis=0)
        table -= table[0]
        table += (np.arange(nodes) / nodes)[:, None]
        return table

    def spread(self) -> FloatArray:
        """Half the mean distance of two draws, the integral of F (1 - F): (samples,)."""
        table = self.table
        return self.period * (table * (1 - table)).mean(axis=0)

    def quantiles(self, probabilities: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return u at F = p and whether it is accurate enough, both (q, samples).

        Linear interpolation of the table, then one step of Halley's method on the series.
        """
        table = self.table
        p = probabilities[:, None]
        upper = np.array([np.count_nonzero(table < one, axis=0) for one in probabilities])
        upper = np.clip(upper, 1, len(table) - 1)
        above = np.take_along_axis(table, upper, axis=0)
        below = np.take_along_axis(table, upper - 1, axis=0)
        spacing = self.period / len(table)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (upper - 1 + (p - below) / (above - below)) * spacing - self.period / 2
            probability, density, slope = self.evaluate(u)
            newton = (probability - p) / density
            step = newton / (1 - 0.5 * newton * slope / density)
        certain = self.remainder < ACCURACY * self.sd * density
        certain &= np.abs(step) < 0.1 * spacing
        return np.where(np.abs(step) < spacing, u - step, u), certain

    def evaluate(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return F, its density and the density's slope at u, all (q, samples)."""
        j = np.arange(1, len(self.coefficients) + 1)[:, None]
        frequency = 2 * np.pi / self.period * j
        angle = frequency[:, :, None] * u
        cosine, sine = np.cos(angle), np.sin(angle, out=angle)
        real, imaginary = self.coefficients.real, self.coefficients.imag
        start = (np.where(j % 2, -1, 1) * imaginary / j).sum(axis=0) / np.pi

        def total(weights: FloatArray, waves: FloatArray) -> FloatArray:
            sums: FloatArray = np.einsum("jt,jqt->qt", weights, waves)
            return sums

        probability = total(real / j, sine) - total(imaginary / j, cosine)
        density = total(real, cosine) + total(imaginary, sine)
        slope = total(imaginary * frequency, cosine) - total(real * frequency, sine)
        return (
            0.5 + u / self.period + start + probability / np.pi,
            (1 + 2 * density) / self.period,
            2 * slope / self.period,
        )


def _quantiles(
    series: _Series, means: FloatArray, sds: FloatArray, probabilities: FloatArray
) -> FloatArray:
    """Quantiles (q, samples) from the series, or by a search where it is not sure of them."""
    u, certain = series.quantiles(probabilities)
    x = u + series.centre
    rows, columns = np.nonzero(~certain)
    for some in pieces(means, rows.size):
        row, column = rows[some], columns[some]
        step = LAST_STEP * series.sd[column]
        x[row, column] = _search(
            means, sds, column, probabilities[row], guess=x[row, column], last_step=step
        )
    return x


def _search(
    means: FloatArray,
    sds: FloatArray,
    columns: NDArray[np.intp],
    p: FloatArray,
    *,
    guess: FloatArray,
    last_step: FloatArray,
) -> FloatArray:
    """Solve F(x) = p with Newton's method, by halving where that fails.

    ``columns`` (n,) says which column of ``means`` each equation is about; ``p``, ``guess`` and
    ``last_step`` are (n,). The mixture's quantile lies between the smallest and the largest
    quantile of its components.
    """
    components = means[:, columns] + sds[:, None] * ndtri(p)
    lower, upper = components.min(axis=0), components.max(axis=0)
    # A step up to a draw without sd would end the search beside it.
    sds = np.maximum(sds, last_step.min())
    x = np.clip(guess, lower, upper)
    moved = upper - lower
    active = np.arange(x.size)
    for _ in range(LONGEST_SEARCH):
        at = x[active]
        probability, density = _evaluate(means[:, columns[active]], sds, at)
        excess = probability - p[active]
        lower[active] = np.where(excess <= 0, at, lower[active])
        upper[active] = np.where(excess >= 0, at, upper[active])
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            newton = at - excess / density
        inside = (lower[active] <= newton) & (newton <= upper[active])
        fast = np.abs(newton - at) <= 0.5 * moved[active]
        middle = 0.5 * (lower[active] + upper[active])
        x[active] = np.where(inside & fast, newton, middle)
        moved[active] = np.abs(x[active] - at)
        active = active[moved[active] > last_step[active]]
        if not active.size:
            break
    return x


def _evaluate(means: FloatArray, sds: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return F and its density at x, both (n,), from all draws, sds above 0."""
    z = _standardised(x, means, sds)
    probability = ndtr(z).mean(axis=0)
    np.multiply(z, z, out=z)
    z *= -0.5
    weights = 1 / (np.sqrt(2 * np.pi) * sds.size * sds)
    density: FloatArray = weights @ np.exp(z, out=z)
    return probability, density


def log_density(means: FloatArray, sds: FloatArray, values: FloatArray) -> FloatArray:
    """Log density of the mixture at ``values`` (samples,), y in um; per um, in nats.

    log (1/S) Σ φ((y − mean) / sd) / sd over the S draws, however far off y is. ``means`` and
    ``sds``, all above zero, as in :func:`judged`; without any sd a density is infinite or zero.
    """
    result = np.empty(values.size)
    with np.errstate(divide="ignore"):
        sizes = np.log(sds)[:, np.newaxis] + 0.5 * np.log(2 * np.pi)
    for piece in pieces(means):
        z = _standardised(values[piece], means[:, piece], sds)
        np.multiply(z, z, out=z)
        z *= -0.5
        z -= sizes
        top = z.max(axis=0)
        # Far from all draws no density is a float; its log is.
        with np.errstate(invalid="ignore"):
            z -= np.where(np.isfinite(top), top, 0)
        result[piece] = top + np.log(np.exp(z, out=z).mean(axis=0))
    return result


def _standardised(x: FloatArray, means: FloatArray, sds: FloatArray) -> FloatArray:
    """(x - means) / sds, (draws, n); infinite for zero sds, and 0 where x is such a mean."""
    z: FloatArray = x - means
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        z /= sds[:, None]
    if not sds.all():
        np.nan_to_num(z, copy=False, nan=0.0, posinf=np.inf, neginf=-np.inf)
    return z


def _judged(
    means: FloatArray, sds: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """F(y) and E|X - y| at every sample, both (samples,)."""
    z = _standardised(values, means, sds)
    below = ndtr(z)
    with np.errstate(over="ignore"):
        np.multiply(z, z, out=z)
    z *= -0.5
    distance = np.sqrt(2 / np.pi) * sds @ np.exp(z, out=z)
    away = values - means
    equal = np.ones(sds.size)
    probability = equal @ below
    below -= 0.5
    below *= away
    distance += 2 * equal @ below
    return probability / sds.size, distance / sds.size


def _pairs_spread(means: FloatArray, sds: FloatArray) -> FloatArray:
    """E|X - X'| / 2 at every sample, (samples,), from all pairs of draws."""
    # Every shift pairs each draw with one other; without a shift it meets its like.
    total = np.zeros(means.shape[1])
    for shift in range(sds.size):
        pair_sds = np.hypot(sds, np.roll(sds, shift))
        total += _judged(means, pair_sds, np.roll(means, shift, axis=0))[1]
    return total / (2 * sds.size)


def pieces(means: FloatArray, columns: int | None = None) -> Iterator[slice]:
    """Cut the columns (of ``means`` if not told) into pieces small enough for a core's cache."""
    columns = means.shape[1] if columns is None else columns
    size = max(1, PIECE // len(means))
    for start in range(0, columns, size):
        yield slice(start, start + size)
