"""Step responses are those of closed forms."""

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Span
from bwbayes.model.linear import Creep
from bwbayes.model.nonlinearity import PolynomialNonlinearity
from bwbayes.prediction.loops import Estimate, measure_step, measure_steps, step_of
from bwbayes.prediction.prediction import forecast
from bwbayes.record.record import Record
from bwbayes.record.waveforms import signal
from tests.inference.problems import decaying_sine, posterior_of

INTERVAL = 0.01


def problem(actuator: Actuator, **fixed: float) -> tuple[Posterior, FloatArray]:
    voltage = decaying_sine(300)
    known = {"d": 0.7, "alpha": 0.36, "beta": 0.027, "gamma": 0.017, "exponent": 1.0, **fixed}
    of = posterior_of(voltage, 0.6 * voltage, actuator, "discrepancy", known, from_rest=True)
    return of, of.prior.draw(np.random.default_rng(1), 40)


def measured(of: Posterior, draws: FloatArray, height: float, held: float) -> dict[str, Estimate]:
    every = measure_step(of, draws, height, held).estimates.items()
    return {name: estimate for name, estimate in every if estimate is not None}


def level(height: float) -> float:
    """Where a step of n = 1 Bouc-Wen settles, um."""
    rate = 0.027 + 0.017
    return 0.7 * height + float(0.36 * np.expm1(-rate * height) / rate)


@pytest.mark.parametrize("height", [10.0, 50.0, 100.0])
def test_a_lag_rises_in_log_nine_times_its_time_and_does_not_overshoot(height: float) -> None:
    of, draws = problem(Actuator("lag", "first", INTERVAL))
    lags = of.table.columns(of.prior.theta(draws))["lag"]
    slow = (lags > 1e-4) & (lags < 1)  # inside of the times that are looked at
    assert np.sum(slow) > 20
    got = measured(of, draws[slow], height, 20.0)
    rise, overshoot, settled = (got[n] for n in ("rise_s", "overshoot_percent", "level_um"))
    expected = np.log(9) * lags[slow]
    assert np.mean(expected) == pytest.approx(rise.mean, rel=1e-3)
    assert np.quantile(expected, [0.025, 0.975]) == pytest.approx(
        [rise.lower, rise.upper], rel=2e-3
    )
    assert 0.0 == overshoot.upper
    assert level(height) == pytest.approx(settled.mean)
    assert "creep_percent" not in got


def test_a_light_damping_overshoots_as_the_text_book_says() -> None:
    """By exp(−π ζ / sqrt(1 − ζ²)), whatever the record's sampling."""
    mass, stiffness, ratio = 0.00134, 4.1e5, 0.3
    damping = 2 * ratio * np.sqrt(mass * stiffness)
    actuator = Actuator("second-order", "zero", INTERVAL)
    of, draws = problem(actuator, mass=mass, stiffness=stiffness, damping=damping)
    overshoot = measured(of, draws, 50.0, 1.0)["overshoot_percent"]
    expected = 100 * np.exp(-np.pi * ratio / np.sqrt(1 - ratio**2))
    assert expected == pytest.approx(overshoot.mean, rel=2e-3)


def test_creep_is_the_sum_of_its_lags() -> None:
    times, strengths = (0.1, 1.0, 10.0), (0.01, 0.02, 0.015)
    actuator = Actuator("lag", "first", INTERVAL, creep=Creep(times))
    known = {f"creep_{i + 1}": c for i, c in enumerate(strengths)}
    of, draws = problem(actuator, lag=1e-3, **known)
    got = measure_step(of, draws, 50.0, 10.0)
    creep = measured(of, draws, 50.0, 10.0)["creep_percent"]

    def crept(t: float) -> float:
        return float(sum(-c * np.expm1(-t / T) for c, T in zip(strengths, times, strict=True)))

    expected = 100 * (crept(10.0) - crept(0.1)) / (1 + crept(0.1)) / 2
    assert expected == pytest.approx(creep.mean, rel=1e-3)
    assert 0.0 == pytest.approx(creep.sd, abs=1e-9)
    assert (1 + crept(10.0)) * level(50.0) == pytest.approx(got.response.mean[-1], rel=1e-9)
    assert got.crept is not None
    assert np.isnan(got.crept.mean[got.time < 0.1]).all()
    grown = (crept(10.0) - crept(0.1)) * level(50.0)
    assert grown == pytest.approx(got.crept.mean[-1], rel=1e-3)


def test_a_gain_counts_from_the_displacement_before_the_step() -> None:
    nonlinearity = PolynomialNonlinearity(("quadratic",), Span(-20.0, 100.0))
    of, draws = problem(
        Actuator("lag", "first", INTERVAL, nonlinearity=nonlinearity), quadratic=3.0
    )
    settled = measured(of, draws, 50.0, 5.0)["level_um"]
    added = 3.0 * ((50 - 40) ** 2 - 40**2) / 60**2
    assert level(50.0) + added == pytest.approx(settled.mean)


@pytest.mark.parametrize("name", ["step10", "step50", "step100"])
def test_the_papers_steps_are_recognized(name: str) -> None:
    _, voltage = signal(name).sample(100)
    step = step_of(Record(voltage, None, interval=INTERVAL))
    assert step is not None
    height, held = step
    assert float(name.removeprefix("step")) == height
    assert 10.0 == pytest.approx(held)


@pytest.mark.parametrize(
    "voltage",
    [
        decaying_sine(300),
        np.zeros(100),
        np.full(100, 50.0),
        np.repeat([0.0, 50.0, 0.0], 40),
        np.repeat([10.0, 60.0], 40),
        np.linspace(0, 50, 200),
    ],
)
def test_what_is_no_step_from_zero_is_left_alone(voltage: FloatArray) -> None:
    of, draws = problem(Actuator("lag", "first", INTERVAL))
    assert {} == measure_steps(of, draws, {"other": Record(voltage, None, interval=INTERVAL)})


@pytest.mark.parametrize("voltage", [np.zeros((2, 2)), np.array([]), np.array([1.0, np.nan])])
def test_a_forecast_needs_a_voltage(voltage: FloatArray) -> None:
    of, draws = problem(Actuator("lag", "first", INTERVAL))
    record = Record(of.single_record.voltage, of.single_record.displacement, interval=INTERVAL)
    with pytest.raises(InputError, match="give one finite row"):
        forecast(of, draws, record, voltage, np.random.default_rng(1))
