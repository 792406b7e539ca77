"""The signals do what the paper's text means, and the parts keep their shapes."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.errors import InputError
from bwbayes.record.waveforms import (
    Carrier,
    Waveform,
    signal,
    signal_names,
    sine,
    staircase,
    triangle,
)

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


def test_an_unknown_name_is_answered_with_the_nearest_and_all_known() -> None:
    with pytest.raises(InputError) as caught:
        signal("verificaton")
    text = str(caught.value)
    assert "'verificaton'" in text
    assert "did you mean 'verification'?" in text
    assert all(name in text for name in signal_names())
    assert "\n" not in text


@given(amplitudes, frequencies, phases)
def test_a_triangle_is_straight_between_its_corners(
    amplitude: float, frequency: float, phase: float
) -> None:
    # From a crest to the next trough, in twenty equal parts.
    parts = np.linspace(0.0, 0.5, 21)
    times = (parts + 4.25 - phase / (2 * np.pi)) / frequency
    voltage = triangle(amplitude, frequency, phase).voltage(times)
    expected = np.linspace(amplitude, -amplitude, 21)
    np.testing.assert_allclose(expected, voltage, rtol=0, atol=1e-10 * amplitude)


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=8), st.integers(1, 300))
def test_a_staircase_holds_each_level_for_its_dwell_and_the_last_for_good(
    levels: list[float], held: int
) -> None:
    carrier = staircase(tuple(levels), dwell=held / RATE)
    voltage = carrier.voltage(np.arange(held * (len(levels) + 2)) / RATE)
    expected = np.repeat([*levels, levels[-1], levels[-1]], held)
    np.testing.assert_array_equal(expected, voltage)


@given(st.floats(-50, 50), st.floats(0, 2), st.floats(0, 2))
def test_a_waveform_is_its_bias_before_the_start_and_carrier_times_decay_after(
    bias: float, start: float, rate: float
) -> None:
    carrier = sine(30.0, 1.3, 0.4)
    time, voltage = Waveform(carrier, 3.0, start, rate, 0.7, bias).sample(RATE)
    for k in (0, 700, 1100, 1999, 2999):
        t = time[k]
        shape = 30.0 * math.sin(2 * math.pi * 1.3 * (t - start) + 0.4)
        fade = max(1 - rate * max(t - 0.7, 0.0), 0.0)
        expected = bias if t < start else bias + shape * fade
        np.testing.assert_allclose(expected, voltage[k], rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("build", "named"),
    [
        (lambda: sine(1.0, 0.0), "sine: frequency"),
        (lambda: sine(math.nan, 1.0), "sine: amplitude"),
        (lambda: triangle(1.0, math.inf), "triangle: frequency"),
        (lambda: staircase((), 1.0), "staircase: levels"),
        (lambda: staircase((1.0,), 0.0), "staircase: dwell"),
        (lambda: Waveform(sine(1.0, 1.0), 1.0, decay=-0.1), "waveform: decay"),
        (lambda: Waveform(sine(1.0, 1.0), 0.0), "waveform: duration"),
        (lambda: Waveform(sine(1.0, 1.0), 1.0, start=-0.1), "waveform: start"),
        (lambda: Waveform(sine(1.0, 1.0), 1.0, start=1.0), "waveform: start"),
        (lambda: Waveform(sine(1.0, 1.0), 1.0).sample(0.0), "sampling: rate"),
        (lambda: Waveform(sine(1.0, 1.0), 0.001).sample(100.0), "sampling: 0.001 s"),
        (lambda: Waveform(sine(1.0, 1.0), 1e5).sample(101.0), "sampling: 100000 s at 101 Hz"),
    ],
)
def test_impossible_values_are_named_in_one_line(build: Callable[[], object], named: str) -> None:
    with pytest.raises(InputError) as caught:
        build()
    assert str(caught.value).startswith(named)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "carrier", [sine(1.0, 50.0), triangle(1.0, 50.0), staircase((0.0, 1.0), dwell=0.01)]
)
def test_sampling_at_twice_the_highest_frequency_is_refused(carrier: Carrier) -> None:
    wave = Waveform(carrier, duration=1.0)
    with pytest.raises(InputError, match=r"100 Hz cannot resolve 50 Hz"):
        wave.sample(100.0)
    expected = 101
    assert expected == wave.sample(101.0)[1].size
