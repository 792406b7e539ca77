"""Forecasts: the discrepancy goes on from where readings leave it; the bands keep their word."""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy import stats

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import InitialConditions
from bwbayes.model.declaration import Distribution
from bwbayes.prediction.bands import Bands
from bwbayes.prediction.prediction import forecast, predict_record, predict_windows
from bwbayes.record.record import Record
from tests.inference.problems import INTERVAL, decaying_sine, short_posterior, truth
from tests.measured import keep
from tests.prediction.runs import posterior_draws

# Samples of a record, and of what follows it.
LEAD, LATER = 80, 120


def whole(seed: int) -> tuple[Posterior, Record, FloatArray]:
    """Return the posterior of a record's first part, that part, and what was read later.

    The discrepancy of the whole record is one draw of the noise that the model has.
    """
    voltage = decaying_sine(LEAD + LATER)
    posterior = short_posterior("discrepancy", LEAD)
    theta = truth(posterior)
    one = posterior.single_record
    clean = one.actuator.displacement(one.table.actuator(theta), voltage, from_rest=True)[0]
    noise = DiscrepancyNoise(INTERVAL)
    parts = noise.draw(one.table.noise(theta), voltage.size, np.random.default_rng([5, seed]))
    reading = clean + sum(parts)
    first = Record(voltage[:LEAD], reading[:LEAD], interval=INTERVAL)
    posterior = posterior.altered(voltage=voltage[:LEAD], displacement=reading[:LEAD])
    return posterior, first, np.stack([voltage[LEAD:], reading[LEAD:]])


def free_truth(posterior: Posterior) -> FloatArray:
    """Return the true free parameters, (1, free)."""
    theta = truth(posterior)
    return theta[:, [posterior.prior.names.index(name) for name in posterior.names]]


def test_a_forecast_is_narrower_at_first_and_as_wide_as_ever_later() -> None:
    posterior, record, (voltage, _) = whole(1)
    draws, generator = free_truth(posterior), np.random.default_rng(1)
    told = forecast(posterior, draws, record, voltage, generator)
    longer = replace(record, voltage=np.concatenate([record.voltage, voltage]), displacement=None)
    window = {"later": slice(LEAD, LEAD + LATER)}
    (usual,) = predict_windows(posterior, draws, longer, window, generator)

    def width(bands: Bands) -> FloatArray:
        wide: FloatArray = bands.upper["displacement", 95] - bands.lower["displacement", 95]
        return wide

    assert width(told)[0] < 0.75 * width(usual)[0]
    part = width(told) / width(usual)
    assert (np.diff(part) > -0.02).all()
    assert part[-1] == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(told.mean[-1], usual.mean[-1], atol=0.02)
    low = told.lower["parameter", 95]
    np.testing.assert_allclose(low, usual.lower["parameter", 95], atol=1e-9)


@pytest.mark.parametrize(
    ("from_rest", "estimate_offset"), [(True, False), (True, True), (False, True)]
)
def test_another_record_is_forecast_from_its_lead_in(
    from_rest: bool, estimate_offset: bool
) -> None:
    """Narrower than without at first, and alike later, whatever is unknown of its start."""
    posterior, record, (voltage, reading) = whole(2)
    other = Record(
        np.concatenate([record.voltage, voltage]),
        np.concatenate([record.displacement, reading]),
        interval=INTERVAL,
    )
    draws = np.repeat(free_truth(posterior), 200, axis=0)
    lead_in = LEAD * INTERVAL
    told, usual = (
        predict_record(
            posterior,
            draws,
            other,
            InitialConditions(from_rest, estimate_offset, lead_in, after=after),
            np.random.default_rng(3),
        )
        for after in (True, False)
    )
    assert told.scored_from == LEAD
    widths = [(one.upper["sensor", 95] - one.lower["sensor", 95])[LEAD:] for one in (told, usual)]
    assert widths[0][0] < 0.95 * widths[1][0]
    assert widths[0][-1] == pytest.approx(widths[1][-1], rel=0.05)
    assert told.crps is not None
    assert np.isfinite(told.crps).all()


# Forecasts from a posterior are calibrated: truth from the prior, what comes later in the bands

# Samples after a record that are looked at.
AT = (0, 2, 10, 30, LATER - 1)

PRIORS = {
    "d": Distribution("normal", {"mean": 0.7, "sd": 0.05}),
    "alpha": Distribution("lognormal", {"median": 0.36, "sigma": 0.15}),
    "beta": Distribution("lognormal", {"median": 0.03, "sigma": 0.2}),
    "offset": Distribution("normal", {"mean": 0.0, "sd": 2.0}),
    "discrepancy_sd": Distribution("lognormal", {"median": 0.8, "sigma": 0.4}),
    "discrepancy_time": Distribution("lognormal", {"median": 0.2, "sigma": 0.4}),
}
FIXED = {"initial": 0.0, "gamma": 0.01, "sensor_sd": 0.3}


class Replicate(NamedTuple):
    """A posterior with draws (draws, free), its record, and what follows: V and um (samples,)."""

    posterior: Posterior
    draws: FloatArray
    record: Record
    voltage: FloatArray
    reading: FloatArray


def replicate(seed: int) -> Replicate:
    """Draw a truth from the prior, simulate its record and what follows, and fit the record."""
    source = np.random.default_rng([11, seed])
    usual = short_posterior("discrepancy", LEAD, fixed=FIXED, priors=PRIORS)
    theta = usual.prior.theta(usual.prior.draw(source, 1))
    voltage = decaying_sine(LEAD + LATER)[::-1].copy()
    one = usual.single_record
    clean = one.actuator.displacement(one.table.actuator(theta), voltage, from_rest=True)[0]
    reading = clean + sum(one.noise.draw(one.table.noise(theta), voltage.size, source))
    record = Record(voltage[:LEAD], reading[:LEAD], interval=INTERVAL)
    posterior = usual.altered(voltage=voltage[:LEAD], displacement=reading[:LEAD])
    _, draws = posterior_draws(posterior, source)
    return Replicate(posterior, draws, record, voltage[LEAD:], reading[LEAD:])


def ranks(replicates: Iterable[Replicate]) -> IntArray:
    """Where readings lie in their bands, (replicates, samples): 0 below 95%, ... 6 above it."""
    places = []
    for posterior, draws, record, voltage, reading in replicates:
        bands = forecast(posterior, draws, record, voltage, np.random.default_rng(1))
        edges = [bands.lower["sensor", level] for level in (95, 90, 50)]
        edges += [bands.upper["sensor", level] for level in (50, 90, 95)]
        places.append(np.sum(reading > np.array(edges), axis=0))
    return np.array(places)


def smallest_p(of: IntArray) -> float:
    """Return the smallest p-value of all distances, for both tails of 95% and for the quartiles.

    Two tests of each of five distances: binomial, chi-square with two degrees of freedom.
    """
    values = []
    for at in AT:
        column = of[:, at]
        outside = int(np.sum((column == 0) | (column == 6)))
        values.append(stats.binomtest(outside, column.size, 0.05).pvalue)
        quartiles = [np.sum(column <= 2), np.sum(column == 3), np.sum(column >= 4)]
        expected = column.size * np.array([0.25, 0.5, 0.25])
        values.append(stats.chisquare(quartiles, expected).pvalue)
    return float(min(values))


@pytest.mark.slow
def test_parameters_taken_for_known_are_noticed() -> None:
    """The twin: bands that are those of the discrepancy alone, parameters at their mean."""
    every = map(replicate, range(36))
    known = (one._replace(draws=one.draws.mean(axis=0, keepdims=True)) for one in every)
    assert smallest_p(ranks(known)) < 1e-4


@pytest.mark.slow
def test_forecasts_from_many_posteriors_are_calibrated() -> None:
    """With 300 records, a coverage of 88% instead of 95 would be noticed in three of four."""
    of = ranks(replicate(seed) for seed in range(1000, 1300))
    inside = {f"{at + 1} samples later": np.mean((of[:, at] > 0) & (of[:, at] < 6)) for at in AT}
    figures = {name: float(part) for name, part in inside.items()}
    p = smallest_p(of)
    keep(
        "forecasts from posteriors",
        {"records": len(of), "95% bands cover": figures, "smallest p of ten": p},
    )
    assert p > 1e-4
