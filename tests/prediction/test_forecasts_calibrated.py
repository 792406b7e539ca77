"""Forecasts from a posterior are calibrated: truth from the prior, what comes later in the bands.

Of each replicate parameters are drawn from the prior and a record and what follows are simulated
with them; the record is fitted, and its posterior's draws say what follows. A reading then lies
below each edge of the sensor band as often as the band says, at every distance after the record
(simulation-based calibration of what is predicted: S. Talts and others, arXiv:1804.06788). What
follows goes to larger voltages than the record, so that the parameters' uncertainty counts as much
as the discrepancy.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import pytest
from scipy import stats

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.posterior import Posterior
from bwbayes.model.distributions import Distribution
from bwbayes.prediction.prediction import forecast
from bwbayes.record.record import Record
from tests.inference.problems import INTERVAL, decaying_sine, short_posterior
from tests.measured import keep
from tests.prediction.runs import posterior_draws

# Samples of a record, of what follows, and those after it that are looked at.
LEAD, LATER = 80, 120
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
    one = usual.only
    clean = one.actuator.displacement(one.table.actuator(theta), voltage, from_rest=True)[0]
    reading = clean + sum(one.noise.draw(one.table.noise(theta), voltage.size, source))
    record = Record(voltage[:LEAD], reading[:LEAD], INTERVAL)
    posterior = usual.altered(voltage=voltage[:LEAD], displacement=reading[:LEAD])
    _, draws = posterior_draws(posterior, source)
    return Replicate(posterior, draws, record, voltage[LEAD:], reading[LEAD:])


def ranks(replicates: Iterable[Replicate]) -> IntArray:
    """Where readings lie in their bands, (replicates, samples): 0 below 95 %, ... 6 above it."""
    return np.array(list(_ranks(replicates)))


def _ranks(replicates: Iterable[Replicate]) -> Iterator[IntArray]:
    for posterior, draws, record, voltage, reading in replicates:
        bands = forecast(posterior, draws, record, voltage, np.random.default_rng(1))
        edges = [bands.lower["sensor", level] for level in (95, 90, 50)]
        edges += [bands.upper["sensor", level] for level in (50, 90, 95)]
        yield np.sum(reading > np.array(edges), axis=0)


def smallest_p(of: IntArray) -> float:
    """Return the smallest p-value of all distances, for both tails of 95 % and for the quartiles.

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


def known(replicates: Iterable[Replicate]) -> list[Replicate]:
    """Take the parameters for known, at their posterior mean."""
    return [one._replace(draws=one.draws.mean(axis=0, keepdims=True)) for one in replicates]


@pytest.fixture(scope="module")
def few() -> list[Replicate]:
    return [replicate(seed) for seed in range(36)]


@pytest.mark.slow
def test_parameters_taken_for_known_are_noticed(few: list[Replicate]) -> None:
    """The twin: bands that are those of the discrepancy alone."""
    assert smallest_p(ranks(known(few))) < 1e-4


@pytest.mark.slow
def test_forecasts_from_many_posteriors_are_calibrated() -> None:
    """Of 300 records: a coverage of 88 % instead of 95 would be noticed in three of four."""
    of = ranks(replicate(seed) for seed in range(1000, 1300))
    inside = {f"{at + 1} samples later": np.mean((of[:, at] > 0) & (of[:, at] < 6)) for at in AT}
    figures = {name: float(part) for name, part in inside.items()}
    p = smallest_p(of)
    keep(
        "forecasts from posteriors",
        {"records": len(of), "95 % bands cover": figures, "smallest p of ten": p},
    )
    assert p > 1e-4
