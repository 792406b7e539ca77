"""A fit that has swallowed a drift of its readings is told."""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.inference import pointfit
from bwbayes.inference.posterior import Posterior
from bwbayes.results.drift import Drift, drifted
from bwbayes.results.moved import Moved
from bwbayes.results.verdict import Background, assess
from tests.inference import problems
from tests.results.records import bands_of, made
from tests.results.test_transient import drawn, fitted

SLOW = Moved("beta", "1/V", (0.0002, 0.0001), (0.0275, 0.0007), 38.0)


def drifting(seed: int, size: float) -> Posterior:
    """Return the posterior of a record whose readings drift by ``size`` um in all."""
    posterior = fitted(seed)
    one = posterior.only
    drift = size * np.linspace(0, 1, one.displacement.size)
    return posterior.with_readings({one.name: one.displacement + drift})


def followed(posterior: Posterior) -> FloatArray:
    """Draw where the memory of the hysteresis hardly fades, as a fit that follows a drift does."""
    free = drawn(posterior)
    free[:, posterior.names.index("beta")] *= 0.01
    return free


def test_good_fits_follow_no_drift() -> None:
    for seed in range(3):
        posterior = fitted(seed)
        assert drifted(posterior, drawn(posterior), np.random.default_rng(2)) is None


@pytest.mark.parametrize("size", [30.0, -30.0])
def test_a_drift_is_told_with_its_size(size: float) -> None:
    """And what is left without it is as probable as the record was before."""
    posterior, clean = drifting(1, size), fitted(1)
    draws = followed(posterior)
    told = drifted(posterior, draws, np.random.default_rng(2))
    assert told is not None
    assert told.size == pytest.approx(size, abs=2.0)
    best = pointfit.fit(clean, np.random.default_rng(1)).log_density
    plain = np.max(posterior.log_density(posterior.prior.unconstrain(draws)))
    assert told.nats == pytest.approx(best - plain, abs=3.0)
    assert "beta" == told.parameter.name
    assert told.parameter.rest[0] == pytest.approx(0.0272, rel=0.1)


def test_a_drift_that_the_parameters_do_not_follow_is_left_to_the_residuals() -> None:
    """Draws where the rest of the record is: no parameter moves."""
    posterior = drifting(1, 30.0)
    assert drifted(posterior, drawn(fitted(1)), np.random.default_rng(2)) is None


def test_a_small_drift_is_left_to_the_discrepancy() -> None:
    posterior = drifting(1, 3.0)
    assert drifted(posterior, followed(posterior), np.random.default_rng(2)) is None


def test_a_record_of_a_single_reading_tells_nothing() -> None:
    posterior = problems.short_posterior(samples=5)
    point = pointfit.fit(posterior, np.random.default_rng(1))
    free, _ = posterior.prior.constrain(point.mode[np.newaxis])
    assert drifted(posterior, free, np.random.default_rng(2)) is None


def test_a_fit_that_follows_a_drift_does_not_hold() -> None:
    bands = bands_of(made(np.random.default_rng(1), length=30), training=True)
    verdict = assess(bands, Background(0.3, 0.0, (-100.0, 100.0)), drift=Drift(30.1, 367.0, SLOW))
    assert verdict is not None
    assert verdict.holds is False
    assert verdict.reasons == (
        "a drift of 30.1 um explains its readings better, by 367 nats; without it beta is "
        "0.0275 +- 0.0007 1/V, with it 0.0002 +- 0.0001",
    )
    assert verdict.cause is not None
    assert "drift" == verdict.cause.kind
