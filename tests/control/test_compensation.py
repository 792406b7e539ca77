"""Commands that compensate do what is promised of them, on the virtual stand and over seeds.

The quick test of the promised bands draws truths from the same distribution as the posterior's
draws, with which any truth is exchangeable: with 400 truths the part of them that an interval of
probability p holds has a standard error of √(p (1 − p)/400), and four of these are allowed. One of
three levels is off by chance once in 5,000 runs. The twin, whose draws have a quarter of the
truths' spread and half of their discrepancy, is found. ``-m slow`` fits 40 seeds of the stand,
compensates, and runs the stand.
"""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bwbayes.app.config.config import parse
from bwbayes.app.problem.problem import Problem, generator, resolve
from bwbayes.app.running.workers import one_thread
from bwbayes.arrays import FloatArray
from bwbayes.control.compensation import Compensation, compensate
from bwbayes.control.wished import SHAPES, Reference, shaped
from bwbayes.data.teststand import VirtualTestStand
from bwbayes.data.waveforms import signal
from bwbayes.errors import InputError
from bwbayes.inference import pointfit
from bwbayes.model.inverse.limits import Limits
from bwbayes.results.bands import LEVELS
from bwbayes.results.prediction import thinned
from bwbayes.sampling.sampler import draws, first_chain, sample
from tests.measured import keep

CONFIG = Path(__file__).resolve().parents[2] / "runs" / "ring_bender.toml"
LIMITS = Limits(-100.0, 100.0)

# Displacement per volt of the paper's signals when they are asked for, and the sd of the smoothing
# of those that jump, s.
PER_VOLT, SMOOTH = 0.45, 0.01

PAPER = ("identification", "verification", "step10", "step50", "step100")


@cache
def problem(discrepancy: str = "process", rate: float = 100.0, seed: int = 1) -> Problem:
    text = CONFIG.read_text(encoding="utf-8").replace(
        'discrepancy = "process"', f'discrepancy = "{discrepancy}"\nsample_rate = {rate}'
    )
    config = parse(re.sub(r"ess = \d+", "ess = 500", text), "compensation")
    return resolve(config.model_copy(update={"seed": seed}), CONFIG.parent)


def about(of: Problem, spread: float, count: int, source: np.random.Generator) -> FloatArray:
    """Return draws (draws, free) about the truth, each parameter with this relative sd."""
    truth = of.config.truth
    known = np.array([truth.get(name, 0.5) for name in of.posterior.names])
    scale = np.where(known == 0.0, 1.0, known)
    return known + spread * scale * source.standard_normal((count, known.size))


def made(of: Problem, asked: Reference, flat: FloatArray, **options: Any) -> Compensation:
    source = np.random.default_rng(7)
    return compensate(of.posterior, flat, asked, source, from_rest=True, limits=LIMITS, **options)


def reached(asked: Reference, voltage: FloatArray, discrepancy: Any, seed: int) -> FloatArray:
    """Run the stand, and return the tracking error of the true displacement, (samples,), um."""
    stand = VirtualTestStand(discrepancy, 1 / asked.interval)
    truth = stand.run(voltage, np.random.default_rng(seed)).truth
    assert truth is not None
    return np.asarray(truth - np.asarray(asked.displacement))


def rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def references(interval: float) -> dict[str, Reference]:
    """Return the paper's signals, and a raster scan, in um."""
    every = {}
    for name in PAPER:
        _, voltage = signal(name).sample(1 / interval)
        begun = np.concatenate([np.zeros(round(0.1 / interval)), PER_VOLT * voltage])
        every[name] = Reference(begun, interval, name, SMOOTH)
    every["raster"] = shaped("raster", interval, 40.0, 1.0, periods=10)
    return every


def test_errors_are_ten_times_smaller_on_the_stand_with_the_right_model() -> None:
    """Fitted to the paper's identification signal without discrepancy; rms over each reference."""
    of = problem("none")
    with one_thread():
        point = pointfit.fit(of.posterior, generator(1, "point fit"))
    flat = of.posterior.prior.constrain(point.mode[np.newaxis])[0].repeat(2, axis=0)
    smaller = {}
    for name, asked in references(1e-3).items():
        command = made(of, asked, flat)
        after = rms(reached(asked, command.voltage, "none", 1))
        smaller[name] = rms(reached(asked, command.linear.voltage, "none", 1)) / after
    assert min(smaller.values()) > 10.0, smaller


def promised(
    of: Problem, command: Compensation, truths: FloatArray, source: np.random.Generator
) -> dict[tuple[str, int], float]:
    """Return the part of truths (truths, free) whose errors are where the command says."""
    record, asked = of.posterior.only, command.asked
    theta = of.posterior.prior.theta(truths)
    actuator = replace(record.actuator, interval=command.reference.interval)
    model = actuator.displacement(record.table.actuator(theta), command.voltage, from_rest=True)
    noise = record.noise.at(command.reference.interval)
    held: dict[tuple[str, int], list[float]] = {}
    for row, one in enumerate(model):
        truth = one + noise.draw(record.table.noise(theta[row : row + 1]), one.size, source)[0]
        for level in LEVELS:
            bands = command.compensated.bands
            low, high = (edge["displacement", level] for edge in (bands.lower, bands.upper))
            # One sample of each truth: its samples are not independent.
            at = int(source.integers(one.size))
            held.setdefault(("band", level), []).append(low[at] <= truth[at] <= high[at])
            low_rms, high_rms = command.summary["compensated"]["rms_um"][str(level)]
            held.setdefault(("rms", level), []).append(low_rms <= rms(truth - asked) <= high_rms)
    return {key: float(np.mean(values)) for key, values in held.items()}


def running(voltage: float, source: np.random.Generator, interval: float) -> FloatArray:
    """Return a sine of any amplitude within the limits that is stopped at a voltage, and waits."""
    amplitude = source.uniform(abs(voltage) + 1.0, 100.0)
    time = interval * np.arange(round(4.0 / interval))
    swung = amplitude * np.sin(2 * np.pi * (time + source.uniform())) * np.minimum(time, 1.0)
    passes = np.flatnonzero(np.diff(np.sign(swung[time > 2.0] - voltage))) + np.sum(time <= 2.0)
    until = int(source.choice(passes)) + 1
    return np.concatenate([swung[:until], np.full(round(0.2 / interval), voltage)])


def off(held: dict[tuple[str, int], float], count: int) -> dict[tuple[str, int], float]:
    """Return by how many standard errors the parts are off."""
    return {
        (kind, level): (part - level / 100) / np.sqrt(level / 100 * (1 - level / 100) / count)
        for (kind, level), part in held.items()
    }


@pytest.fixture(scope="module")
def asked() -> Reference:
    return shaped("triangle", 0.01, 40.0, 1.0, periods=2)


def test_truths_are_where_the_command_says(asked: Reference) -> None:
    of, source = problem(), np.random.default_rng(3)
    command = made(of, asked, about(of, 0.02, 400, source))
    result = off(promised(of, command, about(of, 0.02, 400, source), source), 400)
    assert max(abs(value) for value in result.values()) < 4.0, result


def covered_early(of: Problem, command: Compensation, truths: FloatArray) -> dict[Any, float]:
    """Return the part of truths (truths, free) that bands hold in the first tenth of a command.

    Each is an actuator that ran before, and was stopped anywhere.
    """
    record, source = of.posterior.only, np.random.default_rng(11)
    theta = of.posterior.prior.theta(truths)
    actuator = replace(record.actuator, interval=command.reference.interval)
    bands = command.compensated.bands
    held: dict[tuple[str, int], list[float]] = {}
    for row in range(len(theta)):
        before = running(float(command.voltage[0]), source, actuator.interval)
        model = record.table.actuator(theta[row : row + 1])
        whole = actuator.displacement(
            model, np.concatenate([before, command.voltage]), from_rest=True
        )[0, before.size :]
        noise = record.noise.at(actuator.interval)
        truth = whole + noise.draw(record.table.noise(theta[row : row + 1]), whole.size, source)[0]
        at = int(source.integers(whole.size // 10))
        for level in LEVELS:
            low, high = (edge["displacement", level] for edge in (bands.lower, bands.upper))
            held.setdefault(("early", level), []).append(low[at] <= truth[at] <= high[at])
    return {key: float(np.mean(values)) for key, values in held.items()}


def test_truths_that_ran_before_are_where_a_command_from_any_state_says(asked: Reference) -> None:
    """The twin, which takes them to be demagnetised, is found."""
    of, source = problem(), np.random.default_rng(3)
    flat, truths = (about(of, 0.02, 400, source) for _ in range(2))
    flat[:, of.posterior.names.index("discrepancy_sd")] *= 0.4
    truths[:, of.posterior.names.index("discrepancy_sd")] *= 0.4

    def anywhere(**options: Any) -> dict[Any, float]:
        source = np.random.default_rng(7)
        made = compensate(of.posterior, flat, asked, source, limits=LIMITS, **options)
        return off(covered_early(of, made, truths), 400)

    result = anywhere()
    assert max(abs(value) for value in result.values()) < 4.0, result
    sure = anywhere(from_rest=True)
    assert sure["early", 95] < -4.0, sure


def test_twin_draws_that_are_too_sure_are_found(asked: Reference) -> None:
    of, source = problem(), np.random.default_rng(3)
    flat = about(of, 0.005, 400, source)
    flat[:, of.posterior.names.index("discrepancy_sd")] *= 0.5
    result = off(promised(of, made(of, asked, flat), about(of, 0.02, 400, source), source), 400)
    assert min(result["band", 95], result["rms", 95]) < -4.0, result


def test_the_expected_command_errs_less_over_the_draws_than_the_mean_one(asked: Reference) -> None:
    """With draws far apart the two differ; the expected error is least for the one that says so."""
    of, source = problem(), np.random.default_rng(3)
    flat = about(of, 0.05, 200, source)
    mean, expected = (made(of, asked, flat, command=one) for one in ("mean", "expected"))
    assert expected.compensated.expected < mean.compensated.expected
    assert mean.other == pytest.approx(expected.compensated.expected, rel=1e-9)
    assert expected.other == pytest.approx(mean.compensated.expected, rel=1e-9)
    assert mean.difference == np.max(np.abs(mean.voltage - expected.voltage)) > 0
    linear = expected.linear.expected
    assert expected.compensated.expected < linear


def test_the_mean_command_brings_the_mean_model_to_the_reference(asked: Reference) -> None:
    of = problem()
    flat = about(of, 0.0, 3, np.random.default_rng(1))
    command = made(of, asked, flat)
    np.testing.assert_allclose(command.compensated.bands.mean, command.asked, atol=1e-6)
    assert command.compensated.expected < 1e-6
    assert command.difference < 1e-6


def test_the_probability_of_a_limit_is_that_of_the_largest_error(asked: Reference) -> None:
    of, source = problem(), np.random.default_rng(3)
    command = made(of, asked, about(of, 0.02, 200, source), limit=4.0)
    numbers = command.summary["compensated"]
    assert numbers["probability_below_limit"] == np.mean(command.compensated.largest <= 4.0)
    assert command.compensated.probability(0.0) == 0.0
    assert command.compensated.probability(1e3) == 1.0
    assert command.compensated.probability(4.0) > command.linear.probability(4.0)


@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_begin_at_rest_and_reach_their_amplitude(shape: str) -> None:
    made_shape = shaped(shape, 1e-3, 40.0, 1.0, middle=20.0, periods=3)
    values = np.asarray(made_shape.displacement)
    np.testing.assert_allclose(values[:20], 0.0, atol=1e-9)
    assert np.max(values) == pytest.approx(60.0, abs=3.0)
    assert np.min(values) == pytest.approx(-20.0, abs=3.0)
    # Rounded, so that no lag needs a voltage that jumps.
    assert np.max(np.abs(np.diff(values, 2))) < 0.7


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ([], "give one row of 10 samples or more"),
        ([1.0] * 5, "give one row of 10 samples or more"),
        ([1.0] * 20, "is 1 um all along"),
        ([0.0, np.nan] * 10, "sample 1 is not a finite number"),
    ],
)
def test_references_that_cannot_be_used_are_refused(given: list[float], line: str) -> None:
    with pytest.raises(InputError, match=line):
        Reference(given, 1e-3)


def test_shapes_that_make_no_sense_are_refused() -> None:
    for options, line in (
        ({"amplitude": -1.0}, "amplitude -1; must be positive"),
        ({"frequency": 600.0}, "cannot be sampled"),
        ({"frequency": 1e-9}, "more than"),
        ({"middle": np.inf}, "middle inf"),
        ({"smoothed": -1.0}, "not negative"),
    ):
        with pytest.raises(InputError, match=line):
            shaped("sine", 1e-3, **{"amplitude": 1.0, "frequency": 1.0, **options})  # type: ignore[arg-type]
    with pytest.raises(InputError, match="did you mean sine"):
        shaped("sinus", 1e-3, 1.0, 1.0)


def test_what_is_out_of_reach_is_said_with_its_place_and_time() -> None:
    of = problem()
    flat = about(of, 0.0, 2, np.random.default_rng(1))
    far = shaped("sine", 0.01, 100.0, 1.0)
    with pytest.raises(InputError, match=r"um at .* s needs .* V, and from .* s on it is beyond"):
        made(of, far, flat)
    near = made(of, far, flat, nearest=True)
    assert np.max(np.abs(near.voltage)) <= 100.0
    assert any("the command is the nearest one" in remark for remark in near.remarks)
    with pytest.raises(InputError, match="limit: 0 um; must be positive"):
        made(of, far, flat, limit=0.0)


@pytest.mark.slow
def test_forty_seeds_of_the_stand_are_where_their_commands_say() -> None:
    """Fit, compensate, run the stand with its discrepancy; three standard errors."""
    held: dict[str, list[float]] = {}
    for seed in range(40):
        for key, part in one_seed(seed).items():
            held.setdefault(key, []).append(part)
    figures = {}
    for key, parts in held.items():
        p, values = int(key.split()[1]) / 100, np.array(parts)
        spread = np.std(values, ddof=1)
        if key.startswith("rms"):
            spread = np.sqrt(p * (1 - p))
        figures[key] = [float(np.mean(values)), float((np.mean(values) - p) / spread * 40**0.5)]
    keep("compensation", figures)
    assert max(abs(error) for _, error in figures.values()) < 3.0, figures


def one_seed(seed: int, rate: float = 1000.0) -> dict[str, float]:
    """Return what the promised bands and rms intervals held of one run of the stand."""
    of = problem.__wrapped__("process", rate, seed)
    posterior = of.posterior
    with ThreadPoolExecutor(1) as executor, one_thread():
        point = pointfit.fit(posterior, generator(seed, "point fit"))
        chain = first_chain(posterior, point, of.plan, generator(seed, "sampling"))
        outcome = sample(posterior, of.plan, chain, executor)
    assert outcome.converged, outcome.stop_reason
    flat = draws(posterior, chain).reshape(-1, len(posterior.names))
    asked = shaped("triangle", 1 / rate, 40.0, 0.5, periods=8)
    command = made(of, asked, thinned(flat, generator(seed, "draws")))
    error = reached(asked, command.voltage, "process", 10_000 + seed)
    held = {}
    bands, numbers = command.compensated.bands, command.summary["compensated"]["rms_um"]
    for level in LEVELS:
        low = bands.lower["displacement", level] - command.asked
        high = bands.upper["displacement", level] - command.asked
        held[f"band {level}"] = float(np.mean((low <= error) & (error <= high)))
        least, most = numbers[str(level)]
        held[f"rms {level}"] = float(least <= rms(error) <= most)
    return held
