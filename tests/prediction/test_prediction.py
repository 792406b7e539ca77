"""Promises of predictions: nested bands, one simulation a record, honest unknown starts."""

from dataclasses import replace

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import InitialConditions
from bwbayes.model.actuator import Actuator
from bwbayes.prediction.bands import Bands, Kind
from bwbayes.prediction.prediction import predict_record, predict_windows
from bwbayes.record.record import Record
from tests.inference.problems import posterior_of
from tests.stand import Stand

STAND = Stand(lag=0.004, discrepancy=1.0, memory=0.2, sensor=0.5)
TRUTH = STAND.truth | {"offset": 5.0}
INTERVAL = 1 / STAND.rate


def random() -> np.random.Generator:
    return np.random.default_rng(2)


def made(samples: int = 1200, start: float = 0.0) -> Record:
    time = np.arange(samples) * INTERVAL
    voltage = 100 * np.sin(2 * np.pi * 0.5 * time + start) * np.exp(-0.1 * time)
    return STAND.measure(voltage, np.random.default_rng(4), offset=TRUTH["offset"])


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
    return replace(whole.altered(training=(slice(0, 600),)), engine="numba")


@pytest.fixture(scope="module")
def draws(posterior: Posterior) -> FloatArray:
    """Draws around the truth, a few per cent wide: stand-ins for a posterior's."""
    generator = np.random.default_rng(1)
    center = np.array([TRUTH[name] for name in posterior.names])
    wide = 0.03 * np.abs(center) + np.where(center == 0, 0.1, 0.0)
    return center + wide * generator.standard_normal((300, center.size))


def predicted(
    posterior: Posterior,
    draws: FloatArray,
    record: Record,
    start: InitialConditions,
    window: tuple[float, float] | None = None,
) -> Bands:
    rng = np.random.default_rng(3)
    return predict_record(posterior, draws, record, start, rng, window=window)


def width(bands: Bands, kind: Kind = "parameter", level: int = 95) -> FloatArray:
    return bands.upper[kind, level] - bands.lower[kind, level]


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


def test_another_record_has_its_own_hold(posterior: Posterior, draws: FloatArray) -> None:
    """A command acts when it is held, whatever the training record's voltage was."""
    planned = replace(made(), displacement=None)
    output = predicted(posterior, draws, planned, InitialConditions(from_rest=True))
    command = predicted(
        posterior, draws, replace(planned, voltage_is="command"), InitialConditions(from_rest=True)
    )
    theta = posterior.prior.theta(draws)[:, : len(posterior.single_record.actuator.parameters)]
    theta[:, posterior.single_record.actuator.parameters.index("initial")] = 0.0
    held = replace(posterior.single_record.actuator, hold="zero").displacement(
        theta, planned.voltage
    )
    np.testing.assert_allclose(held.mean(axis=0), command.mean, rtol=1e-9)
    assert np.max(np.abs(command.mean - output.mean)) > 0.5
    given = predicted(
        posterior,
        draws,
        replace(planned, voltage_is="command"),
        InitialConditions(from_rest=True, hold="first"),
    )
    np.testing.assert_allclose(output.mean, given.mean, rtol=1e-9)


def test_rest_means_a_path_from_zero_volts(posterior: Posterior, draws: FloatArray) -> None:
    planned = replace(made(start=1.2), displacement=None)
    bands = predicted(posterior, draws, planned, InitialConditions(from_rest=True))
    theta = posterior.prior.theta(draws)[:, : len(posterior.single_record.actuator.parameters)]
    theta[:, posterior.single_record.actuator.parameters.index("initial")] = 0.0
    path = np.concatenate([[0.0], np.full(3000, planned.voltage[0]), planned.voltage])
    expected = posterior.single_record.actuator.displacement(theta, path)[:, 3001:].mean(axis=0)
    np.testing.assert_allclose(expected, bands.mean, atol=1e-6)


def test_a_window_of_another_record_is_that_part_of_the_whole(
    posterior: Posterior, draws: FloatArray
) -> None:
    record, start = made(start=0.4), InitialConditions(lead_in=1.0)
    whole = predicted(posterior, draws, record, start)
    part = predicted(posterior, draws, record, start, (3.0, 7.0))
    assert (100, 0) == (whole.scored_from, part.scored_from)
    for (name, expected), (_, got) in zip(whole.columns(), part.columns(), strict=True):
        np.testing.assert_allclose(expected[300:700], got, atol=1e-9, err_msg=name)
    with pytest.raises(InputError, match="lead-in leaves nothing of the window"):
        predicted(posterior, draws, record, start, (0.0, 0.5))


def test_missing_readings_are_not_judged_and_bands_go_on(
    posterior: Posterior, draws: FloatArray
) -> None:
    record = made(start=0.4)
    assert record.displacement is not None
    reading = record.displacement.copy()
    reading[::7] = np.nan
    bands = predicted(posterior, draws, replace(record, displacement=reading), InitialConditions())
    assert bands.pit is not None
    assert bands.crps is not None
    np.testing.assert_array_equal(np.isnan(reading), np.isnan(bands.pit))
    np.testing.assert_array_equal(np.isnan(reading), np.isnan(bands.crps))
    assert np.isfinite(bands.upper["sensor", 95]).all()


@pytest.mark.parametrize("lead_in", [0.001, 12.0, 100.0])
def test_a_lead_in_that_leaves_nothing_is_refused(
    posterior: Posterior, draws: FloatArray, lead_in: float
) -> None:
    with pytest.raises(InputError, match="lead-in"):
        predicted(posterior, draws, made(), InitialConditions(lead_in=lead_in))
