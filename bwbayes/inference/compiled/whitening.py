"""The noise's filter along series that come from NumPy: their innovations themselves, not sums.

It works like :meth:`~bwbayes.inference.state_space.Noise.filter`, for any number of states: a
model's covariance advances once for all of its series. The series of some models are side by side,
so that no reading of one waits for the one before it.
"""

from __future__ import annotations

import math

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled.caching import compile_cached
from bwbayes.inference.compiled.lanes import inner

# Number of readings whose series are put side by side at a time, and of models in a group.
PIECE, TOGETHER = 16, 32


@compile_cached(error_model="numpy")
def whitened(
    transitions: FloatArray,
    gained: FloatArray,
    stationary: FloatArray,
    observe: FloatArray,
    sensor: FloatArray,
    gaps: IntArray,
    series: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return innovations (models, series, readings) over their sds, and log determinants (models,).

    Parameters
    ----------
    transitions, gained
        F and Q (gaps, models, states, states) over each gap; the first misses no reading.
    stationary, observe, sensor
        P (models, states, states), h (states,), and the sensor's variance, um², (models, 1), or
        that of each reading (models, readings).
    gaps
        (readings,) index of the gap just before a reading; 0 without a gap.
    series
        (models, series, readings), um.
    """
    white, logs = np.empty_like(series), np.zeros(len(series))
    for begin in range(0, len(series), TOGETHER):
        models = slice(begin, begin + TOGETHER)
        _whiten(
            transitions[:, models], gained[:, models], stationary[models].copy(), observe,
            sensor[models], gaps, series[models], white[models], logs[models],
        )  # fmt: skip
    return white, logs


@inner(error_model="numpy")
def _whiten(
    transitions: FloatArray,
    gained: FloatArray,
    covariance: FloatArray,
    observe: FloatArray,
    sensor: FloatArray,
    gaps: IntArray,
    series: FloatArray,
    white: FloatArray,
    logs: FloatArray,
) -> None:
    """Write the whitened series of a group of models, and advance their covariance in place."""
    models, count, readings = series.shape
    varies = sensor.shape[1] > 1
    states, columns = observe.size, models * count
    work, shared = np.empty((3, states, states)), np.empty((models, states))
    variance, log_variance = np.ones(models), np.zeros(models)
    settled, before = np.zeros(models, np.bool_), -1
    # For each series: the estimates of its states, its model's F and gain, one over its sd.
    mean, after = np.zeros((states, columns)), np.zeros((states, columns))
    f_matrix, gain = np.empty((states, states, columns)), np.empty((states, columns))
    scale, values = np.empty(columns), np.empty((PIECE, columns))
    for first in range(0, readings, PIECE):
        size = min(PIECE, readings - first)
        for model in range(models):
            for k in range(count):
                values[:size, model * count + k] = series[model, k, first : first + size]
        for t in range(size):
            step = gaps[first + t + 1] if first + t + 1 < readings else 0
            for model in range(models):
                at = first + t if varies else 0
                if not settled[model]:
                    variance[model] = _observe(
                        covariance[model], observe, sensor[model, at], shared[model]
                    )
                    log_variance[model] = math.log(variance[model])
                if not settled[model] or step != before:
                    block = slice(model * count, (model + 1) * count)
                    scale[block] = 1.0 / math.sqrt(variance[model])
                    _set_gain(
                        transitions[step, model], shared[model], variance[model],
                        f_matrix[..., block], gain[:, block],
                    )  # fmt: skip
                logs[model] += log_variance[model]
            before = step
            _innovate(values[t], mean, after, f_matrix, gain, observe, scale)
            mean, after = after, mean
            for model in range(models):
                if not settled[model] or step > 0:
                    # A gap changes the covariance and its gains.
                    settled[model] = _advance(
                        covariance[model], transitions[step, model], gained[step, model],
                        shared[model], observe, sensor[model, first + t if varies else 0],
                        variance[model], work,
                    ) and step == 0 and not varies  # fmt: skip
        for model in range(models):
            for k in range(count):
                white[model, k, first : first + size] = values[:size, model * count + k]


@inner(error_model="numpy")
def _set_gain(
    transition: FloatArray,
    shared: FloatArray,
    variance: float,
    f_matrix: FloatArray,
    gain: FloatArray,
) -> None:
    """Write F and F P h / S for the series of a model, (states, states, series), (states, series).

    P h (states,) is ``shared``, S the ``variance`` of a reading.
    """
    states = shared.size
    for i in range(states):
        weight = 0.0
        for j in range(states):
            weight += transition[i, j] * shared[j]
            f_matrix[i, j] = transition[i, j]
        gain[i] = weight / variance


@inner(error_model="numpy")
def _innovate(
    values: FloatArray,
    mean: FloatArray,
    after: FloatArray,
    f_matrix: FloatArray,
    gain: FloatArray,
    observe: FloatArray,
    scale: FloatArray,
) -> None:
    """Turn a reading of each series (series,) into its innovation over its sd.

    ``mean`` (states, series) is the estimate for it, and ``after`` receives that for the next one.
    """
    states, count = mean.shape
    for i in range(states):
        for k in range(count):
            values[k] -= observe[i] * mean[i, k]
    for i in range(states):
        for k in range(count):
            after[i, k] = gain[i, k] * values[k]
        for j in range(states):
            for k in range(count):
                after[i, k] += f_matrix[i, j, k] * mean[j, k]
    for k in range(count):
        values[k] *= scale[k]


@inner(error_model="numpy")
def _observe(
    covariance: FloatArray, observe: FloatArray, sensor: float, shared: FloatArray
) -> float:
    """Write P h (states,), and return the variance of a reading, h P hᵀ + s²."""
    variance = sensor
    for i in range(observe.size):
        shared[i] = 0.0
        for j in range(observe.size):
            shared[i] += covariance[i, j] * observe[j]
        variance += observe[i] * shared[i]
    return variance


@inner(error_model="numpy")
def _advance(
    covariance: FloatArray,
    f_matrix: FloatArray,
    gained: FloatArray,
    shared: FloatArray,
    observe: FloatArray,
    sensor: float,
    variance: float,
    work: FloatArray,
) -> bool:
    """Update the covariance by a reading, advance it by F and Q, and tell whether it is unchanged.

    The update is Joseph's form, which has no negative eigenvalue however it is rounded: with
    K = P h / S, F ((1 − K h) P (1 − K h)ᵀ + s² K Kᵀ) Fᵀ + Q.
    """
    states = observe.size
    reduced, updated = work[0], work[1]
    for i in range(states):
        for j in range(states):
            reduced[i, j] = (1.0 if i == j else 0.0) - shared[i] / variance * observe[j]
    _between(reduced, covariance, updated, work[2])
    for i in range(states):
        for j in range(states):
            updated[i, j] += sensor * (shared[i] / variance) * (shared[j] / variance)
    _between(f_matrix, updated, reduced, work[2])
    stays = True
    for i in range(states):
        for j in range(states):
            after = reduced[i, j] + gained[i, j]
            size = math.sqrt(
                max((reduced[i, i] + gained[i, i]) * (reduced[j, j] + gained[j, j]), 0.0)
            )
            stays &= abs(after - covariance[i, j]) <= 2e-15 * size
            covariance[i, j] = after
    return stays


@inner(error_model="numpy")
def _between(left: FloatArray, middle: FloatArray, product: FloatArray, work: FloatArray) -> None:
    """Write left middle leftᵀ, all (states, states)."""
    states = len(left)
    for i in range(states):
        for j in range(states):
            work[i, j] = 0.0
            for k in range(states):
                work[i, j] += left[i, k] * middle[k, j]
    for i in range(states):
        for j in range(states):
            product[i, j] = 0.0
            for k in range(states):
                product[i, j] += work[i, k] * left[j, k]
