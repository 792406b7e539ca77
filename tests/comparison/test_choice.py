"""What is recommended follows from the numbers, and what cannot be told is called so."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.comparison.candidates import Candidate
from bwbayes.comparison.choice import Comparison, choose
from bwbayes.comparison.differences import paired
from bwbayes.comparison.evidence import Evidence
from bwbayes.comparison.future import Future
from bwbayes.comparison.table import COLUMNS, differences, numbers, rows, table
from bwbayes.results.scores import score
from tests.results.records import bands_of, made

RECORD = made(np.random.default_rng(5), length=4.0)


def noise(seed: int, size: int = 400) -> FloatArray:
    return np.random.default_rng(seed).normal(size=size)


def model(
    name: str,
    scores: FloatArray | None,
    log_evidence: float | None = None,
    free: int = 5,
    *,
    hysteresis: bool = True,
    future: FloatArray | None = None,
) -> Candidate:
    """Return a converged model with those log scores."""
    one = Candidate(name, name, True, "converged", free, 1000, hysteresis, log_likelihood=0.0)
    if scores is not None:
        bands = replace(bands_of(RECORD), log_score=scores)
        one = replace(
            one,
            held_out=(bands,),
            scores={bands.name: score(bands, np.random.default_rng(1))},
        )
    if log_evidence is not None:
        one = replace(one, evidence=Evidence(log_evidence, 0.02, 0.0, 1000.0))
    if future is not None:
        rows = {"record": np.arange(future.size, dtype=np.int64)}
        one = replace(one, future=Future(future, rows, (0.3,), 1, True))
    return one


def chosen(*models: Candidate) -> Comparison:
    return choose(models, np.random.default_rng(1))


def test_the_better_held_out_score_is_recommended_whatever_the_evidence_says() -> None:
    common = noise(1)
    worse = model("other", common - 0.5 + 0.1 * noise(2), 100.0)
    got = chosen(worse, model("rich", common, 0.0, 9))
    assert got.recommended == got.best == "rich"
    assert got.alike == ()
    assert "other is worse by more than 2 standard errors" in got.lines[1]
    assert got.against[0] == "the log evidence is for other, by 100.0"
    assert got.against[1].startswith("BIC is for other")


def test_scores_within_two_errors_are_told_apart_by_the_evidence_if_it_is_sure() -> None:
    common = noise(1)
    near = common + 0.001 * noise(2)
    got = chosen(model("plain", common, 0.0), model("rich", near, 10.0, 9))
    assert (got.recommended, got.alike) == ("rich", ())
    assert any("log evidence is lower by 10.0" in line for line in got.lines)
    got = chosen(model("plain", common, 0.0), model("rich", near, 2.0, 9))
    assert (got.recommended, got.alike) == ("plain", ("rich",))
    assert got.lines[0] == "plain and rich cannot be told apart; the plainest of them is plain"


def test_what_differs_by_little_is_not_told_apart_however_small_its_error() -> None:
    """Half a nat over 400 readings, at ten errors; what scores better is still recommended."""
    common = noise(1)
    less = common - 0.5 / 400 + 2.5e-3 * noise(2)
    got = chosen(model("plain", less, 5.0), model("rich", common, 0.0, 9))
    assert got.differences["plain"]["held_out"].beyond
    assert (got.recommended, got.alike) == ("rich", ("plain",))
    assert got.lines[0].endswith("cannot be told apart; the best score of them has rich")
    assert any("the log evidence is for plain" in line for line in got.against)


def test_an_evidence_that_is_not_known_decides_nothing() -> None:
    common = noise(1)
    unknown = replace(
        model("rich", common + 0.001 * noise(2), 0.0, 9),
        evidence=Evidence(np.nan, np.inf, 0.0, 0.0),
    )
    got = chosen(model("plain", common, 10.0), unknown)
    assert set(got.alike) | {got.recommended} == {"plain", "rich"}


def test_without_hysteresis_it_says_so() -> None:
    common = noise(1)
    linear = model("linear", common, 4.0, 3, hysteresis=False)
    got = chosen(linear, model("rich", common + 0.001 * noise(2), 0.0))
    assert got.recommended == "linear"
    assert got.lines[1].startswith("the record shows no hysteresis")
    # One that is alike, but not the plainest, leaves it open.
    got = chosen(replace(linear, free=9), model("rich", common + 0.001 * noise(2), 4.0))
    assert "whether there is any hysteresis cannot be told" in got.lines


def test_what_has_not_converged_is_listed_and_never_recommended() -> None:
    lost = Candidate("lost", "lost", False, "budget used up", 4, 1000)
    got = chosen(lost, model("plain", noise(1), 0.0))
    assert got.recommended == "plain"
    assert got.candidates[-1] is lost
    assert got.against[-1] == "lost has not converged (budget used up) and is not judged"
    got = chosen(lost)
    assert got.recommended is None
    assert [row[2] for row in rows(got)] == ["not converged"]


def test_without_readings_held_out_the_future_decides_and_then_the_evidence() -> None:
    later = noise(3)
    got = chosen(
        model("plain", None, 0.0, future=later), model("rich", None, 0.0, future=later + 1)
    )
    assert (got.measure, got.recommended) == ("future", "rich")
    got = chosen(model("plain", None, 0.0), model("rich", None, 9.0))
    assert (got.measure, got.recommended) == ("evidence", "rich")
    assert any("trusts priors and noise" in line for line in got.against)


def test_few_independent_stretches_are_said() -> None:
    slow = np.sin(np.linspace(0, 6, 400))
    got = chosen(model("plain", 0 * slow, 0.0), model("rich", slow - 0.1, 0.0))
    assert any("independent stretches only" in line for line in got.against)


def test_table_numbers_and_page_have_every_model() -> None:
    got = chosen(model("plain", noise(1), 0.0, future=noise(4)), model("rich", noise(2) - 1, None))
    said = numbers(got)
    assert isinstance(said["models"], Mapping)
    assert [row[0] for row in rows(got)] == list(said["models"]) == ["plain", "rich"]
    assert all(len(row) == len(COLUMNS) for row in rows(got))
    assert [row[0] for row in differences(got)] == ["rich"]
    (plain, _) = table(got)
    assert plain["held_out_log_score"] == pytest.approx(np.mean(noise(1)))
    assert plain["difference_held_out_value"] == 0


# 400 pairs of AR(1) series of 600 readings: the share beyond two errors is 0.05 for exact errors of
# normal means, and 0.07 here as blocks are few; above 0.13 by chance once in a million. Without
# blocks the errors would be 2.4 times too small and the share 0.4.
def share_beyond(block_factor: float = 1.0) -> float:
    source = np.random.default_rng(7)
    beyond = 0
    for _ in range(400):
        fresh = source.normal(size=700)
        series = np.empty(700)
        series[0] = fresh[0]
        for i in range(1, 700):
            series[i] = 0.7 * series[i - 1] + fresh[i]
        series = series[100:]
        common = source.normal(size=600)
        got = paired(common + series, common, source)
        beyond += abs(got.value) > 2 * block_factor * got.error
    return beyond / 400


def test_paired_errors_are_right_for_correlated_readings() -> None:
    assert share_beyond() < 0.13
    # The twin: errors of readings taken for independent ones.
    assert share_beyond(1 / 2.4) > 0.25


def test_a_reading_held_for_impossible_settles_it() -> None:
    fine = noise(1)
    broken = np.where(np.arange(400) == 7, -np.inf, fine)
    source = np.random.default_rng(1)
    assert paired(broken, fine, source).worse
    assert paired(fine, broken, source).value == np.inf
    assert not paired(broken, broken, source).worse
