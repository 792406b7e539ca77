"""A clean voltage comes back bit for bit, and of a noisy one the reversals that are real."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.record import Record, read_record
from bwbayes.record.voltage_path import estimate_path, turns, with_corners
from bwbayes.record.waveforms import signal, signal_names
from tests.record.drives import DRIVES, drive

STACK = Path(__file__).resolve().parents[3] / "shared" / "data" / "picma_stack_open_loop.csv"

KINDS = st.sampled_from(sorted(DRIVES))
SEEDS = st.integers(0, 10_000)


def noisy(clean: FloatArray, sd: float, seed: int) -> FloatArray:
    return clean + sd * np.random.default_rng([1, seed]).standard_normal(clean.size)


def length(voltage: FloatArray) -> float:
    return float(np.sum(np.abs(np.diff(voltage))))


@given(
    KINDS,
    SEEDS,
    st.sampled_from([50.0, 200.0, 1000.0, 4000.0]),
    st.sampled_from([0, 8, 10, 12, 16]),
    st.sampled_from([1e-3, 1.0, 90.0]),
    st.floats(-2, 2),
)
def test_a_clean_voltage_comes_back_bit_for_bit(
    kind: str, seed: int, rate: float, bits: int, scale: float, shift: float
) -> None:
    """At any rate and phase, as it is or as a DAC of 8 to 16 bits makes it; without a remark."""
    voltage = drive(kind, rate, np.random.default_rng(seed))
    if bits:
        voltage = np.rint(voltage * 2**bits) / 2**bits
    voltage = scale * (voltage + shift)
    path = estimate_path(voltage)
    np.testing.assert_array_equal(path.voltage, voltage)
    assert not path.remark


@given(
    st.lists(st.floats(5.0, 60.0), min_size=2, max_size=8),
    st.floats(0.01, 0.99),
    st.floats(0.1, 1.0),
    st.sampled_from([1e-3, 1.0, 90.0]),
    st.floats(-2, 2),
)
def test_a_voltage_reaches_its_corners_between_samples(
    spans: list[float], first: float, ratio: float, scale: float, shift: float
) -> None:
    """At corners as far apart as 5 samples, of lines of any two slopes, and in any unit.

    The nearest sample is at the corner then, and no other one has moved. Read backwards, the
    voltage has the same corners.
    """
    times = first + np.cumsum([0.0, *spans])
    slopes = np.resize([1.0, -ratio], len(spans))
    corners = np.concatenate([[0.0], np.cumsum(slopes * spans)])
    samples = np.arange(np.ceil(times[0]), np.floor(times[-1]) + 1)
    voltage = scale * (np.interp(samples, times, corners) + shift)
    turned, position = scale * (corners + shift), times - samples[0]
    expected = voltage.copy()
    for time, corner in zip(position[1:-1], turned[1:-1], strict=True):
        assume(abs(time % 1 - 0.5) > 1e-6)  # else two samples are nearest
        if 1 <= time <= voltage.size - 2:  # a line needs two samples
            expected[round(time)] = corner
    extent = np.ptp(turned)
    np.testing.assert_allclose(with_corners(voltage), expected, rtol=0, atol=1e-9 * extent)
    backwards = with_corners(voltage[::-1])[::-1]
    np.testing.assert_allclose(backwards, expected, rtol=0, atol=1e-9 * extent)


@given(
    st.sampled_from([kind for kind in sorted(DRIVES) if kind != "triangle"]),
    SEEDS,
    st.sampled_from([200.0, 1000.0, 4000.0]),
)
def test_other_extremes_than_corners_stay_as_they_are(kind: str, seed: int, rate: float) -> None:
    """Of whatever is round, held, or rises within a sample."""
    voltage = drive(kind, rate, np.random.default_rng(seed))
    np.testing.assert_array_equal(with_corners(voltage), voltage)


@given(
    SEEDS,
    st.sampled_from([200.0, 1000.0, 4000.0]),
    st.floats(0.002, 0.02),
    st.sampled_from([50, 60]),
)
def test_hum_is_real(seed: int, rate: float, size: float, frequency: int) -> None:
    """It moves the actuator: a clean voltage with mains hum comes back bit for bit."""
    voltage = drive("sine", rate, np.random.default_rng(seed))
    voltage += size * np.sin(2 * np.pi * frequency / rate * np.arange(voltage.size))
    np.testing.assert_array_equal(estimate_path(voltage).voltage, voltage)


def test_hum_stays_where_noise_is_removed() -> None:
    rng = np.random.default_rng(3)
    hum = 0.5 * np.sin(2 * np.pi * 50 / 4000 * np.arange(40_000))
    clean = 90 * drive("sine", 4000.0, rng) + hum
    path = estimate_path(noisy(clean, 0.03, 0))
    assert path.remark
    phase = np.exp(2j * np.pi * 50 / 4000 * np.arange(hum.size))
    assert abs(phase @ (path.voltage - clean)) < 0.1 * abs(phase @ hum)


def test_measured_and_simulated_voltages_come_back() -> None:
    for name in signal_names():
        voltage = signal(name).sample(250.0)[1]
        np.testing.assert_array_equal(estimate_path(voltage).voltage, voltage)
    if not STACK.is_file():
        pytest.skip("the measured record is not part of the project, and not here")
    voltage = read_record(STACK).voltage
    np.testing.assert_array_equal(estimate_path(voltage).voltage, voltage)


@given(KINDS, SEEDS, st.sampled_from([1000.0, 4000.0]), st.sampled_from([3e-4, 1e-3, 3e-3]))
def test_of_a_noisy_voltage_the_real_path_is_left(
    kind: str, seed: int, rate: float, sd: float
) -> None:
    """Its length within 0.5%, or a hundredth of what noise adds; the removed sd within 10%."""
    clean = drive(kind, rate, np.random.default_rng(seed))
    measured = noisy(clean, sd, seed)
    path = estimate_path(measured)
    assert path.noise_sd in (0.0, pytest.approx(sd, rel=0.1))
    excess = length(measured) - length(clean)
    assert abs(length(path.voltage) - length(clean)) < max(0.005 * length(clean), 0.01 * excess)


@given(kind=st.sampled_from(["triangle", "staircase"]), seed=SEEDS)
@example(kind="staircase", seed=10_000)  # whose first sample alone is at the first level
def test_its_reversals_are_the_true_ones(kind: str, seed: int) -> None:
    """Wherever the voltage comes back by ten times the noise's sd, which is known to two of it."""
    sd = 1e-3
    clean = drive(kind, 1000.0, np.random.default_rng(seed))
    path = estimate_path(noisy(clean, sd, seed))
    found = large_turns(path.voltage, 10 * sd)
    assert large_turns(clean, 12 * sd) <= found <= large_turns(clean, 8 * sd)
    # Those that are left beside them are flat.
    assert large_turns(path.voltage, 3 * sd) <= turns(clean)


def large_turns(voltage: FloatArray, threshold: float) -> int:
    count, direction, extreme = 0, 0, voltage[0]
    for value in voltage:
        if direction * (value - extreme) >= 0 and direction:
            extreme = value
        elif abs(value - extreme) > threshold:
            count += direction != 0
            direction, extreme = (1 if value > extreme else -1), value
    return count


@given(KINDS, SEEDS, st.floats(-1e3, 1e3).filter(lambda a: abs(a) > 1e-3), st.floats(-10, 10))
def test_the_path_scales_with_the_voltage(
    kind: str, seed: int, factor: float, shift: float
) -> None:
    measured = noisy(drive(kind, 500.0, np.random.default_rng(seed)), 2e-3, seed)
    path = estimate_path(measured).voltage
    scaled = estimate_path(factor * (measured + shift)).voltage
    np.testing.assert_allclose(scaled, factor * (path + shift), atol=1e-6 * abs(factor))


def test_a_longer_moving_average_does_not_do_it() -> None:
    """The twin: where a triangle turns, an average cuts, and on its way noise is left."""
    clean = drive("triangle", 1000.0, np.random.default_rng(0))
    measured = noisy(clean, 3e-3, 0)
    for width in (5, 15, 51, 151):
        averaged = np.convolve(measured, np.full(width, 1 / width), "valid")
        assert abs(length(averaged) / length(clean) - 1) > 0.005


def test_what_cannot_be_repaired_says_so() -> None:
    rng = np.random.default_rng(0)
    clean = drive("sine", 1000.0, rng)
    assert "do not trust the parameters" in estimate_path(noisy(clean, 0.01, 0)).remark
    assert "do not trust" not in estimate_path(noisy(clean, 0.002, 0)).remark
    coarse = np.rint(noisy(drive("staircase", 1000.0, rng), 2e-3, 0) * 200) / 200
    assert "do not trust the parameters" in estimate_path(coarse).remark
    white = rng.standard_normal(2000)
    path = estimate_path(white)
    assert "too fast" in path.remark
    np.testing.assert_array_equal(path.voltage, white)


def test_commands_and_planned_voltages_have_no_noise() -> None:
    measured = noisy(drive("sine", 1000.0, np.random.default_rng(0)), 2e-3, 0)
    record = Record(measured, measured, interval=1e-3)
    assert record.path.remark
    np.testing.assert_array_equal(record.voltage, measured)
    for exact in (
        Record(measured, measured, interval=1e-3, voltage_is="command"),
        Record(measured, None, interval=1e-3),
    ):
        np.testing.assert_array_equal(exact.path.voltage, measured)
        assert not exact.path.remark


@pytest.mark.parametrize("voltage", [[0.0], [1.0, 2.0], [3.0] * 200, list(range(100))])
def test_short_and_constant_voltages_come_back(voltage: list[float]) -> None:
    np.testing.assert_array_equal(estimate_path(np.array(voltage)).voltage, voltage)
