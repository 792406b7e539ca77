"""The stock path that benchmarks compare with computes the same posterior.

It is right but for the step within which h passes zero. Such a step is v = 2 V long here at most,
and another rate for all of it would move h by γ α v² < 0.03 um, and the log density by less than 1.
"""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.inference.posterior import Posterior
from bwbayes.model.boucwen import hysteresis
from tests.benchmarks.cases import trial
from tests.benchmarks.stock import hysteresis_loop, stock
from tests.inference.problems import decaying_sine, short_posterior

SAMPLES = 1200


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    fixed = {"initial": 0.0, "mass": 0.00134, "stiffness": 4.1e5}
    return short_posterior(samples=SAMPLES, dynamics="second-order", fixed=fixed)


def test_the_loop_follows_the_hysteresis(posterior: Posterior) -> None:
    column = dict(zip(posterior.prior.names, trial(posterior, 5).T, strict=True))
    shape = {name: column[name] for name in ("alpha", "beta", "gamma", "initial")}
    voltage = decaying_sine(SAMPLES)
    np.testing.assert_allclose(
        hysteresis_loop(voltage, **shape), hysteresis(voltage, **shape), rtol=0, atol=0.03
    )


def test_the_stock_path_has_the_same_log_density(posterior: Posterior) -> None:
    prior = posterior.prior
    free = [prior.names.index(name) for name in prior.free_names]
    coordinates = prior.unconstrain(trial(posterior, 5)[:, free])
    expected = posterior.log_density(coordinates)
    assert np.ptp(expected) > 10
    np.testing.assert_allclose(stock(posterior).log_density(coordinates), expected, rtol=0, atol=1)


def test_training_windows_count_alone(posterior: Posterior) -> None:
    part = posterior.altered(training=(slice(100, 300), slice(700, SAMPLES)))
    theta = trial(part, 3)
    np.testing.assert_allclose(
        stock(part).log_likelihood(theta), part.log_likelihood(theta), rtol=0, atol=1
    )
