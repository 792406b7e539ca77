"""A prediction that leaves what was fitted says so, and one that stays within it says nothing.

False alarms: none in 300 drives of the fitted kind, with noise and other sampling rates.
"""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.results.extrapolation import beyond_training
from tests.inference.problems import short_posterior


def sine(
    frequency: float, interval: float, amplitude: float = 75.0, periods: float = 3.0
) -> FloatArray:
    """Return a drive (samples,) from 0 V to twice the amplitude."""
    time = np.arange(0, periods / frequency, interval)
    voltage: FloatArray = amplitude * (1 - np.cos(2 * np.pi * frequency * time))
    return voltage


def fitted(voltage: FloatArray, interval: float) -> Posterior:
    """Return a posterior trained with a drive; only its voltage matters here."""
    return short_posterior(samples=20).altered(
        voltage=voltage,
        displacement=0.5 * voltage,
        training=(slice(0, voltage.size),),
        actuator=Actuator("none", "first", interval),
    )


SLOW = fitted(sine(0.1, 0.05), 0.05)


def test_drive_fifty_times_as_fast_as_the_fitted_one_is_said() -> None:
    """A fit of 0.1 Hz at 20 Hz tells nothing of a 5 Hz record's lag."""
    (remark,) = beyond_training(SLOW, sine(5.0, 1e-3), 1e-3)
    assert "V/s, and only up to 47" in remark
    assert "faster than that the bands are an extrapolation" in remark


@pytest.mark.parametrize("factor", [1.0, 1.3, 2.0, 5.0])
@pytest.mark.parametrize("interval", [1e-3, 0.02])
def test_speed_is_remarked_on_from_a_factor_of_one_and_a_half(
    factor: float, interval: float
) -> None:
    remarks = beyond_training(SLOW, sine(0.1 * factor, interval), interval)
    assert (factor > 1.5) == bool(remarks)


def test_step_is_faster_than_a_sine_and_no_sine_than_a_step() -> None:
    step = np.repeat([0.0, 150.0], 100)
    assert beyond_training(fitted(sine(1.0, 0.01), 0.01), step, 0.01)
    assert not beyond_training(fitted(step, 0.01), sine(5.0, 0.01), 0.01)


def test_range_and_speed_are_said_one_by_one() -> None:
    remarks = beyond_training(SLOW, sine(5.0, 1e-3, 100.0), 1e-3)
    assert ["V", "V/s"] == [remark.split(",")[0].split()[-1] for remark in remarks]
    (remark,) = beyond_training(SLOW, sine(0.1, 0.05, 100.0), 0.05)
    assert remark.startswith("the voltage goes from 0 to 200 V, and only 0 to 150 V were fitted")


def test_held_out_part_of_the_same_drive_is_no_extrapolation() -> None:
    """Noise of half a volt, decaying amplitudes, and every rate from 50 Hz to 2 kHz."""
    generator = np.random.default_rng(1)
    alarms = 0
    for _ in range(300):
        interval, other = 10 ** generator.uniform(-3.3, -1.7, 2)
        one = sine(1.0, interval, periods=5.0)
        two = sine(1.0, other, periods=generator.uniform(1.0, 5.0))
        two *= np.linspace(1.0, 0.5, two.size)
        noise = [0.5 * generator.standard_normal(v.size) for v in (one, two)]
        alarms += len(beyond_training(fitted(one + noise[0], interval), two + noise[1], other))
    assert alarms == 0
