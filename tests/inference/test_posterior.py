"""The posterior against a slow one: a scalar model, sample by sample, and dense matrices."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from math import exp

import numpy as np
import pytest
from scipy import stats

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.noise import DiscrepancyNoise, WhiteNoise
from bwbayes.inference.posterior import Posterior
from tests.inference.problems import INTERVAL, short_posterior, single


def scalar_displacement(theta: dict[str, float], voltage: FloatArray) -> FloatArray:
    """Equation (6) sample by sample, n = 1, and the lag by an integral over each interval."""
    h = theta["initial"]
    rest = theta["d"] * voltage[0] - h
    x, drive = 0.0, 0.0
    displacement = [rest + theta["offset"]]
    for before, after in itertools.pairwise(voltage.tolist()):
        sign, left = float(np.sign(after - before)), abs(after - before)
        g = sign * h
        if g < 0:
            # Relax with beta - gamma until h crosses zero, or the interval ends.
            rate = theta["beta"] - theta["gamma"]
            travel = min(left, float(np.log(1 - g * rate / theta["alpha"]) / rate))
            limit = theta["alpha"] / rate
            g, left = limit + (g - limit) * exp(-rate * travel), left - travel
        limit = theta["alpha"] / (theta["beta"] + theta["gamma"])
        g = limit + (g - limit) * exp(-(theta["beta"] + theta["gamma"]) * left)
        h = sign * g
        slope = (theta["d"] * after - h - rest - drive) / INTERVAL
        lag = theta["lag"]
        # tau x' + x = drive + slope t has the particular solution drive + slope (t - tau).
        kept = exp(-INTERVAL / lag)
        x = drive + slope * (INTERVAL - lag) + (x - drive + slope * lag) * kept
        drive += slope * INTERVAL
        displacement.append(x + rest + theta["offset"])
    return np.array(displacement)


def dense_log_likelihood(posterior: Posterior, theta: FloatArray) -> float:
    named = dict(zip(posterior.prior.names, theta.tolist(), strict=True))
    residual = posterior.only.displacement - scalar_displacement(named, posterior.only.voltage)
    rows = posterior.only.readings.rows
    apart = np.abs(np.subtract.outer(rows, rows))
    covariance = named["sensor_sd"] ** 2 * np.eye(rows.size)
    if "discrepancy_sd" in named:
        kept = np.exp(-INTERVAL * apart / named["discrepancy_time"])
        covariance += named["discrepancy_sd"] ** 2 * kept
    dense = stats.multivariate_normal(np.zeros(rows.size), covariance)
    return float(dense.logpdf(residual[rows]))


WINDOWS = (slice(5, 40), slice(70, 120))


@pytest.mark.parametrize("noise", ["white", "discrepancy"])
@pytest.mark.parametrize("training", [None, WINDOWS])
def test_log_density_is_that_of_a_slow_computation(
    noise: str, training: tuple[slice, ...] | None
) -> None:
    posterior = short_posterior(
        "white" if noise == "white" else "discrepancy", 150, "lag", {}, training=training
    )
    draws = posterior.prior.draw(np.random.default_rng(1), 12)
    z = posterior.prior.unconstrain(draws)
    theta = posterior.prior.theta(draws)
    expected = posterior.prior.constrain(z)[1] + [
        dense_log_likelihood(posterior, row) for row in theta
    ]
    got = posterior.log_density(z)
    assert np.max(np.abs(expected - got) / (150 + np.abs(expected))) < 1e-9


@pytest.mark.parametrize("size", [1, 63, 64, 65, 130])
def test_a_batch_is_its_rows(size: int) -> None:
    posterior = short_posterior(samples=100, dynamics="lag", fixed={})
    z = posterior.prior.unconstrain(posterior.prior.draw(np.random.default_rng(2), size))
    z[0, 0] = 40.0  # one row is outside
    together = posterior.log_density(z)
    alone = np.concatenate([posterior.log_density(row[np.newaxis]) for row in z])
    assert -np.inf == together[0] == alone[0]
    np.testing.assert_allclose(alone[1:], together[1:], rtol=1e-12)


@dataclass(frozen=True)
class BrokenNoise(WhiteNoise):
    """A likelihood that fails for every other model."""

    value: float = np.nan

    def whiten(
        self, theta: FloatArray, series: FloatArray, skipped: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the white noise's innovations, with a hole in every other determinant."""
        white, log_determinant = super().whiten(theta, series, skipped)
        log_determinant[::2] = self.value
        return white, log_determinant


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_likelihood_that_is_not_finite_is_no_evidence(value: float) -> None:
    sound = short_posterior("white", 100)
    broken = sound.altered(noise=BrokenNoise(value=value))
    z = sound.prior.unconstrain(sound.prior.draw(np.random.default_rng(3), 6))
    expected = sound.log_density(z)
    expected[::2] = -np.inf
    np.testing.assert_array_equal(expected, broken.log_density(z))


@pytest.mark.parametrize(
    "windows",
    [(slice(20, 50), slice(0, 20)), (slice(0, 30), slice(20, 50))],
    ids=["order", "apart"],
)
def test_windows_must_be_in_order_and_apart(windows: tuple[slice, ...]) -> None:
    with pytest.raises(InputError, match="in order of time and must not overlap"):
        short_posterior("white", 50, training=windows)


def test_parameters_must_be_those_of_the_model() -> None:
    sound = short_posterior("white", 50)
    with pytest.raises(InputError, match=r"^prior: its parameters must be d, .*, in this order"):
        sound.altered(noise=DiscrepancyNoise(INTERVAL))
    offset = single("offset", sound.prior.free[-2].prior or pytest.fail("has a prior"))
    with pytest.raises(InputError, match="in this order"):
        replace(sound, prior=offset)
