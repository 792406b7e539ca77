"""Isolated outliers: readings that say nothing about the displacement are set aside.

A loose contact or a lost bit spoils a reading now and then. A Gaussian noise model takes a few such
readings for its sensor, and every band grows; ranges that hold them make default priors absurd. The
model here is: each reading is spoiled with a small probability, independently of all others, and a
spoiled one may be anything. Its likelihood is a sum over all sets of spoiled readings. Where spikes
are far outside the noise one set has nearly all of the weight, so it is chosen once, at the point
fit, and kept: the likelihood of the others costs no more than before. A reading belongs to the set
if the retained readings before and after it, without itself, predict it worse than by
:data:`LIMIT` standard deviations: a good reading does so once in five hundred million. What is
retained decides the priors and the fit, and these decide what is retained, so the selection is
repeated until it does not change.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.readings import Readings

# Standard deviations from what its neighbors predict at which a reading is an outlier.
LIMIT = 6.0


def outliers(
    without: Callable[[Mapping[str, IntArray]], Posterior],
    generator: np.random.Generator,
    suspects: Mapping[str, IntArray] | None = None,
) -> dict[str, IntArray]:
    """Return the samples (outliers,) of each record, by name, whose readings are to be set aside.

    Parameters
    ----------
    without
        Returns the posterior, with the priors that its readings lead to, without the readings of
        some samples of each record, by name.
    generator
        Of the fits.
    suspects
        Samples (suspects,) of each record, by name, that the first fit leaves out. Whether they are
        outliers is decided afterwards.

    Raises
    ------
    InputError
        More than one in twenty of a record's readings would be.
    """
    readings_of = {dataset.name: dataset.readings for dataset in without({}).datasets}
    aside: dict[str, BoolArray] = {
        name: np.isin(readings.rows, (suspects or {}).get(name, []))
        for name, readings in readings_of.items()
    }
    cleared = {name: np.zeros_like(mask) for name, mask in aside.items()}
    for _ in range(10):
        posterior = without({name: readings_of[name].rows[mask] for name, mask in aside.items()})
        point = pointfit.fit(posterior, generator.spawn(1)[0])
        before = dict(aside)
        free = posterior.prior.constrain(point.mode[np.newaxis])[0]
        for name, alone, values in posterior.each(free):
            position, mask = alone.prior.unconstrain(values)[0], aside[name]
            away = np.abs(surprise(alone, position, readings_of[name]))
            # Spikes in a fit make its noise larger than that of most readings: theirs counts, but
            # what a later fit clears needs the whole distance from then on.
            typical = min(1.0, float(np.median(away[~mask]) / scipy.special.ndtri(0.75)))
            cleared[name] = cleared[name] | (mask & (away <= LIMIT))
            suspect = (away > LIMIT * typical) & ~mask & ~cleared[name]
            aside[name] = (away > LIMIT) | suspect
            _require_few(aside[name], 0.5)  # and a fit to fewer than half says nothing
        if all(np.array_equal(aside[name], before[name]) for name in aside):
            break
    for mask in aside.values():
        _require_few(mask, 0.05)
    return {name: readings_of[name].rows[mask] for name, mask in aside.items()}


def _require_few(aside: BoolArray, limit: float) -> None:
    """Refuse to set aside more than a part of the readings (readings,)."""
    if np.mean(aside) > limit:
        raise InputError(
            f"model.outliers: {np.sum(aside)} of {aside.size} readings would be set aside, too "
            "many for isolated outliers; leave outliers out, and look at the residuals"
        )


def surprise(
    posterior: Posterior, position: FloatArray, readings: Readings | None = None
) -> FloatArray:
    """Return how far each reading of a record is from what all others predict, in sds, (readings,).

    At the coordinates ``position`` (free,). ``readings`` may have some that the posterior has not;
    these predict no other. With the mean and covariance (m, P) of the discrepancy's state from the
    readings before, and from those after, both joined over its own covariance σ²:

        Q⁻¹ = P₁⁻¹ + P₂⁻¹ − σ⁻²,   x̂ = Q (P₁⁻¹ m₁ + P₂⁻¹ m₂),   (r − x̂) / √(Q + s²).
    """
    theta = posterior.prior.theta(posterior.prior.constrain(position[np.newaxis])[0])
    dataset, readings = posterior.only, readings or posterior.only.readings
    simulated = posterior.simulate(theta, readings.rows)[0]
    residual = readings.values - simulated
    noise = dataset.noise.at(dataset.actuator.interval * readings.stride)
    parameters = dataset.table.noise(theta)
    process, sensor = (float(sd[0]) ** 2 for sd in noise.marginal_sd(parameters))
    if process <= 0:
        return np.asarray(residual / np.sqrt(sensor))
    fitted = np.isin(readings.rows, dataset.readings.rows)
    steps = {
        missing: noise.transition(parameters, 1 + missing)[0]
        for missing in set(readings.skipped.tolist())
    }
    backward = np.concatenate([[0.0], readings.skipped[:0:-1]])
    m_1, p_1 = _predicted(residual, readings.skipped, fitted, steps, process, sensor)
    after = _predicted(residual[::-1], backward, fitted[::-1], steps, process, sensor)
    # Backwards in time the second state has the other sign.
    turned = np.array([1.0, -1.0])
    m_2, p_2 = after[0][::-1] * turned, after[1][::-1] * np.outer(turned, turned)
    one, other = np.linalg.inv(p_1), np.linalg.inv(p_2)
    joined = np.linalg.inv(one + other - np.eye(2) / process)
    pull = np.einsum("tij,tj->ti", one, m_1) + np.einsum("tij,tj->ti", other, m_2)
    expected = np.einsum("tj,tj->t", joined[:, 0], pull)
    distance: FloatArray = (residual - expected) / np.sqrt(joined[:, 0, 0] + sensor)
    return distance


def _predicted(
    residual: FloatArray,
    skipped: FloatArray,
    fitted: BoolArray,
    steps: Mapping[float, FloatArray],
    process: float,
    sensor: float,
) -> tuple[FloatArray, FloatArray]:
    """Predict the discrepancy's state at each reading from known ones before.

    ``steps`` are F (2, 2) by the readings that are missing. Returns means (readings, 2) and
    covariances (readings, 2, 2).
    """
    means, gains = np.empty((residual.size, 2)), np.empty((residual.size, 2, 2))
    mean, gained = np.zeros(2), np.zeros((2, 2))
    series = zip(residual.tolist(), skipped.tolist(), fitted.tolist(), strict=True)
    for t, (reading, missing, is_known) in enumerate(series):
        if t:
            kept = steps[missing]
            mean, gained = kept @ mean, kept @ gained @ kept.T
        means[t], gains[t] = mean, gained
        if is_known:
            told = np.array([process - gained[0, 0], -gained[1, 0]])
            gain = told / (told[0] + sensor)
            mean = mean + gain * (reading - mean[0])
            gained = gained + np.outer(gain, told)
    return means, process * np.eye(2) - gains
