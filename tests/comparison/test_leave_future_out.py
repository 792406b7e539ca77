"""Later readings are scored by their joint density, given the earlier ones alone."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from scipy import linalg, stats

from bwbayes.app.running.workers import one_thread
from bwbayes.arrays import FloatArray, IntArray
from bwbayes.comparison.leave_future_out import (
    BLOCKS,
    FUTURE,
    Part,
    leave_future_out,
    log_ratios,
)
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.plan import SamplingPlan
from tests.inference.test_solvable import (
    WINDOWS,
    covariance,
    every_case,
    linear_posterior,
    prior_moments,
)

PLAN = SamplingPlan(ess=400, walkers=24, block=25)


def exact(posterior: Posterior, count: int = 4000) -> FloatArray:
    """Draw from the closed form given the training readings, (draws, free)."""
    mean, sd = prior_moments(posterior)
    rows = posterior.only.readings.rows
    level, design, noise = parts_of(posterior)
    weighted = linalg.solve(noise[np.ix_(rows, rows)], design[rows], assume_a="pos")
    spread = linalg.inv(design[rows].T @ weighted + np.diag(sd**-2.0))
    shift = spread @ weighted.T @ (posterior.only.displacement - level)[rows]
    rng = np.random.default_rng(3)
    drawn: FloatArray = rng.multivariate_normal(mean + shift, spread, size=count)
    return drawn


def scored(
    posterior: Posterior, flat: FloatArray, held_out: dict[str, dict[str, tuple[slice, ...]]]
) -> dict[str, Part]:
    with ThreadPoolExecutor(1) as pool, one_thread():
        rng = np.random.default_rng(1)
        return leave_future_out(posterior, PLAN, flat, held_out, rng, pool)


def parts_of(posterior: Posterior) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Level at the prior's mean, columns, and dense covariance of the noise, at all samples."""
    mean, _ = prior_moments(posterior)
    whole = posterior.altered(training=(slice(0, posterior.only.voltage.size),))
    level = whole.simulate(whole.prior.theta(mean[np.newaxis]))[0]
    design = (whole.simulate(whole.prior.theta(mean + np.eye(mean.size))) - level).T
    fixed = {p.name: p.fixed for p in posterior.prior.parameters if p.fixed is not None}
    return level, design, covariance(fixed, posterior.only.voltage.size)


def marginal(posterior: Posterior) -> tuple[FloatArray, FloatArray]:
    """Mean and dense covariance of all readings of a linear model, parameters integrated out."""
    level, design, noise = parts_of(posterior)
    return level, noise + (design * prior_moments(posterior)[1] ** 2) @ design.T


def block_densities(posterior: Posterior, known: IntArray, later: IntArray) -> FloatArray:
    """Log density of each block of later readings, given the known ones and earlier blocks."""
    level, spread = marginal(posterior)

    def density(rows: IntArray) -> float:
        normal = stats.multivariate_normal(level[rows], spread[np.ix_(rows, rows)])
        return float(normal.logpdf(posterior.only.displacement[rows]))

    edges = [k * later.size // BLOCKS for k in range(BLOCKS)] + [later.size]
    return np.diff([density(np.sort(np.r_[known, later[:edge]])) for edge in edges])


@every_case
def test_the_later_half_has_the_conditional_density_of_its_closed_form(
    free: tuple[str, ...], noise: str
) -> None:
    """Block by block within 0.15 nats, the sum too, with a discrepancy and without."""
    posterior = linear_posterior(free, noise)
    part = scored(posterior, exact(posterior), {})[FUTURE]
    rows = posterior.only.readings.rows
    half = rows.size // 2
    expected = block_densities(posterior, rows[:half], rows[half:])
    np.testing.assert_allclose(part.log_scores, expected, atol=0.15)
    assert abs(np.sum(part.log_scores - expected)) < 0.3
    assert part.readings == rows.size - half
    # The twin: readings taken for independent ones score otherwise.
    level, spread = marginal(posterior)
    later = rows[half:]
    alone = stats.norm.logpdf(
        posterior.only.displacement[later], level[later], np.sqrt(np.diag(spread)[later])
    )
    assert abs(np.sum(alone) - np.sum(expected)) > (1 if noise == "discrepancy" else 0.1)


@every_case
def test_a_held_out_window_has_the_conditional_density_of_its_closed_form(
    free: tuple[str, ...], noise: str
) -> None:
    """Also one that lies before what was fitted, for readings know their neighbors either way."""
    posterior = linear_posterior(free, noise)
    for known, later in (WINDOWS, WINDOWS[::-1]):
        fitted = posterior.altered(training=(known,))
        part = scored(fitted, exact(fitted), {"record": {"window": (later,)}})["window"]
        rows = np.arange(known.start, known.stop), np.arange(later.start, later.stop)
        expected = block_densities(posterior, *rows)
        assert abs(np.sum(part.log_scores) - np.sum(expected)) < 0.3
        np.testing.assert_allclose(part.log_scores, expected, atol=0.2)


def test_two_records_are_scored_given_the_beginnings_of_both() -> None:
    """Two windows as records that share all parameters; white noise forgets the cut at once."""
    posterior = linear_posterior(("d", "offset"), "white")
    names = ("first", "second")
    datasets = tuple(
        replace(posterior.only, training=(window,), name=name)
        for name, window in zip(names, WINDOWS, strict=True)
    )
    table = replace(datasets[0].table, records=names, shared=("initial", "offset"))
    both = Posterior(datasets, posterior.prior, joint=table)
    part = scored(both, exact(posterior), {})[FUTURE]
    rows = [dataset.readings.rows for dataset in datasets]
    known = np.concatenate([own[: own.size // 2] for own in rows])
    later = np.concatenate([own[own.size // 2 :] for own in rows])
    expected = np.sum(block_densities(posterior, known, later))
    assert abs(np.sum(part.log_scores) - expected) < 0.3
    assert part.readings == later.size


def test_the_ratios_of_normal_integrals_are_those_of_their_volumes() -> None:
    """Draws of the two ends tell all between; of one end alone less, and they say so."""
    rng = np.random.default_rng(2)
    sds = np.array([4.0, 3.0, 2.0, 1.0, 0.25])
    ends = np.concatenate([rng.normal(0, sds[0], 4000), rng.normal(0, sds[-1], 4000)])
    log_likelihood = -0.5 * (ends / sds[:, np.newaxis]) ** 2
    log_z, effective = log_ratios(log_likelihood, {0: 4000, 4: 4000})
    np.testing.assert_allclose(log_z, np.log(sds / sds[0]), atol=0.1)
    assert np.min(effective) > 1000
    _, alone = log_ratios(log_likelihood[:, :4000], {0: 4000})
    assert alone[-1] < 600 < alone[0]
