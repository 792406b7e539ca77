"""Replicates: simulate records whose truth was drawn from the prior, fit them, and compare.

If prior, model, likelihood and sampler are right, the truth is one more draw from the posterior. So
its rank among as many independent draws is any of the possible ones, each as likely as the next,
and a band covers as much as it promises (simulation-based calibration). :func:`replicate` is a pure
function of an experiment, a seed and a number, so it does not matter where, when or in which order
replicates are made; :mod:`bwbayes.calibration.evaluation` judges many of them. A record that is not
fitted starts as :mod:`bwbayes.prediction.initial_state` takes it to: from a hysteretic state that a
running drive of some amplitude leaves, with the dynamics as far from rest as their prior says, and
with an offset of its own.

Around a posterior that was sampled, truths are its draws, and each replicate's readings are fitted
together with its own: p(θ | own, replicated) has the posterior for its prior. So ranks are even if
the posterior is right where the record has put it (posterior SBC: Säilynoja, Schmitt, Bürkner and
Vehtari, arXiv:2502.03279, 2025).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import product, repeat
from typing import NamedTuple, Self, TypedDict

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import one_line
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.state_space import Noise
from bwbayes.inference.study import Validation
from bwbayes.model.inputs import rate
from bwbayes.prediction.bands import KINDS, LEVELS, Bands, Kind
from bwbayes.prediction.initial_state import estimate_initial_states
from bwbayes.prediction.prediction import predict_record, predict_windows, thin_draws
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
class Sampled:
    """A posterior that was sampled: its ``draws`` (draws, free), and the ``point`` fit.

    Parameters are in their own units.
    """

    __repr__ = brief

    draws: FloatArray
    point: MAPEstimate


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
        The posterior's own draws, if truths come from these and not from its prior. The
        readings behind these draws are then fitted with each replicate, and no bands are predicted.
    """

    __repr__ = brief

    posterior: Posterior
    plan: SamplingPlan
    held_out: Mapping[str, Sequence[slice]] = field(default_factory=dict)
    others: Mapping[str, Validation] = field(default_factory=dict)
    source: Posterior | None = None
    around: Sampled | None = None

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
    theta, simulated = _simulated(experiment, simulating)
    readings = {
        name: record.displacement
        for name, (record, _) in simulated.items()
        if record.displacement is not None
    }
    posterior = experiment.posterior.with_readings(readings)
    if experiment.around is not None:
        posterior = _together(experiment.posterior, posterior)
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
            else pointfit.refit(posterior, around.point)
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


def _together(posterior: Posterior, replicated: Posterior) -> Posterior:
    """Return the posterior of its own readings and of replicated ones: the same parameters."""
    datasets = posterior.datasets + replicated.datasets
    return replace(posterior, datasets=datasets, joint=posterior.table)


def _simulated(
    experiment: CalibrationSetup, generator: np.random.Generator
) -> tuple[dict[str, FloatArray], dict[str, Simulated]]:
    """Draw a truth; return it by parameter, (1,) each, and its records by name."""
    source, around = experiment.truth, experiment.around
    free = (
        source.prior.draw(generator, 1)
        if around is None
        else generator.choice(around.draws, size=1)
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
