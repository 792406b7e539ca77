"""A record that the model made looks like its replicates; one that it could not make does not.

A p-value below 0.005 or above 0.995 is odd: one in a hundred for a record of the model itself, and
less here, since the posterior has seen the record.
"""

from collections.abc import Callable

import numpy as np
import pytest
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.innovations import (
    STATISTICS,
    Innovations,
    PredictiveChecks,
    check_predictions,
    departures,
    innovations,
)
from bwbayes.inference.noise import noise_model
from bwbayes.inference.posterior import Posterior
from tests.inference import problems
from tests.inference.problems import INTERVAL, TRUE_NOISE, short_posterior, truth

SAMPLES = 400


def looked_at(posterior: Posterior) -> PredictiveChecks:
    """Check against the truth's own replicates, its parameters hardly uncertain."""
    names = list(posterior.prior.names)
    free = [names.index(name) for name in posterior.names]
    draws = np.repeat(truth(posterior)[:, free], 200, axis=0)
    return check_predictions(posterior, draws, np.random.default_rng(1))


def changed(posterior: Posterior, added: FloatArray) -> Posterior:
    return posterior.altered(displacement=posterior.single_record.displacement + added)


def test_good_records_are_not_odd() -> None:
    """Three or more of eight statistics of ten records are odd with a probability of 0.01."""
    odd = 0
    for seed in range(10):
        made = looked_at(short_posterior(samples=SAMPLES, seed=seed))
        assert list(made.statistics) == list(STATISTICS)
        odd += sum(one.extreme for one in made.statistics.values())
    assert odd < 4


@pytest.mark.parametrize(
    ("kind", "statistic"),
    [
        ("faster", "residual_fast"),
        ("slow", "residual_slow"),
        ("larger", "residual_sd_um"),
        ("shifted", "pit_mean"),
        ("wild", "pit_outside"),
    ],
)
def test_what_the_model_does_not_do_is_odd(kind: str, statistic: str) -> None:
    time = INTERVAL * np.arange(SAMPLES)
    size = TRUE_NOISE["discrepancy_sd"]
    added = {
        "faster": 2 * size * np.sin(2 * np.pi * 20 * time),
        "slow": 6 * size * np.sin(2 * np.pi * 0.25 * time),
        "larger": 4 * size * np.random.default_rng(1).normal(size=SAMPLES),
        "shifted": np.full(SAMPLES, 8 * size),
        "wild": 6 * size * np.random.default_rng(2).normal(size=SAMPLES),
    }[kind]
    made = looked_at(changed(short_posterior(samples=SAMPLES), added))
    assert made.statistics[statistic].extreme


def test_readings_that_are_missing_are_missing_in_all() -> None:
    posterior = short_posterior(samples=SAMPLES)
    displacement = posterior.single_record.displacement.copy()
    displacement[100:180] = np.nan
    made = looked_at(posterior.altered(displacement=displacement))
    assert all(np.isfinite(one.observed) for one in made.statistics.values())
    assert not made.statistics["residual_sd_um"].extreme


# Innovations: silent on what the noise model describes, and a remark on each departure


def along(white: FloatArray) -> Innovations:
    """Return innovations along a sine of 1 Hz at 200 Hz."""
    time = 0.005 * np.arange(white.size, dtype=np.float64)
    voltage = 100 * np.sin(2 * np.pi * time)
    rate = np.gradient(voltage) / 0.005
    noise = noise_model("white", 0.005), np.array([0.5])
    return Innovations(time, white, voltage, rate, 0.5 * white, 0.005, *noise)


def test_innovations_of_the_right_model_raise_no_remark() -> None:
    """At most 4 false alarms of 400, 1%; of 1,000 others there were three."""
    generator = np.random.default_rng(1)
    alarms = 0
    for _ in range(400):
        result = along(generator.normal(size=int(generator.choice([200, 1000, 4000]))))
        alarms += bool(departures(result))
    assert alarms <= 4


def colored(white: FloatArray, _: Innovations) -> FloatArray:
    return white + 0.3 * np.concatenate([[0.0], white[:-1]])


def rising(white: FloatArray, result: Innovations) -> FloatArray:
    return white + 0.3 * (result.rate > 0)


@pytest.mark.parametrize(
    ("spoil", "part"),
    [(colored, "the power that white ones have"), (rising, "SD where the voltage is rising")],
)
def test_each_departure_is_remarked_on(
    spoil: Callable[[FloatArray, Innovations], FloatArray], part: str
) -> None:
    """In 20 of 20 records of 2,000 readings."""
    for seed in range(20):
        white = np.random.default_rng([2, seed]).normal(size=2000)
        lines = [*map(str, departures(along(spoil(white, along(white)))))]
        assert any(part in line for line in lines), (seed, lines)
        assert all(line.startswith("noise model: ") for line in lines)


@pytest.mark.parametrize("samples", [30, 301, 4000])
def test_power_by_octave_is_judged_at_the_stated_rate(samples: int) -> None:
    """28 to 77 of 1,000 white records have p below 0.05: all but one in a thousand such studies.

    Each octave's power is that of the periodogram between its edges, and the highest edge is the
    last frequency below Nyquist's.
    """
    generator = np.random.default_rng(samples)
    low = 0
    for _ in range(1000):
        frequency, power, p = along(generator.standard_normal(samples)).octaves()
        low += p < 0.05
    assert 28 <= low <= 77
    white = generator.standard_normal(samples) * np.linspace(0.5, 1.5, samples)
    at, density = scipy.signal.periodogram(white, 200.0)
    inside = at[1:] < 100
    density, at = density[1:][inside], at[1:][inside]
    frequency, power, _ = along(white).octaves()
    assert frequency[-1] == pytest.approx(at[-1])
    for lower, upper, observed in zip(frequency, frequency[1:], power, strict=False):
        part = (at > lower * (1 + 1e-9)) & (at <= upper * (1 + 1e-9))
        assert observed == pytest.approx(np.mean(density[part]) / np.mean(density))


def test_innovations_of_a_simulated_record_are_standard_normal() -> None:
    """At the truth: mean within 4.5 standard errors of 0, sd of 1, and no remark."""
    posterior = problems.short_posterior(samples=3000, seed=4)
    theta = problems.truth(posterior)[0]
    free = np.array([theta[posterior.prior.names.index(n)] for n in posterior.names])
    result = innovations(posterior, free, begin=7.0)
    assert 7.0 == result.time[0]
    assert abs(np.mean(result.white)) < 4.5 / np.sqrt(3000)
    assert abs(np.std(result.white) - 1) < 4.5 / np.sqrt(6000)
    assert () == departures(result)
    assert 3000 == result.numbers["readings"]
    assert {"rate", "voltage", "direction"} == set(result.numbers["by"])  # type: ignore[call-overload]
