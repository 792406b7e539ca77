"""Simulation-based calibration: whether the posteriors of many replicates mean what they say.

Replicates simulate records whose truth was drawn from the prior, fit them, and compare.
If prior, model, likelihood and sampler are right, the truth is one more draw from the posterior. So
its rank among as many independent draws is any of the possible ones, each as likely as the next,
and a band covers as much as it promises (simulation-based calibration). :func:`replicate` is a pure
function of an experiment, a seed and a number, so it does not matter where, when or in which order
replicates are made. A record that is not fitted starts as :mod:`bwbayes.prediction.initial_state`
takes it to: from a hysteretic state that a running drive of some amplitude leaves, with the
dynamics as far from rest as their prior says, and with an offset of its own.

Ranks that heap up at both ends tell of posteriors that are too narrow, in the middle of ones too
wide, at one end of a bias. The smooth test looks for just these shapes and is by far the more
powerful; that of Kolmogorov and Smirnov sees any other. Both together raise a false alarm in one
sound calibration of a hundred. Bands on held-out samples must cover what they promise within three
standard errors. Single coverages are far from normal, so this is asked of 500 replicates or more,
of which one sound calibration in forty fails it by chance (one in 17 with 100). These rates are
those of one look. Replicates that did not converge are counted, and ranked with the rest if they
have draws at all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import product, repeat
from typing import NamedTuple, Self, TypedDict

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, one_line
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.parameters import Parameter
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.state_space import Noise
from bwbayes.inference.study import Validation
from bwbayes.model.inputs import rate
from bwbayes.prediction.bands import KINDS, LEVELS, Bands, Kind
from bwbayes.prediction.initial_state import estimate_initial_states
from bwbayes.prediction.prediction import predict_record, predict_windows, thin_draws
from bwbayes.quantities import DEFAULT, Quantities
from bwbayes.record.record import Record
from bwbayes.sampling.chain import draws
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.sampler import init_chain, sample
from bwbayes.shown import brief


class Simulated(NamedTuple):
    """A record with its truth, and the displacement of its model (samples,), um."""

    record: Record
    model: FloatArray

    @classmethod
    def of(
        cls,
        record: Record,
        model: FloatArray,
        noise: Noise,
        parameters: FloatArray,
        generator: np.random.Generator,
    ) -> Self:
        """Add the noise of ``parameters`` (1, parameters); missing readings stay missing."""
        speed = np.abs(rate(record.inputs.voltage, record.interval))
        discrepancy, sensor = noise.draw(parameters, model.size, generator, speed)
        truth = model + discrepancy
        reading = truth + sensor
        if record.displacement is not None:
            reading[np.isnan(record.displacement)] = np.nan
        return cls(replace(record, displacement=reading, truth=truth), model)

    def target(self, kind: Kind) -> FloatArray:
        """Return what a kind of band is for, (samples,), um: model, truth or reading."""
        values = {
            "parameter": self.model,
            "displacement": self.record.truth,
            "sensor": self.record.displacement,
        }[kind]
        assert values is not None
        return values


def band_coverage(
    predictions: Sequence[tuple[Bands, Simulated, slice]],
) -> Iterator[tuple[Kind, int, float]]:
    """Yield the part of simulated records' samples that lie inside each kind and level of band.

    The samples of the bands are those of the slice of the record that they come with. Those of a
    lead-in do not count, and those without a reading not for the sensor band.
    """
    for kind, level in product(KINDS, LEVELS):
        inside = []
        for bands, simulated, window in predictions:
            values = simulated.target(kind)[window]
            inside.append(bands.covers(kind, level, values)[bands.scored(values)])
        yield kind, level, float(np.mean(np.concatenate(inside)))


# Draws that a truth is ranked among.
RANKED = 199


class Entry(TypedDict):
    """A replicate as it is stored.

    ``steps`` are those of the sampling that count, ``spacing`` those between two draws of one
    walker, at least one autocorrelation time if it has converged. ``truth`` and ``ranks`` (how many
    draws lie below it, from 0 to ``RANKED``) are by statistic, ``covered`` (the part of the samples
    inside) by band ("sensor 95").
    """

    number: int
    converged: bool
    stop_reason: str
    steps: int
    spacing: int
    truth: dict[str, float]
    ranks: dict[str, int]
    covered: dict[str, float]


@dataclass(frozen=True)
class CalibrationSetup:
    """The setup that all replicates share.

    Parameters
    ----------
    posterior
        Voltage, training windows, model and prior that are fitted; of its displacement nothing is
        used.
    plan
        How to sample.
    held_out
        Windows (slices of a record's voltage) for which bands are predicted and held against the
        simulated record, by the record's name.
    others
        Other records, by name: simulated with the same truth, but with a start and an offset of
        their own, and predicted with the parameters from the posterior. Their displacement only
        marks where there are readings; without any it is a planned voltage, whose start nothing
        tells.
    source
        Where truths and records come from, if not from ``posterior``, whose parameters it must
        include. A calibration then must fail: on records that the analysis is wrong about.
    around
        The posterior's own draws (draws, free), in their own units, and its point fit, if truths
        come from these and not from its prior. The readings behind these draws are then fitted
        with each replicate, and no bands are predicted.
    """

    __repr__ = brief

    posterior: Posterior
    plan: SamplingPlan
    held_out: Mapping[str, Sequence[slice]] = field(default_factory=dict)
    others: Mapping[str, Validation] = field(default_factory=dict)
    source: Posterior | None = None
    around: tuple[FloatArray, MAPEstimate] | None = None

    @property
    def truth(self) -> Posterior:
        """The posterior whose prior and model make truths and records."""
        return self.source or self.posterior

    @property
    def statistics(self) -> tuple[str, ...]:
        """Names of what is ranked."""
        return (*self.posterior.names, "log_likelihood", "loop_area", "range")

    @property
    def bands(self) -> tuple[str, ...]:
        """Names of the bands: "sensor 95" of held-out windows, "NAME sensor 95" of others."""
        names = [f"{kind} {level}" for kind in KINDS for level in LEVELS]
        others = [f"{other} {name}" for other in self.others for name in names]
        return (*(names if self.held_out else []), *others)

    def measures(self, posterior: Posterior, theta: FloatArray) -> FloatArray:
        """Return what is ranked of models θ (models, parameters), (models, statistics).

        Free parameters, log likelihood, and two measures of the displacement: the area of its
        loops, −∮ x du (um V), by trapezoids, positive where it lags behind the voltage, summed over
        the records up to their last readings; and the largest range of any of them (um).
        """
        area, extent = np.zeros((2, len(theta)))
        for data in posterior.datasets:
            displacement = posterior.simulate(theta, record=data.name)
            path = data.voltage[: data.training[-1].stop]
            area -= np.trapezoid(displacement, path, axis=1)
            extent = np.maximum(extent, np.ptp(displacement, axis=1))
        free = theta[:, [posterior.prior.names.index(name) for name in posterior.names]]
        return np.column_stack([free, posterior.log_likelihood(theta), area, extent])


@dataclass(frozen=True, eq=False)
class Replicate:
    """One record, simulated and fitted: what is stored, and (RANKED, statistics) posterior draws.

    The draws are empty, and nothing is ranked or covered, if there are not so many.
    """

    __repr__ = brief

    entry: Entry
    draws: FloatArray


def replicate(experiment: CalibrationSetup, seed: int, number: int) -> Replicate:
    """Draw a truth, simulate its record, fit that, and compare.

    Raises
    ------
    InputError
        The prior draws a model without a finite displacement.
    """
    generator = np.random.default_rng([seed, number])
    simulating, fitting, sampling, choosing, predicting, others = generator.spawn(6)
    theta, simulated = _simulate_truth(experiment, simulating)
    readings = {
        name: record.displacement
        for name, (record, _) in simulated.items()
        if record.displacement is not None
    }
    posterior = experiment.posterior.with_readings(readings)
    if experiment.around is not None:
        posterior = experiment.posterior.with_readings_of(posterior)
    true = np.stack([theta[name] for name in posterior.prior.names], axis=1)
    names, truth = experiment.statistics, experiment.measures(posterior, true)[0]
    entry = Entry(
        number=number,
        converged=False,
        stop_reason="",
        steps=0,
        spacing=0,
        truth=dict(zip(names, truth.tolist(), strict=True)),
        ranks={},
        covered={},
    )
    # InputError, and what linear algebra raises: one record must not end the whole calibration.
    try:
        around = experiment.around
        point = (
            pointfit.fit(posterior, fitting)
            if around is None
            else pointfit.refit(posterior, around[1])
        )
        chain = init_chain(posterior, point, experiment.plan, sampling)
        with ThreadPoolExecutor(1) as executor:
            outcome = sample(posterior, experiment.plan, chain, executor)
    except ValueError as error:
        entry["stop_reason"] = one_line(str(error))
        return Replicate(entry, np.empty((0, len(names))))
    # As good as independent are draws that lie the longest autocorrelation time apart, if anything
    # moves and enough are left. As two of a chain are correlated by 1/ESS on average, that much of
    # the ranks' evenness is lost, and no more.
    chained, time = draws(posterior, chain), float(np.max(outcome.check.autocorrelation))
    longest = chained[..., 0].size // RANKED
    spacing = max(min(math.ceil(time) if math.isfinite(time) else 1, longest), 1)
    free = thin_draws(chained[::-spacing].reshape(-1, chained.shape[-1]), choosing, RANKED)
    entry["converged"], entry["stop_reason"] = outcome.converged, outcome.stop_reason
    entry["steps"], entry["spacing"] = outcome.check.steps, spacing
    if len(free) < RANKED:
        return Replicate(entry, np.empty((0, len(names))))
    drawn = experiment.measures(posterior, posterior.prior.theta(free))
    entry["ranks"] = dict(zip(names, np.sum(drawn < truth, axis=0).tolist(), strict=True))
    if not experiment.bands:
        return Replicate(entry, drawn)
    # Fewer draws than a run's, to save time.
    flat = thin_draws(chained.reshape(-1, free.shape[1]), predicting, 400)
    predictions = _predictions(experiment, posterior, flat, theta, simulated, predicting, others)
    entry["covered"] = {
        f"{name} {kind} {level}".strip(): share
        for name, predicted in predictions.items()
        for kind, level, share in band_coverage(predicted)
    }
    return Replicate(entry, drawn)


def _simulate_truth(
    experiment: CalibrationSetup, generator: np.random.Generator
) -> tuple[dict[str, FloatArray], dict[str, Simulated]]:
    """Draw a truth; return it by parameter, (1,) each, and its records by name."""
    source, around = experiment.truth, experiment.around
    free = (
        source.prior.draw(generator, 1) if around is None else generator.choice(around[0], size=1)
    )
    theta = source.prior.theta(free)
    column = source.table.columns(theta)
    simulated = {}
    for fitted, likelihood in zip(experiment.posterior.datasets, source.likelihoods, strict=True):
        record_theta = source.table.of(theta, likelihood.name)
        sd = likelihood.start_sd(record_theta)
        model = likelihood.actuator.advance(
            likelihood.table.actuator(record_theta),
            likelihood.inputs,
            initial_transient=sd * generator.standard_normal(sd.shape),
            from_rest=likelihood.from_rest,
        )[0][0]
        record = Record(
            likelihood.voltage,
            fitted.displacement,
            interval=likelihood.inputs.interval,
            covariates=likelihood.inputs.covariates,
        )
        noise = likelihood.table.noise(record_theta)
        simulated[likelihood.name] = Simulated.of(record, model, likelihood.noise, noise, generator)
    return column, simulated


def _predictions(
    experiment: CalibrationSetup,
    posterior: Posterior,
    draws: FloatArray,
    theta: Mapping[str, FloatArray],
    simulated: Mapping[str, Simulated],
    predicting: np.random.Generator,
    others: np.random.Generator,
) -> dict[str, list[tuple[Bands, Simulated, slice]]]:
    """Predict held-out windows, all together under no name, and other records of the same truth.

    Each prediction comes with what it is of, and with the samples of it that count.
    """
    predictions: dict[str, list[tuple[Bands, Simulated, slice]]] = {}
    for name, single, record_draws in posterior.each(draws):
        if name in experiment.held_out:
            windows = {str(window): window for window in experiment.held_out[name]}
            record = simulated[name].record
            bands = predict_windows(single, record_draws, record, windows, predicting)
            held_out = zip(bands, repeat(simulated[name]), windows.values())
            predictions.setdefault("", []).extend(held_out)
    readings = {dataset.name: dataset.displacement for dataset in posterior.datasets}
    source = experiment.truth.with_readings(readings)
    true = np.stack([theta[name] for name in source.prior.names], axis=1)
    for name, other in experiment.others.items():
        made_with = source.for_record(other.of), source.table.of(true, other.of)
        another, planned = _simulated_other(other, *made_with, others), other.record
        assert planned is not None
        record, window = another.record, slice(0, another.model.size)
        if planned.displacement is None:
            record = replace(record, displacement=None)
        if other.judged is not None:
            window = record.window_slice(*other.judged)
        alone = posterior.for_record(other.of), posterior.select_draws(draws, other.of)
        predicted = predict_record(*alone, record, other.start, others, window=other.judged)
        predictions[name] = [(predicted, another, window)]
    return predictions


def _simulated_other(
    other: Validation, posterior: Posterior, theta: FloatArray, generator: np.random.Generator
) -> Simulated:
    """Simulate another record with the true parameters (1, parameters).

    ``posterior`` is that of the record that was made with them, which tells the ranges of voltage
    and offset.
    """
    record, training = other.record, posterior.single_record
    assert record is not None
    planned = replace(record, displacement=None, truth=None)
    start_states = estimate_initial_states(posterior, theta, planned, other.start, generator)
    model = start_states.displacement(planned.inputs)[0]
    if other.start.estimate_offset and record.displacement is not None:
        model = model + training.extent * generator.standard_normal()
    noise, parameters = training.noise.at(planned.interval), training.table.noise(theta)
    return Simulated.of(replace(record, truth=None), model, noise, parameters, generator)


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
