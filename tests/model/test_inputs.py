"""Inputs of an actuator on one clock, and their turning points, times and speeds."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.inputs import (
    RETURN,
    Inputs,
    fastest,
    monotone_stretches,
    time_between_turns,
    turning_points,
)
from bwbayes.record import Record

COARSE = 0.25


def inputs_of(samples: int) -> Inputs:
    voltage = np.random.default_rng(samples).normal(size=samples)
    covariates = {"temperature_degC": 20 + voltage**2, "load_N": -voltage}
    return Inputs(voltage, interval=COARSE, start=-3.0, covariates=covariates)


def record_of(samples: int) -> Record:
    inputs = inputs_of(samples)
    return Record(displacement=2 * inputs.voltage, truth=3 * inputs.voltage, **vars(inputs))


@given(samples=st.integers(2, 60), data=st.data())
def test_parts_put_together_are_the_whole(samples: int, data: st.DataObject) -> None:
    """For inputs and for a record: every series, cut at any sample."""
    cut = data.draw(st.integers(1, samples - 1))
    for whole in (inputs_of(samples), record_of(samples)):
        again = whole[:cut].followed_by(whole[cut:])
        for name, value in vars(whole).items():
            np.testing.assert_equal(getattr(again, name), value)


@given(
    samples=st.integers(2, 60),
    first=st.integers(0, 40),
    last=st.integers(1, 60),
    step=st.integers(1, 5),
)
def test_samples_keep_their_times(samples: int, first: int, last: int, step: int) -> None:
    whole, part = inputs_of(samples), slice(first, last, step)
    cut = whole[part]
    np.testing.assert_allclose(cut.time, whole.time[part], atol=1e-12)
    for name in ("voltage", *whole.covariates):
        np.testing.assert_array_equal(cut.column(name), whole.column(name)[part])


def test_what_is_not_known_is_refused() -> None:
    whole = inputs_of(10)
    with pytest.raises(InputError, match=r"pressure: the model needs it at .* a constant column"):
        whole.column("pressure")
    with pytest.raises(InputError, match="temperature_degC: the model needs it at every sample"):
        whole.followed_by(Inputs(whole.voltage, interval=COARSE))


def test_a_record_is_driven_on_a_clock_that_starts_with_it() -> None:
    record = record_of(40)
    assert record.start == -3.0
    assert record.inputs.time[0] == 0.0
    assert record.inputs.hold == "first"
    assert Record(record.voltage, None, interval=1.0, voltage_is="command").inputs.hold == "zero"
    np.testing.assert_array_equal(record.inputs.column("load_N"), -record.voltage)


def test_a_record_with_other_covariates_is_another_one() -> None:
    record = record_of(40)
    without = Record(record.voltage, record.displacement, interval=COARSE, start=-3.0)
    other = Record(
        record.voltage,
        record.displacement,
        interval=COARSE,
        start=-3.0,
        covariates={"load_N": record.voltage, "temperature_degC": record.voltage},
    )
    assert len({record.sha256, without.sha256, other.sha256}) == 3


@pytest.mark.parametrize("wrong", [np.zeros(9), np.full(10, np.nan), np.zeros((10, 1))])
def test_a_covariate_is_known_at_every_sample(wrong: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"^load_N: "):
        Record(np.arange(10.0), None, interval=1.0, covariates={"load_N": wrong})


# Turning points, times and speeds are the drive's own: noise and sampling rate do not show


INTERVAL = 1e-3


def sine(
    frequency: float = 1.0, duration: float = 10.0, interval: float = INTERVAL, noise: float = 0.0
) -> FloatArray:
    """Return 100 V (samples,) with a measured voltage's noise (sd, V)."""
    time = np.arange(0, duration, interval)
    generator = np.random.default_rng(1)
    voltage: FloatArray = 100 * np.sin(2 * np.pi * frequency * time)
    return voltage + noise * generator.standard_normal(time.size)


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("frequency", [0.5, 1.0, 5.0])
def test_sine_turns_twice_a_period_noise_or_not(frequency: float, noise: float) -> None:
    voltage = sine(frequency, noise=noise)
    expected = (np.arange(20 * frequency) + 0.5) / (2 * frequency)
    turns = turning_points(voltage) * INTERVAL
    assert turns.size == expected.size
    # Noise moves a turn as far as the sine falls by six sds: (2 pi f t)^2 / 2 = 6 sd / 100 V.
    moved = np.sqrt(12 * noise / 100) / (2 * np.pi * frequency)
    np.testing.assert_allclose(turns, expected, atol=INTERVAL + moved)
    assert time_between_turns(voltage, INTERVAL) == pytest.approx(0.5 / frequency, rel=0.15)


@given(
    every=st.integers(1, 20),
    frequency=st.floats(0.2, 2.0),
    duration=st.floats(8.0, 20.0),
    phase=st.floats(0, 1),
)
def test_record_and_its_every_kth_sample_have_the_same_times_and_speeds(
    every: int, frequency: float, duration: float, phase: float
) -> None:
    time = np.arange(0, duration, INTERVAL)
    decay = 1 - 0.5 * time / duration
    voltage = 50 + 50 * decay * np.sin(2 * np.pi * (frequency * time + phase))
    # A turn that comes back by just the least counts in the one and not in the other.
    least = RETURN * float(np.ptp(voltage))
    fewer, more = (turning_points(voltage, part * least) for part in (1.02, 0.98))
    assume(fewer.size == more.size)
    whole = time_between_turns(voltage, INTERVAL)
    thinned = time_between_turns(voltage[::every], every * INTERVAL)
    assert thinned == pytest.approx(whole, abs=2 * every * INTERVAL)
    speeds = [fastest(voltage[::k], k * INTERVAL, 0.05 / frequency) for k in (1, every)]
    assert speeds[1] == pytest.approx(speeds[0], rel=0.1)


@pytest.mark.parametrize(
    "voltage", [np.zeros(1000), np.arange(1000.0), -np.arange(1000.0), np.repeat([0.0, 9.0], 500)]
)
def test_without_a_turn_the_time_is_the_length(voltage: FloatArray) -> None:
    assert time_between_turns(voltage, INTERVAL) == pytest.approx(0.999)


def test_windows_alone_count_each_with_its_own_turns_and_rest_before_a_drive_does_not() -> None:
    assert time_between_turns(np.zeros(1), INTERVAL) == INTERVAL
    rested = np.concatenate([np.zeros(3000), sine()])
    assert time_between_turns(rested, INTERVAL) == pytest.approx(0.5, rel=0.02)
    voltage = np.concatenate([sine(1.0, 5.0), sine(10.0, 5.0)])
    slow, fast = slice(0, 5000), slice(5000, 10000)
    assert time_between_turns(voltage, INTERVAL, [slow]) == pytest.approx(0.5)
    assert time_between_turns(voltage, INTERVAL, [fast]) == pytest.approx(0.05)


def test_fastest_is_the_largest_slope_and_noise_counts_for_little() -> None:
    slope = 2 * np.pi * 100
    assert fastest(sine(), INTERVAL, 0.02) == pytest.approx(slope, rel=0.01)
    assert fastest(sine(noise=0.3), INTERVAL, 0.05) == pytest.approx(slope, rel=0.1)
    assert fastest(np.zeros(10), INTERVAL, 0.02) == 0


def test_plateaus_belong_to_the_stretch_that_leads_to_them() -> None:
    voltage = np.array([1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 0.0, 0.0, 1.0, 1.0])
    assert [(0, 5, 1.0), (5, 7, -1.0), (7, 9, 1.0)] == list(monotone_stretches(voltage))


@given(
    steps=st.lists(st.integers(-2, 2), max_size=60), longest=st.one_of(st.none(), st.integers(1, 9))
)
def test_stretches_partition_the_record(steps: list[int], longest: int | None) -> None:
    voltage = np.cumsum([0.0, *steps])
    stretches = list(monotone_stretches(voltage, longest))
    edges = [0, *(stretch.last for stretch in stretches)]
    assert edges[:-1] == [stretch.first for stretch in stretches]
    assert voltage.size - 1 == edges[-1]
    for first, last, direction in stretches:
        assert (direction * np.diff(voltage[first : last + 1]) >= 0).all()
        assert 1 <= last - first <= (longest or voltage.size)
    if longest is None:
        assert all(one.direction == -two.direction for one, two in pairwise(stretches))
