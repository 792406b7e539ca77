"""The signals do what the paper's text means, and the parts keep their shapes."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bwbayes.data.waveforms import (
    Carrier,
    Decay,
    Multisine,
    Sine,
    Staircase,
    Triangle,
    Waveform,
    signal,
    signal_names,
)
from bwbayes.errors import InputError

RATE = 1000.0

amplitudes = st.floats(0.1, 200.0)
frequencies = st.floats(0.01, 50.0)
phases = st.floats(-10.0, 10.0)


def paper_identification(t: float) -> float:
    """Equations (1)-(4), read as the text means them, one time at a time."""
    if t <= 0.5:
        return 0.0
    q = max(t - 4.0, 0.0)
    return 100.0 * math.sin(2.0 * math.pi * t) * max(1.0 - 0.1 * q, 0.0)


def paper_verification(t: float) -> float:
    """Section 4.2 with the assumed decay of 0.05 per second."""
    if t <= 5.0:
        return 0.0
    return 100.0 * math.sin(0.2 * math.pi * t) * max(1.0 - 0.05 * max(t - 25.0, 0.0), 0.0)


@pytest.mark.parametrize(
    ("name", "printed", "samples"),
    [
        ("identification", paper_identification, 16_000),
        ("verification", paper_verification, 50_000),
    ],
)
def test_the_papers_signals_are_its_equations_at_every_sample(
    name: str, printed: Callable[[float], float], samples: int
) -> None:
    time, voltage = signal(name).sample(RATE)
    assert (samples, samples) == (time.size, voltage.size)
    np.testing.assert_array_equal(np.arange(samples) / RATE, time)
    np.testing.assert_allclose([printed(t) for t in time], voltage, rtol=0, atol=2e-11)


def test_identification_rests_then_goes_down_first_to_minus_100_volts() -> None:
    wave = signal("identification")
    np.testing.assert_array_equal(np.zeros(500), wave(np.arange(500) / RATE))
    np.testing.assert_allclose([-100.0, 100.0], wave([0.75, 1.25]), rtol=1e-14)
    assert wave([0.501])[0] < -0.6


def test_identification_stays_at_zero_from_14_seconds_on() -> None:
    time, voltage = signal("identification").sample(RATE)
    np.testing.assert_array_equal(np.zeros(2000), voltage[time >= 14.0])
    assert np.abs(voltage[13_990:13_999]).min() > 0.0


def test_identification_amplitude_halves_after_five_seconds_of_decay() -> None:
    # 9.25 s is a crest: 100 V (1 - 0.1 (9.25 - 4)).
    np.testing.assert_allclose(47.5, signal("identification")([9.25])[0], rtol=1e-13)


def test_verification_goes_down_first_and_ends_at_zero() -> None:
    wave = signal("verification")
    np.testing.assert_allclose([-100.0, 100.0, -100.0], wave([7.5, 12.5, 17.5]), rtol=1e-14)
    np.testing.assert_array_equal(np.zeros(3), wave([45.0, 47.3, 49.999]))


@pytest.mark.parametrize(("name", "height"), [("step10", 10.0), ("step50", 50.0), ("step100", 100)])
def test_steps_rise_at_one_second(name: str, height: float) -> None:
    time, voltage = signal(name).sample(RATE)
    np.testing.assert_array_equal(np.where(time < 1.0, 0.0, height), voltage)


@pytest.mark.parametrize("name", ["identification", "verification"])
def test_the_papers_sines_have_no_jump_at_their_joints(name: str) -> None:
    wave = signal(name)
    for joint in (0.5, 4.0, 5.0, 14.0, 25.0, 45.0):
        before, at, after = wave([joint - 1e-9, joint, joint + 1e-9])
        np.testing.assert_allclose([at, at], [before, after], rtol=0, atol=1e-6)


def test_every_listed_name_is_a_signal() -> None:
    expected = ("identification", "verification", "step10", "step50", "step100")
    assert expected == signal_names()
    assert all(isinstance(signal(name), Waveform) for name in signal_names())


def test_an_unknown_name_is_answered_with_the_nearest_and_all_known() -> None:
    with pytest.raises(InputError) as caught:
        signal("verificaton")
    text = str(caught.value)
    assert "'verificaton'" in text
    assert "did you mean 'verification'?" in text
    assert all(name in text for name in signal_names())
    assert "\n" not in text


@settings(deadline=None)
@given(amplitudes, frequencies, phases)
def test_a_triangle_has_the_extremes_and_zeros_of_its_sine(
    amplitude: float, frequency: float, phase: float
) -> None:
    # Times from the start at which the sine's phase is a multiple of a quarter turn.
    quarters = np.arange(8.0, 20.0)
    times = (quarters * np.pi / 2 - phase) / (2 * np.pi * frequency)
    sine, triangle = Sine(amplitude, frequency, phase), Triangle(amplitude, frequency, phase)
    np.testing.assert_allclose(sine(times), triangle(times), rtol=0, atol=1e-10 * amplitude)


@settings(deadline=None)
@given(amplitudes, frequencies, phases)
def test_a_triangle_is_straight_between_its_corners(
    amplitude: float, frequency: float, phase: float
) -> None:
    # From a crest to the next trough, in twenty equal parts.
    parts = np.linspace(0.0, 0.5, 21)
    times = (parts + 4.25 - phase / (2 * np.pi)) / frequency
    voltage = Triangle(amplitude, frequency, phase)(times)
    expected = np.linspace(amplitude, -amplitude, 21)
    np.testing.assert_allclose(expected, voltage, rtol=0, atol=1e-10 * amplitude)


@settings(deadline=None)
@given(st.lists(st.floats(-100, 100), min_size=1, max_size=8), st.integers(1, 300))
def test_a_staircase_holds_each_level_for_its_dwell_and_the_last_for_good(
    levels: list[float], held: int
) -> None:
    carrier = Staircase(tuple(levels), dwell=held / RATE)
    voltage = carrier(np.arange(held * (len(levels) + 2)) / RATE)
    expected = np.repeat([*levels, levels[-1], levels[-1]], held)
    np.testing.assert_array_equal(expected, voltage)


def test_a_staircase_goes_up_and_down_in_equal_steps() -> None:
    expected = (0.0, 5.0, 10.0, 5.0, 0.0)
    assert expected == Staircase.up_and_down(10.0, 2, 0.1).levels


@settings(deadline=None)
@given(st.lists(st.integers(1, 40), min_size=1, max_size=10, unique=True), amplitudes)
def test_a_flat_multisine_has_equal_lines_at_its_frequencies_and_nothing_else(
    bins: list[int], amplitude: float
) -> None:
    wave = Multisine.flat(amplitude, tuple(float(f) for f in bins))
    voltage = wave(np.arange(100) / 100.0)
    spectrum = np.abs(np.fft.rfft(voltage)) / 50.0
    expected = np.zeros(51)
    expected[bins] = amplitude / len(bins)
    np.testing.assert_allclose(expected, spectrum, rtol=0, atol=1e-10 * amplitude)
    assert np.abs(voltage).max() <= amplitude * (1 + 1e-12)


def test_schroeders_phases_halve_the_crest_of_sines_in_phase() -> None:
    frequencies = tuple(float(f) for f in range(1, 17))
    time = np.arange(2000) / 2000.0
    flat = np.abs(Multisine.flat(16.0, frequencies)(time)).max()
    cosines = sum(np.cos(2 * np.pi * f * time) for f in frequencies)
    assert 0.5 * np.abs(cosines).max() > flat


@settings(deadline=None)
@given(st.floats(0, 5), st.floats(0, 3), st.sampled_from(["linear", "exponential"]))
def test_a_decay_starts_at_one_never_rises_and_never_turns_negative(
    start: float, rate: float, kind: str
) -> None:
    factor = Decay(start, rate, "linear" if kind == "linear" else "exponential")(
        np.linspace(0.0, 20.0, 401)
    )
    np.testing.assert_array_equal(1.0, factor[0])
    assert factor.min() >= 0.0
    assert (np.diff(factor) <= 0.0).all()


def test_decays_follow_their_laws() -> None:
    time = np.array([0.0, 1.0, 2.0, 4.0, 9.0])
    np.testing.assert_allclose([1, 1, 0.75, 0.25, 0], Decay(1.0, 0.25)(time), rtol=1e-15)
    expected = np.exp([0, 0, -0.25, -0.75, -2.0])
    np.testing.assert_allclose(expected, Decay(1.0, 0.25, "exponential")(time), rtol=1e-15)


@settings(deadline=None)
@given(st.floats(-50, 50), st.floats(0, 2), st.floats(0, 2))
def test_a_waveform_is_its_bias_before_the_start_and_carrier_times_decay_after(
    bias: float, start: float, rate: float
) -> None:
    carrier, decay = Sine(30.0, 1.3, 0.4), Decay(0.7, rate, "exponential")
    time, voltage = Waveform(carrier, 3.0, start, decay, bias).sample(RATE)
    for k in (0, 700, 1100, 1999, 2999):
        t = time[k]
        shape = 30.0 * math.sin(2 * math.pi * 1.3 * (t - start) + 0.4)
        fade = math.exp(-rate * max(t - 0.7, 0.0))
        expected = bias if t < start else bias + shape * fade
        np.testing.assert_allclose(expected, voltage[k], rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("build", "named"),
    [
        (lambda: Sine(1.0, 0.0), "sine: frequency"),
        (lambda: Sine(1.0, -2.0), "sine: frequency"),
        (lambda: Sine(math.nan, 1.0), "sine: amplitude"),
        (lambda: Sine(1.0, 1.0, math.inf), "sine: phase"),
        (lambda: Triangle(1.0, math.inf), "triangle: frequency"),
        (lambda: Staircase((), 1.0), "staircase: levels"),
        (lambda: Staircase((1.0, math.nan), 1.0), "staircase: levels"),
        (lambda: Staircase((1.0,), 0.0), "staircase: dwell"),
        (lambda: Staircase.up_and_down(1.0, 0, 1.0), "staircase: steps"),
        (lambda: Multisine(()), "multisine: sines"),
        (lambda: Multisine.flat(1.0, ()), "multisine: sines"),
        (lambda: Multisine.flat(1.0, (1.0, -1.0)), "sine: frequency"),
        (lambda: Decay(0.0, -0.1), "decay: rate"),
        (lambda: Decay(math.nan, 0.1), "decay: start"),
        (lambda: Waveform(Sine(1.0, 1.0), 0.0), "waveform: duration"),
        (lambda: Waveform(Sine(1.0, 1.0), 1.0, start=-0.1), "waveform: start"),
        (lambda: Waveform(Sine(1.0, 1.0), 1.0, start=1.0), "waveform: start"),
        (lambda: Waveform(Sine(1.0, 1.0), 1.0, bias=math.nan), "waveform: bias"),
        (lambda: Waveform(Sine(1.0, 1.0), 1.0).sample(0.0), "sampling: rate"),
        (lambda: Waveform(Sine(1.0, 1.0), 0.001).sample(100.0), "sampling: 0.001 s"),
        (lambda: Waveform(Sine(1.0, 1.0), 1e5).sample(101.0), "sampling: 100000 s at 101 Hz"),
        (lambda: Waveform(Sine(1.0, 1.0), 1e300).sample(1e300), "sampling: 1e+300 s"),
    ],
)
def test_impossible_values_are_named_in_one_line(build: Callable[[], object], named: str) -> None:
    with pytest.raises(InputError) as caught:
        build()
    assert str(caught.value).startswith(named)
    assert "\n" not in str(caught.value)


def test_a_decay_of_unknown_kind_is_refused() -> None:
    with pytest.raises(InputError, match="decay: kind: no 'cubic'"):
        Decay(0.0, 1.0, "cubic")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "carrier",
    [
        Sine(1.0, 50.0),
        Triangle(1.0, 50.0),
        Staircase((0.0, 1.0), dwell=0.01),
        Multisine.flat(1.0, (3.0, 50.0)),
    ],
)
def test_sampling_at_twice_the_highest_frequency_is_refused(carrier: Carrier) -> None:
    wave = Waveform(carrier, duration=1.0)
    with pytest.raises(InputError, match=r"100 Hz cannot resolve 50 Hz"):
        wave.sample(100.0)
    expected = 101
    assert expected == wave.sample(101.0)[1].size


def test_a_step_can_be_sampled_at_any_rate() -> None:
    expected = 11
    assert expected == signal("step10").sample(1.0)[0].size
