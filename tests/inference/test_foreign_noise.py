"""A noise that someone else writes is the Gaussian that it says it is, in both engines.

The oracle is the dense covariance, from autocorrelations in closed form: an autoregressive process
of second order by the Yule-Walker equations, a Matérn process of order 5/2 (three states), a sum of
Ornstein-Uhlenbeck processes (two, three or four states).
"""

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
import pytest
import scipy
from hypothesis import given, strategies as st

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference.engine import Engine
from bwbayes.inference.likelihood import Readings
from bwbayes.inference.noise import (
    DISCREPANCY_SD,
    DISCREPANCY_TIME,
    SENSOR_SD,
    DiscrepancyNoise,
    noise_model,
)
from bwbayes.inference.state_space import LOG_TWO_PI, Noise, powers, root
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Declaration, Distribution
from tests.inference.problems import INTERVAL, decaying_sine, posterior_of, ring_bender
from tests.inference.test_likelihood import responses

UNIT = Distribution("uniform", {"lower": 0.0, "upper": 1.0})


@dataclass(frozen=True)
class Autoregressive(Noise):
    """x_k = φ₁ x_(k−1) + φ₂ x_(k−2) + w_k, as textbooks write its states (x_k, x_(k−1))."""

    @property
    def declarations(self) -> tuple[Declaration, ...]:
        """Sds of sensor and process, and two coefficients."""
        one, two = (
            Declaration(name, "", name, "a coefficient", lambda _: UNIT)
            for name in ("phi1", "phi2")
        )
        return (SENSOR_SD, DISCREPANCY_SD, one, two)

    @property
    def observe(self) -> FloatArray:
        """The first state."""
        return np.array([1.0, 0.0])

    def stationary(self, theta: FloatArray) -> FloatArray:
        """Return the autocovariances at lags zero and one."""
        _, sd, one, two = theta.T
        across = one / (1 - two)
        rows = np.stack([np.ones_like(across), across, across, np.ones_like(across)], axis=-1)
        covariance: FloatArray = sd[:, np.newaxis, np.newaxis] ** 2 * rows.reshape(-1, 2, 2)
        return covariance

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return a power of the companion matrix."""
        matrices = np.zeros((len(theta), 2, 2))
        matrices[:, 0], matrices[:, 1, 0] = theta[:, 2:4], 1.0
        return powers(matrices, readings)


@dataclass(frozen=True)
class Matern(Noise):
    """A Matérn process of order 5/2: (d/dt + λ)³ x = white noise, with three states x, ẋ, ẍ."""

    @property
    def declarations(self) -> tuple[Declaration, ...]:
        """Sds of sensor and process, and 1/λ."""
        return (SENSOR_SD, DISCREPANCY_SD, DISCREPANCY_TIME)

    @property
    def observe(self) -> FloatArray:
        """The first state."""
        return np.array([1.0, 0.0, 0.0])

    def stationary(self, theta: FloatArray) -> FloatArray:
        """Return the covariance of x and its derivatives."""
        rate = 1 / theta[:, 2]
        matrices = np.zeros((len(theta), 3, 3))
        matrices[:, 0, 0], matrices[:, 2, 2] = 1.0, rate**4
        matrices[:, 1, 1] = rate**2 / 3
        matrices[:, 0, 2] = matrices[:, 2, 0] = -(rate**2) / 3
        return theta[:, 1, np.newaxis, np.newaxis] ** 2 * matrices

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return the matrix exponential of the motion."""
        matrices = np.zeros((len(theta), 3, 3))
        rate = 1 / theta[:, 2]
        matrices[:, 0, 1] = matrices[:, 1, 2] = 1.0
        matrices[:, 2] = -np.stack([rate**3, 3 * rate**2, 3 * rate], axis=1)
        if np.ndim(readings) == 0:
            return np.asarray(scipy.linalg.expm(float(readings) * self.interval * matrices))
        times = self.interval * np.asarray(readings)[:, np.newaxis, np.newaxis]
        return np.asarray(scipy.linalg.expm(times * matrices[:, np.newaxis]))


class Case(NamedTuple):
    """A noise, its θ from three numbers in (0, 1), and its autocovariance at lags in readings."""

    noise: str
    theta: Callable[[FloatArray], FloatArray]
    autocovariance: Callable[[FloatArray, IntArray], FloatArray]


def yule_walker(theta: FloatArray, lags: IntArray) -> FloatArray:
    _, sd, one, two = theta
    values = [1.0, one / (1 - two)]
    while len(values) <= lags.max():
        values.append(one * values[-1] + two * values[-2])
    covariances: FloatArray = sd**2 * np.array(values)[lags]
    return covariances


def matern(theta: FloatArray, lags: IntArray) -> FloatArray:
    r = INTERVAL * lags / theta[2]
    covariances: FloatArray = theta[1] ** 2 * (1 + r + r**2 / 3) * np.exp(-r)
    return covariances


def sum_of_decays(theta: FloatArray, lags: IntArray) -> FloatArray:
    terms = [
        sd**2 * np.exp(-INTERVAL * lags / time) for sd, time in theta[1:].reshape(-1, 2).tolist()
    ]
    total: FloatArray = np.sum(terms, axis=0)
    return total


HERE = "tests.inference.test_foreign_noise"
CASES = {
    "AR(2)": Case(
        f"{HERE}:Autoregressive",
        lambda u: np.array([0.1 + u[0], 1.0, (1.9 * u[1] - 0.95) * 1.9, 0.9 * u[2] - 0.95]),
        yule_walker,
    ),
    "three states": Case(
        f"{HERE}:Matern", lambda u: np.array([0.1 + u[0], 1.3, 0.01 + 0.3 * u[1]]), matern
    ),
    "two decays": Case(
        "discrepancy + discrepancy",
        lambda u: np.array([0.1 + u[0], 1.0, 0.01 + u[1], 0.4, 0.001 + 0.1 * u[2]]),
        sum_of_decays,
    ),
    "three decays": Case(
        "discrepancy + discrepancy + discrepancy",
        lambda u: np.array([0.1 + u[0], 1.0, 0.01 + u[1], 0.4, 0.01 + u[2], 2.0, 10.0]),
        sum_of_decays,
    ),
}
EACH = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
NUMBERS = st.lists(st.floats(0.01, 0.99), min_size=3, max_size=3).map(np.array)


def stationary_theta(case: Case, numbers: FloatArray) -> FloatArray:
    theta = case.theta(numbers)
    if case.autocovariance is yule_walker:
        # Inside the triangle in which the process is stationary.
        theta[2] *= (1 - theta[3]) / 1.9 / 0.95 * 0.97
    return theta


def dense(case: Case, theta: FloatArray, rows: IntArray) -> FloatArray:
    lags = np.abs(np.subtract.outer(rows, rows))
    covariance: FloatArray = case.autocovariance(theta, lags) + theta[0] ** 2 * np.eye(rows.size)
    return covariance


@EACH
@given(
    st.integers(0, 2**32 - 1),
    NUMBERS,
    st.lists(st.integers(0, 300), min_size=1, max_size=80, unique=True),
)
def test_a_density_is_that_of_the_dense_covariance(
    case: Case, seed: int, numbers: FloatArray, readings: list[int]
) -> None:
    """To 1e-10, whatever readings are missing."""
    theta, rows = stationary_theta(case, numbers), np.sort(np.array(readings))
    noise = noise_model(case.noise, INTERVAL)
    factor = np.linalg.cholesky(dense(case, theta, rows))
    scores = np.random.default_rng(seed).standard_normal(rows.size)
    log_determinant = 2 * np.sum(np.log(np.diag(factor)))
    expected = -0.5 * (scores @ scores + log_determinant + rows.size * LOG_TWO_PI)
    skipped = np.concatenate([[0.0], np.diff(rows) - 1.0])
    series = (factor @ scores)[np.newaxis, np.newaxis]
    whitened = [noise.whiten(theta[np.newaxis], series, skipped)]
    if importlib.util.find_spec("numba"):
        compiled = importlib.import_module("bwbayes.inference.compiled")
        gaps = Readings(np.empty(0, dtype=np.int64), np.empty(0), 1, skipped).gaps
        whitened.append(compiled.whiten(noise, theta[np.newaxis], series, gaps))
    for white, (log_volume,) in whitened:
        np.testing.assert_allclose(white[0, 0], scores, atol=1e-9)
        density = -0.5 * (np.sum(white**2) + log_volume + rows.size * LOG_TWO_PI)
        assert density == pytest.approx(expected, rel=1e-10, abs=1e-10)


@EACH
@pytest.mark.parametrize("engine", ["numpy", "numba"])
def test_a_likelihood_is_dense_with_gaps_and_an_unknown_start(case: Case, engine: str) -> None:
    """A long record, so that the filter settles, with an offset and a lag in motion."""
    if engine == "numba":
        pytest.importorskip("numba")
    actuator = Actuator("lag", "first", INTERVAL)
    voltage = decaying_sine(500)[100:]
    displacement = ring_bender(actuator, "discrepancy", voltage, 3)
    posterior = posterior_of(voltage, displacement, actuator, case.noise, {})
    displacement[np.random.default_rng(4).integers(300, size=25)] = displacement[150:200] = np.nan
    posterior = posterior.altered(displacement=displacement, from_rest=False)
    likelihood = replace(posterior.likelihood, engine=cast(Engine, engine), offset_sd=3.0)
    free = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), 5))
    own = len(likelihood.actuator.parameters)
    numbers = np.random.default_rng(6).uniform(size=(5, 3))
    noise = np.stack([stationary_theta(case, row) for row in numbers])
    theta = np.concatenate([free[:, :own], noise], axis=1)
    rows = likelihood.readings.rows
    for row, density in zip(theta, likelihood.log_density(theta).tolist(), strict=True):
        clean = likelihood.actuator.displacement(row[np.newaxis, :own], voltage)[0]
        residual = likelihood.readings.values - clean[rows]
        f, sd = responses(likelihood, row), likelihood.start_sd(row[np.newaxis])[0]
        full = dense(case, row[own:], rows) + f.T @ np.diag(sd**2) @ f
        factor = np.linalg.cholesky(full)
        scores = scipy.linalg.solve_triangular(factor, residual, lower=True)
        logs = 2 * np.sum(np.log(np.diag(factor))) + rows.size * LOG_TWO_PI
        assert density == pytest.approx(-0.5 * (scores @ scores + logs), rel=1e-9, abs=1e-8)


@EACH
def test_draws_go_on_sample_by_sample(case: Case) -> None:
    """A long draw is x ← F x + shock, one sample after the other, to 1e-12 of its largest value.

    So draws have the covariance that the density takes; the sensor's noise is white beside it.
    """
    theta = stationary_theta(case, np.array([0.3, 0.6, 0.4]))[np.newaxis]
    noise, samples = noise_model(case.noise, INTERVAL), 3_000
    drawn, sensor = noise.draw(theta, samples, np.random.default_rng(3))
    *of_states, white = np.random.default_rng(3).standard_normal((noise.states + 1, samples))
    scores = np.transpose(of_states)
    np.testing.assert_array_equal(sensor, theta[0, 0] * white)
    (kept,) = noise.transition(theta)
    shocks = scores @ root(noise.process_covariance(theta))[0]
    states = [scores[0] @ root(noise.stationary(theta))[0]]
    for shock in shocks[1:]:
        states.append(kept @ states[-1] + shock)
    slow = np.stack(states) @ noise.observe
    assert drawn == pytest.approx(slow, rel=0, abs=1e-12 * np.abs(slow).max())


@EACH
def test_the_correlation_time_is_the_integral(case: Case) -> None:
    """To 2% of an interval or of itself, where a discrepancy lasts over some readings."""
    theta = stationary_theta(case, np.array([0.3, 0.6, 0.4]))
    noise = noise_model(case.noise, INTERVAL)
    values = case.autocovariance(theta, np.arange(20_000))
    total = INTERVAL * (np.sum(values) / values[0] - 0.5)
    (time,) = noise.correlation_time(theta[np.newaxis])
    assert time == pytest.approx(max(total, 0.0), rel=0.02, abs=0.02 * INTERVAL)


def test_a_sum_names_each_parameter_once() -> None:
    names = [declared.name for declared in noise_model("discrepancy + smooth", 1.0).declarations]
    assert names == [
        "sensor_sd", "discrepancy_sd", "discrepancy_time",
        "discrepancy_sd_2", "discrepancy_time_2", "discrepancy_quality",
    ]  # fmt: skip
    both = DiscrepancyNoise(0.5) + noise_model("white", 0.5)
    assert [declared.name for declared in both.declarations] == names[:3]


@dataclass(frozen=True)
class Unstationary(Autoregressive):
    """The same with the covariance of white noise, which the process does not keep."""

    def stationary(self, theta: FloatArray) -> FloatArray:
        """Return the unit matrix."""
        return np.tile(np.eye(2), (len(theta), 1, 1))


def test_a_covariance_that_the_process_does_not_keep_is_refused() -> None:
    theta = np.array([[0.5, 1.0, 1.6, -0.7]])
    with pytest.raises(InputError, match=r"stationary\(theta\) is not stationary under"):
        Unstationary(INTERVAL).log_density(theta, np.zeros((1, 10)))
