"""Every noise is the Gaussian that it says it is.

The oracle is a dense Gaussian, with the covariance of a driven oscillator from a matrix exponential
of its equation of motion.
"""

import importlib
import importlib.util
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import scipy
from hypothesis import given, strategies as st

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.likelihood import Readings
from bwbayes.inference.noise import DiscrepancyNoise, SmoothNoise
from bwbayes.inference.outliers import surprise
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.state_space import Noise
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import rate
from bwbayes.prediction.initial_state import filter_discrepancy
from tests.inference.problems import (
    INTERVAL,
    decaying_sine,
    posterior_of,
    ring_bender,
    short_posterior,
)

QUALITIES = st.one_of(st.floats(0.02, 5.0), st.sampled_from([0.5, 0.5 + 1e-9, 0.5 - 1e-9]))


def covariance(theta: FloatArray, time: FloatArray) -> FloatArray:
    """Covariance (times,) of the discrepancy over times, s; of a rough one without a quality."""
    _, process, memory, *qualities = theta
    if not qualities:
        rough: FloatArray = process**2 * np.exp(-time / memory)
        return rough
    (quality,) = qualities
    frequency = 1 / (memory * quality)
    motion = np.array([[0.0, frequency], [-frequency, -frequency / quality]])
    kept = [scipy.linalg.expm(motion * one)[0, 0] for one in time.ravel()]
    values: FloatArray = process**2 * np.reshape(kept, time.shape)
    return values


def dense(theta: FloatArray, rows: IntArray, interval: float) -> FloatArray:
    lags = covariance(theta, interval * np.arange(rows[-1] - rows[0] + 1.0))
    full: FloatArray = lags[np.abs(np.subtract.outer(rows, rows))]
    full += theta[0] ** 2 * np.eye(rows.size)
    return full


def noise_of(theta: FloatArray) -> Noise:
    return DiscrepancyNoise(INTERVAL) if theta.size == 3 else SmoothNoise(INTERVAL)


def parameters(sensor: float, time: float, quality: float | None) -> FloatArray:
    return np.array([sensor, 1.3, time, *([] if quality is None else [quality])])


def whitened(
    noise: Noise, theta: FloatArray, series: FloatArray, skipped: FloatArray
) -> Iterator[tuple[FloatArray, FloatArray]]:
    yield noise.whiten(theta, series, skipped)
    if importlib.util.find_spec("numba"):
        readings = Readings(np.empty(0, dtype=np.int64), np.empty(0), 1, skipped)
        yield importlib.import_module("bwbayes.inference.compiled").whiten(
            noise, theta, series, readings.gaps
        )


@given(
    st.integers(0, 2**32 - 1),
    st.floats(1e-3, 3.0),
    st.one_of(st.none(), QUALITIES),
    st.lists(st.integers(0, 300), min_size=1, max_size=60, unique=True),
)
def test_whitening_is_that_of_a_dense_covariance(
    seed: int, time: float, quality: float | None, readings: list[int]
) -> None:
    """L⁻¹ of the Cholesky factor L, whatever readings there are, evenly spaced or not."""
    generator = np.random.default_rng(seed)
    theta = parameters(np.exp(generator.normal(-2, 1)), time, quality)
    rows = np.sort(np.array(readings))
    factor = np.linalg.cholesky(dense(theta, rows, INTERVAL))
    expected = generator.standard_normal((2, rows.size))
    skipped = np.concatenate([[0.0], np.diff(rows) - 1.0])
    given_to = theta[np.newaxis], (expected @ factor.T)[np.newaxis], skipped
    for (white,), (log_determinant,) in whitened(noise_of(theta), *given_to):
        np.testing.assert_allclose(white, expected, atol=1e-8)
        np.testing.assert_allclose(log_determinant, 2 * np.sum(np.log(np.diag(factor))), atol=1e-8)


@pytest.mark.parametrize("quality", [None, 0.05, 0.5, 2.0])
def test_a_filter_that_has_settled_goes_on_as_one_that_has_not(quality: float | None) -> None:
    """Through thousands of readings with two gaps, against the dense Gaussian."""
    theta = parameters(0.1, 0.2, quality)
    rows = np.concatenate([np.arange(700), np.arange(730, 1300), np.arange(1310, 1600)])
    factor = np.linalg.cholesky(dense(theta, rows, INTERVAL))
    expected = np.random.default_rng(1).standard_normal(rows.size)
    skipped = np.concatenate([[0.0], np.diff(rows) - 1.0])
    one = theta[np.newaxis], (factor @ expected)[np.newaxis, np.newaxis], skipped
    for white, log_determinant in whitened(noise_of(theta), *one):
        np.testing.assert_allclose(white[0, 0], expected, atol=1e-8)
        assert abs(log_determinant[0] - 2 * np.sum(np.log(np.diag(factor)))) < 1e-8 * rows.size


@pytest.mark.parametrize("quality", [None, 0.02, 0.5, 3.0])
def test_draws_have_the_covariance(quality: float | None) -> None:
    """800 draws of 40 samples: a variance is known to 5%, so 20% too much is seen (4 sds)."""
    theta = parameters(0.3, 0.1, quality)
    generator = np.random.default_rng(3)
    draws = np.array([noise_of(theta).draw(theta[np.newaxis], 40, generator) for _ in range(800)])
    assert abs(np.std(draws[:, 1]) / 0.3 - 1) < 0.02
    factor = np.linalg.cholesky(dense(theta, np.arange(40), INTERVAL))
    white = scipy.linalg.solve_triangular(factor, draws.sum(axis=1).T, lower=True)
    # Of independent standard normals: each mean square by itself, and the first with the others.
    squares = np.mean(white**2, axis=1) - 1
    assert np.abs(squares).max() * np.sqrt(800 / 2) < 4.5
    across = np.mean(white[0] * white[1:], axis=1)
    assert np.abs(across).max() * np.sqrt(800) < 4.5


def test_without_quality_it_is_an_ornstein_uhlenbeck_process() -> None:
    """The difference falls with Q², and at Q = 1/2 the covariance is that of Matérn 3/2."""
    residual = np.random.default_rng(2).standard_normal((1, 200))
    theta = np.array([[0.5, 0.8, 0.2, 1.0]])
    rough = DiscrepancyNoise(INTERVAL).log_density(theta[:, :3], residual)[0]
    gaps = []
    for quality in (1e-2, 1e-3):
        theta[0, 3] = quality
        gaps.append(abs(SmoothNoise(INTERVAL).log_density(theta, residual)[0] - rough))
    assert gaps[1] < 0.02 * gaps[0] < 0.02
    time = np.linspace(0, 2, 50)
    theta[0, 3] = 0.5
    kept = SmoothNoise(INTERVAL).transition(theta, time / INTERVAL)[0, :, 0, 0]
    np.testing.assert_allclose(kept, (1 + 10 * time) * np.exp(-10 * time), atol=1e-12)


@given(st.floats(-250, 250), st.floats(-280, np.log10(2) / -2), st.floats(-6, 6), st.floats(-3, 3))
def test_any_time_and_quality_have_a_density(
    time: float, quality: float, sd: float, sensor: float
) -> None:
    """Exponents of ten: where a search for the mode may step, however wild, is a number."""
    residual = np.random.default_rng(3).standard_normal((1, 20))
    theta = 10 ** np.array([[sensor, sd, time, quality]])
    density = SmoothNoise(INTERVAL).log_density(theta, residual)[0]
    assert np.isfinite(density)
    if quality < -9:
        rough = DiscrepancyNoise(INTERVAL).log_density(theta[:, :3], residual)[0]
        assert density == pytest.approx(rough, rel=1e-6, abs=1e-6)


def altered(quality: float | None, **changes: object) -> tuple[Posterior, FloatArray]:
    """Return a posterior and a place in it (free,) of that quality."""
    kind = "discrepancy" if quality is None else "smooth"
    posterior = short_posterior(kind, 120, **changes)  # type: ignore[arg-type]
    free = posterior.prior.draw(np.random.default_rng(7), 1)
    if quality is not None:
        free[0, posterior.names.index("discrepancy_quality")] = quality
    free[0, posterior.names.index("discrepancy_time")] = 0.2
    return posterior, posterior.prior.unconstrain(free)[0]


@pytest.mark.parametrize("quality", [None, 0.1, 0.45])
def test_what_others_predict_of_a_reading_is_that_of_a_dense_matrix(quality: float | None) -> None:
    posterior, place = altered(quality, training=(slice(5, 60), slice(80, 120)))
    theta = posterior.prior.theta(posterior.prior.constrain(place[np.newaxis])[0])
    rows = posterior.single_record.readings.rows
    full = dense(posterior.single_record.table.noise(theta)[0], rows, INTERVAL)
    residual = posterior.single_record.readings.values - posterior.simulate(theta, rows)[0]
    inverse = np.linalg.inv(full)
    expected = inverse @ residual / np.sqrt(np.diag(inverse))
    np.testing.assert_allclose(expected, surprise(posterior, place), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("quality", [None, 0.1, 0.45])
def test_what_readings_leave_is_that_of_the_dense_gaussian(quality: float | None) -> None:
    """Mean and variance of the discrepancy at any later sample, given all readings but a gap."""
    posterior, place = altered(quality, training=(slice(5, 60), slice(80, 120)))
    theta = posterior.prior.theta(posterior.prior.constrain(place[np.newaxis])[0])
    rows = posterior.single_record.readings.rows
    simulated = posterior.simulate(theta, rows)
    left = filter_discrepancy(posterior.likelihood, theta, simulated)
    noise = posterior.single_record.table.noise(theta)[0]
    later = rows[-1] + np.array([0, 3, 50])
    across = covariance(noise, INTERVAL * np.abs(np.subtract.outer(later, rows)))
    gain = np.linalg.solve(dense(noise, rows, INTERVAL), across.T).T
    expected = gain @ (posterior.single_record.readings.values - simulated[0])
    known = np.sum(gain * across, axis=1) / noise[1] ** 2
    first = int(later[0])
    means, told = (values[0][later - first] for values in left.after(first, 51))
    np.testing.assert_allclose(means, expected, atol=1e-7)
    np.testing.assert_allclose(told, known, atol=1e-7)


@pytest.mark.parametrize("stride", [1, 20])
def test_engines_agree_on_an_offset_any_stride_and_gaps(stride: int) -> None:
    pytest.importorskip("numba")
    posterior = short_posterior("smooth", 700, "lag", {})
    reading = posterior.single_record.displacement.copy()
    reading[80:160] = reading[np.random.default_rng(6).integers(700, size=30)] = np.nan
    reading[np.arange(700) % stride != 0] = np.nan
    posterior = posterior.altered(displacement=reading, from_rest=False)
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), 40))
    likelihood = replace(posterior.likelihood, offset_sd=3.0)
    slow, fast = (
        replace(likelihood, engine=engine).log_density(theta) for engine in ("numpy", "numba")
    )
    np.testing.assert_allclose(fast, slow, atol=1e-9 * 700, rtol=1e-9)


def test_the_size_on_new_readings_is_that_of_the_residuals() -> None:
    """Whatever the kernel says of it; a rough discrepancy's size is the kernel's."""
    for noise in ("smooth", "discrepancy"):
        posterior = short_posterior(noise, 400)
        theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(7), 20))
        rows, kernel = (
            posterior.single_record.readings.rows,
            posterior.single_record.table.noise(theta),
        )
        kernel[:, 0] = theta[:, posterior.table.names.index("sensor_sd")] = 1e-3
        sized = posterior.noise_of_new(theta)
        residual = posterior.single_record.readings.values - posterior.simulate(theta, rows).mean(
            axis=0
        )
        if noise == "smooth":
            kernel[:, 1] = np.sqrt(np.mean(residual**2) - 1e-6)
        np.testing.assert_allclose(sized, kernel, rtol=1e-9)


@pytest.mark.parametrize("kind", ["paced", "discrepancy + paced"])
def test_noise_that_grows_with_the_speed_is_that_of_a_dense_matrix(kind: str) -> None:
    """In both engines, with gaps; draws have its variance."""
    actuator, voltage = Actuator("none", "first", INTERVAL), decaying_sine(120)
    displacement = ring_bender(actuator, "discrepancy", voltage, 1)
    windows = slice(5, 60), slice(80, 120)
    posterior = posterior_of(voltage, displacement, actuator, kind, {}, training=windows)
    record, free = posterior.single_record, posterior.prior.draw(np.random.default_rng(7), 1)
    free[0, posterior.names.index("sensor_speed")] = 150.0
    theta = posterior.prior.theta(free)
    rows, sensor = record.readings.rows, theta[0, posterior.table.names.index("sensor_sd")]
    speed = np.abs(rate(record.voltage, INTERVAL))
    covariance = np.diag(sensor**2 * (1 + (speed[rows] / 150.0) ** 2))
    if kind != "paced":
        sd, time = (
            theta[0, posterior.table.names.index(f"discrepancy_{name}")] for name in ("sd", "time")
        )
        apart = INTERVAL * np.abs(np.subtract.outer(rows, rows))
        covariance += sd**2 * np.exp(-apart / time)
    residual = record.readings.values - posterior.simulate(theta, rows)[0]
    expected = scipy.stats.multivariate_normal.logpdf(residual, np.zeros(rows.size), covariance)
    for engine in ("numpy", "numba"):
        density = replace(posterior, engine=engine).likelihood.log_density(theta)[0]
        np.testing.assert_allclose(density, expected, rtol=1e-9)
    rng, steady = np.random.default_rng(3), np.full(20_000, 200.0)
    drawn = record.noise.draw(record.table.noise(theta), 20_000, rng, steady)[1]
    assert np.std(drawn) == pytest.approx(sensor * np.hypot(1, 200 / 150), rel=0.03)
