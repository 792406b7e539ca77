"""Isolated outliers: readings that say nothing about the displacement are set aside.

A loose contact or a lost bit spoils a reading now and then. A Gaussian noise model takes a few such
readings for its sensor, and every band grows. The model here is: each reading is spoiled with a
small probability, independently of all others, and a spoiled one may be anything. Its likelihood is
a sum over all sets of spoiled readings. Where spikes are far outside the noise one set has nearly
all of the weight, so it is chosen once, at the point fit, and kept: the likelihood of the others
costs no more than before. A reading belongs to the set if the readings before and after it, without
itself, predict it worse than by :data:`LIMIT` standard deviations: a good reading does so once in
five hundred million.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy import ndimage
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

# If they are a larger part of the readings than this, they are not isolated outliers.
MOST = 0.05


def outliers(posterior: Posterior, generator: np.random.Generator) -> dict[str, IntArray]:
    """Return the samples (outliers,) of each record, by name, whose readings are to be set aside.

    Raises
    ------
    InputError
        More than one in twenty of a record's readings would be.
    """
    everything, none = posterior, np.empty(0, dtype=np.int64)
    aside = {one.name: none for one in posterior.datasets}
    doubtful = dict(aside)
    for _ in range(ROUNDS):
        point = pointfit.fit(posterior, generator.spawn(1)[0])
        places = _places(posterior, point.mode)
        quiet = True
        for name, place in places.items():
            alone = posterior.alone(name)
            rows, away = alone.only.readings.rows, np.abs(surprise(alone, place))
            # Many spikes make the fit's noise larger than that of most readings: theirs counts, and
            # leaves a doubt.
            far = away > LIMIT * min(1.0, float(np.median(away)) / MEDIAN)
            quiet = quiet and not far.any()
            aside[name] = np.union1d(aside[name], rows[far])
            # So does lying beside a larger one, which a discrepancy would have carried on.
            beside = away < ndimage.maximum_filter1d(away, 3)
            doubt = far & (beside | (away <= LIMIT))
            doubtful[name] = np.union1d(doubtful[name], rows[doubt])
            _require_few(aside[name].size, everything.alone(name).only.readings.rows.size)
        if quiet:
            break
        posterior = _without(everything, aside)
    # The last fit tells which of those that were suspect are outliers.
    for name, place in places.items():
        one = everything.alone(name)
        good = [row for row in doubtful[name].tolist() if _is_good(one, aside[name], row, place)]
        aside[name] = np.setdiff1d(aside[name], good)
    return aside


def _places(posterior: Posterior, place: FloatArray) -> dict[str, FloatArray]:
    """Return the coordinates (its free,) of each record alone at joint ones (free,)."""
    free = posterior.prior.constrain(place[np.newaxis])[0]
    return {name: one.prior.unconstrain(draws)[0] for name, one, draws in posterior.each(free)}


def _require_few(outliers: int, everything: int) -> None:
    if outliers > MOST * everything:
        raise InputError(
            f"model.outliers: {outliers} of {everything} readings would be set aside, too "
            "many for isolated outliers; leave outliers out, and look at the residuals"
        )


def _without(posterior: Posterior, rows: Mapping[str, IntArray]) -> Posterior:
    """Return the posterior without some readings of its records."""
    displacements = {one.name: one.displacement.copy() for one in posterior.datasets}
    for name, displacement in displacements.items():
        displacement[rows[name]] = np.nan
    return posterior.with_readings(displacements)


def _is_good(posterior: Posterior, aside: IntArray, row: int, place: FloatArray) -> bool:
    """Tell whether the reading of a sample goes with all others that are not set aside."""
    with_it = _without(posterior, {posterior.only.name: aside[aside != row]})
    at = int(np.searchsorted(with_it.only.readings.rows, row))
    return bool(np.abs(surprise(with_it, place)[at]) <= LIMIT)


def surprise(posterior: Posterior, place: FloatArray) -> FloatArray:
    """Return how far each reading of a record is from what all others predict, in sds, (readings,).

    At the coordinates ``place`` (free,). With the discrepancy's mean and variance (m, P) from the
    readings before, and from those after, both joined over its own variance σ²:

        1/Q = 1/P₁ + 1/P₂ − 1/σ²,   x̂ = Q (m₁/P₁ + m₂/P₂),   (r − x̂) / √(Q + s²).
    """
    theta = posterior.prior.theta(posterior.prior.constrain(place[np.newaxis])[0])
    readings, likelihood = posterior.only.readings, posterior.likelihood
    simulated = posterior.simulate(theta, readings.rows)[0]
    residual = readings.values - simulated
    steady = likelihood.spaced.steady_state(posterior.only.table.noise(theta))
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
