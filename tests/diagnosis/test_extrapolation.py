"""A prediction that leaves what was fitted says so, and one that stays within it says nothing.

False alarms: none in 100 drives of the fitted kind, with noise and other sampling rates.
"""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.extrapolation import Drive, beyond_training, unexcited_note
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Inputs
from tests.inference.problems import short_posterior


def sine(
    frequency: float, interval: float, amplitude: float = 75.0, periods: float = 3.0
) -> FloatArray:
    """Return a drive (samples,) from 0 V to twice the amplitude."""
    time = np.arange(0, periods / frequency, interval)
    voltage: FloatArray = amplitude * (1 - np.cos(2 * np.pi * frequency * time))
    return voltage


def fitted(voltage: FloatArray, interval: float) -> Posterior:
    return short_posterior(samples=20).altered(
        voltage=voltage,
        displacement=0.5 * voltage,
        training=(slice(0, voltage.size),),
        actuator=Actuator("none", "first", interval),
    )


SLOW = fitted(sine(0.1, 0.05), 0.05)


@pytest.mark.parametrize("factor", [1.0, 1.3, 2.0, 5.0])
@pytest.mark.parametrize("interval", [1e-3, 0.02])
def test_speed_is_remarked_on_from_a_factor_of_one_and_a_half(
    factor: float, interval: float
) -> None:
    remarks = beyond_training(SLOW, Inputs(sine(0.1 * factor, interval), interval=interval))
    assert (factor > 1.5) == bool(remarks)


def kinds(posterior: Posterior, voltage: FloatArray, interval: float) -> list[str]:
    return [
        finding.kind for finding in beyond_training(posterior, Inputs(voltage, interval=interval))
    ]


def test_what_a_drive_excites_that_the_record_did_not_is_said_in_a_word() -> None:
    """Steps after a sine have fast edges and slow holds; the sine itself has neither."""
    for voltage, text in (
        (
            np.repeat([20.0, 120.0, 20.0], 3_000),
            "this drive excites what the record did not (fast edges, slow holds)",
        ),
        (sine(0.1, 0.05), ""),
    ):
        assert unexcited_note(beyond_training(SLOW, Inputs(voltage, interval=0.05))) == text


def test_range_and_speed_are_said_one_by_one() -> None:
    assert ["range", "speed"] == kinds(SLOW, sine(5.0, 1e-3, 100.0), 1e-3)
    (wide,) = beyond_training(SLOW, Inputs(sine(0.1, 0.05, 100.0), interval=0.05))
    assert wide.text == (
        "voltage 0 to 200 V exceeds the training range 0 to 150 V; the bands extrapolate, "
        "their level untested"
    )


TIME = np.arange(0, 16, 0.005)
FAST = fitted(75 * np.sin(4 * np.pi * TIME), 0.005)


def test_a_slow_sine_and_a_hold_are_said() -> None:
    """A fit of 2 Hz for 16 s passes, and its bands cover 34% of the one, 0.3% of the other."""
    long = np.arange(0, 100, 0.005)
    slow, duration = beyond_training(FAST, Inputs(75 * np.sin(0.04 * np.pi * long), interval=0.005))
    assert ("slow", "duration") == (slow.kind, duration.kind)
    assert slow.text.startswith("voltage averages 50.2 V over 23.7 s, in training at most 0.")
    assert duration.text.startswith("duration of 100 s exceeds the 16 s of training; the bands")
    for held in (np.full(long.size, 75.0), np.where(long > 1, 75.0, 0.0)):
        slow = next(
            finding
            for finding in beyond_training(FAST, Inputs(held, interval=0.005))
            if finding.kind == "slow"
        )
        assert f"voltage averages {np.mean(held):.3g} V over 100 s" in slow.text


@pytest.mark.parametrize("factor", [0.5, 2.5, 4.0, 10.0])
@pytest.mark.parametrize("interval", [1e-3, 0.02])
@pytest.mark.parametrize("phase", [0.0, np.pi / 2])
def test_slowness_is_remarked_on_from_a_factor_of_three(
    factor: float, interval: float, phase: float
) -> None:
    time = np.arange(0, 45, interval)
    remarks = kinds(FAST, 75 * np.sin(4 * np.pi * time / factor + phase), interval)
    assert (factor > 3) == ("slow" in remarks)
    assert "duration" not in remarks


def test_rest_small_drives_and_long_ones_of_the_same_frequency_are_not_slow() -> None:
    rested = np.where(TIME < 4, 75 * np.sin(4 * np.pi * TIME), 0.0)
    small = 5 * np.sin(0.2 * np.pi * TIME)
    assert [] == kinds(FAST, rested, 0.005)
    assert ["reversals"] == kinds(FAST, small, 0.005)
    repeated = np.tile(FAST.single_record.voltage, 4)
    assert ["duration"] == kinds(FAST, repeated, 0.005)
    assert [] == kinds(fitted(repeated, 0.005), FAST.single_record.voltage, 0.005)


def test_held_out_part_of_the_same_drive_is_no_extrapolation() -> None:
    """Noise of half a volt, and every rate from 50 Hz to 2 kHz; its twin has smaller loops."""
    generator = np.random.default_rng(1)
    alarms = 0
    for _ in range(100):
        interval, other = 10 ** generator.uniform(-3.3, -1.7, 2)
        one = sine(1.0, interval, periods=5.0)
        two = sine(1.0, other, periods=generator.uniform(1.0, 5.0))
        noise = [0.5 * generator.standard_normal(v.size) for v in (one, two)]
        posterior, decay = fitted(one + noise[0], interval), np.linspace(1.0, 0.5, two.size)
        alarms += len(beyond_training(posterior, Inputs(two + noise[1], interval=other)))
        assert set(kinds(posterior, decay * two + noise[1], other)) <= {"reversals"}
    assert alarms == 0


def test_a_drive_is_told_by_its_range_its_fastest_swing_and_its_reversals() -> None:
    """Noise makes no reversal, and of a ramp alone the range is all there is to say."""
    decay = 50 + 40 * np.exp(-0.2 * TIME) * np.sin(2 * np.pi * 1.5 * TIME)
    noise = 0.1 * np.random.default_rng(1).standard_normal(TIME.size)
    for voltage in (decay, decay + noise):
        drive = Drive.of(fitted(voltage, 0.005))
        assert drive.depths is not None
        smallest, largest = drive.depths
        assert abs(drive.frequency - 1.5) < 0.2
        assert abs(drive.low - voltage.min()) + abs(drive.high - voltage.max()) == 0
        assert smallest < 8
        assert abs(largest - np.ptp(decay)) < 2
    text = "13.81 to 88.7 V, up to 1.5 Hz, reversals of 4.3 to 74.9 V"
    assert str(Drive.of(fitted(decay, 0.005))) == text
    assert str(Drive.of(fitted(5 * TIME, 0.005))) == "0 to 79.98 V"


@given(phase=st.floats(0, 6.2), frequency=st.floats(0.3, 2.0), low=st.floats(-20, 20))
def test_a_drive_with_reversals_elsewhere_is_told_from_the_same_one_again(
    phase: float, frequency: float, low: float
) -> None:
    """At any frequency, for rate-independent memory knows none. The twin never goes below."""
    decay = np.exp(-0.1 * TIME)
    posterior = fitted(75 * decay * np.sin(4 * np.pi * TIME), 0.005)
    again = 75 * decay * np.sin(2 * np.pi * frequency * TIME + phase)
    elsewhere = low + (70 - low) * (1 + np.sin(2 * np.pi * frequency * TIME + phase)) / 2
    assert "reversals" not in kinds(posterior, again, 0.005)
    assert "reversals" in kinds(posterior, elsewhere, 0.005)
