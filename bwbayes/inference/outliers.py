"""Isolated outliers: readings that say nothing about the displacement are set aside.

A loose contact or a lost bit spoils a reading now and then. A Gaussian noise model takes a few such
readings for its sensor, and every band grows; ranges that hold them make default priors absurd. The
model here is: each reading is spoiled with a small probability, independently of all others, and a
spoiled one may be anything. Its likelihood is a sum over all sets of spoiled readings. Where spikes
are far outside the noise one set has nearly all of the weight, so it is chosen once, at the point
fit, and kept: the likelihood of the others costs no more than before. A reading belongs to the set
if the retained readings before and after it, without itself, predict it worse than by :data:`LIMIT`
standard deviations: a good reading does so once in five hundred million. The retained readings
decide the priors and the fit, and these decide which are retained, so the selection is repeated
until it does not change.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.likelihood import Readings
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Study
from bwbayes.model.inputs import rate

# Standard deviations from what its neighbors predict at which a reading is an outlier.
LIMIT = 6.0

# Part of the readings that may be outliers.
MOST = 0.05


def outliers(
    study: Study, generator: np.random.Generator, suspects: Mapping[str, IntArray]
) -> dict[str, IntArray]:
    """Return the samples (outliers,) of records, by name, whose readings are to be set aside.

    Parameters
    ----------
    study
        The study of all readings; its priors are those that the others lead to.
    generator
        Random generator of the fits.
    suspects
        Samples (suspects,) of each record that is searched, by name, that the first fit leaves out.
        Whether they are outliers is decided afterwards.

    Raises
    ------
    InputError
        More than one in twenty of a record's readings would be.
    """
    datasets = {dataset.name: dataset for dataset in study.posterior.datasets}
    if any(dataset.noise.tailed for dataset in datasets.values()):
        raise InputError("model.outliers: noise has heavy tails, which are for outliers; remove it")
    readings_of = {name: datasets[name].readings for name in suspects}
    aside: dict[str, BoolArray] = {
        name: np.isin(readings.rows, suspects[name]) for name, readings in readings_of.items()
    }
    cleared = {name: np.zeros_like(mask) for name, mask in aside.items()}
    for _ in range(10):
        rows = {name: readings_of[name].rows[mask] for name, mask in aside.items()}
        posterior = study.without(rows).posterior
        point = pointfit.fit(posterior, generator.spawn(1)[0])
        before = dict(aside)
        free = posterior.prior.constrain(point.mode[np.newaxis])[0]
        for name, alone, values in posterior.each(free):
            if name not in suspects:
                continue
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
        _require_few(mask, MOST)
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
    these predict no other. With the mean and covariance (m, P) of the discrepancy's states from the
    readings before, and from those after, both joined over their stationary covariance P₀:

        Q⁻¹ = P₁⁻¹ + P₂⁻¹ − P₀⁻¹,   x̂ = Q (P₁⁻¹ m₁ + P₂⁻¹ m₂),   (r − h x̂) / √(h Q hᵀ + s²).

    Backwards in time the states go on by P₀ Fᵀ P₀⁻¹.
    """
    theta = posterior.prior.theta(posterior.prior.constrain(position[np.newaxis])[0])
    dataset, readings = posterior.single_record, readings or posterior.single_record.readings
    simulated = posterior.simulate(theta, readings.rows)[0]
    residual = readings.values - simulated
    noise = dataset.noise.at(dataset.actuator.interval * readings.stride)
    parameters = dataset.table.noise(theta)
    speed = np.abs(rate(dataset.voltage, dataset.actuator.interval))[readings.rows]
    (stationary,), (sensor,) = (
        noise.stationary(parameters),
        noise.sensor_variance(parameters, speed),
    )
    observe = noise.observe
    if not observe @ stationary @ observe > 0:
        return np.asarray(residual / np.sqrt(sensor))
    fitted = np.isin(readings.rows, dataset.readings.rows)
    forward, backward = {}, {}
    for missing in set(readings.skipped.tolist()):
        forward[missing] = noise.transition(parameters, 1 + missing)[0]
        backward[missing] = np.linalg.solve(stationary, forward[missing] @ stationary).T
    turned = np.concatenate([[0.0], readings.skipped[:0:-1]])
    of_states = stationary, observe
    m_1, p_1 = _predict(residual, readings.skipped, fitted, forward, *of_states, sensor)
    after = _predict(residual[::-1], turned, fitted[::-1], backward, *of_states, sensor[::-1])
    m_2, p_2 = after[0][::-1], after[1][::-1]
    inverse_1, inverse_2 = np.linalg.inv(p_1), np.linalg.inv(p_2)
    joined = np.linalg.inv(inverse_1 + inverse_2 - np.linalg.inv(stationary))
    pull = np.einsum("tij,tj->ti", inverse_1, m_1) + np.einsum("tij,tj->ti", inverse_2, m_2)
    projected = joined @ observe
    distance: FloatArray = residual - np.sum(projected * pull, axis=1)
    return np.asarray(distance / np.sqrt(projected @ observe + sensor))


def _predict(
    residual: FloatArray,
    skipped: FloatArray,
    fitted: BoolArray,
    steps: Mapping[float, FloatArray],
    stationary: FloatArray,
    observe: FloatArray,
    sensor: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Predict the discrepancy's states at each reading from known ones before.

    ``steps`` are F (states, states) by the readings that are missing. Returns means (readings,
    states) and covariances (readings, states, states).
    """
    means = np.empty((residual.size, observe.size))
    covariances = np.empty((residual.size, *stationary.shape))
    # The known part is taken from the covariance, which stays stationary otherwise.
    mean, covariance_now = np.zeros(observe.size), np.zeros_like(stationary)
    series = zip(residual.tolist(), skipped.tolist(), fitted.tolist(), strict=True)
    for t, (reading, missing, is_fitted) in enumerate(series):
        if t:
            transition_gap = steps[missing]
            mean, covariance_now = (
                transition_gap @ mean,
                transition_gap @ covariance_now @ transition_gap.T,
            )
        means[t], covariances[t] = mean, stationary - covariance_now
        if is_fitted:
            shared = covariances[t] @ observe
            gain = shared / (shared @ observe + sensor[t])
            mean = mean + gain * (reading - observe @ mean)
            covariance_now = covariance_now + np.outer(gain, shared)
    return means, covariances
