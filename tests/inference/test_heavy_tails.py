"""Sensor noise of a Student t distribution is one, and outliers hardly move what is fitted.

The oracle of its filter is numerical integration over the discrepancy at every reading, and over an
unknown start, with scipy's t density. The filter is approximate (a normal distribution takes the
place of the states' own after each reading), so what is promised is the posterior: where
integration puts it, and calibrated.
"""

import importlib
import importlib.util
from dataclasses import replace

import numpy as np
import pytest
import scipy
from hypothesis import given, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference import Engine, heavy_tails, map_estimate
from bwbayes.inference.noise import noise_model
from bwbayes.inference.outliers import outliers
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.state_space import Noise
from bwbayes.model.actuator import Actuator
from tests.inference.problems import (
    INTERVAL,
    decaying_sine,
    posterior_of,
    ring_bender,
    study_of,
    truth,
)

ENGINES: list[Engine] = ["numpy", "numba"] if importlib.util.find_spec("numba") else ["numpy"]
RUNS = [heavy_tails.run]
if "numba" in ENGINES:
    RUNS.append(importlib.import_module("bwbayes.inference.compiled.whitening").run)


def t_scale(inverse_df: float) -> float:
    """Scale of the t distribution of which ±1 hold as much as one sd of a normal one does."""
    return float(1 / scipy.stats.t.ppf(scipy.stats.norm.cdf(1.0), 1 / inverse_df))


@given(st.floats(1e-3, 1.0), st.floats(-3.0, 3.0), st.floats(0.0, 50.0))
def test_a_reading_has_the_density_of_a_t_distribution(
    inverse_df: float, log_sd: float, away: float
) -> None:
    """To a thousandth at up to 10 sds and, where ν < 5, at up to 50."""
    sd = np.exp(log_sd)
    error = sd * (away if inverse_df > 0.2 else away / 5)
    (density,) = noise_model("student", 1.0).log_density(
        np.array([[sd, inverse_df]]), np.array([[error]])
    )
    scale = sd * t_scale(inverse_df)
    expected = scipy.stats.t.logpdf(error, 1 / inverse_df, scale=scale)
    assert density == pytest.approx(expected, abs=1e-3)


def moving(noise: str, engine: Engine, seed: int = 3) -> Posterior:
    """Return a posterior with gaps, an unknown start and outliers, at any noise and engine."""
    actuator = Actuator("lag", "first", INTERVAL)
    voltage = decaying_sine(400)[100:]
    displacement = ring_bender(actuator, "discrepancy", voltage, seed)
    source = np.random.default_rng(seed)
    displacement[source.integers(300, size=12)] += 8 * source.standard_normal(12)
    displacement[source.integers(300, size=25)] = displacement[150:190] = np.nan
    posterior = posterior_of(voltage, displacement, actuator, noise, {})
    posterior = posterior.altered(displacement=displacement, from_rest=False)
    return replace(posterior, engine=engine)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("noise", ["discrepancy", "smooth", "white"])
def test_without_tails_it_is_the_normal_noise(noise: str, engine: Engine) -> None:
    """At 1/ν = 0, to 1e-10; with gaps, an unknown start, an offset of the record."""
    normal = moving(noise, engine)
    likelihood = replace(normal.likelihood, offset_sd=3.0)
    tailed = replace(moving(f"{noise} + student", engine).likelihood, offset_sd=3.0)
    theta = normal.prior.theta(normal.prior.draw(np.random.default_rng(5), 5))
    theta[:, normal.table.names.index("sensor_sd")] = np.linspace(0.1, 1.0, 5)
    level = np.insert(theta, theta.shape[1], 0.0, axis=1)
    for found, expected in zip(tailed.start(level), likelihood.start(theta), strict=True):
        size = np.max(np.abs(expected), axis=tuple(range(1, expected.ndim)), keepdims=True)
        np.testing.assert_allclose(found / size, expected / size, rtol=0, atol=1e-10)
    shapes = np.sin(np.outer([0.01, 0.3], np.arange(likelihood.readings.rows.size)))
    for found, expected in zip(
        tailed.score(level, shapes), likelihood.score(theta, shapes), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.skipif(len(ENGINES) < 2, reason="numba is not installed")
@pytest.mark.parametrize("noise", ["discrepancy + student", "smooth + student", "student"])
def test_engines_agree(noise: str) -> None:
    slow, fast = (replace(moving(noise, e).likelihood, offset_sd=3.0) for e in ENGINES)
    prior = moving(noise, "numpy").prior
    theta = prior.theta(prior.draw(np.random.default_rng(6), 40))
    for found, expected in zip(fast.start(theta), slow.start(theta), strict=True):
        # A variance that readings make small has the rounding of the large one before.
        rounding = 1e-11 * np.max(np.abs(expected))
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=rounding)
    shapes = np.sin(np.outer([0.01, 0.3], np.arange(slow.readings.rows.size)))
    for found, expected in zip(fast.score(theta, shapes), slow.score(theta, shapes), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9)


# Readings of a known discrepancy, and places of sensor_sd and sensor_tail, equally probable.
DISCREPANCY, TIME = 0.8, 0.3
SDS, TAILS = np.geomspace(0.1, 0.9, 15), np.linspace(0.02, 1.0, 12)
PLACES = np.stack([places.ravel() for places in np.meshgrid(SDS, TAILS, indexing="ij")], axis=1)
THETA = np.insert(PLACES, [1, 1], [DISCREPANCY, TIME], axis=1)


def simulated(readings: int, place: FloatArray, source: np.random.Generator) -> FloatArray:
    """Return readings (readings,) of a discrepancy and a t-distributed sensor."""
    theta = np.array([[place[0], DISCREPANCY, TIME, place[1]]])
    drawn = noise_model("discrepancy", INTERVAL).draw(theta[:, :3], readings, source)[0]
    sensor = place[0] * t_scale(place[1]) * source.standard_t(1 / place[1], size=readings)
    return np.asarray(drawn + sensor)


def integrated(
    residual: FloatArray, place: FloatArray, response: FloatArray, start_sd: float
) -> float:
    """Log density by numerical integration over the discrepancy's states and the start's size."""
    kept, scale = np.exp(-INTERVAL / TIME), place[0] * t_scale(place[1])
    states, step = np.linspace(-4 * DISCREPANCY, 4 * DISCREPANCY, 121, retstep=True)
    sizes, width = np.linspace(-4 * start_sd, 4 * start_sd, 101, retstep=True)
    gained = DISCREPANCY * np.sqrt(1 - kept**2)
    onwards = step * scipy.stats.norm.pdf(states[:, np.newaxis], kept * states, gained)
    known = step * scipy.stats.norm.pdf(states, 0, DISCREPANCY)[:, np.newaxis]
    logs = scipy.stats.norm.logpdf(sizes, 0, start_sd) + np.log(width)
    for number, (reading, size) in enumerate(
        zip(residual.tolist(), response.tolist(), strict=True)
    ):
        known = onwards @ known if number else known
        errors = (reading - states[:, np.newaxis] - size * sizes) / scale
        # scipy's t density, which takes far longer; its factor comes last.
        known = known * (1 + place[1] * errors**2) ** (-0.5 * (1 / place[1] + 1))
        total = np.sum(known, axis=0)
        logs, known = logs + np.log(total), known / total
    factor = residual.size * scipy.stats.t.logpdf(0.0, 1 / place[1], scale=scale)
    return float(scipy.special.logsumexp(logs) + factor)


def moments(places: FloatArray, log_density: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means and sds of log sensor_sd and sensor_tail over places (places, 2)."""
    weights = scipy.special.softmax(log_density)
    values = np.stack([np.log(places[:, 0]), places[:, 1]], axis=1)
    mean = weights @ values
    return mean, np.sqrt(weights @ (values - mean) ** 2)


def test_the_posterior_is_where_integration_puts_it() -> None:
    """40 readings, two of them far off, a start unknown: means within 0.3 sds, sds within 20%.

    The twin, normal noise, has its posterior elsewhere.
    """
    source, start_sd = np.random.default_rng(1), 2.0
    rows = PLACES[:, 0] > 0.15
    rows &= np.isin(PLACES[:, 1], TAILS[::2]) & np.isin(PLACES[:, 0], SDS[::2])
    places, theta = PLACES[rows], THETA[rows]
    residual = 1.5 + simulated(40, np.array([0.3, 0.6]), source)
    residual[[10, 25]] += 3.0, -4.0
    response = np.exp(-np.arange(40) / 30)
    logs = np.array([integrated(residual, place, response, start_sd) for place in places])
    exact = moments(places, logs)
    noise = noise_model("discrepancy + student", INTERVAL)
    series = np.tile(np.stack([residual, response]), (len(theta), 1, 1))
    found = heavy_tails.follow(noise, theta, series, np.full((len(theta), 1), start_sd))
    mean, sd = moments(places, found.log_density)
    np.testing.assert_array_less(np.abs(mean - exact[0]) / exact[1], 0.3)
    np.testing.assert_allclose(sd, exact[1], rtol=0.2)
    normal = noise_model("discrepancy", INTERVAL)
    white, log_determinant = normal.whiten(theta[:, :3], series[:, :1])
    twin = moments(places, -0.5 * (np.sum(white**2, axis=(1, 2)) + log_determinant))
    assert np.max(np.abs(twin[0] - exact[0]) / exact[1]) > 1


def ranks(noise: Noise, readings: int, records: int, factor: float = 1.0) -> FloatArray:
    """Return where the truth is among what is found, by probability, (records, parameters).

    Sensors are ``factor`` times as large as they are said to be.
    """
    source, found = np.random.default_rng(8), np.empty((records, 2))
    for record in range(records):
        place = PLACES[source.integers(len(PLACES))]
        residual = simulated(readings, place * [factor, 1.0], source)
        series = np.tile(residual, (len(THETA), 1, 1))
        nothing = np.empty((len(THETA), 0))
        log_density = heavy_tails.follow(noise, THETA, series, nothing, along=RUNS[-1]).log_density
        weights = scipy.special.softmax(log_density)
        for column in range(2):
            below, here = (
                np.sum(weights[chosen])
                for chosen in (
                    PLACES[:, column] < place[column],
                    PLACES[:, column] == place[column],
                )
            )
            found[record, column] = below + here * source.uniform()
    return found


@pytest.mark.parametrize(
    ("readings", "records"), [(150, 200), pytest.param(1_000, 1_000, marks=pytest.mark.slow)]
)
def test_posteriors_are_calibrated(readings: int, records: int) -> None:
    """Ranks of sensor_sd and sensor_tail are uniform: by chance one of four fails in 2,500 runs.

    With 200 records a bias of 0.3 sds is found in 90%, with 1,000 one of 0.12 sds. The twin,
    sensors a tenth larger than said, which is a bias of about one sd in 150 readings, must be
    found.
    """
    noise = noise_model("discrepancy + student", INTERVAL)
    for found in ranks(noise, readings, records).T:
        assert scipy.stats.kstest(found, "uniform").pvalue > 1e-4
    twin = ranks(noise, readings, records, 1.1)[:, 0]
    assert scipy.stats.kstest(twin, "uniform").pvalue < 1e-4


def test_draws_have_the_tails() -> None:
    """10,000 of each: by chance one fails in 1,000 runs; a normal distribution would."""
    noise = noise_model("discrepancy + student", INTERVAL)
    for inverse_df in (0.5, 1.0):
        theta = np.array([[0.3, 0.8, 0.2, inverse_df]])
        _, sensor = noise.draw(theta, 10_000, np.random.default_rng(2))
        law = scipy.stats.t(1 / inverse_df, scale=0.3 * t_scale(inverse_df))
        assert scipy.stats.kstest(sensor, law.cdf).pvalue > 3e-4
        assert scipy.stats.kstest(sensor, scipy.stats.norm(0, 0.3).cdf).pvalue < 1e-6


@pytest.mark.parametrize("engine", ENGINES)
def test_innovations_are_standard_normal(engine: Engine) -> None:
    """3,000 readings of the model: by chance one fails in 1,000 runs; effective ones would."""
    posterior = moving("discrepancy + student", engine)
    windows = (slice(0, 3_000),)
    likelihood = replace(posterior.likelihood, displacement=np.zeros(3_000), training=windows)
    residual = simulated(3_000, np.array([0.3, 0.8]), np.random.default_rng(4))[np.newaxis]
    theta = np.array([[0.3, DISCREPANCY, TIME, 0.8]])
    innovations = likelihood.innovations(theta, residual)[0]
    assert scipy.stats.kstest(innovations, "norm").pvalue > 1e-3
    effective = likelihood.whiten(theta, residual[:, np.newaxis])[0][0, 0]
    assert scipy.stats.kstest(effective, "norm").pvalue < 1e-3


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_outliers_hardly_move_the_estimate(share: float) -> None:
    """Parameters and sensor_sd within 3.5 sds of the truth: by chance one of 18 fails in 1 of 120.

    The twin, normal noise, makes the sensor several times as noisy.
    """
    actuator, source = Actuator("none", "first", INTERVAL), np.random.default_rng(17)
    voltage = decaying_sine(600)
    displacement = ring_bender(actuator, "discrepancy", voltage, 21)
    spoiled = source.random(600) < share
    displacement[spoiled] += 6 * source.standard_normal(np.sum(spoiled))
    known = {"initial": 0.0, "exponent": 1.0}
    posterior = posterior_of(voltage, displacement, actuator, "discrepancy + student", known)
    point = map_estimate.fit(replace(posterior, engine=ENGINES[-1]), np.random.default_rng(1))
    normal = posterior_of(voltage, displacement, actuator, "discrepancy", known)
    names = list(posterior.names)
    true = dict(zip(normal.prior.names, truth(normal)[0], strict=True))
    place = np.array([[true.get(name, 0.2) for name in names]])
    away = (point.mode - posterior.prior.unconstrain(place)[0]) / np.sqrt(np.diag(point.covariance))
    compared = [names.index(name) for name in true if name in names]
    assert np.abs(away[compared]).max() < 3.5
    if share:
        taken = map_estimate.fit(replace(normal, engine=ENGINES[-1]), np.random.default_rng(1))
        values = dict(
            zip(normal.names, normal.prior.constrain(taken.mode[np.newaxis])[0][0], strict=True)
        )
        assert values["sensor_sd"] > 2 * true["sensor_sd"]


def test_two_tails_and_outliers_set_aside_are_refused() -> None:
    with pytest.raises(InputError, match=r"two terms with heavy tails or noise .*, but one sensor"):
        noise_model("student + discrepancy + student", 1.0)
    study = study_of(moving("discrepancy", "numpy").single_record, noise="discrepancy + student")
    with pytest.raises(InputError, match=r"model\.outliers: noise has heavy tails"):
        outliers(study, np.random.default_rng(1), {})


def test_a_sum_names_the_tail_wherever_the_term_is() -> None:
    one, other = (noise_model(kind, 1.0) for kind in ("student + smooth", "smooth + student"))
    assert "sensor_tail" == one.declarations[1].name == other.declarations[-1].name
    assert one.tailed
    theta = np.array([[0.3, 0.7, 0.8, 0.2, 0.4]])
    turned = theta[:, [0, 2, 3, 4, 1]]
    assert one.inverse_df(theta) == other.inverse_df(turned) == 0.7
    residual = np.random.default_rng(1).standard_normal((1, 50))
    assert one.log_density(theta, residual) == pytest.approx(other.log_density(turned, residual))
