"""Values of the mixture against double sums and the exact mixture."""

import numpy as np
import pytest
from scipy.special import logsumexp, ndtr
from scipy.stats import norm, t

from bwbayes.arrays import FloatArray, Floating
from bwbayes.inference.heavy_tails import scale_mixture, scale_of
from bwbayes.prediction.prediction import (
    crps,
    log_density,
    quantile,
    ranked_values,
    stratified_scales,
    stratified_scores,
)

LEVELS = (0.025, 0.05, 0.25, 0.75, 0.95, 0.975)

# Errors of a probability, in the sds of as many independent values: stratified ones have less.
ALARM = 4.5


def random() -> np.random.Generator:
    return np.random.default_rng(11)


def _kinds(number: int = 400, samples: int = 7) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Means (samples, draws) and sds (1, draws) of every kind that posteriors come in."""
    generator = np.random.default_rng(3)
    normal = generator.normal(size=(number, 1))
    means = 10 * np.sin(np.arange(samples)) + 0.3 * generator.normal(size=(number, samples))
    far = 8.0 * (generator.random((number, 1)) < 0.4)
    kinds = {
        "usual": (means, np.exp(0.2 * normal)),
        "parameters alone": (means + normal, np.full_like(normal, 0.01)),
        "no sds": (means, np.zeros_like(normal)),
        "one draw": (means[:1], np.array([[0.7]])),
        "two draws": (means[:2], np.array([[0.7], [0.1]])),
        "two modes": (means + far, np.full_like(normal, 0.4)),
        "skewed": (means + np.exp(normal), 0.5 * np.exp(0.3 * normal)),
        "wide draws are high": (means + normal, np.exp(0.5 * normal)),
        "some zero sds": (means, np.where(normal < -1, 0.0, 0.5)),
        "sds along the record": (means, np.exp(0.2 * normal) * np.arange(1, samples + 1)),
        "many draws": (np.repeat(means, 13, axis=0), np.repeat(np.exp(0.2 * normal), 13, axis=0)),
    }
    return {kind: (means.T, sds.T) for kind, (means, sds) in kinds.items()}


KINDS = _kinds()


def values(kind: str) -> Floating:
    means, sds = KINDS[kind]
    return ranked_values(means, sds, stratified_scores(means.shape[1], random()))


def worst_error(means: FloatArray, sds: FloatArray, ranked: Floating) -> float:
    """Error of the quantiles' probabilities in sds of independent values, the largest.

    Where a part of the draws has no sd the distribution has steps: both sides count.
    """
    errors = []
    for p in LEVELS:
        x = quantile(ranked, p)
        sides = (x[:, np.newaxis] + side for side in (-1e-9, 1e-9))
        z = [(side - means) / np.maximum(sds, 1e-12) for side in sides]
        low, high = (ndtr(one).mean(axis=1) for one in z)
        off = np.maximum(low - p, 0) + np.maximum(p - high, 0)
        errors.append(off / np.sqrt(p * (1 - p) / ranked.shape[1]))
    return float(np.max(errors))


@pytest.mark.parametrize("kind", KINDS)
def test_quantiles_have_their_probabilities(kind: str) -> None:
    """By chance one of the kinds fails less than once in a hundred generators."""
    assert worst_error(*KINDS[kind], values(kind)) < ALARM


def test_scores_that_go_with_the_draws_would_be_noticed() -> None:
    """The twin: without the permutation high draws get high scores."""
    means, sds = np.sort(KINDS["many draws"][0], axis=1), np.full((1, 1), 0.5)
    scores = stratified_scores(means.shape[1], random())
    assert worst_error(means, sds, ranked_values(means, sds, scores)) < ALARM
    ordered = ranked_values(means, sds, np.sort(scores, axis=1))
    assert worst_error(means, sds, ordered) > 2 * ALARM


@pytest.mark.parametrize("kind", KINDS)
def test_crps_is_the_double_sum_over_values(kind: str) -> None:
    ranked = values(kind)[:, ::5]
    y = ranked.mean(axis=1) + np.linspace(-4, 4, len(ranked))
    pairs = np.abs(ranked[:, :, np.newaxis] - ranked[:, np.newaxis]).mean(axis=(1, 2))
    expected = np.abs(ranked - y[:, np.newaxis]).mean(axis=1) - pairs / 2
    np.testing.assert_allclose(crps(ranked, y), expected, rtol=1e-9)


def test_the_log_density_is_that_of_all_components() -> None:
    """Also where none of them is anything that a float can hold; nothing without a reading."""
    means = np.random.default_rng(1).normal(size=(6, 300))
    sds = np.random.default_rng(2).uniform(0.1, 2.0, (1, 300))
    y = np.array([0.0, 1.0, -3.0, 40.0, 1e4, np.nan])[:, np.newaxis]
    expected = logsumexp(norm.logpdf(y, means, sds), axis=1) - np.log(300)
    np.testing.assert_allclose(log_density((y - means) / sds, sds), expected, rtol=1e-12)


def test_heavy_tails_are_in_the_values_and_the_density() -> None:
    """Quantiles and log density of a mixture of t distributions, to what the draws allow.

    The twin, tails that go with the scores instead of beside them, has other quantiles.
    """
    number = 700
    generator = np.random.default_rng(5)
    means = 0.2 * generator.normal(size=(3, number))
    inverse_df = generator.uniform(0.1, 0.9, number)
    law = t(1 / inverse_df, loc=means, scale=0.5 * scale_of(inverse_df))
    scores = stratified_scores(number, random())
    scales = stratified_scales(scores, inverse_df)

    def worst(scales: FloatArray) -> float:
        ranked = ranked_values(means, 0.5 * np.sqrt(scales)[np.newaxis], scores)
        errors = [
            np.abs(law.cdf(quantile(ranked, p)[:, np.newaxis]).mean(axis=1) - p)
            / np.sqrt(p * (1 - p) / ranked.shape[1])
            for p in LEVELS
        ]
        return float(np.max(errors))

    assert worst(scales) < ALARM / 3
    order = np.argsort(np.argsort(np.abs(scores), axis=None)).reshape(scores.shape)
    assert worst(np.sort(scales, axis=None)[order]) > ALARM
    values, logs = scale_mixture(inverse_df)
    sds = 0.5 * np.sqrt(values).reshape(1, -1)
    y = np.array([0.0, 3.0, -60.0])[:, np.newaxis]
    z = np.repeat(y - means, values.shape[1], axis=1) / sds
    found = log_density(z, sds, (logs + np.log(values.shape[1])).ravel())
    expected = logsumexp(law.logpdf(y), axis=1) - np.log(number)
    np.testing.assert_allclose(found, expected, atol=2e-3)
