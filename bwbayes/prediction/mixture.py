"""The predictive distribution at every sample: a normal mixture over posterior draws.

Given a draw a reading is normal, with the draw's simulation as its mean. Standard normal scores
that are kept along the record turn means and sds into values of the mixture, and the bands are
quantiles of these: as smooth along the record as the simulations are. The scores are stratified,
and a few draws get many of them each, so that hardly any chance is left in a quantile.

All but the scores works in the precision of its arguments: a single one, of means less what they
have in common, takes half the time.
"""

from __future__ import annotations

import math

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, Floating
from bwbayes.inference.heavy_tails import scale_of


def stratified_scores(draws: int, rng: np.random.Generator) -> FloatArray:
    """Draw standard normal scores for posterior draws, (scores, draws).

    With S draws and the least number K of scores that makes S K values 1,000 or more, draw i gets
    Φ⁻¹((j + (π_j(i) + 1/2) / S) / K) for j = 0 ... K - 1, each π_j a random permutation of
    0 ... S - 1. So each draw has a score in each of K equal parts of the probability, and all
    together have one in each of S K.
    """
    # One value of each of as many draws as predictions take: quantiles are as sure as the draws.
    n_scores = -(-1000 // draws)
    ranks = rng.permuted(np.tile(np.arange(draws), (n_scores, 1)), axis=1)
    below = (np.arange(n_scores)[:, np.newaxis] + (ranks + 0.5) / draws) / n_scores
    scores: FloatArray = scipy.special.ndtri(below)
    return scores


def ranked_values(means: Floating, sds: Floating, scores: Floating) -> Floating:
    """Return values of the mixture in ascending order, (samples, values), um.

    Parameters
    ----------
    means
        (samples, draws) mean given a draw, um.
    sds
        (samples, draws) or (1, draws) standard deviation given a draw, um, or (samples or 1,
        scores, draws) of each score. If all are zero the values are the means.
    scores
        (scores, draws) from :func:`stratified_scores`.
    """
    if not sds.any():
        return np.sort(means, axis=1)
    sds = sds if sds.ndim == 3 else sds[:, np.newaxis]
    values = (means[:, np.newaxis] + sds * scores).reshape(len(means), -1)
    values.sort(axis=1)
    return values


def stratified_scales(scores: FloatArray, inverse_df: FloatArray) -> FloatArray:
    """Return values of u (scores, draws) for normal scores: √u z has a Student t distribution.

    With 1/ν (draws,) of each draw, scaled as in :mod:`~bwbayes.inference.heavy_tails`. The i-th of
    the scores in ascending order gets the quantile of the golden ratio's i-th multiple, less its
    whole part: so any part of the plane of both probabilities holds its share of them, and
    quantiles of the products are as sure as those of the scores.
    """
    ranks = np.argsort(np.argsort(scores, axis=None)).reshape(scores.shape)
    probability = (0.5 + (np.sqrt(5) - 1) / 2 * ranks) % 1
    half = 0.5 / np.maximum(inverse_df, 1e-9)
    scales: FloatArray = (
        scale_of(inverse_df) ** 2 * half / scipy.special.gammaincinv(half, probability)
    )
    return scales


def quantile(ranked: Floating, probability: float) -> Floating:
    """Return a quantile (samples,), um, of values ranked along the last axis.

    The i-th of N values is the quantile of (i + 1/2) / N, with straight lines in between.
    """
    count = ranked.shape[1]
    rank = min(max(probability * count - 0.5, 0.0), count - 1.0)
    below, above = ranked[:, math.floor(rank)], ranked[:, math.ceil(rank)]
    line: Floating = below + (rank % 1) * (above - below)
    return line


def probability(ranked: Floating, values: Floating) -> FloatArray:
    """Return the probability (samples,) that a reading is below a value (samples,), um.

    The share of the ranked values that are, as the i-th of N is the quantile of (i + 1/2) / N; nan
    where a value is missing.
    """
    share: FloatArray = np.mean(ranked < values[:, np.newaxis], axis=1, dtype=np.float64)
    return np.where(np.isnan(values), np.nan, share)


def crps(ranked: Floating, values: Floating) -> Floating:
    """Return the continuous ranked probability score of values y (samples,), um.

    E|X - y| - E|X - X'| / 2 over the N ranked x: (2/N) Σ (x_i - y) (1{y < x_i} - (i + 1/2) / N).
    nan where a value is missing.

    Notes
    -----
    T. Gneiting and A. E. Raftery, J. Am. Stat. Assoc. 102 (2007) 359-378, section 4.2.
    """
    away = ranked - values[:, np.newaxis]
    count = ranked.shape[1]
    below = (np.arange(count, dtype=ranked.dtype) + 0.5) / count
    score: Floating = 2 * np.mean(away * ((away > 0) - below), axis=1)
    return score


def log_density(z: Floating, sds: Floating, log_weights: Floating | float = 0.0) -> Floating:
    """Return the log density (samples,), nats, per um: log (1/S) Σ a φ(z) / sd over the S draws.

    ``z`` (samples, draws) is (value - mean) / sd, and ``sds``, all above zero, as in
    :func:`ranked_values`; ``log_weights`` (draws,) are log a. nan where a value is missing.
    """
    by_draw = -0.5 * z**2 - np.log(sds) + log_weights
    largest = np.max(by_draw, axis=1)
    mean = np.mean(np.exp(by_draw - largest[:, np.newaxis]), axis=1)
    density: Floating = largest + np.log(mean) - 0.5 * math.log(2 * math.pi)
    return density
