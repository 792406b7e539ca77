"""A record that the model made looks like its replicates; one that it could not make does not.

A p-value below 0.005 or above 0.995 is odd: one in a hundred for a record of the model itself, and
less here, since the posterior has seen the record.
"""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.predictive_checks import STATISTICS, Replicated, replicated
from bwbayes.inference.posterior import Posterior
from tests.inference.problems import INTERVAL, TRUE_NOISE, short_posterior, truth

SAMPLES = 400


def looked_at(posterior: Posterior) -> Replicated:
    """Check against the truth's own replicates, its parameters hardly uncertain."""
    names = list(posterior.prior.names)
    free = [names.index(name) for name in posterior.names]
    draws = np.repeat(truth(posterior)[:, free], 200, axis=0)
    return replicated(posterior, draws, np.random.default_rng(1))


def changed(posterior: Posterior, added: FloatArray) -> Posterior:
    return posterior.altered(displacement=posterior.only.displacement + added)


def test_good_records_are_not_odd() -> None:
    """Of eight statistics of ten records three or more are odd with a probability of 0.01."""
    odd = 0
    for seed in range(10):
        made = looked_at(short_posterior(samples=SAMPLES, seed=seed))
        assert list(made.statistics) == list(STATISTICS)
        odd += sum(one.odd for one in made.statistics.values())
    assert odd < 4


@pytest.mark.parametrize(
    ("kind", "statistic"),
    [
        ("faster", "residual_fast"),
        ("slow", "residual_slow"),
        ("larger", "residual_sd_um"),
        ("shifted", "pit_mean"),
        ("wild", "pit_outside"),
    ],
)
def test_what_the_model_does_not_do_is_odd(kind: str, statistic: str) -> None:
    time = INTERVAL * np.arange(SAMPLES)
    size = TRUE_NOISE["discrepancy_sd"]
    added = {
        "faster": 2 * size * np.sin(2 * np.pi * 20 * time),
        "slow": 6 * size * np.sin(2 * np.pi * 0.25 * time),
        "larger": 4 * size * np.random.default_rng(1).normal(size=SAMPLES),
        "shifted": np.full(SAMPLES, 8 * size),
        "wild": 6 * size * np.random.default_rng(2).normal(size=SAMPLES),
    }[kind]
    made = looked_at(changed(short_posterior(samples=SAMPLES), added))
    assert made.statistics[statistic].odd


def test_readings_that_are_missing_are_missing_in_all() -> None:
    posterior = short_posterior(samples=SAMPLES)
    displacement = posterior.only.displacement.copy()
    displacement[100:180] = np.nan
    made = looked_at(posterior.altered(displacement=displacement))
    assert all(np.isfinite(one.observed) for one in made.statistics.values())
    assert not made.statistics["residual_sd_um"].odd
