"""A prediction from one draw is a normal distribution whose mean and sd are known.

So the bands, the scores of the readings and what a lead-in tells of the offset are held against
closed forms and dense matrices, with sds that differ much, at the training record's sampling
interval and at others.
"""

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.stats import norm

from bwbayes.arrays import FloatArray
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import InitialConditions
from bwbayes.model.actuator import Actuator
from bwbayes.model.operators.bouc_wen import hysteresis
from bwbayes.prediction.bands import LEVELS, Bands, Kind
from bwbayes.prediction.prediction import predict_record, predict_windows
from bwbayes.record.record import Record
from tests.inference.problems import INTERVAL, decaying_sine, short_posterior, truth

# Far from each other, so that none can stand for another.
SENSOR, DISCREPANCY, TIME = 0.9, 0.25, 0.3

LEAD_IN = 1.0  # s


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    return short_posterior(dynamics="lag", fixed={})


@pytest.fixture(scope="module")
def draw(posterior: Posterior) -> FloatArray:
    """Return the truth with the sds above, as one draw (1, free)."""
    theta = truth(posterior)[0]
    named = dict(zip(posterior.prior.names, theta, strict=True))
    named |= {"sensor_sd": SENSOR, "discrepancy_sd": DISCREPANCY, "discrepancy_time": TIME}
    return np.array([[named[name] for name in posterior.names]])


def simulated(posterior: Posterior, voltage: FloatArray, interval: float) -> FloatArray:
    """Displacement (samples,) of the true model from rest and without an offset, um."""
    actuator = Actuator("lag", "first", interval)
    theta = truth(posterior)[:, : len(actuator.parameters)]
    theta[:, actuator.parameters.index("offset")] = 0.0
    moved: FloatArray = actuator.displacement(theta, voltage)[0]
    return moved


def another(posterior: Posterior, interval: float) -> Record:
    """Make a record of four seconds at another interval, from rest, some readings far off."""
    voltage = decaying_sine(round(4.0 / interval), amplitude=80.0)
    reading = simulated(posterior, voltage, interval) + 12.0
    reading += SENSOR * np.random.default_rng(1).standard_t(3, voltage.size)
    return Record(voltage, reading, interval=interval)


def sds(bands: Bands, kind: Kind) -> FloatArray:
    """Return the sd (samples,) of a normal band, from its widths at all levels, um."""
    half = [
        (bands.upper[kind, level] - bands.lower[kind, level]) / 2 / norm.ppf(0.5 + level / 200)
        for level in LEVELS
    ]
    np.testing.assert_allclose(half, np.mean(half, axis=0) * np.ones_like(half), rtol=2e-3)
    result: FloatArray = np.mean(half, axis=0)
    return result


def assert_scores_are_of(bands: Bands, mean: FloatArray, sd: float) -> None:
    """Hold PIT and CRPS against those of a normal distribution."""
    assert bands.measured is not None
    assert bands.pit is not None
    assert bands.crps is not None
    z = (bands.measured - mean) / sd
    np.testing.assert_allclose(norm.cdf(z), bands.pit, atol=1e-3)
    crps = sd * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / np.sqrt(np.pi))
    np.testing.assert_allclose(crps, bands.crps, atol=1e-3 * sd)


def offset_of_lead_in(posterior: Posterior, record: Record) -> tuple[float, float]:
    """Mean and sd of the offset, um, by the dense normal equations of a lead-in."""
    assert record.displacement is not None
    samples = round(LEAD_IN / record.interval)
    moved = simulated(posterior, record.voltage, record.interval)[:samples]
    lags = np.abs(np.subtract.outer(np.arange(samples), np.arange(samples))) * record.interval
    covariance = DISCREPANCY**2 * np.exp(-lags / TIME) + SENSOR**2 * np.eye(samples)
    weight = np.linalg.solve(covariance, np.ones(samples))
    mean = float(weight @ (record.displacement[:samples] - moved) / weight.sum())
    return mean, float(weight.sum() ** -0.5)


def test_readings_are_judged_by_the_sensors_distribution(
    posterior: Posterior, draw: FloatArray
) -> None:
    """Its sd is the root of both squares; the discrepancy's alone is less than a third of it."""
    record = Record(
        posterior.single_record.voltage,
        posterior.single_record.displacement + 0.5,
        interval=INTERVAL,
    )
    bands = predict_windows(
        posterior, draw, record, {"all": slice(0, record.samples)}, np.random.default_rng(2)
    )[0]
    sd = float(np.hypot(SENSOR, DISCREPANCY))
    assert_scores_are_of(bands, bands.mean, sd)
    np.testing.assert_allclose(sd, sds(bands, "sensor"), rtol=2e-3)
    np.testing.assert_allclose(DISCREPANCY, sds(bands, "displacement"), rtol=2e-3)


@pytest.mark.parametrize("interval", [INTERVAL / 4, INTERVAL, 2 * INTERVAL])
def test_a_lead_in_tells_the_offset_as_the_dense_matrix_does(
    posterior: Posterior, draw: FloatArray, interval: float
) -> None:
    """Mean and variance, at the record's own interval; and all bands have that variance."""
    record = another(posterior, interval)
    start = InitialConditions(from_rest=True, lead_in=LEAD_IN)
    bands = predict_record(posterior, draw, record, start, np.random.default_rng(1))
    offset, sd = offset_of_lead_in(posterior, record)
    mean = simulated(posterior, record.voltage, interval) + offset
    np.testing.assert_allclose(mean, bands.mean, atol=0.01 * sd)
    np.testing.assert_allclose(sd, sds(bands, "parameter"), rtol=5e-3)
    np.testing.assert_allclose(np.hypot(sd, DISCREPANCY), sds(bands, "displacement"), rtol=5e-3)
    whole = float(np.sqrt(sd**2 + DISCREPANCY**2 + SENSOR**2))
    np.testing.assert_allclose(whole, sds(bands, "sensor"), rtol=5e-3)
    assert_scores_are_of(bands, mean, whole)


def left_by_running_drives(
    model: Mapping[str, float], voltage: float, every: FloatArray, count: int
) -> FloatArray:
    """Return as many states h at a voltage, each as probable as the next, um.

    They are those of loops of 16 amplitudes about the middle of ``every`` voltage, left on either
    branch, the outermost as far out as none; between them are straight lines.
    """
    alpha, beta, gamma = (np.array([model[name]]) for name in ("alpha", "beta", "gamma"))
    middle, half = (np.max(every) + np.min(every)) / 2, np.ptp(every) / 2
    states: list[float] = []
    for reach in np.arange(1, 17) / 16:
        low, high = middle - reach * half, middle + reach * half
        for sweeps in ([0.0, high, low, high, low], [0.0, low, high, low, high]):
            h = hysteresis(np.array([*sweeps, voltage]), alpha, beta, gamma)
            states.append(float(h[0, -1]))
    states = sorted(states)
    states[0], states[-1] = min(states[0], 0.0), max(states[-1], 0.0)
    places = np.linspace(0.0, 1.0, len(states))
    parts = (np.arange(count) + 0.5) / count
    return np.asarray(np.interp(parts, places, states), dtype=np.float64)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_unknown_state_is_one_that_leads_to_the_first_voltage(
    posterior: Posterior, draw: FloatArray, sign: float
) -> None:
    """At the end of the voltage's range the last drive went there: h is close to its ceiling.

    Any other drive would leave h anywhere between both ceilings, 0 on average.
    """
    named = dict(zip(posterior.prior.names, posterior.prior.theta(draw)[0], strict=True))
    top = named["alpha"] / (named["beta"] + named["gamma"])
    every = np.array([-100.0, 100.0])
    running = left_by_running_drives(named, sign * 100.0, every, 1000)
    # Half have come from as far as any drive goes, half are what drives of any amplitude leave.
    left = float(sign * np.max(sign * running) + np.mean(running)) / 2
    assert 0.9 * top < sign * left < top
    held = Record(np.full(60, sign * 100.0), None, interval=INTERVAL)
    bands = predict_record(
        posterior, np.repeat(draw, 400, axis=0), held, InitialConditions(), np.random.default_rng(5)
    )
    # Late, when the dynamics have settled; h stays as the voltage does.
    h = named["d"] * held.voltage[-1] + named["offset"] - bands.mean[-1]
    assert left == pytest.approx(h, abs=0.02 * top)
