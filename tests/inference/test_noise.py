"""Every noise, of the package or someone else's, is the Gaussian that it says it is.

The oracle is a dense Gaussian, with the covariance of a driven oscillator from a matrix exponential
of its equation of motion.
"""

import importlib
import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
import pytest
import scipy
from hypothesis import given, strategies as st

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference import Engine
from bwbayes.inference.likelihood import Readings
from bwbayes.inference.noise import (
    DISCREPANCY_SD,
    DISCREPANCY_TIME,
    SENSOR_SD,
    DiscrepancyNoise,
    SmoothNoise,
    noise_model,
)
from bwbayes.inference.outliers import surprise
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.state_space import LOG_TWO_PI, Noise, powers, root
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Declaration, Distribution
from bwbayes.model.inputs import rate
from bwbayes.prediction.initial_state import filter_discrepancy
from tests.inference.problems import (
    INTERVAL,
    decaying_sine,
    posterior_of,
    ring_bender,
    short_posterior,
)
from tests.inference.test_likelihood import responses

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
    # They are independent standard normals: each mean square by itself, and the first with the
    # others.
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
    """The kernel has no say in it; a rough discrepancy's size is the kernel's."""
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


# A noise that someone else writes is the Gaussian that it says it is, in both engines.
# The oracle is the dense covariance, from autocorrelations in closed form: an autoregressive
# process of second order by the Yule-Walker equations, a Matérn process of order 5/2 (three
# states), a sum of Ornstein-Uhlenbeck processes (two, three or four states).


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


HERE = "tests.inference.test_noise"
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


def dense_of_case(case: Case, theta: FloatArray, rows: IntArray) -> FloatArray:
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
    factor = np.linalg.cholesky(dense_of_case(case, theta, rows))
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
        full = dense_of_case(case, row[own:], rows) + f.T @ np.diag(sd**2) @ f
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
