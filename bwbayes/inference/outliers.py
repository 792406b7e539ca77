"""Isolated outliers: readings that say nothing of the displacement, found and set aside.

A loose contact or a lost bit spoils a reading now and then. A Gaussian noise model takes a few such
readings for its sensor, and every band grows. The model here is: each reading is spoiled with a
small probability, independently of all others, and a spoiled one may be anything. Its likelihood is
a sum over all sets of spoiled readings. Where spikes are far outside the noise one set has nearly
all of the weight, so it is found once, at the point fit, and kept: the likelihood of the others
costs no more than before. A reading belongs to the set if the readings before and after it, without
itself, predict it worse than by :data:`LIMIT` standard deviations: a good reading does so once in
five hundred million.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.stats import norm

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference import pointfit
from bwbayes.inference.noise import SteadyState
from bwbayes.inference.posterior import Posterior

__all__ = ["LIMIT", "outliers", "surprise"]

# Standard deviations from what its neighbours predict at which a reading is an outlier.
LIMIT = 6.0

# Fits, each without the outliers of those before; spikes hide others until they are set aside.
ROUNDS = 6

# Median of a standard normal's distance from zero.
MEDIAN = float(norm.ppf(0.75))

# A larger part of the readings than this are no isolated outliers.
MOST = 0.05


def outliers(posterior: Posterior, generator: np.random.Generator) -> IntArray:
    """Return the samples (outliers,) whose readings are to be set aside.

    Raises
    ------
    InputError
        More than one in twenty of the readings would be.
    """
    readings, everything = posterior, posterior.readings.rows.size
    aside = doubtful = np.empty(0, dtype=np.int64)
    for _ in range(ROUNDS):
        point = pointfit.fit(posterior, generator.spawn(1)[0])
        rows = posterior.readings.rows
        away = np.abs(surprise(posterior, point.mode))
        # Many spikes make the fit's noise larger than that of most readings: theirs counts.
        far = away > LIMIT * min(1.0, float(np.median(away)) / MEDIAN)
        if not far.any():
            break
        aside = np.union1d(aside, rows[far])
        doubtful = np.union1d(doubtful, rows[far & (away <= LIMIT)])
        if aside.size > MOST * everything:
            raise InputError(
                f"model.outliers: {aside.size} of {everything} readings would be set aside, too "
                "many for isolated outliers; leave outliers out, and look at the residuals"
            )
        posterior = _without(readings, aside)
    # The last fit tells which of those that most readings' noise made suspect are outliers.
    good = [row for row in doubtful.tolist() if _is_good(readings, aside, row, point.mode)]
    return np.setdiff1d(aside, good)


def _without(posterior: Posterior, rows: IntArray) -> Posterior:
    """Return the posterior without some readings."""
    displacement = posterior.displacement.copy()
    displacement[rows] = np.nan
    return replace(posterior, displacement=displacement)


def _is_good(posterior: Posterior, aside: IntArray, row: int, place: FloatArray) -> bool:
    """Tell whether the reading of a sample goes with all others that are not set aside."""
    with_it = _without(posterior, aside[aside != row])
    at = int(np.searchsorted(with_it.readings.rows, row))
    return bool(np.abs(surprise(with_it, place)[at]) <= LIMIT)


def surprise(posterior: Posterior, place: FloatArray) -> FloatArray:
    """Return how far each reading is from what all others predict, in sds, (readings,).

    At the coordinates ``place`` (free,). With the discrepancy's mean and variance (m, P) from the
    readings before, and from those after, both joined over its own variance σ²:

        1/Q = 1/P₁ + 1/P₂ − 1/σ²,   x̂ = Q (m₁/P₁ + m₂/P₂),   (r − x̂) / √(Q + s²).
    """
    theta = posterior.prior.theta(posterior.prior.constrain(place[np.newaxis])[0])
    readings, likelihood = posterior.readings, posterior.likelihood
    simulated = posterior.simulate(theta, readings.rows)[0]
    residual = readings.values - simulated
    steady = likelihood.spaced.steady_state(posterior.table.noise(theta))
    own = float(steady.predicted[0] + steady.surplus[0])
    sensor = float(steady.variance[0] - steady.predicted[0])
    if own <= 0:
        return np.asarray(residual / np.sqrt(sensor))
    before = _predicted(residual, readings.skipped, steady)
    backward = np.concatenate([[0.0], readings.skipped[:0:-1]])
    after = (part[::-1] for part in _predicted(residual[::-1], backward, steady))
    (m_1, p_1), (m_2, p_2) = before, after
    joined = 1 / (1 / p_1 + 1 / p_2 - 1 / own)
    expected = joined * (m_1 / p_1 + m_2 / p_2)
    distance: FloatArray = (residual - expected) / np.sqrt(joined + sensor)
    return distance


def _predicted(
    residual: FloatArray, skipped: FloatArray, steady: SteadyState
) -> tuple[FloatArray, FloatArray]:
    """Predict the discrepancy at each reading from those before: mean and variance (readings,)."""
    predicted, variance = float(steady.predicted[0]), float(steady.variance[0])
    own = predicted + float(steady.surplus[0])
    rate, sensor = float(steady.rate[0]), variance - predicted
    means, variances = np.empty_like(residual), np.empty_like(residual)
    mean, unsure = 0.0, own
    for t, (reading, missing) in enumerate(zip(residual.tolist(), skipped.tolist(), strict=True)):
        if t:
            kept = math.exp(-(1 + missing) * rate)
            mean, unsure = kept * mean, kept**2 * unsure + (1 - kept**2) * own
        means[t], variances[t] = mean, unsure
        gain = unsure / (unsure + sensor)
        mean, unsure = mean + gain * (reading - mean), gain * sensor
    return means, variances
