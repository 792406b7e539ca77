"""Commands that compensate do what is promised of them, on the virtual stand and over seeds.

The quick test of the promised bands draws truths from the same distribution as the posterior's
draws, with which any truth is exchangeable: with 400 truths, and five times as many draws, the part
of them that an interval of probability p holds has a standard error of 1.1 √(p (1 − p)/400), and
four of √(p (1 − p)/400) are allowed. One of three levels is off by chance once in 1,000 runs. A
twin is in ``test_command_hold.py``.
``-m slow`` fits 40 seeds of the stand, compensates, and runs the stand.
"""

from functools import partial
from typing import Any

import numpy as np
import pytest

from bwbayes.app.running.workers import one_thread
from bwbayes.arrays import FloatArray
from bwbayes.control.references import SHAPES, Reference, build_reference
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.study import generator
from bwbayes.prediction.bands import LEVELS
from bwbayes.record.waveforms import signal
from tests.control.commands import (
    about,
    compensated,
    drawn,
    inside,
    off,
    played,
    problem,
    promised,
    rms,
    study,
)

# Displacement per volt of the paper's signals when they are asked for, and the sd of the smoothing
# of those that jump, s.
PER_VOLT, SMOOTH = 0.45, 0.01

PAPER = ("identification", "verification", "step10", "step50", "step100")


def references(interval: float) -> dict[str, Reference]:
    """Return the paper's signals, and a raster scan, in um."""
    every = {}
    for name in PAPER:
        _, voltage = signal(name).sample(1 / interval)
        begun = np.concatenate([np.zeros(round(0.1 / interval)), PER_VOLT * voltage])
        every[name] = Reference(begun, interval, name, SMOOTH)
    every["raster"] = build_reference("raster", interval, 40.0, 1.0, periods=10)
    return every


def test_errors_are_ten_times_smaller_on_the_stand_with_the_right_model() -> None:
    """Fitted to the paper's identification signal without discrepancy; rms over each reference."""
    of = problem("none")
    with one_thread():
        point = pointfit.fit(of.study.posterior, generator(1, "point fit"))
    flat = of.study.posterior.prior.constrain(point.mode[np.newaxis])[0].repeat(2, axis=0)
    smaller = {}
    for name, asked in references(1e-3).items():
        command = compensated(of, asked, flat)
        after, before = (
            rms(played(asked, one.voltage) - np.asarray(asked.displacement))
            for one in (command, command.linear)
        )
        smaller[name] = before / after
    assert min(smaller.values()) > 10.0, smaller


def running(voltage: float, source: np.random.Generator, interval: float) -> FloatArray:
    """Return a sine that is stopped at a voltage, and waits.

    Its amplitude is that of the limits as often as any within them.
    """
    amplitude = source.choice([100.0, source.uniform(abs(voltage) + 1.0, 100.0)])
    time = interval * np.arange(round(4.0 / interval))
    swung = amplitude * np.sin(2 * np.pi * (time + source.uniform())) * np.minimum(time, 1.0)
    passes = np.flatnonzero(np.diff(np.sign(swung[time > 2.0] - voltage))) + np.sum(time <= 2.0)
    until = int(source.choice(passes)) + 1
    return np.concatenate([swung[:until], np.full(round(0.2 / interval), voltage)])


@pytest.fixture(scope="module")
def asked() -> Reference:
    return build_reference("triangle", 0.01, 40.0, 1.0, periods=2)


def test_truths_are_where_the_command_says(asked: Reference) -> None:
    of, source = problem(), np.random.default_rng(3)
    command = compensated(of, asked, about(of, 0.02, 2000, source))
    result = off(promised(of, command, about(of, 0.02, 400, source), source), 400)
    assert max(abs(value) for value in result.values()) < 4.0, result


def test_truths_that_ran_before_are_where_a_command_from_any_state_says(asked: Reference) -> None:
    """The twin, which takes them to be demagnetized, is found."""
    of, source = problem(), np.random.default_rng(3)
    flat, truths = (about(of, 0.02, 400, source) for _ in range(2))
    flat[:, of.study.posterior.names.index("discrepancy_sd")] *= 0.4
    truths[:, of.study.posterior.names.index("discrepancy_sd")] *= 0.4

    # Before the first swing all are where they stand, after it they have forgotten how they came.
    samples = asked.time.size
    swing, moved = slice(samples // 9, samples // 3), np.random.default_rng(11)

    def anywhere(**options: Any) -> list[float]:
        command = compensated(of, asked, flat, **options)
        before = partial(running, float(command.voltage[0]), moved, asked.interval)
        result = off(promised(of, command, truths, moved, before, swing), 400)
        return [result["band", level] for level in LEVELS]

    assert max(map(abs, anywhere(from_rest=False))) < 4.0
    assert anywhere(from_rest=True)[-1] < -4.0


def test_the_expected_command_errs_less_over_the_draws_than_the_mean_one(asked: Reference) -> None:
    """With draws far apart the two differ; the expected error is least for the one that says so."""
    of, source = problem(), np.random.default_rng(3)
    flat = about(of, 0.05, 200, source)
    mean, expected = (compensated(of, asked, flat, command=one) for one in ("mean", "expected"))
    of_mean, of_expected = (one.compensated.smoothed.expected for one in (mean, expected))
    assert of_expected < of_mean
    assert of_expected < expected.linear.smoothed.expected


def test_errors_are_those_to_the_reference_as_requested(asked: Reference) -> None:
    """Both are given: what the smoothing moves is an error too, unless it is said not to be."""
    of, source = problem(), np.random.default_rng(3)
    flat = about(of, 0.0, 2, source)
    # Nearly: a discrepancy has a sd.
    flat[:, of.study.posterior.names.index("discrepancy_sd")] = 1e-9
    command = compensated(of, asked, flat, limit=0.1)
    moved = asked.given - np.asarray(asked.displacement)
    assert np.max(np.abs(moved)) == asked.moved > 0.5
    errors = command.compensated
    for values, expected in (
        (errors.expected, rms(moved)),
        (errors.rms, rms(moved)),
        (errors.largest, asked.moved),
        (errors.smoothed.rms, 0.0),
        (errors.smoothed.largest, 0.0),
    ):
        np.testing.assert_allclose(values, expected, atol=1e-6)
    numbers = command.summary["compensated"]
    assert numbers["rms_um"]["mean"] == pytest.approx(rms(moved), abs=1e-6)
    assert numbers["to_smoothed_reference"]["rms_um"]["mean"] < 1e-6
    assert (0.0, 1.0) == (
        numbers["probability_below_limit"],
        numbers["to_smoothed_reference"]["probability_below_limit"],
    )
    columns = dict(command.columns())
    upper = command.compensated.bands.upper["displacement", 95]
    np.testing.assert_array_equal(columns["reference_um"], asked.given)
    np.testing.assert_array_equal(columns["error_upper_95_um"], upper - asked.given)
    np.testing.assert_array_equal(columns["smoothed_error_upper_95_um"], upper - command.smoothed)
    assert any("errors are those to the reference as requested" in one for one in command.remarks)


@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_begin_at_rest_and_reach_their_amplitude(shape: str) -> None:
    made_shape = build_reference(shape, 1e-3, 40.0, 1.0, middle=20.0, periods=3)
    values = np.asarray(made_shape.displacement)
    np.testing.assert_allclose(values[:20], 0.0, atol=1e-9)
    assert np.max(values) == pytest.approx(60.0, abs=3.0)
    assert np.min(values) == pytest.approx(-20.0, abs=3.0)
    # Rounded, so that no lag needs a voltage that jumps.
    assert np.max(np.abs(np.diff(values, 2))) < 0.7


def test_shapes_that_make_no_sense_are_refused() -> None:
    for options, line in (
        ({"amplitude": -1.0}, "amplitude -1; must be positive"),
        ({"frequency": 600.0}, "cannot be sampled"),
        ({"frequency": 1e-9}, "more than"),
        ({"middle": np.inf}, "middle inf"),
        ({"smoothed": -1.0}, "not negative"),
    ):
        with pytest.raises(InputError, match=line):
            build_reference("sine", 1e-3, **{"amplitude": 1.0, "frequency": 1.0, **options})  # type: ignore[arg-type]
    with pytest.raises(InputError, match="did you mean sine"):
        build_reference("sinus", 1e-3, 1.0, 1.0)


def test_what_is_out_of_reach_is_said_with_its_time() -> None:
    of = problem()
    flat = about(of, 0.0, 2, np.random.default_rng(1))
    far = build_reference("sine", 0.01, 100.0, 1.0)
    with pytest.raises(InputError, match=r"needs .* V, and from .* s on it is beyond"):
        compensated(of, far, flat)
    near = compensated(of, far, flat, nearest=True)
    assert np.max(np.abs(near.voltage)) <= 100.0
    assert any("the command is the nearest one" in remark for remark in near.remarks)
    with pytest.raises(InputError, match="limit: 0 um; must be positive"):
        compensated(of, far, flat, limit=0.0)


@pytest.mark.slow
def test_forty_seeds_of_the_stand_are_where_their_commands_say() -> None:
    """Fit, compensate, run the stand with its discrepancy; three standard errors."""

    def part(seed: int) -> dict[tuple[str, int], float]:
        of = problem.__wrapped__("process", 1000.0, seed)
        asked = build_reference("triangle", 1e-3, 40.0, 0.5, periods=8)
        command = compensated(of, asked, drawn(of))
        return inside(command, played(asked, command.voltage, "process", 10_000 + seed))

    figures = study("compensation", map(part, range(40)))
    assert max(abs(error) for _, error in figures.values()) < 3.0, figures
