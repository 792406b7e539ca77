"""Both likelihoods are those of a multivariate normal distribution, at extreme values too."""

from __future__ import annotations

from decimal import Decimal, localcontext
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from bwbayes.arrays import FloatArray
from bwbayes.inference.noise import DiscrepancyNoise, WhiteNoise, noise_model

PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")

SCALES = (1e-200, 1e-160, 1e-9, 1e-3, 1.0, 1e3)
TIMES = (1e-6, 1e-3, 0.1, 0.5, 1.0, 10.0, 1e3, 1e6, 1e9)
EXTREMES = [
    (sensor, process, time)
    for sensor, process, time in product(SCALES, SCALES, TIMES)
    # Both vanishing would leave nothing that a residual could be.
    if max(sensor, process) >= 1e-9
]


def covariance(theta: FloatArray, samples: int) -> FloatArray:
    """C[i, j] = σ² exp(−|i − j| / τ) + s² [i = j], times in samples."""
    sensor, process, time = theta
    apart = np.abs(np.subtract.outer(np.arange(samples), np.arange(samples)))
    dense: FloatArray = process**2 * np.exp(-apart / time) + sensor**2 * np.eye(samples)
    return dense


def simulated(theta: FloatArray, samples: int, generator: np.random.Generator) -> FloatArray:
    sensor, process, time = theta
    shocks = generator.standard_normal(samples)
    state, states = shocks[0], []
    for shock in shocks:
        states.append(state)
        state = np.exp(-1 / time) * state + np.sqrt(-np.expm1(-2 / time)) * shock
    residual: FloatArray = process * np.array(states) + sensor * generator.standard_normal(samples)
    return residual


def decimal_log_density(theta: tuple[float, float, float], residual: FloatArray) -> float:
    """Log density by a dense Cholesky factorization with eighty digits."""
    with localcontext() as context:
        context.prec = 80
        sensor, process, time = (Decimal(value) for value in theta)
        size = residual.size
        lags = [process**2 * (-lag / time).exp() for lag in map(Decimal, range(size))]
        lags[0] += sensor**2
        factor = [[Decimal(0)] * size for _ in range(size)]
        white: list[Decimal] = []
        total = Decimal(0)
        for i in range(size):
            row = factor[i]
            for j in range(i + 1):
                rest = lags[i - j] - sum(row[k] * factor[j][k] for k in range(j))
                row[j] = rest.sqrt() if i == j else rest / factor[j][j]
            known = sum(row[k] * white[k] for k in range(i))
            white.append((Decimal(float(residual[i])) - known) / row[i])
            total -= white[i] ** 2 / 2 + row[i].ln() + (2 * PI).ln() / 2
        return float(total)


def assert_same(expected: float, got: float, samples: int) -> None:
    assert abs(expected - got) <= 1e-10 * (samples + abs(expected))


@pytest.mark.parametrize("sensor", SCALES)
def test_white_noise_is_exact_at_extreme_values(sensor: float) -> None:
    residual = sensor * np.random.default_rng(10).standard_normal((1, 1000))
    expected = float(np.sum(norm.logpdf(residual / sensor) - np.log(sensor)))
    assert_same(expected, WhiteNoise().log_density(np.array([[sensor]]), residual)[0], 1000)


def test_exact_at_extreme_values() -> None:
    """Sds down to 1e-200 and times from 1e-6 to 1e9 samples, for residuals of the model's kind."""
    generator = np.random.default_rng(2)
    noise = DiscrepancyNoise(1.0)
    for theta in EXTREMES:
        residual = simulated(np.array(theta), 10, generator)
        got = noise.log_density(np.array([theta]), residual[np.newaxis])[0]
        assert_same(decimal_log_density(theta, residual), got, 10)


@pytest.mark.parametrize("theta", EXTREMES[:: len(EXTREMES) // 25])
def test_exact_at_extreme_values_for_a_residual_that_the_model_does_not_expect(
    theta: tuple[float, float, float],
) -> None:
    residual = np.random.default_rng(3).standard_normal(10)
    expected = decimal_log_density(theta, residual)
    got = DiscrepancyNoise(1.0).log_density(np.array([theta]), residual[np.newaxis])[0]
    assert_same(expected, got, 10)


@pytest.mark.parametrize("theta", [(1.0, 1e-9, 1e3), (1e-200, 1.0, 1e4), (0.3, 1.5, 500.0)])
def test_long_series_lose_no_precision(theta: tuple[float, float, float]) -> None:
    """By the sequential form of the density: each sample given those before it."""
    samples = 20_000
    residual = simulated(np.array(theta), samples, np.random.default_rng(4))
    sensor, process, kept = theta[0] ** 2, theta[1] ** 2, np.exp(-1 / theta[2])
    mean, variance, expected = 0.0, process, 0.0
    for reading in residual:
        total = variance + sensor
        expected -= 0.5 * ((reading - mean) ** 2 / total + np.log(2 * np.pi * total))
        mean, variance = mean + variance / total * (reading - mean), variance * sensor / total
        mean, variance = kept * mean, kept**2 * variance - np.expm1(-2 / theta[2]) * process
    got = DiscrepancyNoise(1.0).log_density(np.array([theta]), residual[np.newaxis])[0]
    assert_same(expected, got, samples)


@pytest.mark.parametrize("kind", ["white", "discrepancy", "smooth"])
def test_rows_are_independent(kind: str) -> None:
    """A model's density does not depend on its neighbors in the batch, but for rounding."""
    generator = np.random.default_rng(7)
    noise = noise_model(kind, 0.01)
    theta = np.exp(generator.normal(size=(8, len(noise.declarations))))
    residual = generator.standard_normal((8, 40))
    together = noise.log_density(theta, residual)
    alone = [noise.log_density(theta[[i]], residual[[i]])[0] for i in range(8)]
    np.testing.assert_allclose(alone, together, rtol=1e-13)


@given(st.integers(0, 2**32 - 1), st.integers(1, 200), st.sampled_from([0.0, 0.1, 0.5]))
@settings(deadline=None, max_examples=60)
def test_whitening_is_that_of_a_dense_covariance(seed: int, readings: int, missing: float) -> None:
    """L⁻¹ of the Cholesky factor L, whatever readings are missing, for stretches of any length."""
    generator = np.random.default_rng(seed)
    theta = np.exp(generator.normal(0, 1, 3))
    skipped = np.where(generator.uniform(size=readings) < missing, 1.5, 0.0)
    skipped[0] = 0.0
    series = generator.standard_normal((2, readings))
    time = np.cumsum(1 + skipped)
    apart = np.abs(np.subtract.outer(time, time))
    dense = theta[1] ** 2 * np.exp(-apart / theta[2]) + theta[0] ** 2 * np.eye(readings)
    factor = np.linalg.cholesky(dense)
    (white,), (log_determinant,) = DiscrepancyNoise(1.0).whiten(
        theta[np.newaxis], series[np.newaxis], skipped
    )
    np.testing.assert_allclose(white, np.linalg.solve(factor, series.T).T, rtol=0, atol=1e-8)
    np.testing.assert_allclose(log_determinant, 2 * np.sum(np.log(np.diag(factor))), atol=1e-8)


def test_twin_a_gap_that_is_taken_for_one_step_is_found() -> None:
    theta, series = np.array([[0.3, 1.0, 5.0]]), np.ones((1, 1, 80))
    skipped = np.where(np.arange(80) == 40, 3.0, 0.0)
    right = DiscrepancyNoise(1.0).whiten(theta, series, skipped)[0]
    wrong = DiscrepancyNoise(1.0).whiten(theta, series, skipped / 3)[0]
    assert np.max(np.abs(right - wrong)) > 1e-2


def test_draws_are_of_the_noise_that_the_likelihood_has() -> None:
    """Its covariance is σ² exp(−|t − t'|/τ); 4,000 draws know it to some 3 %."""
    noise, theta = DiscrepancyNoise(0.01), np.array([[0.3, 1.5, 0.05]])
    generator = np.random.default_rng(1)
    drawn = np.array([noise.draw(theta, 12, generator) for _ in range(4_000)])
    slow, sensor = drawn[:, 0], drawn[:, 1]
    lag = np.abs(np.subtract.outer(np.arange(12), np.arange(12))) * 0.01
    for part, expected in ((slow, 1.5**2 * np.exp(-lag / 0.05)), (sensor, 0.3**2 * np.eye(12))):
        # sd of a covariance of n draws: sqrt((c_ii c_jj + c_ij²) / n)
        error = np.sqrt((expected[0, 0] ** 2 + expected**2) / 4_000)
        assert np.max(np.abs(part.T @ part / 4_000 - expected) / error) < 5


def test_white_noise_has_no_discrepancy() -> None:
    slow, sensor = WhiteNoise().draw(np.array([[0.3]]), 500, np.random.default_rng(1))
    np.testing.assert_array_equal(np.zeros(500), slow)
    assert 0.25 < np.std(sensor) < 0.35
