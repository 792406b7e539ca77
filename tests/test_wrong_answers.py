"""Records on which the first version gave a confident wrong answer: right now, or said to be wrong.

Transients and lead-ins are here. Bands on records cut from a running drive are kept by
``results/test_moving.py``, thinned records by ``test_thinned_records.py``, a steady sine by
``test_steady_sine.py``, a reversed displacement by ``app/test_predict.py``, ``start`` and ``train``
by ``app/test_problem.py``, priors in wrong units by ``inference/test_conflict.py``.

Runs are whole but for their files: a config, a fit, draws until they have converged, bands and
verdicts. Each answer is right, within four posterior sds, or does not hold for the right cause. All
with ``-m slow``; the quick twins are in the other files.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.problem.problem import Problem, generator
from bwbayes.arrays import FloatArray
from bwbayes.data import Record, write_record
from bwbayes.results.prediction import Start, predict_record, thinned
from bwbayes.results.result import Result
from bwbayes.results.verdict import Background, Verdict, assess
from tests.results.runs import Judged, Stand, covered, judge, problem_of, run

pytestmark = pytest.mark.slow

STAND = Stand(lag=0.03)
LARGE = Stand(d=15.0, discrepancy=8.0, sensor=2.0)


def sine(seconds: float, rate: float = 100.0, size: float = 100.0) -> FloatArray:
    """Return a 1 Hz sine (samples,) from rest that decays to a half, V."""
    time = np.arange(round(seconds * rate)) / rate
    voltage: FloatArray = size * np.sin(2 * np.pi * time) * (1 - 0.5 * time / seconds)
    return voltage


def added(record: Record, change: FloatArray) -> Record:
    """Add as much of a change (samples,) to the readings as they are long."""
    assert record.displacement is not None
    displacement = record.displacement.copy()
    displacement += change[: displacement.size]
    return replace(record, displacement=displacement)


def transient(size: float, last: float, samples: int = 2000, rate: float = 100.0) -> FloatArray:
    """Return what dies out exponentially (samples,), um and s."""
    faded: FloatArray = size * np.exp(-np.arange(samples) / rate / last)
    return faded


def fitted(record: Record, folder: Path, *lines: str) -> Judged:
    """Fit a record whole, by a point fit and draws around it; ``lines`` go below [record]."""
    write_record(record, folder / "record.h5")
    text = "\n".join(['[record]\nfile = "record.h5"', *lines])
    return judge(problem_of(text, folder), np.random.default_rng(1))


def off(told: Judged, truth: dict[str, float]) -> dict[str, float]:
    """Return how many posterior sds the means are from the truth."""
    columns = {name: told.column(name) for name in truth}
    return {name: float(abs(np.mean(x) - truth[name]) / np.std(x)) for name, x in columns.items()}


def cause(verdict: Verdict) -> str | None:
    return None if verdict.cause is None else verdict.cause.kind


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, Result]:
    """Fit 10 s from rest, with a lag of 30 ms, and predict a record under two names."""
    folder = tmp_path_factory.mktemp("fit")
    write_record(STAND.measure(sine(10), np.random.default_rng(1)), folder / "record.csv")
    text = '[record]\nfile = "record.csv"\n'
    for name in ("one", "two"):
        write_record(in_motion(1), folder / f"{name}.csv")
        text += f'[validation.{name}]\nfile = "{name}.csv"\n'
    return run(text, folder)


def in_motion(seed: int, seconds: float = 8.0) -> Record:
    """Return a record that was cut at 45 degrees, with an offset of its own."""
    source = np.random.default_rng([11, seed])
    return STAND.measure(sine(2.125 + seconds), source, offset=-40.0, cut=212)


# What is predicted


def few(result: Result) -> FloatArray:
    """Return 200 of the draws (200, free)."""
    return thinned(result.flat_draws, np.random.default_rng(0), 200)


@pytest.mark.parametrize("last", [0.03, 0.3, 1.0])
def test_a_record_that_starts_with_a_transient_is_right_or_does_not_hold(
    fit: tuple[Problem, Result], last: float
) -> None:
    """A lead-in of 1 s; what dies out as the lag does is a start of the dynamics, and right."""
    problem, result = fit
    background = Background.of(problem.posterior, result.flat_draws)
    for seed in range(3):
        record = added(in_motion(seed), transient(20.0, last))
        name = "other"
        bands = predict_record(
            problem.posterior, few(result), record, Start(), generator(seed, name), name
        )
        verdict = assess(bands, background)
        assert verdict is not None
        if last == STAND.lag:
            assert verdict.holds is not False, verdict.line
        if verdict.holds is False:
            assert cause(verdict) in {"lead-in", "start", "offset"}, verdict.line
            assert "lead_in" in verdict.line
        else:
            assert covered(bands) > 0.85


def test_a_transient_is_avoided_as_the_verdict_says(fit: tuple[Problem, Result]) -> None:
    problem, result = fit
    record = added(in_motion(1), transient(20.0, 0.3))
    background = Background.of(problem.posterior, result.flat_draws)
    said = []
    for begin in (0.0, 2.5):
        bands = predict_record(
            problem.posterior,
            few(result),
            record,
            Start(lead_in=1.0, lead_in_from=begin),
            generator(1, "other"),
        )
        verdict = assess(bands, background)
        assert verdict is not None
        said.append(verdict.holds)
    assert said[0] is False
    assert said[1] is not False
    assert covered(bands) > 0.85


@pytest.mark.parametrize("lead_in", [1.0, 2.0, 3.0, 5.0, 10.0])
def test_a_lead_in_of_any_length_gives_right_bands(
    fit: tuple[Problem, Result], lead_in: float
) -> None:
    """Over six records, so that no single one's size of the discrepancy decides."""
    problem, result = fit
    parts = []
    for seed in range(6):
        bands = predict_record(
            problem.posterior,
            few(result),
            in_motion(seed, 20.0),
            Start(lead_in=lead_in),
            generator(seed, "third"),
        )
        parts.append(covered(bands))
        verdict = assess(bands, Background.of(problem.posterior, result.flat_draws))
        assert verdict is not None
        assert verdict.holds is not False, verdict.line
    assert 0.91 < np.mean(parts) < 0.99, parts


# What is fitted


@pytest.mark.parametrize("size", [0.1, 0.2, 0.3])
def test_a_switch_on_transient_in_a_record_fitted_whole_is_said(
    tmp_path: Path, size: float
) -> None:
    """A stack of 15 um/V; the transient is a part of the displacement's range, and lasts 1-2 s.

    Of twelve seconds too much of the drive would go with it, so that no window is given.
    """
    record = LARGE.measure(sine(12), np.random.default_rng(2))
    record = added(record, transient(size * 2 * 15 * 100, 0.5))
    verdict = fitted(record, tmp_path).verdicts["training"]
    assert verdict.holds is False
    assert "transient" == cause(verdict), verdict.line
    assert verdict.cause is not None
    assert "measure again once the displacement has settled" == verdict.cause.fix


def test_a_start_that_holds_little_of_the_drive_is_left_out(tmp_path: Path) -> None:
    """What the verdict says helps: without that window d is right."""
    record = LARGE.measure(sine(60), np.random.default_rng(2))
    record = added(record, np.pad(transient(0.3 * 2 * 15 * 100, 0.5), (0, 4000)))
    verdict = fitted(record, tmp_path).verdicts["training"]
    assert verdict.holds is False
    assert "transient" == cause(verdict), verdict.line
    assert verdict.cause is not None
    fix = verdict.cause.fix
    line = fix[fix.index("exclude = [[0, ") : fix.index(" in [record]")]
    told = fitted(record, tmp_path, line)
    assert off(told, {"d": 15.0})["d"] < 4
    assert told.verdicts["training"].holds is not False
