"""Values of the mixture against scipy's normal distribution, double sums and the exact mixture."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp, ndtr
from scipy.stats import norm

from bwbayes.arrays import FloatArray, Floating
from bwbayes.prediction.mixture import (
    VALUES,
    crps,
    log_density,
    quantile,
    ranked_values,
    stratified_scores,
)

LEVELS = (0.025, 0.05, 0.25, 0.75, 0.95, 0.975)

# Errors of a probability, in the sds of as many independent values: stratified ones have less.
ALARM = 4.5


def random() -> np.random.Generator:
    return np.random.default_rng(11)


def draws(name: str, number: int = 400, samples: int = 7) -> tuple[FloatArray, FloatArray]:
    """Return means (draws, samples) and sds (draws, 1) of every kind that posteriors come in."""
    generator = np.random.default_rng(3)
    normal = generator.normal(size=(number, 1))
    means = 10 * np.sin(np.arange(samples)) + 0.3 * generator.normal(size=(number, samples))
    far = 8.0 * (generator.random((number, 1)) < 0.4)
    return {
        "usual": (means, np.exp(0.2 * normal)),
        "parameters alone": (means + normal, np.full_like(normal, 0.01)),
        "one draw": (means[:1], np.array([[0.7]])),
        "two draws": (means[:2], np.array([[0.7], [0.1]])),
        "two modes": (means + far, np.full_like(normal, 0.4)),
        "skewed": (means + np.exp(normal), 0.5 * np.exp(0.3 * normal)),
        "wide draws are high": (means + normal, np.exp(0.5 * normal)),
        "some zero sds": (means, np.where(normal < -1, 0.0, 0.5)),
        "sds along the record": (means, np.exp(0.2 * normal) * np.arange(1, samples + 1)),
        "many draws": (np.repeat(means, 13, axis=0), np.repeat(np.exp(0.2 * normal), 13, axis=0)),
    }[name]


KINDS = [
    "usual",
    "parameters alone",
    "one draw",
    "two draws",
    "two modes",
    "skewed",
    "wide draws are high",
    "some zero sds",
    "sds along the record",
    "many draws",
]


def values(kind: str) -> Floating:
    means, sds = draws(kind)
    return ranked_values(means, sds, stratified_scores(len(means), random()))


def worst_error(means: FloatArray, sds: FloatArray, ranked: Floating) -> float:
    """Error of the quantiles' probabilities in sds of independent values, the largest.

    Where a part of the draws has no sd the distribution has steps: both sides count.
    """
    errors = []
    for p in LEVELS:
        x = quantile(ranked, p)
        z = [(x + side - means) / np.maximum(sds, 1e-12) for side in (-1e-9, 1e-9)]
        low, high = (ndtr(one).mean(axis=0) for one in z)
        off = np.maximum(low - p, 0) + np.maximum(p - high, 0)
        errors.append(off / np.sqrt(p * (1 - p) / ranked.shape[1]))
    return float(np.max(errors))


@pytest.mark.parametrize("kind", KINDS)
def test_quantiles_have_their_probabilities(kind: str) -> None:
    """By chance one of the kinds fails less than once in a hundred generators."""
    assert worst_error(*draws(kind), values(kind)) < ALARM


def test_scores_that_go_with_the_draws_would_be_noticed() -> None:
    """The twin: without the permutation high draws get high scores."""
    means, sds = np.sort(draws("many draws")[0], axis=0), np.full((1, 1), 0.5)
    scores = stratified_scores(len(means), random())
    assert worst_error(means, sds, ranked_values(means, sds, scores)) < ALARM
    ordered = ranked_values(means, sds, np.sort(scores, axis=1))
    assert worst_error(means, sds, ordered) > 2 * ALARM


@pytest.mark.parametrize("number", [1, 2, 3, 250, 1000, VALUES, VALUES + 1])
def test_scores_are_stratified_in_every_draw_and_in_all(number: int) -> None:
    scores = ndtr(stratified_scores(number, random()))
    each = len(scores)
    assert VALUES <= scores.size < VALUES + number
    assert (np.floor(scores * each) == np.arange(each)[:, np.newaxis]).all()
    expected = (np.arange(scores.size) + 0.5) / scores.size
    np.testing.assert_allclose(np.sort(scores.ravel()), expected, atol=1e-12)


def test_quantiles_of_one_normal_distribution_are_scipys() -> None:
    means, sds = draws("one draw")
    expected = norm.ppf(np.array(LEVELS)[:, np.newaxis], means, sds)
    got = [quantile(values("one draw"), p) for p in LEVELS]
    # A straight line between values that are 1/N apart in probability misses x(p) by x" / (8 N²).
    z = norm.ppf(0.025)
    bend = 0.7 * abs(z) / norm.pdf(z) ** 2
    np.testing.assert_allclose(got, expected, atol=1.1 * bend / (8 * VALUES**2))


@pytest.mark.parametrize("number", [1, 2, 400])
def test_without_sds_the_quantiles_are_those_of_the_draws(number: int) -> None:
    means = draws("usual")[0][:number]
    ranked = ranked_values(means, np.zeros((number, 1)), stratified_scores(number, random()))
    expected = np.quantile(means, LEVELS, axis=0, method="hazen")
    np.testing.assert_allclose([quantile(ranked, p) for p in LEVELS], expected, rtol=1e-12)


def test_a_sample_does_not_depend_on_its_neighbors() -> None:
    means, sds = draws("sds along the record")
    scores = stratified_scores(len(means), random())
    together = ranked_values(means, sds, scores)
    alone = ranked_values(means[:, 3:4], sds[:, 3:4], scores)
    np.testing.assert_array_equal(together[3:4], alone)


@pytest.mark.parametrize("number", [1, 64, 500])
def test_crps_of_one_normal_distribution_is_the_closed_form(number: int) -> None:
    y = np.linspace(-3, 5, 9)
    z = (y - 0.4) / 1.7
    expected = 1.7 * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / np.sqrt(np.pi))
    means, sds = np.full((number, 9), 0.4), np.full((number, 1), 1.7)
    got = crps(ranked_values(means, sds, stratified_scores(number, random())), y)
    np.testing.assert_allclose(got, expected, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_crps_is_the_double_sum_over_values(kind: str) -> None:
    ranked = values(kind)[:, ::5]
    y = ranked.mean(axis=1) + np.linspace(-4, 4, len(ranked))
    pairs = np.abs(ranked[:, :, np.newaxis] - ranked[:, np.newaxis]).mean(axis=(1, 2))
    expected = np.abs(ranked - y[:, np.newaxis]).mean(axis=1) - pairs / 2
    np.testing.assert_allclose(crps(ranked, y), expected, rtol=1e-9)


def test_the_log_density_is_that_of_all_components() -> None:
    """Also where none of them is anything that a float can hold; nothing without a reading."""
    means = np.random.default_rng(1).normal(size=(300, 6))
    sds = np.random.default_rng(2).uniform(0.1, 2.0, (300, 1))
    y = np.array([0.0, 1.0, -3.0, 40.0, 1e4, np.nan])
    expected = logsumexp(norm.logpdf(y, means, sds), axis=0) - np.log(300)
    np.testing.assert_allclose(log_density((y - means) / sds, sds), expected, rtol=1e-12)
