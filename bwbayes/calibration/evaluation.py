"""Calibration: whether the posteriors of many replicates mean what they say.

Where a posterior is right, the truth's rank among its draws is even over replicates
(:mod:`bwbayes.calibration.replicates`). Ranks that heap up at both ends tell of posteriors that are
too narrow, in the middle of ones too wide, at one end of a bias. The smooth test looks for just
these shapes and is by far the more powerful; that of Kolmogorov and Smirnov sees any other. Both
together raise a false alarm in one sound calibration of a hundred. Bands on held-out samples must
cover what they promise within three standard errors. Single coverages are far from normal, so this
is asked of 500 replicates or more, of which one sound calibration in forty fails it by chance (one
in 17 with 100). These rates are those of one look. Replicates that did not converge are counted,
and ranked with the rest if they have draws at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.calibration.replicates import RANKED, Entry
from bwbayes.errors import InputError
from bwbayes.inference.parameters import Parameter
from bwbayes.prediction.bands import LEVELS
from bwbayes.quantities import DEFAULT, Quantities
from bwbayes.shown import brief

# Probability of a false alarm from all tests of all statistics, half of it for either test.
FAMILY_LEVEL = 0.01

# Standard errors that a band's coverage may be off, once its mean over replicates is near normal.
LIMIT = 3.0
JUDGED_FROM = 500


@dataclass(frozen=True)
class Uniformity:
    """How even the ranks of one statistic are.

    ``p`` is the smooth test's, ``adjusted`` the same by Holm for all statistics; ``outside`` says
    that the distribution function leaves its band; ``covered`` is the part of the central intervals
    that hold the truth, by level in percent.
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
class Calibration:
    """The results of many replicates.

    Parameters
    ----------
    replicates
        How many there are; ``unconverged`` are the numbers of those that did not converge.
    positions
        (ranked replicates, statistics) in (0, 1): where each truth lies in its posterior.
    statistics
        Judgment by statistic.
    ecdf_limit
        How far a distribution function of even ranks may lie from the straight line.
    limits
        Binomial limits of the intervals' coverage, by level.
    bands
        Coverage of held-out samples by kind and level ("sensor 95"), and of other records by name,
        kind and level ("NAME sensor 95"); may be empty.
    power
        Probability that the smooth test finds a posterior sd that is wrong by so much.
    name, parameters, facts, provenance
        The calibrated problem, facts about it, and seed, digest of the data and versions.
    quantities
        Quantities of its records, in whose words it is shown.
    """

    __repr__ = brief

    replicates: int
    unconverged: tuple[int, ...]
    positions: FloatArray
    statistics: Mapping[str, Uniformity]
    ecdf_limit: float
    limits: Mapping[int, tuple[float, float]]
    bands: Mapping[str, Coverage]
    power: Mapping[str, float]
    name: str = "calibration"
    parameters: Sequence[Parameter] = ()
    facts: Sequence[tuple[str, str]] = ()
    provenance: Mapping[str, object] = field(default_factory=dict)
    quantities: Quantities = DEFAULT

    @property
    def failures(self) -> tuple[str, ...]:
        """Why the calibration has failed; empty if it has passed."""
        reasons = []
        if len(self.unconverged) > 0.01 * self.replicates:
            reasons.append(
                f"{len(self.unconverged)} of {self.replicates} replicates did not converge, "
                "more than 1%"
            )
        for name, statistic in self.statistics.items():
            if statistic.adjusted < FAMILY_LEVEL / 2:
                reasons.append(f"{name}: ranks are not even (smooth test, p = {statistic.p:.1g})")
            if statistic.outside:
                reasons.append(f"{name}: the distribution of ranks leaves its band")
        for name, coverage in self.bands.items() if len(self.positions) >= JUDGED_FROM else ():
            *record, kind, level = name.split(" ")
            # Written so that nan fails.
            if not abs(coverage.mean - int(level) / 100) <= LIMIT * coverage.error:
                samples = f"the record {' '.join(record)}" if record else "held-out samples"
                reasons.append(
                    f"the {level}% {kind} band covers {coverage.mean:.1%} ± {coverage.error:.1%} "
                    f"of {samples}"
                )
        return tuple(reasons)

    @property
    def notes(self) -> tuple[str, ...]:
        """The same, as a warning says it."""
        return tuple(f"calibration failed: {reason}" for reason in self.failures)

    @property
    def passed(self) -> bool:
        """Whether nothing speaks against the posteriors."""
        return not self.failures

    @property
    def predicted(self) -> tuple[str, ...]:
        """Records of the bands: "" for the held-out windows together, other records' names."""
        return tuple(dict.fromkeys(" ".join(name.split(" ")[:-2]) for name in self.bands))

    @property
    def telling(self) -> bool:
        """Whether there are enough replicates to have noticed sds a fifth too small."""
        return max(self.power.values()) >= 0.8

    @property
    def numbers(self) -> dict[str, object]:
        """Contents of ``calibration.json``."""
        return dict(self.provenance) | {
            "passed": self.passed,
            "telling": self.telling,
            "failures": list(self.failures),
            "replicates": self.replicates,
            "unconverged": list(self.unconverged),
            "draws_ranked_among": RANKED,
            "tests": 2 * len(self.statistics),
            "family_level": FAMILY_LEVEL,
            "power_of_one_smooth_test": dict(self.power),
            "statistics": {
                name: {
                    "p": statistic.p,
                    "p_adjusted": statistic.adjusted,
                    "ecdf_leaves_band": statistic.outside,
                    "covered": {str(level): share for level, share in statistic.covered.items()},
                }
                for name, statistic in self.statistics.items()
            },
            "binomial_limits": {str(level): list(pair) for level, pair in self.limits.items()},
            "bands": {
                name: {"covered": coverage.mean, "error": coverage.error}
                for name, coverage in self.bands.items()
            },
        }


def evaluate_calibration(entries: Sequence[Entry], generator: np.random.Generator) -> Calibration:
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
    count, names = len(ranked), tuple(ranked[0]["ranks"])
    ranks = np.array([[entry["ranks"][name] for name in names] for entry in ranked])
    positions = (ranks + generator.uniform(size=ranks.shape)) / (RANKED + 1)
    level = FAMILY_LEVEL / 2 / len(names)
    p = smooth_test(positions)
    ecdf_limit = float(scipy.stats.kstwo.isf(level, count))
    even = scipy.stats.uniform.cdf
    distances = [scipy.stats.ks_1samp(column, even).statistic for column in positions.T]
    statistics = {
        name: Uniformity(
            float(p[i]),
            float(adjusted),
            bool(distances[i] > ecdf_limit),
            {level: float(np.mean(np.abs(column - 0.5) < level / 200)) for level in LEVELS},
        )
        for i, (name, adjusted, column) in enumerate(zip(names, holm(p), positions.T, strict=True))
    }
    bands = {}
    for name in ranked[0]["covered"]:
        covered = np.array([entry["covered"][name] for entry in ranked])
        error = np.std(covered, ddof=1) / np.sqrt(count) if count > 1 else np.nan
        bands[name] = Coverage(float(np.mean(covered)), float(error))
    intervals = {level: scipy.stats.binom.interval(0.99, count, level / 100) for level in LEVELS}
    return Calibration(
        replicates=len(entries),
        unconverged=tuple(entry["number"] for entry in entries if not entry["converged"]),
        positions=positions,
        statistics=statistics,
        ecdf_limit=ecdf_limit,
        limits={
            lvl: (float(low / count), float(high / count)) for lvl, (low, high) in intervals.items()
        },
        bands=bands,
        power={
            "20% too small": smooth_power(count, level, 0.8),
            "10% too small": smooth_power(count, level, 0.9),
        },
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
    b = _legendre(scipy.special.ndtr(z / width))
    mean = b @ weight
    sd = np.sqrt(((b - mean[:, np.newaxis]) ** 2) @ weight)
    # By symmetry b1 has no mean and both are uncorrelated: integrate over the mean of b1.
    radius = np.sqrt(np.maximum(-2 * np.log(level) - (sd[0] * z) ** 2, 0))
    shift = mean[1] * np.sqrt(count)
    below, above = ((side - radius) / sd[1] for side in (shift, -shift))
    beyond = scipy.special.ndtr(below) + scipy.special.ndtr(above)
    return float(np.where(radius > 0, beyond, 1) @ weight)


def holm(p: FloatArray) -> FloatArray:
    """Adjust p-values (tests,) for their number by Holm: each is right for the whole family."""
    order = np.argsort(p)
    factors = np.arange(p.size, 0, -1)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(factors * p[order]), 1)
    return adjusted


def _legendre(u: FloatArray) -> FloatArray:
    """First two Legendre polynomials, orthonormal on (0, 1), stacked in front."""
    return np.stack([np.sqrt(3) * (2 * u - 1), np.sqrt(5) * (6 * u * (u - 1) + 1)])
