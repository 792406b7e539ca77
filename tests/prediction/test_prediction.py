"""What predictions promise: nested bands, one simulation a record, honest unknown starts."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.readings import Readings
from bwbayes.model.actuator import Actuator
from bwbayes.prediction import prediction
from bwbayes.prediction.bands import KINDS, LEVELS, Bands, Kind
from bwbayes.prediction.initial_state import Started, started
from bwbayes.prediction.prediction import Start, predict_record, predict_windows
from bwbayes.record.record import Record
from tests.inference.problems import posterior_of
from tests.prediction.process import process
from tests.prediction.running import left_by_running_drives

TRUTH = {
    "d": 0.7,
    "alpha": 0.3575,
    "beta": 0.0272,
    "gamma": 0.0172,
    "exponent": 1.0,
    "initial": 0.0,
    "lag": 0.004,
    "offset": 5.0,
    "sensor_sd": 0.5,
    "discrepancy_sd": 1.0,
    "discrepancy_time": 0.2,
}
INTERVAL = 0.01


def random() -> np.random.Generator:
    return np.random.default_rng(2)


def made(samples: int = 1200, offset: float = 5.0, start: float = 0.0) -> Record:
    """Simulate a record of a decaying sine: model, discrepancy and sensor noise."""
    time = np.arange(samples) * INTERVAL
    voltage = 100 * np.sin(2 * np.pi * 0.5 * time + start) * np.exp(-0.1 * time)
    actuator = Actuator("lag", "first", INTERVAL)
    theta = np.array([[TRUTH[n] for n in actuator.parameters]])
    generator = np.random.default_rng(4)
    x = process(samples, INTERVAL / TRUTH["discrepancy_time"], generator)
    truth = actuator.displacement(theta, voltage)[0] - TRUTH["offset"] + offset + x
    reading = truth + TRUTH["sensor_sd"] * generator.standard_normal(samples)
    return Record(voltage, reading, INTERVAL, truth=truth, origin="made up")


@pytest.fixture(scope="module")
def record() -> Record:
    return made()


@pytest.fixture(scope="module")
def posterior(record: Record) -> Posterior:
    assert record.displacement is not None
    actuator = Actuator("lag", "first", INTERVAL)
    whole = posterior_of(
        record.voltage,
        record.displacement,
        actuator,
        "discrepancy",
        {"exponent": 1.0},
        from_rest=True,
    )
    return whole.altered(training=(slice(0, 600),))


@pytest.fixture(scope="module")
def draws(posterior: Posterior) -> FloatArray:
    """Draws around the truth, a few per cent wide: stand-ins for a posterior's."""
    generator = np.random.default_rng(1)
    center = np.array([TRUTH[name] for name in posterior.names])
    wide = 0.03 * np.abs(center) + np.where(center == 0, 0.1, 0.0)
    return center + wide * generator.standard_normal((300, center.size))


def predicted(
    posterior: Posterior, draws: FloatArray, record: Record, start: Start, seed: int = 3
) -> Bands:
    return predict_record(posterior, draws, record, start, np.random.default_rng(seed))


def width(bands: Bands, kind: Kind = "parameter", level: int = 95) -> FloatArray:
    return bands.upper[kind, level] - bands.lower[kind, level]


def test_bands_are_nested_in_level_and_in_kind(
    posterior: Posterior, draws: FloatArray, record: Record
) -> None:
    bands = predict_windows(posterior, draws, record, {"all": slice(0, record.samples)}, random())[
        0
    ]
    for inner, outer in pairwise(LEVELS):
        for kind in KINDS:
            assert (bands.lower[kind, outer] <= bands.lower[kind, inner]).all()
            assert (bands.upper[kind, inner] <= bands.upper[kind, outer]).all()
    for level in LEVELS:
        for tight, loose in pairwise(KINDS):
            assert (width(bands, tight, level) < width(bands, loose, level)).all()


def test_a_window_is_the_same_part_of_the_whole_record(
    posterior: Posterior, draws: FloatArray, record: Record
) -> None:
    """One simulation from the first sample: a window does not start the model afresh."""
    windows = {"all": slice(0, record.samples), "late": slice(700, 900)}
    whole, late = predict_windows(posterior, draws, record, windows, random())
    for (name, expected), (_, got) in zip(whole.columns(), late.columns(), strict=True):
        np.testing.assert_allclose(expected[700:900], got, atol=1e-9, err_msg=name)
    assert whole.training
    assert not late.training


def test_walking_through_in_other_pieces_changes_nothing(
    posterior: Posterior, draws: FloatArray, record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    windows = {"late": slice(500, 1100)}
    expected = predict_windows(posterior, draws, record, windows, random())[0]
    monkeypatch.setattr(prediction, "PIECE", 97)
    got = predict_windows(posterior, draws, record, windows, random())[0]
    for (name, one), (_, two) in zip(expected.columns(), got.columns(), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-9, err_msg=name)


def test_an_unknown_state_widens_the_start_and_is_forgotten_later(
    posterior: Posterior, draws: FloatArray
) -> None:
    planned = replace(made(), displacement=None, truth=None)
    rest = predicted(posterior, draws, planned, Start(from_rest=True))
    unknown = predicted(posterior, draws, planned, Start())
    assert width(unknown)[:5].mean() > 3 * width(rest)[:5].mean()
    late = slice(300, 400)
    assert width(unknown)[late].mean() < 0.5 * width(unknown)[:5].mean()


def start_of(
    posterior: Posterior, draws: FloatArray, record: Record, start: Start, seed: int = 0
) -> Started:
    theta = posterior.prior.theta(draws)
    return started(posterior, theta, record, start, np.random.default_rng(seed))


def initial(posterior: Posterior, begun: Started) -> FloatArray:
    states: FloatArray = begun.model[:, posterior.only.actuator.parameters.index("initial")]
    return states


def test_the_lead_in_is_told_and_a_longer_one_tells_more(
    posterior: Posterior, draws: FloatArray
) -> None:
    short = predicted(posterior, draws, made(), Start(from_rest=True, lead_in=0.2))
    long = predicted(posterior, draws, made(), Start(from_rest=True, lead_in=4.0))
    assert (short.scored_from, long.scored_from) == (20, 400)
    assert width(long).mean() < width(short).mean()


@pytest.mark.parametrize("lead_in_from", [pytest.param(0.0, marks=pytest.mark.slow), 2.0])
def test_offset_and_unrest_are_those_of_the_dense_normal_equations(
    posterior: Posterior, draws: FloatArray, lead_in_from: float
) -> None:
    """Over many starts of one draw: mean and covariance of what is drawn, and the offset's sd."""
    record = made()
    assert record.displacement is not None
    same = np.repeat(draws[:1], 4000, axis=0)
    start = Start(lead_in=0.3, lead_in_from=lead_in_from)
    begun = start_of(posterior, same, record, start)
    offset = posterior.only.actuator.parameters.index("offset")
    rows = np.arange(30) + round(lead_in_from / INTERVAL)
    theta = posterior.prior.theta(draws[:1])
    sensor, sd, time = theta[0, -3:]
    lags = np.abs(np.subtract.outer(rows, rows)) * INTERVAL
    noise = sd**2 * np.exp(-lags / time) + sensor**2 * np.eye(30)
    lag = theta[0, posterior.prior.names.index("lag")]
    response = np.stack([np.ones(30), np.exp(-rows * INTERVAL / lag)])
    wide = np.ptp(posterior.only.readings.values), theta[0, 0] * np.ptp(record.voltage) / 2
    # Of the starts drawn, those whose h lies near the median's: given h all is normal.
    states = initial(posterior, begun)
    near = np.abs(states - np.median(states)) < 0.2 * np.std(states)
    model = begun.model[near].mean(axis=0)[np.newaxis]
    model[:, offset] = 0.0
    clean = posterior.only.actuator.displacement(model, record.voltage)[0]
    residual = record.displacement[rows] - clean[rows]
    center = np.array([np.mean(record.displacement[rows]), 0.0])
    inverse = np.linalg.inv(noise)
    precision = np.diag(np.array(wide) ** -2.0) + response @ inverse @ response.T
    covariance = np.linalg.inv(precision)
    mean = center + covariance @ response @ inverse @ (residual - center @ response)
    got = begun.model[near, offset].mean(), begun.unrest[near, 0].mean()
    spread = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(mean, got, atol=0.1 * spread.max())
    left = covariance[0, 0] - covariance[0, 1] ** 2 / covariance[1, 1]
    np.testing.assert_allclose(begun.offset_sd, np.sqrt(left), rtol=1e-4)
    total = np.sqrt(np.var(begun.model[near, offset]) + left)
    together = np.cov(begun.model[near, offset], begun.unrest[near, 0])[0, 1]
    assert total == pytest.approx(spread[0], rel=0.15)
    assert together == pytest.approx(covariance[0, 1], rel=0.15, abs=1e-3)


def test_unrest_is_part_of_the_simulation(posterior: Posterior, draws: FloatArray) -> None:
    """The bands' mean is that of the draws' simulations from their own starts."""
    record = made(start=1.2)
    bands = predicted(posterior, draws, record, Start(), seed=0)
    begun = start_of(posterior, draws, record, Start())
    own, at_rest = (
        begun.actuators[0].advance(begun.model, record.voltage, unrest=unrest)[0].mean(axis=0)
        for unrest in (begun.unrest, None)
    )
    np.testing.assert_allclose(own, bands.mean, atol=1e-9)
    assert np.max(np.abs(own - at_rest)) > 0.1


@pytest.mark.slow
def test_the_state_is_that_of_a_fine_grid_whatever_the_seed(posterior: Posterior) -> None:
    """Mean and sd of the hysteretic state against 8,000 states of running drives, three seeds."""
    record = made(start=0.7)
    center = np.array([TRUTH[name] for name in posterior.names])
    same = np.tile(center, (2000, 1))
    begun = [start_of(posterior, same, record, Start(lead_in=1.0), seed) for seed in range(3)]
    states = [initial(posterior, one) for one in begun]
    window = Start(lead_in=1.0).window(record)
    assert window is not None
    assert record.displacement is not None
    theta = np.tile(posterior.prior.theta(center[np.newaxis]), (8000, 1))
    every = np.concatenate([record.voltage, posterior.only.voltage])
    nodes = left_by_running_drives(TRUTH, float(record.voltage[0]), every, len(theta))
    theta[:, posterior.prior.names.index("initial")] = nodes
    theta[:, posterior.prior.names.index("offset")] = np.mean(record.displacement[window])
    likelihood = Likelihood(
        record.voltage,
        Readings.of(record.displacement, [window]),
        posterior.only.actuator,
        posterior.only.noise,
        "numpy",
        from_rest=False,
        half_range=float(np.ptp(np.concatenate([record.voltage, posterior.only.voltage]))) / 2,
        offset_sd=float(np.ptp(posterior.only.readings.values)),
    )
    density = likelihood.log_density(theta)
    weight = np.exp(density - density.max())
    weight /= weight.sum()
    mean = float(weight @ nodes)
    sd = float(np.sqrt(weight @ (nodes - mean) ** 2))
    for one in states:
        assert np.mean(one) == pytest.approx(mean, abs=0.05 * sd)
        assert np.std(one) == pytest.approx(sd, rel=0.05)


def test_another_record_has_its_own_hold(posterior: Posterior, draws: FloatArray) -> None:
    """A command acts when it is held, whatever the training record's voltage was."""
    planned = replace(made(), displacement=None, truth=None)
    output = predicted(posterior, draws, planned, Start(from_rest=True))
    command = predicted(
        posterior, draws, replace(planned, voltage_is="command"), Start(from_rest=True)
    )
    theta = posterior.prior.theta(draws)[:, : len(posterior.only.actuator.parameters)]
    theta[:, posterior.only.actuator.parameters.index("initial")] = 0.0
    held = replace(posterior.only.actuator, hold="zero").displacement(theta, planned.voltage)
    np.testing.assert_allclose(held.mean(axis=0), command.mean, rtol=1e-9)
    assert np.max(np.abs(command.mean - output.mean)) > 0.5
    given = predicted(
        posterior,
        draws,
        replace(planned, voltage_is="command"),
        Start(from_rest=True, hold="first"),
    )
    np.testing.assert_allclose(output.mean, given.mean, rtol=1e-9)


def test_bands_of_two_voltages_differ_by_the_voltages_alone(
    posterior: Posterior, draws: FloatArray, record: Record
) -> None:
    """Where the voltages are still the same, so are the bands, whatever the seed."""
    voltage = record.voltage.copy()
    voltage[300:] *= 0.5
    plans = [replace(record, voltage=v, displacement=None) for v in (record.voltage, voltage)]
    rest = Start(from_rest=True)
    one, other = (predicted(posterior, draws, plan, rest, seed=s) for s, plan in enumerate(plans))
    for band in one.upper:
        np.testing.assert_allclose(one.upper[band][:300], other.upper[band][:300], rtol=1e-12)
        assert (one.upper[band][300:] != other.upper[band][300:]).any()


def test_rest_means_a_path_from_zero_volts(posterior: Posterior, draws: FloatArray) -> None:
    planned = replace(made(start=1.2), displacement=None, truth=None)
    bands = predicted(posterior, draws, planned, Start(from_rest=True))
    theta = posterior.prior.theta(draws)[:, : len(posterior.only.actuator.parameters)]
    theta[:, posterior.only.actuator.parameters.index("initial")] = 0.0
    path = np.concatenate([[0.0], np.full(3000, planned.voltage[0]), planned.voltage])
    expected = posterior.only.actuator.displacement(theta, path)[:, 3001:].mean(axis=0)
    np.testing.assert_allclose(expected, bands.mean, atol=1e-6)


def test_a_window_of_another_record_is_that_part_of_the_whole(
    posterior: Posterior, draws: FloatArray
) -> None:
    record = made(start=0.4)
    whole = predicted(posterior, draws, record, Start(lead_in=1.0))
    part = predict_record(
        posterior, draws, record, Start(lead_in=1.0), np.random.default_rng(3), window=(3.0, 7.0)
    )
    assert (100, 0) == (whole.scored_from, part.scored_from)
    for (name, expected), (_, got) in zip(whole.columns(), part.columns(), strict=True):
        np.testing.assert_allclose(expected[300:700], got, atol=1e-9, err_msg=name)
    with pytest.raises(InputError, match="lead-in leaves nothing of the window"):
        predict_record(
            posterior,
            draws,
            record,
            Start(lead_in=1.0),
            np.random.default_rng(3),
            window=(0.0, 0.5),
        )


def test_missing_readings_are_not_judged_and_bands_go_on(
    posterior: Posterior, draws: FloatArray
) -> None:
    record = made(start=0.4)
    assert record.displacement is not None
    reading = record.displacement.copy()
    reading[::7] = np.nan
    bands = predicted(posterior, draws, replace(record, displacement=reading), Start())
    assert bands.pit is not None
    assert bands.crps is not None
    np.testing.assert_array_equal(np.isnan(reading), np.isnan(bands.pit))
    np.testing.assert_array_equal(np.isnan(reading), np.isnan(bands.crps))
    assert np.isfinite(bands.upper["sensor", 95]).all()


def test_another_sampling_interval_gives_the_same_bands(
    posterior: Posterior, draws: FloatArray
) -> None:
    fine = replace(made(), displacement=None, truth=None)
    coarse = replace(fine, voltage=fine.voltage[::2], interval=2 * fine.interval)
    expected = predicted(posterior, draws, fine, Start(from_rest=True))
    got = predicted(posterior, draws, coarse, Start(from_rest=True))
    # Straight lines between every second sample leave a little of the sine out.
    np.testing.assert_allclose(expected.mean[::2], got.mean, atol=0.2)
    np.testing.assert_allclose(width(expected, "sensor")[::2], width(got, "sensor"), atol=0.05)


@pytest.mark.parametrize("lead_in", [0.001, 12.0, 100.0])
def test_a_lead_in_that_leaves_nothing_is_refused(
    posterior: Posterior, draws: FloatArray, lead_in: float
) -> None:
    with pytest.raises(InputError, match="lead-in"):
        predicted(posterior, draws, made(), Start(lead_in=lead_in))
