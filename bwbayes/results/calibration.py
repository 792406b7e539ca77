"""Calibration: whether the posteriors of many replicates mean what they say.

Where a posterior is right, the truth's rank among its draws is even over replicates
(:mod:`bwbayes.results.replicates`). Ranks that heap up at both ends tell of posteriors that are too
narrow, in the middle of ones too wide, at one end of a bias. Two tests look at each statistic. The
smooth test looks for just these shapes and is by far the more powerful; the simultaneous band
around the ranks' distribution function sees any other. Both together raise a false alarm in one
sound calibration of a hundred. Bands on held-out samples must cover what they promise within three
standard errors. Single coverages are far from normal, so this is asked of 500 replicates or more,
of which at most one sound calibration in forty fails it by chance (one in 28 would with 150, one in
17 with 100). These rates are those of one look: who goes on until a calibration passes has others.
What did not converge is counted, and ranked with the rest if it has draws at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy
from scipy.special import ndtr

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.parameters import Parameter
from bwbayes.results.bands import LEVELS
from bwbayes.results.replicates import RANKED, Entry
from bwbayes.shown import brief

__all__ = [
    "FAMILY_LEVEL",
    "JUDGED_FROM",
    "LARGEST_UNCONVERGED",
    "LIMIT",
    "Calibration",
    "Coverage",
    "EcdfBand",
    "Uniformity",
    "ecdf_band",
    "holm",
    "judge",
    "smooth_power",
    "smooth_test",
    "summary",
]

# Probability of a false alarm from all tests of all statistics, half of it for either test.
FAMILY_LEVEL = 0.01

# Part of the replicates that may stay unconverged.
LARGEST_UNCONVERGED = 0.01

# Standard errors that a band's coverage may be off, once its mean over replicates is near normal.
LIMIT = 3.0
JUDGED_FROM = 500

# Points at which the distribution functions of ranks are held against their band.
POINTS = 49

# Power below which nothing follows from a calibration that has passed.
TELLING = 0.8

# Ratios of a stated to a right posterior sd for which the power is stated.
WIDTHS = {"20 % too small": 0.8, "10 % too small": 0.9}


@dataclass(frozen=True)
class Uniformity:
    """How even the ranks of one statistic are.

    ``p`` is the smooth test's, ``adjusted`` the same by Holm for all statistics; ``outside`` says
    that the distribution function leaves its simultaneous band; ``covered`` is the part of the
    central intervals that hold the truth, by level in percent.
    """

    p: float
    adjusted: float
    outside: bool
    covered: dict[int, float]


@dataclass(frozen=True)
class Coverage:
    """Mean coverage of a band over replicates, and its error from the spread between them."""

    mean: float
    error: float


@dataclass(frozen=True)
class EcdfBand:
    """The simultaneous band around the distribution function of even ranks.

    ``points`` (POINTS,) in (0, 1); ``lower`` and ``upper`` (POINTS,) the smallest and largest part
    of the replicates below each.
    """

    points: FloatArray
    lower: FloatArray
    upper: FloatArray

    def ecdf(self, positions: FloatArray) -> FloatArray:
        """Part of the positions (replicates, statistics) up to each point, (POINTS, statistics)."""
        below: FloatArray = np.mean(positions <= self.points[:, np.newaxis, np.newaxis], axis=1)
        return below

    def left(self, positions: FloatArray) -> BoolArray:
        """Tell which statistics (statistics,) leave the band anywhere."""
        observed = self.ecdf(positions).T
        outside: BoolArray = ((observed < self.lower) | (observed > self.upper)).any(axis=1)
        return outside


@dataclass(frozen=True)
class Calibration:
    """What many replicates say.

    Parameters
    ----------
    replicates
        How many there are; ``unconverged`` are the numbers of those that did not converge.
    positions
        (ranked replicates, statistics) in (0, 1): where each truth lies in its posterior.
    statistics
        Judgment by statistic.
    ecdf
        The band of the rank test.
    limits
        Binomial limits of the intervals' coverage, by level.
    bands
        Coverage of held-out samples by kind and level ("sensor 95"), and of other records by name,
        kind and level ("NAME sensor 95"); may be empty.
    power
        Probability that the smooth test finds a posterior sd that is wrong by so much.
    shortcomings
        Why the calibration has failed; empty if it has passed.
    name, parameters, facts, provenance
        What was calibrated, and what its numbers depend on: seed, digest of the data, versions.
    """

    __repr__ = brief

    replicates: int
    unconverged: tuple[int, ...]
    positions: FloatArray
    statistics: Mapping[str, Uniformity]
    ecdf: EcdfBand
    limits: Mapping[int, tuple[float, float]]
    bands: Mapping[str, Coverage]
    power: Mapping[str, float]
    shortcomings: tuple[str, ...]
    name: str = "calibration"
    parameters: Sequence[Parameter] = ()
    facts: Sequence[tuple[str, str]] = ()
    provenance: Mapping[str, object] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether nothing speaks against the posteriors."""
        return not self.shortcomings

    @property
    def predicted(self) -> tuple[str, ...]:
        """What the bands are of: "" for the held-out windows together, and other records' names."""
        return tuple(dict.fromkeys(_whose(name) for name in self.bands))

    @property
    def telling(self) -> bool:
        """Whether there are enough replicates to have noticed sds a fifth too small."""
        return max(self.power.values()) >= TELLING


def judge(entries: Sequence[Entry], generator: np.random.Generator) -> Calibration:
    """Judge replicates.

    Parameters
    ----------
    entries
        The replicates, in the order of their numbers; at least one with ranks.
    generator
        Spreads each rank over its place among the draws, so that an even rank is exactly uniform.

    Raises
    ------
    InputError
        No replicate could be fitted at all.
    """
    ranked = [entry for entry in entries if entry["ranks"]]
    if not ranked:
        why = entries[0]["stop_reason"] if entries else "there is none"
        raise InputError(f"none of the {len(entries)} replicates could be fitted: {why}")
    names = tuple(ranked[0]["ranks"])
    ranks = np.array([[entry["ranks"][name] for name in names] for entry in ranked])
    positions = (ranks + generator.uniform(size=ranks.shape)) / (RANKED + 1)
    each = FAMILY_LEVEL / 2 / len(names)
    ecdf = ecdf_band(len(ranked), each)
    p = smooth_test(positions)
    adjusted, outside = holm(p), ecdf.left(positions)
    statistics = {
        name: Uniformity(
            float(p[i]),
            float(adjusted[i]),
            bool(outside[i]),
            {level: float(np.mean(np.abs(column - 0.5) < level / 200)) for level in LEVELS},
        )
        for i, (name, column) in enumerate(zip(names, positions.T, strict=True))
    }
    unconverged = tuple(entry["number"] for entry in entries if not entry["converged"])
    bands = _bands(ranked)
    return Calibration(
        replicates=len(entries),
        unconverged=unconverged,
        positions=positions,
        statistics=statistics,
        ecdf=ecdf,
        limits={level: _binomial_limits(len(ranked), level) for level in LEVELS},
        bands=bands,
        power={text: smooth_power(len(ranked), each, width) for text, width in WIDTHS.items()},
        shortcomings=(
            *_unconverged_remark(len(unconverged), len(entries)),
            *(remark for name, even in statistics.items() for remark in _remarks(name, even)),
            *(_band_remarks(bands) if len(ranked) >= JUDGED_FROM else ()),
        ),
    )


def smooth_test(positions: FloatArray) -> FloatArray:
    """Neyman's smooth test of uniformity with two terms: p-values (statistics,).

    With Legendre's polynomials b₁ = √3 (2u − 1), which sees a bias, and b₂ = √5 (6u² − 6u + 1),
    which sees a wrong width, and their means m₁, m₂ over n positions u,

        T = n (m₁² + m₂²)  is nearly χ² with two degrees of freedom,  p = exp(−T/2).

    At n = 150 a p-value of 4e-4 stands for 5e-4.

    Parameters
    ----------
    positions
        (replicates, statistics), in (0, 1).
    """
    means = np.mean(_legendre(positions), axis=1)
    p: FloatArray = np.exp(-0.5 * positions.shape[0] * np.sum(means**2, axis=0))
    return p


def smooth_power(count: int, level: float, width: float) -> float:
    """Power of the smooth test when posterior sds are ``width`` times the right ones.

    For a normal posterior the truth then lies at u = Φ(z/width), z standard normal; means of b₁
    and b₂ over ``count`` replicates are taken as normal, with the moments they have.
    """
    z = np.linspace(-9, 9, 4001)
    weight = np.exp(-0.5 * z**2)
    weight /= np.sum(weight)
    b = _legendre(ndtr(z / width))
    mean = b @ weight
    sd = np.sqrt(((b - mean[:, np.newaxis]) ** 2) @ weight)
    # By symmetry b1 has no mean and both are uncorrelated: integrate over the mean of b1.
    rest = np.sqrt(np.maximum(-2 * np.log(level) - (sd[0] * z) ** 2, 0))
    shift = mean[1] * np.sqrt(count)
    beyond = ndtr((shift - rest) / sd[1]) + ndtr((-shift - rest) / sd[1])
    return float(np.where(rest > 0, beyond, 1) @ weight)


def holm(p: FloatArray) -> FloatArray:
    """Adjust p-values (tests,) for their number by Holm: each is right for the whole family."""
    order = np.argsort(p)
    factors = np.arange(p.size, 0, -1)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(factors * p[order]), 1)
    return adjusted


def ecdf_band(count: int, level: float) -> EcdfBand:
    """Return the band that ``count`` uniform values leave with probability ``level`` at most.

    Every point has the same binomial tail probability γ, and the largest γ is taken that keeps the
    level. The probability to stay inside is exact: a uniform sample is a Poisson process given its
    total, whose counts go from point to point by convolution. (arviz finds the same band by
    simulation, which at the small levels of a family of tests takes too many.)
    """
    points = np.arange(1, POINTS + 1) / (POINTS + 1)
    # log γ between values that certainly leave the band and certainly keep inside.
    high, low = 0.0, np.log(level) - np.log(2 * POINTS)
    for _ in range(40):
        center = (low + high) / 2
        inside = _stays_inside(count, *_pointwise(count, points, np.exp(center)))
        low, high = (center, high) if inside >= 1 - level else (low, center)
    lower, upper = _pointwise(count, points, np.exp(low))
    return EcdfBand(points, lower / count, upper / count)


def _pointwise(count: int, points: FloatArray, tail: float) -> tuple[FloatArray, FloatArray]:
    """Return counts (POINTS,) beyond which lies at most half the tail's probability either side."""
    either = (
        scipy.stats.binom.ppf(tail / 2, count, points),
        scipy.stats.binom.isf(tail / 2, count, points),
    )
    return np.asarray(either[0]), np.asarray(either[1])


def _stays_inside(count: int, lower: FloatArray, upper: FloatArray) -> float:
    """Probability that the counts of a uniform sample stay between both, at every point."""
    counts = np.arange(count + 1)
    step = scipy.stats.poisson.pmf(counts, count / (POINTS + 1))
    probability = np.zeros(count + 1)
    probability[0] = 1.0
    for low, high in zip(lower, upper, strict=True):
        probability = np.convolve(probability, step)[: count + 1]
        probability[(counts < low) | (counts > high)] = 0.0
    whole = np.convolve(probability, step)[count]
    return float(whole / scipy.stats.poisson.pmf(count, count))


def _legendre(u: FloatArray) -> FloatArray:
    """First two Legendre polynomials, orthonormal on (0, 1), stacked in front."""
    return np.stack([np.sqrt(3) * (2 * u - 1), np.sqrt(5) * (6 * u * (u - 1) + 1)])


def _binomial_limits(count: int, level: int) -> tuple[float, float]:
    low, high = scipy.stats.binom.interval(0.99, count, level / 100)
    return float(low / count), float(high / count)


def _bands(entries: Sequence[Entry]) -> dict[str, Coverage]:
    """Mean coverage and its standard error, by the bands' names."""
    coverages = {}
    for name in entries[0]["covered"]:
        covered = np.array([entry["covered"][name] for entry in entries])
        error = np.std(covered, ddof=1) / np.sqrt(covered.size) if covered.size > 1 else np.nan
        coverages[name] = Coverage(float(np.mean(covered)), float(error))
    return coverages


def _whose(band: str) -> str:
    """Return the name of the other record in a band's name, "" if it is of held-out windows."""
    return " ".join(band.split(" ")[:-2])


def _unconverged_remark(unconverged: int, replicates: int) -> list[str]:
    if unconverged <= LARGEST_UNCONVERGED * replicates:
        return []
    return [
        f"{unconverged} of {replicates} replicates did not converge, more than "
        f"{LARGEST_UNCONVERGED:.0%}"
    ]


def _remarks(name: str, statistic: Uniformity) -> list[str]:
    """Say what is wrong with a statistic's ranks."""
    remarks = []
    if statistic.adjusted < FAMILY_LEVEL / 2:
        remarks.append(f"{name}: ranks are not even (smooth test, p = {statistic.p:.1g})")
    if statistic.outside:
        remarks.append(f"{name}: the distribution of ranks leaves its band")
    return remarks


def _band_remarks(bands: Mapping[str, Coverage]) -> list[str]:
    """Say which bands do not keep their promise; written so that nan fails."""
    remarks = []
    for name, coverage in bands.items():
        other, (kind, level) = _whose(name), name.split()[-2:]
        if not abs(coverage.mean - int(level) / 100) <= LIMIT * coverage.error:
            remarks.append(
                f"the {level} % {kind} band covers {coverage.mean:.1%} ± {coverage.error:.1%} of "
                + (f"the record {other}" if other else "held-out samples")
            )
    return remarks


def summary(calibration: Calibration) -> dict[str, object]:
    """Return the numbers as ``calibration.json`` holds them."""
    return dict(calibration.provenance) | {
        "passed": calibration.passed,
        "telling": calibration.telling,
        "shortcomings": list(calibration.shortcomings),
        "replicates": calibration.replicates,
        "unconverged": list(calibration.unconverged),
        "draws_ranked_among": RANKED,
        "tests": 2 * len(calibration.statistics),
        "family_level": FAMILY_LEVEL,
        "power_of_one_smooth_test": dict(calibration.power),
        "statistics": {
            name: {
                "p": statistic.p,
                "p_adjusted": statistic.adjusted,
                "ecdf_leaves_band": statistic.outside,
                "covered": {str(level): covered for level, covered in statistic.covered.items()},
            }
            for name, statistic in calibration.statistics.items()
        },
        "binomial_limits": {str(level): list(pair) for level, pair in calibration.limits.items()},
        "bands": {
            name: {"covered": coverage.mean, "error": coverage.error}
            for name, coverage in calibration.bands.items()
        },
    }
