"""What to measure next: the promise is the closed form's, tells good drives from poor, and is kept.

The promise is kept where a record is simulated from a draw of the posterior and the draws are
weighted by its likelihood: what is left of the sd is then, over several truths, what was promised.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.comparison.design import promises
from bwbayes.comparison.designed import Promise
from bwbayes.errors import InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.readings import Readings
from bwbayes.model.limits import Limits
from bwbayes.sampling.diagnostics import smoothed_weights
from tests.inference.linear import Linear
from tests.inference.problems import decaying_sine, short_posterior
from tests.prediction.runs import weighted_draws

WIDE = Limits(-100.0, 100.0)
SAMPLES = 400


def steady(amplitude: float = 100.0, periods: float = 4.0) -> FloatArray:
    turns = 2 * np.pi * periods * np.arange(SAMPLES) / SAMPLES
    return -amplitude * np.sin(turns)


@pytest.fixture(scope="module")
def known() -> tuple[Posterior, FloatArray]:
    """Return the posterior of half a period, which tells little of the loop's shape."""
    fixed = {"initial": 0.0, "sensor_sd": 0.3, "discrepancy_sd": 0.8, "discrepancy_time": 0.2}
    posterior = short_posterior(samples=SAMPLES, fixed=fixed)
    posterior = posterior.altered(training=(slice(0, 60),))
    generator = np.random.default_rng(1)
    draws, weights = weighted_draws(posterior, generator)
    return posterior, draws[generator.choice(len(draws), 4000, p=weights)]


def promised(
    known: tuple[Posterior, FloatArray],
    candidates: dict[str, FloatArray],
    target: str | FloatArray = "beta",
    amplifier: Limits = WIDE,
) -> list[Promise]:
    return promises(*known, candidates, target, amplifier, np.random.default_rng(2))


def test_where_the_model_is_linear_it_is_the_closed_form() -> None:
    """Of d beside the offset; the new record has an offset of its own, of the same prior."""
    model = Linear(("d", "offset"), "discrepancy")
    exact, posterior = model.exact, model.posterior
    # Not about zero, so that the offset counts.
    voltage = 50 + 0.5 * decaying_sine(150)
    (promise,) = promised((posterior, exact.draw(40_000, 1)), {"sine": voltage}, "d")
    # dx/dd is the lagged voltage, seen by two slopes.
    theta = posterior.prior.theta(exact.mean + np.array([[0.0, 0.0], [1e-3, 0.0]]))
    base, moved = posterior.likelihood.actuator.displacement(
        posterior.only.table.actuator(theta), voltage, from_rest=True
    )
    slope = (moved - base) / 1e-3
    dense = model.covariance(voltage.size) + model.sd[1] ** 2
    information = slope @ np.linalg.solve(dense, slope)
    left = 1 / np.sqrt(1 + exact.covariance[0, 0] * information)
    assert promise.left == pytest.approx(left, rel=0.02)
    assert promise.error < 1e-4


def test_a_decaying_sine_is_told_from_a_steady_one(known: tuple[Posterior, FloatArray]) -> None:
    """Of the loop's shape, and of the band on another drive: by more than three errors.

    Its four loops are four, where the steady sine drives one four times.
    """
    candidates = {"steady": steady(), "decaying": decaying_sine(SAMPLES), "small": steady(5.0)}
    for target in ("beta", decaying_sine(SAMPLES, periods=7.0, amplitude=50.0)):
        best, second, worst = promised(known, candidates, target)
        assert (best.name, second.name, worst.name) == ("decaying", "steady", "small")
        assert second.left - best.left > 3 * np.hypot(best.error, second.error)
        assert 0 < best.left < worst.left <= 1


def kept(known: tuple[Posterior, FloatArray], voltage: FloatArray, seed: int) -> float:
    """Measure a voltage on an actuator that is a draw; part of β's sd left, by importance."""
    posterior, draws = known
    source = np.random.default_rng(seed)
    theta = posterior.prior.theta(draws)
    table, actuator = posterior.only.table, posterior.likelihood.actuator
    truth = theta[source.integers(len(theta))][np.newaxis]
    clean = actuator.displacement(table.actuator(truth), voltage, from_rest=True)[0]
    discrepancy, sensor = posterior.only.noise.draw(table.noise(truth), voltage.size, source)
    reading = clean + discrepancy + sensor
    likelihood = replace(
        posterior.likelihood,
        voltage=voltage,
        readings=Readings.of(reading, (slice(0, voltage.size),)),
        from_rest=True,
        offset_sd=20.0,
        engine="numba",
    )
    weights, shape = smoothed_weights(likelihood.log_density(theta))
    if shape > 0.7:
        return np.nan
    beta = draws[:, posterior.names.index("beta")]
    mean = weights @ beta
    return float(np.sqrt(weights @ (beta - mean) ** 2) / np.std(beta))


def test_the_promise_is_kept_when_the_record_is_measured(
    known: tuple[Posterior, FloatArray],
) -> None:
    """Mean over twelve truths, within a quarter; a twin of a tenth of the readings is not."""
    voltage = decaying_sine(SAMPLES)
    (promise,) = promised(known, {"decaying": voltage})
    got = np.array([kept(known, voltage, seed) for seed in range(12)])
    assert np.sum(np.isfinite(got)) > 6
    ratio = np.nanmean(got) / promise.left
    assert 0.75 < ratio < 1.33, ratio
    (less,) = promised(known, {"decaying": voltage[: SAMPLES // 10]})
    assert less.left > 1.5 * promise.left


def test_what_the_amplifier_cannot_make_is_refused_and_comes_last(
    known: tuple[Posterior, FloatArray],
) -> None:
    slow = Limits(-60.0, 60.0, current=2e-3, capacitance=5e-6)
    assert slow.rate == pytest.approx(400)
    candidates = {"far": steady(100.0), "fast": steady(50.0, 20.0), "fine": steady(50.0)}
    made = promised(known, candidates, amplifier=slow)
    assert made[0].name == "fine"
    refused = {one.name: one.refused for one in made}
    assert refused["far"].startswith("needs -100 V, and from 0.11 s on it is beyond the")
    assert refused["fast"].endswith("faster than the amplifier's 400 V/s")
    assert refused["fine"] == ""


def test_what_cannot_be_asked_is_one_line(known: tuple[Posterior, FloatArray]) -> None:
    with pytest.raises(InputError, match="'bet' is not a free parameter of the actuator; did you"):
        promised(known, {"one": steady()}, "bet")
