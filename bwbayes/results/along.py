"""Quantiles along a record: the shape of the mixture at some samples, its mean and sd at all.

Mean and sd of what the draws predict change from sample to sample. The shape of its distribution,
that of (x − mean) / sd, hardly does between two turning points of the voltage, so it need not be
worked out at each sample. It is taken on a straight line between samples where it is known,
wherever a sample in the middle and the moments of all others say that the line is good enough;
where they do not, as along a noisy voltage or at a step, it is worked out at every sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.results import mixture

__all__ = ["Moments", "moments_of", "quantiles_and_spread"]

# Samples between those at which the shape is worked out, where it changes least.
COARSEST = 32

# Largest error at an interval's middle, in units of the mixture's sd.
TOLERANCE = 1e-4

# How far a change of one in skewness and in kurtosis moves the quantiles of 2.5 to 97.5 %, at
# most and rounded up, in units of the sd (Cornish and Fisher's expansion).
SKEWNESS_MOVES = 0.5
KURTOSIS_MOVES = 0.1


def quantiles_and_spread(
    means: FloatArray,
    sds: FloatArray,
    probabilities: FloatArray,
    already: Moments | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Quantiles of the mixture and half the mean distance of two draws, sample by sample.

    With q(t) a quantile, m(t) and s(t) mean and sd of the mixture, z(t) = (q(t) − m(t)) / s(t) is
    worked out at both ends and in the middle of intervals of 32 samples. An interval is halved
    again and again while the straight line between its ends misses z in the middle by more than
    1e-4, or while somewhere in it the straight lines of skewness and kurtosis miss these moments
    by what moves a quantile as far. The spread over s(t) goes the same way.

    Parameters
    ----------
    means
        (draws, samples) mean given a draw, um, of samples that follow each other.
    sds
        (draws,) standard deviation given a draw, um, zero or positive. If all are zero nothing is
        interpolated.
    probabilities
        (q,) inside (0, 1).
    already
        The mixture's moments, if they are known already.

    Returns
    -------
    tuple[FloatArray, FloatArray]
        Quantiles (q, samples) and E|X − X'| / 2 (samples,), um. They differ from those that
        :mod:`bwbayes.results.mixture` works out at each sample by less than 2e-4 of the mixture's
        sd, mostly by a tenth of that; where the distribution is level, in a gap between draws
        whose sds are far smaller, by the same probability instead.
    """
    if not sds.any():
        return mixture.quantiles_and_spread(means, sds, probabilities)
    mean, sd, moments = already or moments_of(means, [sds])[0]
    shape = np.empty((probabilities.size + 1, mean.size))
    every = np.arange(mean.size)
    known = np.zeros(mean.size, dtype=bool)

    def work_out(at: IntArray) -> None:
        quantiles, spread = mixture.quantiles_and_spread(means[:, at], sds, probabilities)
        shape[:-1, at] = (quantiles - mean[at]) / sd[at]
        shape[-1, at] = spread / sd[at]
        known[at] = True

    ends = np.union1d(every[::COARSEST], every[-1:])
    work_out(ends)
    left, right = ends[:-1], ends[1:]
    while (wide := right - left > 1).any():
        left, right = left[wide], right[wide]
        middle = (left + right) // 2
        work_out(middle)
        share = (middle - left) / (right - left)
        line = (1 - share) * shape[:, left] + share * shape[:, right]
        bent = np.abs(line - shape[:, middle]).max(axis=0) > TOLERANCE
        away = np.cumsum(_missed(moments, known) > TOLERANCE)
        bent |= away[right] > away[left]
        left, right = (
            np.concatenate([left[bent], middle[bent]]),
            np.concatenate([middle[bent], right[bent]]),
        )
    at = np.flatnonzero(known)
    shape = np.array([np.interp(every, at, row[at]) for row in shape])
    return mean + sd * shape[:-1], sd * shape[-1]


class Moments(NamedTuple):
    """Mean and sd of a mixture, and what its skewness and kurtosis move a quantile by, (samples,).

    See :func:`moments_of`.
    """

    mean: FloatArray
    sd: FloatArray
    moves: tuple[FloatArray, FloatArray]


def moments_of(means: FloatArray, every: Sequence[FloatArray]) -> list[Moments]:
    """Return the moments of mixtures with the same means and different sds.

    ``means`` (draws, samples) and each of ``every`` (draws,) as in :func:`quantiles_and_spread`.
    Their means are gone through once for all of them.
    """
    draws, samples = means.shape
    # The first row makes means of what it multiplies, the others means of it times variances.
    weights = np.stack([np.ones(draws), *(sds**2 for sds in every)]) / draws
    mean = means.mean(axis=0)
    first, second = np.empty((2, len(weights), samples))
    third, fourth = np.empty((2, samples))
    for piece in mixture.pieces(means):
        away = means[:, piece] - mean[piece]
        square = away**2
        first[:, piece] = weights @ away
        second[:, piece] = weights @ square
        third[piece] = weights[0] @ (square * away)
        fourth[piece] = weights[0] @ square**2
    result = []
    for sds, with_away, with_square in zip(every, first[1:], second[1:], strict=True):
        variance = second[0] + (sds**2).mean()
        size = np.where(variance > 0, variance, 1.0)  # where all draws agree there is no shape
        skewness = (third + 3 * with_away) / size**1.5
        kurtosis = (fourth + 6 * with_square + 3 * (sds**4).mean()) / size**2
        moves = SKEWNESS_MOVES * skewness, KURTOSIS_MOVES * kurtosis
        result.append(Moments(mean, np.sqrt(variance), moves))
    return result


def _missed(rows: Sequence[FloatArray], known: BoolArray) -> FloatArray:
    """How far straight lines between the known samples miss the others, the worst of the rows."""
    every, at = np.arange(known.size), np.flatnonzero(known)
    missed = [np.abs(np.interp(every, at, row[at]) - row) for row in rows]
    worst: FloatArray = np.max(missed, axis=0)
    return worst
