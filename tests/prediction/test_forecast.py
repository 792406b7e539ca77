"""Forecasts: the discrepancy goes on from where readings leave it; the bands keep their word."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.inference.posterior import Posterior
from bwbayes.prediction.bands import Bands
from bwbayes.prediction.initial_state import Start
from bwbayes.prediction.prediction import forecast, predict_record, predict_windows
from bwbayes.record.record import Record
from tests.inference.problems import INTERVAL, TRUE_NOISE, decaying_sine, short_posterior, truth

SD, TIME, SENSOR = (
    TRUE_NOISE[f"{name}"] for name in ("discrepancy_sd", "discrepancy_time", "sensor_sd")
)

# Samples of a record, and of what follows it.
LEAD, LATER = 80, 120


def whole(seed: int) -> tuple[Posterior, Record, FloatArray]:
    """Return the posterior of a record's first part, that part, and what was read later.

    The discrepancy of the whole record is one draw of the noise that the model has.
    """
    voltage = decaying_sine(LEAD + LATER)
    posterior = short_posterior("discrepancy", LEAD)
    theta = truth(posterior)
    one = posterior.only
    clean = one.actuator.displacement(one.table.actuator(theta), voltage, from_rest=True)[0]
    noise = DiscrepancyNoise(INTERVAL)
    parts = noise.draw(one.table.noise(theta), voltage.size, np.random.default_rng([5, seed]))
    reading = clean + sum(parts)
    first = Record(voltage[:LEAD], reading[:LEAD], INTERVAL)
    posterior = posterior.altered(voltage=voltage[:LEAD], displacement=reading[:LEAD])
    return posterior, first, np.stack([voltage[LEAD:], reading[LEAD:]])


def free_truth(posterior: Posterior) -> FloatArray:
    """Return the true free parameters, (1, free)."""
    theta = truth(posterior)
    return theta[:, [posterior.prior.names.index(name) for name in posterior.names]]


def test_a_forecast_is_narrower_at_first_and_as_wide_as_ever_later() -> None:
    posterior, record, (voltage, _) = whole(1)
    draws, generator = free_truth(posterior), np.random.default_rng(1)
    told = forecast(posterior, draws, record, voltage, generator)
    longer = replace(record, voltage=np.concatenate([record.voltage, voltage]), displacement=None)
    window = {"later": slice(LEAD, LEAD + LATER)}
    (usual,) = predict_windows(posterior, draws, longer, window, generator)

    def width(bands: Bands) -> FloatArray:
        wide: FloatArray = bands.upper["displacement", 95] - bands.lower["displacement", 95]
        return wide

    assert width(told)[0] < 0.75 * width(usual)[0]
    part = width(told) / width(usual)
    assert (np.diff(part) > -0.02).all()
    assert part[-1] == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(told.mean[-1], usual.mean[-1], atol=0.02)
    low = told.lower["parameter", 95]
    np.testing.assert_allclose(low, usual.lower["parameter", 95], atol=1e-9)


@pytest.mark.parametrize(("from_rest", "own_offset"), [(True, False), (True, True), (False, True)])
def test_another_record_is_forecast_from_its_lead_in(from_rest: bool, own_offset: bool) -> None:
    """Narrower than without at first, and alike later, whatever is unknown of its start."""
    posterior, record, (voltage, reading) = whole(2)
    other = Record(
        np.concatenate([record.voltage, voltage]),
        np.concatenate([record.displacement, reading]),
        INTERVAL,
    )
    draws = np.repeat(free_truth(posterior), 200, axis=0)
    lead_in = LEAD * INTERVAL
    told, usual = (
        predict_record(
            posterior,
            draws,
            other,
            Start(from_rest, own_offset, lead_in, after=after),
            np.random.default_rng(3),
        )
        for after in (True, False)
    )
    assert told.scored_from == LEAD
    widths = [(one.upper["sensor", 95] - one.lower["sensor", 95])[LEAD:] for one in (told, usual)]
    assert widths[0][0] < 0.95 * widths[1][0]
    assert widths[0][-1] == pytest.approx(widths[1][-1], rel=0.05)
    assert told.crps is not None
    assert np.isfinite(told.crps).all()


def test_a_forecast_without_readings_is_refused() -> None:
    posterior, record, _ = whole(3)
    planned = replace(record, displacement=None)
    with pytest.raises(InputError, match="has no readings after which a forecast could start"):
        predict_record(
            posterior,
            free_truth(posterior),
            planned,
            Start(after=True),
            np.random.default_rng(1),
        )
