"""The future is predicted from the past alone, and weighted draws are those of a fit."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg, stats

from bwbayes.app.running.workers import one_thread
from bwbayes.arrays import FloatArray, IntArray
from bwbayes.comparison.future import cut, future, joint_log_score, reweighted
from bwbayes.data import Record
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.table import JointTable
from bwbayes.sampling.plan import SamplingPlan
from tests.inference.problems import INTERVAL
from tests.inference.test_solvable import (
    WINDOWS,
    closed_form,
    covariance,
    linear_posterior,
    prior_moments,
)

PLAN = SamplingPlan(ess=1000, walkers=24, block=25)


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    return linear_posterior(("d", "offset"), "white")


def exact(posterior: Posterior, count: int = 4000) -> FloatArray:
    """Draw from the closed form, (draws, free)."""
    known = posterior_of_rows(posterior)
    source = np.random.default_rng(3)
    drawn: FloatArray = source.multivariate_normal(*known, size=count)
    return drawn


def posterior_of_rows(
    posterior: Posterior, rows: IntArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the normal posterior of some readings, or of those that count."""
    design, level, noise = parts(posterior)
    mean, sd = prior_moments(posterior)
    rows = posterior.only.readings.rows if rows is None else rows
    weighted = linalg.solve(noise[np.ix_(rows, rows)], design[rows], assume_a="pos")
    made = linalg.inv(design[rows].T @ weighted + np.diag(sd**-2.0))
    shift = made @ weighted.T @ (posterior.only.displacement - level)[rows]
    return mean + shift, made


def parts(posterior: Posterior) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Columns, level at the prior's mean, and the dense covariance of the noise."""
    mean, _ = prior_moments(posterior)
    whole = posterior.altered(training=(slice(0, posterior.only.voltage.size),))
    level = whole.simulate(whole.prior.theta(mean[np.newaxis]))[0]
    moved = whole.simulate(whole.prior.theta(mean + np.eye(mean.size)))
    known = {p.name: p.fixed for p in posterior.prior.parameters if p.fixed is not None}
    return (moved - level).T, level, covariance(known, posterior.only.voltage.size)


def test_windows_are_cut_before_a_sample() -> None:
    windows = slice(2, 5), slice(7, 9)
    assert cut(windows, 8) == (slice(2, 5), slice(7, 8))
    assert cut(windows, 6) == (slice(2, 5),)
    assert cut(windows, 4) == (slice(2, 4),)


def foretold(posterior: Posterior, known: IntArray, some: IntArray) -> FloatArray:
    """Log density of each of some readings, given the known ones, in closed form."""
    design, level, noise = parts(posterior)
    mean, spread = posterior_of_rows(posterior, known)
    middle = level[some] + design[some] @ (mean - prior_moments(posterior)[0])
    variance = np.einsum("ri,ij,rj->r", design[some], spread, design[some])
    sds = np.sqrt(variance + np.diag(noise)[some])
    return np.asarray(stats.norm.logpdf(posterior.only.displacement[some], middle, sds))


def whole_record(posterior: Posterior) -> Record:
    return Record(posterior.only.voltage, posterior.only.displacement, INTERVAL)


def test_each_stretch_is_predicted_from_what_came_before(posterior: Posterior) -> None:
    """Against the closed form of each reading's density, given the readings before its stretch."""
    with ThreadPoolExecutor(1) as pool, one_thread():
        record = {"record": whole_record(posterior)}
        made = future(posterior, PLAN, record, np.random.default_rng(1), pool)
    rows = posterior.only.readings.rows
    assert made.converged
    half, later = rows.size // 2, round(0.75 * rows.size)
    np.testing.assert_array_equal(made.rows["record"], rows[half:])
    expected = [
        foretold(posterior, rows[:first], rows[first:last])
        for first, last in ((half, later), (later, rows.size))
    ]
    np.testing.assert_allclose(made.log_score, np.concatenate(expected), atol=0.01)
    # The twin: from all readings the scores are others, by more than that.
    assert np.max(np.abs(foretold(posterior, rows, rows[half:]) - made.log_score)) > 0.02


def test_each_of_two_records_is_predicted_from_the_beginnings_of_both(posterior: Posterior) -> None:
    """Two windows as records of their own that share all; white noise has no memory of the cut."""
    names = ("first", "second")
    datasets = tuple(
        replace(posterior.only, training=(window,), name=name)
        for name, window in zip(names, WINDOWS, strict=True)
    )
    table = JointTable(datasets[0].table, names, shared=("initial", "offset"))
    both = Posterior(datasets, posterior.prior, joint=table)
    record = whole_record(posterior)
    with ThreadPoolExecutor(1) as pool, one_thread():
        records = dict.fromkeys(names, record)
        made = future(both, PLAN, records, np.random.default_rng(1), pool)
    assert made.converged
    rows = [one.readings.rows for one in datasets]
    expected: list[list[FloatArray]] = [[], []]
    for first, last in ((0.5, 0.75), (0.75, 1.0)):
        known = np.concatenate([every[: round(first * every.size)] for every in rows])
        for scores, every in zip(expected, rows, strict=True):
            some = every[round(first * every.size) : round(last * every.size)]
            scores.append(foretold(posterior, known, some))
    parts_of_both = [score for scores in expected for score in scores]
    np.testing.assert_allclose(made.log_score, np.concatenate(parts_of_both), atol=0.01)
    # The twin: of its own beginning alone the second record is told otherwise.
    alone = foretold(posterior, rows[1][: round(0.5 * rows[1].size)], made.rows["second"])
    assert np.max(np.abs(alone - made.log_score[-alone.size :])) > 0.02


def test_weighted_draws_are_those_of_the_later_posterior(posterior: Posterior) -> None:
    """Means within a tenth of a sd and sds within 7 %: four of their errors with 1,000 draws."""
    before = posterior.altered(training=(slice(8, 60),))
    got, shape = reweighted(before, posterior, exact(before), np.random.default_rng(2))
    assert got is not None
    assert shape < 0.7
    known = closed_form(posterior)
    assert posterior.only.training == WINDOWS
    assert np.max(np.abs(np.mean(got, axis=0) - known.mean) / known.sd) < 0.15
    np.testing.assert_allclose(np.std(got, axis=0), known.sd, rtol=0.1)


def test_draws_that_would_not_do_are_not_weighted(posterior: Posterior) -> None:
    """A posterior ten times narrower, and elsewhere."""
    before = posterior.altered(training=(slice(8, 12),))
    got, shape = reweighted(before, posterior, exact(before) + 0.2, np.random.default_rng(2))
    assert got is None
    assert shape > 0.7


def test_the_joint_score_is_the_conditional_density(posterior: Posterior) -> None:
    """Of the normal distribution of all readings; within 0.1 nats."""
    first, second = WINDOWS
    before = posterior.altered(training=(first,))
    later = {"record": [second]}
    got, shape = joint_log_score(before, exact(before), later, np.random.default_rng(2))
    design, level, noise = parts(posterior)
    _, sd = prior_moments(posterior)
    whole = noise + (design * sd**2) @ design.T

    def density(rows: IntArray) -> float:
        normal = stats.multivariate_normal(level[rows], whole[np.ix_(rows, rows)])
        return float(normal.logpdf(posterior.only.displacement[rows]))

    expected = density(posterior.only.readings.rows) - density(before.only.readings.rows)
    assert abs(got - expected) < 0.1
    assert shape < 0.7
