"""Quantiles along a record against those worked out at every sample.

The records have turning points, steps, single outliers and noise of any size, and the models
dynamics or none: smooth ones are interpolated, the others have to be recognised.
"""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.model.actuator import Actuator
from bwbayes.results import along, mixture

PROBABILITIES = np.array([0.025, 0.05, 0.25, 0.75, 0.95, 0.975])
PROMISED = 2e-4
SAMPLES = 500
DRAWS = 211  # so that no probability falls between two draws exactly
INTERVAL = 2e-3

VALUES = {
    "d": 0.7,
    "alpha": 0.3575,
    "beta": 0.0272,
    "gamma": 0.0172,
    "exponent": 1.0,
    "initial": 0.0,
    "lag": 0.004,
    "offset": 5.0,
}

VOLTAGES = (
    "sine",
    "two sines",
    "triangle",
    "steps",
    "held steps",
    "outliers",
    "a little noise",
    "much noise",
    "noise alone",
    "constant",
)


def voltage(name: str) -> FloatArray:
    generator = np.random.default_rng(2)
    time = np.arange(SAMPLES) * INTERVAL
    sine = 80 * np.sin(2 * np.pi * 1.5 * time)
    noise = generator.standard_normal(SAMPLES)
    slow = 40 + 10 * time
    path: FloatArray = {
        "sine": sine,
        "two sines": sine + 30 * np.sin(2 * np.pi * 7 * time),
        "triangle": 80 * np.abs((2.3 * time) % 2 - 1),
        "steps": np.repeat(generator.uniform(-90, 90, 10), SAMPLES // 10),
        "held steps": sine[np.arange(SAMPLES) // 8 * 8],
        "outliers": slow + 30 * (np.arange(SAMPLES) % 397 == 303),
        "a little noise": sine + 0.02 * noise,
        "much noise": sine + 3 * noise,
        "noise alone": 50 * noise,
        "constant": np.full(SAMPLES, 30.0),
    }[name]
    return path


def simulated(path: FloatArray, dynamics: str) -> FloatArray:
    """Simulate draws that differ by some per cent, with a heavy tail: (draws, samples)."""
    actuator = Actuator(dynamics, "first", INTERVAL)
    centre = np.array([VALUES[name] for name in actuator.parameters])
    generator = np.random.default_rng(5)
    spread = 0.03 * np.exp(0.4 * generator.standard_normal((DRAWS, centre.size)))
    theta = centre * (1 + spread * generator.standard_normal(spread.shape))
    theta[:, actuator.parameters.index("exponent")] = 1.0
    return actuator.displacement(theta, path)


def noise(sd: float) -> FloatArray:
    """Sds of all draws, spread by a fifth."""
    drawn: FloatArray = sd * np.exp(0.2 * np.random.default_rng(6).standard_normal(DRAWS))
    return drawn


def errors(means: FloatArray, sds: FloatArray) -> FloatArray:
    """Errors of quantiles and spread in units of the mixture's sd, (q + 1, samples)."""
    sd = np.sqrt(means.var(axis=0) + (sds**2).mean())
    exact = np.vstack(mixture.quantiles_and_spread(means, sds, PROBABILITIES))
    result = np.vstack(along.quantiles_and_spread(means, sds, PROBABILITIES))
    difference: FloatArray = np.abs(result - exact) / sd
    return difference


def worked_out(means: FloatArray, sds: FloatArray) -> float:
    """Part of the samples at which the shape is worked out."""
    with patch.object(
        mixture, "quantiles_and_spread", wraps=mixture.quantiles_and_spread
    ) as called:
        along.quantiles_and_spread(means, sds, PROBABILITIES)
    counts = [int(call.args[0].shape[1]) for call in called.call_args_list]
    return float(sum(counts) / means.shape[1])


@pytest.mark.parametrize(("dynamics", "sd"), [("none", 0.7), ("lag", 0.7), ("lag", 0.05)])
@pytest.mark.parametrize("name", VOLTAGES)
def test_the_error_is_below_what_is_promised(name: str, dynamics: str, sd: float) -> None:
    got = errors(simulated(voltage(name), dynamics), noise(sd))
    assert got.max() < PROMISED
    assert np.sqrt(np.mean(got**2)) < 0.1 * PROMISED


def skewed_once() -> FloatArray:
    """Gaussian draws whose distribution is skewed at one sample, which is no interval's middle."""
    generator = np.random.default_rng(7)
    means = np.tile(generator.standard_normal((DRAWS, 1)), 200)
    means[:, 85] = np.exp(means[:, 85])
    return means


def test_one_sample_of_another_shape_is_found_by_its_moments() -> None:
    assert errors(skewed_once(), noise(0.7)).max() < PROMISED


def test_it_would_not_be_found_without_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """So the test above can fail."""
    monkeypatch.setattr(along, "SKEWNESS_MOVES", 0.0)
    monkeypatch.setattr(along, "KURTOSIS_MOVES", 0.0)
    assert errors(skewed_once(), noise(0.7)).max() > 100 * PROMISED


@pytest.mark.parametrize("kind", ["skewed", "heavy"])
def test_one_sample_whose_means_go_with_the_sds_is_found(kind: str) -> None:
    """Draws have the same means at all samples, and at one of them wide draws have the far means.

    On one side that is skewness, on both it is kurtosis; means alone, or sds alone, show neither.
    """
    sign, wide = np.tile([1.0, -1.0], 100), np.repeat([False, True], 100)
    far = wide if kind == "heavy" else wide == (sign > 0)
    means = np.tile(sign * np.tile(np.repeat([0.2, 1.0], 50), 2), (200, 1)).T
    means[:, 85] = sign * np.where(far, 1.0, 0.2)
    np.testing.assert_array_equal(np.sort(means[:, 0]), np.sort(means[:, 85]))
    assert errors(means, np.where(wide, 1.5, 0.2)).max() < PROMISED


def test_without_a_tolerance_every_promise_above_would_be_broken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Intervals that are never halved miss the shape: the records above do put it to the test."""
    monkeypatch.setattr(along, "TOLERANCE", np.inf)
    for name in ("sine", "triangle", "steps", "outliers", "much noise"):
        assert errors(simulated(voltage(name), "lag"), noise(0.7)).max() > 5 * PROMISED


def test_a_smooth_record_is_worked_out_at_one_sample_in_sixteen() -> None:
    got = worked_out(simulated(voltage("sine")[:161], "lag"), noise(40.0))
    assert pytest.approx(11 / 161) == got


def test_no_sample_is_worked_out_twice() -> None:
    for name in ("steps", "noise alone"):
        assert worked_out(simulated(voltage(name), "none"), noise(0.05)) <= 1


@pytest.mark.parametrize("samples", [1, 2, 3, 32, 33, 34, 65])
def test_any_number_of_samples_will_do(samples: int) -> None:
    means = simulated(voltage("sine"), "lag")[:, 100 : 100 + samples]
    assert errors(means, noise(0.7)).max() < PROMISED


def test_without_sds_nothing_is_interpolated() -> None:
    assert errors(simulated(voltage("sine"), "lag"), np.zeros(DRAWS)).max() == 0


def test_the_spread_of_one_gaussian_is_its_sd_over_the_root_of_pi() -> None:
    means = np.tile(voltage("sine"), (100, 1))
    got = along.quantiles_and_spread(means, np.full(100, 0.3), PROBABILITIES)[1]
    np.testing.assert_allclose(0.3 / np.sqrt(np.pi), got, rtol=1e-5)
