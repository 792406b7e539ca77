"""A thinned record: its path, its readings, and that what is searched in it is found in all."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.inference import map_estimate
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.mode_finding import Mode, refine
from bwbayes.inference.noise import noise_model
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.thinning import (
    beginning,
    displacement,
    thin,
    thin_posterior,
    thin_windows,
    with_residuals_of,
)
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Inputs
from tests.inference.problems import (
    INTERVAL,
    decaying_sine,
    posterior_of,
    ring_bender,
    short_posterior,
    truth,
)


def record_of(voltage: FloatArray) -> Likelihood:
    actuator, noise = Actuator("none", "first", INTERVAL), noise_model("white", INTERVAL)
    inputs = Inputs(voltage, interval=INTERVAL)
    return Likelihood(inputs, np.zeros(voltage.size), (slice(0, voltage.size),), actuator, noise)


@given(
    voltage=st.lists(st.integers(-50, 50), min_size=2, max_size=200).map(
        lambda levels: np.repeat(np.array(levels, dtype=float), 3)
    ),
    stride=st.integers(2, 7),
)
def test_the_voltage_is_one_that_the_record_has_nearby(voltage: FloatArray, stride: int) -> None:
    """So that none is beyond its range, and the hysteresis gets no reversal that was not there."""
    short = thin(record_of(voltage), stride)
    for sample, value in enumerate(short.voltage):
        nearby = voltage[max((sample - 1) * stride + 1, 0) : (sample + 1) * stride]
        assert value in nearby
        ahead = voltage[sample * stride]
        assert value == ahead or value in (nearby.min(), nearby.max())


@given(
    amplitudes=st.lists(st.floats(0.1, 50.0), min_size=1, max_size=9),
    samples=st.integers(1, 60),
    first=st.integers(0, 30),
)
def test_a_long_record_begins_until_its_voltage_has_been_nearly_everywhere(
    amplitudes: list[float], samples: int, first: int
) -> None:
    """And so many samples on, with all of its readings there; a short one is whole."""
    phase = 2 * np.pi * np.arange(40) / 40
    voltage = np.concatenate([amplitude * np.sin(phase) for amplitude in amplitudes])
    moved = np.random.default_rng(1).normal(size=voltage.size)
    moved[:first] = moved[::5] = np.nan
    windows = (slice(0, 25), slice(30, voltage.size))
    actuator = Actuator("none", "first", INTERVAL)
    whole = posterior_of(voltage, moved, actuator, "white", training=windows)
    short = beginning(whole, samples)
    before, after = (each.single_record.readings for each in (whole, short))
    everywhere = next(
        last for last in range(voltage.size) if np.ptp(voltage[: last + 1]) >= 0.9 * np.ptp(voltage)
    )
    last = max(everywhere, before.rows[0]) + samples
    if before.samples <= max(last, 2 * samples):
        assert short is whole
        return
    np.testing.assert_array_equal(after.rows, before.rows[before.rows < last])
    np.testing.assert_array_equal(after.values, before.values[: after.rows.size])


@given(periods=st.floats(1.0, 12.0), decay=st.floats(0.0, 0.9), stride=st.integers(2, 10))
def test_the_reversals_of_a_drive_stay(periods: float, decay: float, stride: int) -> None:
    """At any sample: the operator remembers what it remembers of the whole record."""
    along = np.linspace(0.0, 1.0, 2000)
    voltage = 100 * np.sin(2 * np.pi * periods * along) * (1 - decay * along)
    rising = np.sign(np.diff(voltage))
    turns = voltage[1:-1][rising[1:] != rising[:-1]]
    short = thin(record_of(voltage), stride).voltage
    assert set(turns[:-1]) <= set(short)


@given(
    windows=st.lists(st.integers(0, 300), min_size=2, max_size=6, unique=True).map(sorted),
    stride=st.integers(1, 9),
)
def test_windows_hold_the_same_samples(windows: list[int], stride: int) -> None:
    slices = [slice(*pair) for pair in zip(windows[::2], windows[1::2], strict=False)]
    kept = np.arange(0, 300, stride)
    for window, short in zip(slices, thin_windows(slices, stride), strict=True):
        inside = (kept >= window.start) & (kept < window.stop)
        assert kept[short].tolist() == kept[inside].tolist()


def test_a_thinned_record_is_left_the_residuals_of_the_whole() -> None:
    whole = short_posterior(samples=2000, dynamics="lag")
    theta = truth(whole)
    short = thin_posterior(whole, theta, 250)
    assert 250 == short.single_record.voltage.size
    corrected = with_residuals_of(short, whole, theta)
    residuals = [
        posterior.single_record.displacement
        - displacement(posterior, posterior.single_record, theta)[0]
        for posterior in (whole, corrected, short)
    ]
    np.testing.assert_allclose(residuals[1], residuals[0][::8], atol=1e-9)
    # Without it there is an error: the lag follows another drive between the samples.
    assert np.max(np.abs(residuals[2] - residuals[0][::8])) > 1e-3


@pytest.mark.parametrize(
    ("periods", "every", "first", "samples"),
    [
        (4.0, 1, 0, 250),
        (30.0, 1, 0, 1000),
        (300.0, 1, 0, 2000),
        (4.0, 4, 0, 667),
        (4.0, 8, 3, 2000),
    ],
    ids=["slow", "faster", "too fast", "every fourth reading", "readings in between"],
)
def test_a_record_is_thinned_as_far_as_its_displacement_allows(
    periods: float, every: int, first: int, samples: int
) -> None:
    """And as its readings do: most of them may be at the samples that would go."""
    actuator = Actuator("lag", "first", INTERVAL)
    voltage = decaying_sine(2000, periods)
    readings = ring_bender(actuator, "white", voltage, 1)
    readings[np.arange(2000) % every != first] = np.nan
    whole = posterior_of(voltage, readings, actuator, "white")
    short = thin_posterior(whole, truth(whole), 250)
    assert samples == short.single_record.voltage.size
    assert (short is whole) is (samples == 2000)


def test_what_is_searched_in_a_thinned_record_is_found_on_the_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The mode and its curvature are those that a search in the whole record finds."""
    whole = replace(short_posterior(samples=4000, dynamics="lag"), engine="numba")
    slow = map_estimate.fit(whole, np.random.default_rng(1))
    searched: list[int] = []

    def noted(posterior: Posterior, *arguments: object) -> Posterior:
        short = thin_posterior(posterior, *arguments)  # type: ignore[arg-type]
        searched.append(short.single_record.voltage.size)
        return short

    monkeypatch.setattr(map_estimate, "SAMPLES", 500)
    monkeypatch.setattr(map_estimate, "thin_posterior", noted)
    fast = map_estimate.fit(whole, np.random.default_rng(1))
    assert [500, 500] == searched
    sds = np.sqrt(np.diag(slow.covariance))
    np.testing.assert_allclose(fast.mode / sds, slow.mode / sds, atol=0.02)
    np.testing.assert_allclose(np.sqrt(np.diag(fast.covariance)) / sds, 1.0, atol=0.02)


def test_a_whole_record_is_climbed_from_near_its_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thinning moves the mode by hundreds of its sds, and the climb begins without that.

    A start that is only as unsure as its readings, every eighth of nine parameters, is about
    sqrt(8 * 9) sds away; three times that is beyond chance.
    """
    voltage, actuator = decaying_sine(8000, 30.0), Actuator("lag", "first", INTERVAL)
    readings = ring_bender(actuator, "white", voltage, 1)
    posterior = posterior_of(voltage, readings, actuator, "discrepancy")
    clean = displacement(posterior, posterior.single_record, truth(posterior))[0]
    readings = clean + np.random.default_rng(2).normal(0.0, 0.02, voltage.size)
    whole = replace(posterior_of(voltage, readings, actuator, "discrepancy"), engine="numba")
    starts, ends = dict[bool, FloatArray](), dict[bool, FloatArray]()

    def noted(searched: Posterior, start: FloatArray, covariance: FloatArray) -> Mode:
        mode = refine(searched, start, covariance)
        starts[searched is whole], ends[searched is whole] = start, mode.coordinates
        return mode

    monkeypatch.setattr(map_estimate, "SAMPLES", 1000)
    monkeypatch.setattr(map_estimate, "refine", noted)
    point = map_estimate.fit(whole, np.random.default_rng(1))
    sds = np.linalg.cholesky(point.covariance)
    of_thinned, begun = (
        float(np.linalg.norm(np.linalg.solve(sds, place - point.mode)))
        for place in (ends[False], starts[True])
    )
    assert of_thinned > 100
    assert begun < 3 * np.sqrt(8 * point.mode.size)


def test_a_short_record_is_fitted_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the bit, whatever is looked at of a longer one."""
    posterior = short_posterior(samples=400)
    modes = []
    for samples in (201, 100_000):
        monkeypatch.setattr(map_estimate, "SAMPLES", samples)
        modes.append(map_estimate.fit(posterior, np.random.default_rng(1)).mode)
    np.testing.assert_array_equal(modes[0], modes[1])
