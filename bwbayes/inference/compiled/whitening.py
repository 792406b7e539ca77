"""The noise's filter along series that come from NumPy: their innovations themselves, not sums.

As :meth:`~bwbayes.inference.state_space.Noise.filter` does, for any number of states: a model's
covariance goes on once for all of its series, and each series follows with the gains of its model.
"""

from __future__ import annotations

import math

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled.caching import compile_cached
from bwbayes.inference.compiled.lanes import inner

# Readings whose series are put side by side at a time.
PIECE = 64


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
        P (models, states, states), h (states,), and the sensor's variance (models,), um².
    gaps
        (readings,) which of the gaps is just before a reading; 0 if none is.
    series
        (models, series, readings), um.
    """
    _, count, readings = series.shape
    states = observe.size
    white, logs = np.empty_like(series), np.zeros(len(series))
    covariance, work = np.empty((states, states)), np.empty((3, states, states))
    shared = np.empty(states)
    mean, after = np.empty((states, count)), np.empty((states, count))
    values = np.empty((PIECE, count))
    for model in range(len(series)):
        covariance[:], mean[:] = stationary[model], 0.0
        settled, variance = False, 1.0
        for first in range(0, readings, PIECE):
            size = min(PIECE, readings - first)
            for k in range(count):
                for t in range(size):
                    values[t, k] = series[model, k, first + t]
            for t in range(size):
                if not settled:
                    variance = _observe(covariance, observe, sensor[model], shared)
                logs[model] += math.log(variance)
                step = gaps[first + t + 1] if first + t + 1 < readings else 0
                kept = transitions[step, model]
                _innovate(values[t], mean, after, kept, shared, observe, variance)
                mean, after = after, mean
                if not settled or step > 0:
                    # After a gap the covariance is another one, and so are its gains.
                    settled = _advance(
                        covariance, kept, gained[step, model], shared, observe, sensor[model],
                        variance, work,
                    ) and step == 0  # fmt: skip
            for k in range(count):
                for t in range(size):
                    white[model, k, first + t] = values[t, k]
    return white, logs


@inner(error_model="numpy")
def _innovate(
    values: FloatArray,
    mean: FloatArray,
    after: FloatArray,
    kept: FloatArray,
    shared: FloatArray,
    observe: FloatArray,
    variance: float,
) -> None:
    """Turn a reading of each series (series,) into its innovation over its sd.

    ``mean`` (states, series) is expected of it, and ``after`` written: what is of the next one.
    """
    states, count = mean.shape
    scale = 1.0 / math.sqrt(variance)
    for i in range(states):
        for k in range(count):
            values[k] -= observe[i] * mean[i, k]
    for i in range(states):
        gain = 0.0
        for j in range(states):
            gain += kept[i, j] * shared[j]
        gain /= variance
        for k in range(count):
            after[i, k] = gain * values[k]
        for j in range(states):
            for k in range(count):
                after[i, k] += kept[i, j] * mean[j, k]
    for k in range(count):
        values[k] *= scale


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
    kept: FloatArray,
    gained: FloatArray,
    shared: FloatArray,
    observe: FloatArray,
    sensor: float,
    variance: float,
    work: FloatArray,
) -> bool:
    """Take a reading into the covariance and go on by F and Q; tell whether it stays as it is.

    By Joseph's form, which has no negative eigenvalue however it is rounded: with K = P h / S,
    F ((1 − K h) P (1 − K h)ᵀ + s² K Kᵀ) Fᵀ + Q.
    """
    states = observe.size
    rest, updated = work[0], work[1]
    for i in range(states):
        for j in range(states):
            rest[i, j] = (1.0 if i == j else 0.0) - shared[i] / variance * observe[j]
    _between(rest, covariance, updated, work[2])
    for i in range(states):
        for j in range(states):
            updated[i, j] += sensor * (shared[i] / variance) * (shared[j] / variance)
    _between(kept, updated, rest, work[2])
    stays = True
    for i in range(states):
        for j in range(states):
            after = rest[i, j] + gained[i, j]
            size = math.sqrt(max((rest[i, i] + gained[i, i]) * (rest[j, j] + gained[j, j]), 0.0))
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
