"""The likelihood of a record whose start is unknown, or whose readings are not all there.

Everything is compared with a dense Gaussian: the covariance of the discrepancy and the sensor at
the readings' times, with that of the unknown start added, all inverted at once.
"""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import example, given, strategies as st
from scipy import linalg

from bwbayes.arrays import FloatArray
from bwbayes.inference.engine import Engine
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Hold
from tests.inference.problems import (
    INTERVAL,
    decaying_sine,
    posterior_of,
    ring_bender,
    short_posterior,
)

SLOW = {"mass": 0.00134, "stiffness": 4.1e5}
COMPLEX = {"mass": 300.0, "damping": 3000.0, "stiffness": 4.1e5}
MODELS: list[tuple[str, dict[str, float]]] = [
    ("none", {}),
    ("lag", {}),
    ("second-order", SLOW),
    ("second-order", COMPLEX),
]


def columns(likelihood: Likelihood, theta: FloatArray) -> dict[str, FloatArray]:
    names = likelihood.table.names
    return dict(zip(names, theta[np.newaxis].T, strict=True))


def responses(likelihood: Likelihood, theta: FloatArray) -> FloatArray:
    """Responses (unknowns, readings) of the start, by a slow filter."""
    sections = likelihood.actuator.sections(columns(likelihood, theta))
    free = sections.free_responses(likelihood.voltage.size)[0][:, likelihood.readings.rows]
    parts = [] if likelihood.from_rest else list(free)
    if likelihood.offset_sd:
        parts.insert(0, np.ones(likelihood.readings.rows.size))
    return np.array(parts).reshape(len(parts), likelihood.readings.rows.size)


def dense(likelihood: Likelihood, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Log density of the readings, and mean and covariance of the start, at one θ."""
    value = {name: float(v[0]) for name, v in columns(likelihood, theta).items()}
    size = len(likelihood.actuator.parameters)
    clean = likelihood.actuator.displacement(theta[:size], likelihood.voltage)[0]
    rows = likelihood.readings.rows
    time = rows * likelihood.actuator.interval
    apart = np.abs(np.subtract.outer(time, time)) / value.get("discrepancy_time", 1.0)
    noise = value.get("discrepancy_sd", 0.0) ** 2 * np.exp(-apart)
    noise += value["sensor_sd"] ** 2 * np.eye(rows.size)
    f = responses(likelihood, theta)
    prior = np.diag(likelihood.start_sd(theta[np.newaxis])[0] ** 2)
    residual = likelihood.readings.values - clean[rows]
    factor = linalg.cho_factor(noise + f.T @ prior @ f)
    logs = 2 * np.sum(np.log(np.diag(factor[0]))) + rows.size * np.log(2 * np.pi)
    density = -0.5 * (residual @ linalg.cho_solve(factor, residual) + logs)
    gain = linalg.cho_solve(factor, f.T @ prior).T
    return float(density), gain @ residual, prior - gain @ f.T @ prior


def moving(
    noise: str = "discrepancy",
    dynamics: str = "lag",
    fixed: dict[str, float] | None = None,
    *,
    hold: Hold = "first",
    missing: float = 0.0,
    stride: int = 1,
    training: tuple[slice, ...] | None = None,
    parts: dict[str, Any] | None = None,
) -> Posterior:
    """Cut a record out of a running drive, with readings missing at random."""
    actuator = Actuator(dynamics, hold, INTERVAL, **(parts or {}))
    voltage = decaying_sine(300)[100:]
    plain = replace(actuator, nonlinearity=None, creep=None)
    displacement = ring_bender(plain, noise, voltage, 3) + 5 * np.exp(-np.arange(200) / 3)
    lost = np.random.default_rng(4).uniform(size=200) < missing
    displacement[lost | (np.arange(200) % stride != 0)] = np.nan
    posterior = posterior_of(
        voltage, np.nan_to_num(displacement), actuator, noise, fixed or {}, training=training
    )
    return posterior.altered(displacement=displacement, from_rest=False)


@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("noise", ["white", "discrepancy"])
@pytest.mark.parametrize(("dynamics", "fixed"), MODELS, ids=["none", "lag", "slow", "complex"])
@pytest.mark.parametrize("hold", ["first", "zero"])
def test_the_unknown_start_is_integrated_out(
    engine: str, noise: str, dynamics: str, fixed: dict[str, float], hold: Hold
) -> None:
    posterior = moving(noise, dynamics, fixed, hold=hold)
    likelihood = replace(posterior.likelihood, engine=cast(Engine, engine), offset_sd=3.0)
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), 6))
    assert_dense(likelihood, theta)


def assert_dense(likelihood: Likelihood, theta: FloatArray) -> None:
    start = likelihood.start(theta)
    for row, one in enumerate(theta):
        density, mean, covariance = dense(likelihood, one)
        assert abs(density - start.log_density[row]) < 1e-7 * (200 + abs(density))
        sd = likelihood.start_sd(one[np.newaxis])[0]
        if not sd.size:
            continue
        np.testing.assert_allclose(start.mean[row], mean, rtol=1e-5, atol=1e-6 * sd.max())
        np.testing.assert_allclose(start.covariance[row], covariance, atol=1e-6 * sd.max() ** 2)


@pytest.mark.parametrize(("dynamics", "fixed"), MODELS, ids=["none", "lag", "slow", "complex"])
def test_a_shape_takes_what_an_unknown_of_that_shape_would(
    dynamics: str, fixed: dict[str, float]
) -> None:
    """A constant is an offset of which nothing is known."""
    posterior = moving("discrepancy", dynamics, fixed, missing=0.1)
    without = posterior.likelihood
    free = replace(without, offset_sd=1e6)
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), 6))
    expected = without.start(theta).squares - free.start(theta).squares
    constant = np.ones((1, without.readings.rows.size))
    np.testing.assert_allclose(
        expected, without.score(theta, constant).together, rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("missing", [0.1, 0.7])
@pytest.mark.parametrize("stride", [1, 8])
@pytest.mark.parametrize("training", [None, (slice(3, 4), slice(20, 90), slice(90, 180))])
def test_missing_readings_are_left_out_and_nothing_else(
    engine: str, missing: float, stride: int, training: tuple[slice, ...] | None
) -> None:
    """The simulation runs through, and one discrepancy goes through all gaps and windows."""
    posterior = moving(missing=missing, stride=stride, training=training)
    likelihood = replace(posterior.likelihood, engine=cast(Engine, engine))
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(6), 5))
    got = likelihood.log_density(theta)
    for row, one in enumerate(theta):
        density, _, _ = dense(likelihood, one)
        assert abs(density - got[row]) < 1e-7 * (200 + abs(density))


def test_from_rest_means_a_path_from_zero_volts() -> None:
    """A record from rest at 50 V is one from zero volts whose first samples were not read."""
    usual = short_posterior(samples=200, dynamics="lag", fixed={})
    approach = np.concatenate([np.zeros(1), np.full(400, 50.0)])
    voltage = 50 + usual.single_record.voltage / 4
    whole = np.concatenate([approach, voltage])
    reading = ring_bender(usual.single_record.actuator, "discrepancy", whole, 9)
    theta = usual.prior.theta(usual.prior.draw(np.random.default_rng(10), 5))
    theta[:, usual.prior.names.index("initial")] = 0.0
    settled = usual.altered(
        voltage=whole, displacement=reading, training=(slice(approach.size, whole.size),)
    )
    at_rest = usual.altered(voltage=voltage, displacement=reading[approach.size :])
    np.testing.assert_allclose(
        at_rest.log_likelihood(theta), settled.log_likelihood(theta), rtol=1e-9
    )
    wrong = at_rest.altered(voltage=voltage - 50).log_likelihood(theta)
    assert np.min(np.abs(wrong - at_rest.log_likelihood(theta))) > 1


@example(exponents=(2.0, 6.0, -4.0, -3.0))
@given(
    exponents=st.tuples(st.floats(0, 15), st.floats(0, 18), st.floats(-15, -3), st.floats(-26, -3))
)
def test_no_absurd_place_is_more_probable_than_a_possible_one(
    exponents: tuple[float, float, float, float],
) -> None:
    """Gains of 1e15 um/V, lags of 1e18 s, next to no noise: there rounding is all that is left."""
    posterior = moving("discrepancy", "lag", {}, missing=0.1)
    likelihood = replace(posterior.likelihood, offset_sd=100.0)
    usual = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), 50))
    size, lag, sensor, discrepancy = 10.0 ** np.array(exponents)
    absurd = {"d": size, "alpha": size / 2, "lag": lag}
    absurd |= {"sensor_sd": sensor, "discrepancy_sd": discrepancy}
    theta = usual[:1]
    for name, value in absurd.items():
        theta = likelihood.table.replaced(theta, name, np.array([value]))
    assert likelihood.log_density(theta)[0] < np.max(likelihood.log_density(usual))
