"""Lines of the residual's spectrum are found and named, and noise of any color has none.

Hum of 0.4 sds in 2,000 to 8,000 readings is found in 95 of 100 records or more, and named by its
frequency; of records without lines one in 100 shows one at most, whatever its noise.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.inference import pointfit
from bwbayes.inference.noise import WhiteNoise
from bwbayes.inference.rough import DiscrepancyNoise
from bwbayes.results.innovations import Innovations, departures, innovations, numbers
from bwbayes.results.spectrum import ResidualSpectrum, residual_spectrum, without_lines
from tests.inference.problems import INTERVAL, short_posterior


def spectrum_of(
    white: FloatArray, interval: float, drive: float = 1.0, present: BoolArray | None = None
) -> ResidualSpectrum:
    """Return the spectrum of innovations of half a micrometer each, along a decaying sine."""
    time = interval * np.arange(white.size, dtype=np.float64)
    voltage = 75 * np.sin(2 * np.pi * drive * time) * np.exp(-0.1 * time)
    rows = np.flatnonzero(present) if present is not None else slice(None)
    residual = 0.5 * white[rows]
    return residual_spectrum(7.0 + time[rows], interval, residual, white[rows], voltage[rows])


def hum(samples: int, interval: float, frequency: float, rng: np.random.Generator) -> FloatArray:
    """Return noise of one sd with an oscillation of 0.4 sds."""
    time = interval * np.arange(samples)
    phase = rng.uniform(0, 2 * np.pi)
    return rng.normal(size=samples) + 0.4 * np.sin(2 * np.pi * frequency * time + phase)


# Sampling rate, true frequency, the one that is seen, and what it is called.
HUMS = [
    (1000.0, 50.0, 50.0, "mains"),
    (1000.0, 60.0, 60.0, "mains"),
    (1000.0, 150.0, 150.0, "mains, 3 times 50 Hz"),
    (1000.0, 360.0, 360.0, "mains, 6 times 60 Hz"),
    (5000.0, 49.95, 49.95, "mains"),
    (90.0, 50.0, 40.0, "alias of mains, 50 Hz"),
    (77.0, 60.0, 17.0, "alias of mains, 60 Hz"),
    (130.0, 100.0, 30.0, "alias of mains, 100 Hz"),
    (1000.0, 33.3, 33.3, ""),
]


@pytest.mark.parametrize(("rate", "true", "seen", "source"), HUMS)
def test_hum_is_found_sized_and_named(rate: float, true: float, seen: float, source: str) -> None:
    """In 20 of 20 records each, and nothing else."""
    for seed in range(20):
        rng = np.random.default_rng([1, seed])
        samples = int(rng.choice([2000, 4000, 8000]))
        (line,) = spectrum_of(hum(samples, 1 / rate, true, rng), 1 / rate).lines
        assert abs(line.frequency - seen) < 0.5 * rate / samples
        assert 0.2 * 0.6 < line.amplitude < 0.2 * 1.4
        assert (line.source, line.at_drive) == (source, False)


def test_hum_of_any_frequency_is_found_with_readings_missing() -> None:
    """In 95 of 100 records of 2,500 readings, of which a fifth is missing."""
    found = 0
    for seed in range(100):
        rng = np.random.default_rng([2, seed])
        frequency = rng.uniform(10.0, 99.0)
        white = hum(2500, 0.005, frequency, rng)
        lines = spectrum_of(white, 0.005, present=rng.random(2500) < 0.8).lines
        found += len(lines) == 1 and abs(lines[0].frequency - frequency) < 0.1
    assert found >= 95


def colored(size: int, rng: np.random.Generator) -> FloatArray:
    """Return noise that is not white as of a model that is wrong, but without lines."""
    memory = float(rng.choice([0.0, 0.3, -0.3, 0.7, 0.9]))
    made: FloatArray = lfilter([1.0], [1.0, -memory], rng.normal(size=size + 100))[100:]
    return made


@pytest.mark.parametrize("kind", ["white", "with gaps", "heavy tails", "colored"])
def test_noise_has_no_lines(kind: str) -> None:
    """Of 500 records of each kind five at most have one; of 2,000 others two at most had."""
    alarms = 0
    for seed in range(500):
        rng = np.random.default_rng([3, seed])
        samples = int(rng.choice([100, 300, 1000, 4000]))
        white = colored(samples, rng) if kind == "colored" else rng.normal(size=samples)
        if kind == "heavy tails":
            white = rng.standard_t(3, size=samples)
        present = rng.random(samples) < 0.7 if kind == "with gaps" else None
        alarms += bool(spectrum_of(white, 0.005, present=present).lines)
    assert alarms <= 5


@pytest.mark.parametrize(("times", "name"), [(1, "the"), (3, "3 times the")])
def test_what_follows_the_drive_is_no_other_source(times: int, name: str) -> None:
    rng = np.random.default_rng(4)
    time = 0.005 * np.arange(4000)
    white = rng.normal(size=4000) + 0.5 * np.sin(2 * np.pi * times * 2.0 * time)
    (line,) = spectrum_of(white, 0.005, drive=2.0).lines
    assert (line.source, line.at_drive) == (f"{name} drive's frequency", True)


def test_what_may_be_mains_or_the_drive_is_called_both() -> None:
    white = hum(4000, 0.001, 50.0, np.random.default_rng(5))
    (line,) = spectrum_of(white, 0.001, drive=10.0).lines
    assert "5 times the drive's frequency or mains" == line.source
    assert not line.at_drive


def test_several_lines_are_taken_out() -> None:
    rng = np.random.default_rng(6)
    time = 0.001 * np.arange(8000, dtype=np.float64)
    sizes = {50.0: 2.0, 150.0: 0.6, 171.3: 0.4}
    white = rng.normal(size=8000)
    for frequency, size in sizes.items():
        white += size * np.sin(2 * np.pi * frequency * time)
    lines = spectrum_of(white, 0.001).lines
    assert [50.0, 150.0, 171.3] == pytest.approx([line.frequency for line in lines], abs=0.02)
    assert np.std(without_lines(time, white, lines)) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("kept", [1.0, 0.6])
def test_the_density_of_white_noise_is_flat(kept: float) -> None:
    """The sd times √(2 / sampling rate), whether readings are missing or not, within 6 %."""
    rng = np.random.default_rng(7)
    spectrum = spectrum_of(rng.normal(size=16000), 0.002, present=rng.random(16000) < kept)
    assert np.sqrt(np.mean(spectrum.density**2)) == pytest.approx(0.5 * np.sqrt(0.004), rel=0.06)
    assert spectrum.frequency[-1] == pytest.approx(250.0, abs=0.1)


def test_hum_is_named_and_not_taken_for_a_slow_discrepancy() -> None:
    """On a record whose fit it spoils: 20 readings a period, plain in the autocorrelation."""
    good = short_posterior(samples=1500, seed=8)
    time = INTERVAL * np.arange(1500)
    displacement = good.only.displacement + 1.5 * np.sin(2 * np.pi * time / (20 * INTERVAL))
    spoiled = good.altered(displacement=displacement)
    for posterior, humming in ((good, False), (spoiled, True)):
        point = pointfit.fit(posterior, np.random.default_rng(9))
        free = posterior.prior.constrain(point.mode[np.newaxis])[0][0]
        series = innovations(posterior, free)
        said = [*map(str, departures(series))]
        if humming:
            (line,) = said
            assert line.startswith(
                "noise model: the residual has a line at 5 Hz (1.5 um). Fix: look"
            )
            (number,) = numbers(series)["lines"]  # type: ignore[misc]
            assert 5.0 == pytest.approx(number["frequency"], abs=0.01)  # type: ignore[has-type]
        else:
            assert not said


@pytest.mark.parametrize("theta", [(0.5, 1.4, 0.3), (0.02, 3.0, 40.0), (0.7, 1e-9, 0.01)])
def test_density_of_the_noise_model_is_that_of_its_covariance(
    theta: tuple[float, float, float],
) -> None:
    """Against the sum over all lags: 2 Δ Σ cov(k Δ) cos(2π f k Δ)."""
    sensor, sd, time = theta
    interval = 0.01
    lags = np.arange(1, 400_000)
    covariance = sd**2 * np.exp(-interval * lags / time)
    frequency = np.array([0.3, 2.0, 17.0, 50.0])
    angles = 2 * np.pi * interval * frequency
    sums = [sensor**2 + sd**2 + 2 * np.sum(covariance * np.cos(a * lags)) for a in angles]
    empty = np.empty(0)
    series = Innovations(
        empty, empty, empty, empty, empty, interval, DiscrepancyNoise(interval), np.array(theta)
    )
    density = series.noise_density(frequency)
    assert density is not None
    np.testing.assert_allclose(density, np.sqrt(2 * interval * np.array(sums)), rtol=1e-6)
    white = dataclasses.replace(series, noise=WhiteNoise(interval), parameters=np.array([sensor]))
    level = white.noise_density(frequency)
    assert level is not None
    np.testing.assert_allclose(level, sensor * np.sqrt(2 * interval))
