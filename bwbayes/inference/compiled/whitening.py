"""The noise's filter along series that come from NumPy: their innovations themselves, not sums.

It works like :meth:`~bwbayes.inference.state_space.Noise.filter`, for any number of states: a
model's covariance advances once for all of its series. The series of some models are side by side,
so that no reading of one waits for the one before it. Where the sensor's noise has heavy tails, the
filter of :mod:`~bwbayes.inference.heavy_tails` goes model by model (:func:`run`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled.lanes import compile_cached, inner
from bwbayes.inference.heavy_tails import Steps

# Number of readings whose series are put side by side at a time, and of models in a group.
PIECE, TOGETHER = 16, 32


@compile_cached(error_model="numpy")
def whiten_series(
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


def run(steps: Steps, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, ...]:
    """Run the filter as :func:`bwbayes.inference.heavy_tails.run` does."""
    # Numba would compile the function for each layout of an array.
    arrays: list[Any] = [*map(np.ascontiguousarray, steps)]
    return _run(Steps(*arrays), mean, covariance)


@compile_cached(error_model="numpy")
def _run(steps: Steps, means: FloatArray, covariances: FloatArray) -> tuple[FloatArray, ...]:
    transitions, gained, gaps, variances, logs, observe, series = steps
    models, count, readings = series.shape
    log_densities = np.full(models, -0.5 * readings * np.log(2 * np.pi))
    errors, spreads = np.empty((models, readings)), np.empty((models, readings))
    sensors = np.empty((models, readings))
    states, size = observe.size, means.shape[1]
    row, gain, cross = np.zeros(size), np.empty(size), np.empty(size)
    row[:states] = observe
    after, product = np.empty(size), np.empty((size, size))
    work = np.empty((3, variances.shape[1]))
    for model in range(models):
        mean, covariance = means[model], covariances[model]
        for t in range(readings):
            if t:
                _go_on(
                    transitions[gaps[t], model], gained[gaps[t], model], states, mean, covariance,
                    after, product,
                )  # fmt: skip
            for k in range(1, count):
                row[states + k - 1] = series[model, k, t]
            spread, error = 0.0, series[model, 0, t]
            _times(covariance, row, after)
            for i in range(size):
                spread += row[i] * after[i]
                error -= row[i] * mean[i]
            log, rate, doubt, sensor = _weigh(spread, error, variances[model], logs[model], work)
            log_densities[model] += log
            errors[model, t], spreads[model, t], sensors[model, t] = error, spread, sensor
            _update(covariance, mean, row, after, (error, rate, doubt, sensor), gain, cross)
    return log_densities, errors, spreads, sensors


@inner(error_model="numpy")
def _go_on(
    f_matrices: FloatArray,
    gained: FloatArray,
    states: int,
    mean: FloatArray,
    covariance: FloatArray,
    after: FloatArray,
    product: FloatArray,
) -> None:
    """Advance the discrepancy's states, x ← F x, P ← F P Fᵀ + Q; sizes stay as they are."""
    for i in range(states):
        after[i] = 0.0
        for k in range(states):
            after[i] += f_matrices[i, k] * mean[k]
        for j in range(mean.size):
            product[i, j] = 0.0
            for k in range(states):
                product[i, j] += f_matrices[i, k] * covariance[k, j]
    for i in range(states):
        mean[i] = after[i]
        for j in range(states, mean.size):
            covariance[i, j] = covariance[j, i] = product[i, j]
        for j in range(states):
            covariance[i, j] = gained[i, j]
            for k in range(states):
                covariance[i, j] += product[i, k] * f_matrices[j, k]


@inner(error_model="numpy")
def _update(
    covariance: FloatArray,
    mean: FloatArray,
    row: FloatArray,
    shared: FloatArray,
    reading: tuple[float, float, float, float],
    gain: FloatArray,
    cross: FloatArray,
) -> None:
    """Update the states by a reading, as in NumPy; ``shared`` is P c."""
    size, (error, rate, doubt, sensor) = row.size, reading
    for i in range(size):
        gain[i] = shared[i] * rate
        mean[i] += gain[i] * error
        for j in range(size):
            covariance[i, j] -= gain[i] * shared[j]
    _times(covariance, row, cross)
    for i in range(size):
        for j in range(size):
            covariance[i, j] += (sensor * gain[i] - cross[i]) * gain[j]
            covariance[i, j] += doubt * shared[i] * shared[j]
    for i in range(size):
        for j in range(i):
            symmetric = (covariance[i, j] + covariance[j, i]) / 2
            covariance[i, j] = covariance[j, i] = symmetric


@inner(error_model="numpy")
def _times(matrix: FloatArray, vector: FloatArray, product: FloatArray) -> None:
    """Write the product of a matrix (states, states) and a vector (states,)."""
    for i in range(vector.size):
        product[i] = 0.0
        for j in range(vector.size):
            product[i] += matrix[i, j] * vector[j]


@inner(error_model="numpy", fastmath=True)
def _weigh(
    spread: float, error: float, variances: FloatArray, logs: FloatArray, work: FloatArray
) -> tuple[float, float, float, float]:
    """Return log p(e), E[1/V], e² Var[1/V] and R of a reading.

    The largest part is found without an exponential; the others are relative to it.
    """
    count, squares, top = variances.size, error * error, -np.inf
    for k in range(count):
        inverse = 1.0 / (spread + variances[k])
        work[0, k] = inverse
        work[1, k] = logs[k] - 0.5 * squares * inverse
        top = max(top, work[1, k])
    for k in range(count):
        # Compute exp(x) as exp(x/1024) to the power 1024, since a compiler can vectorize that.
        x = max(work[1, k] - top, -60.0) / 1024.0
        x = 1.0 + x * (1.0 + x / 2 * (1.0 + x / 3 * (1.0 + x / 4 * (1.0 + x / 5 * (1.0 + x / 6)))))
        x *= x
        x *= x
        x *= x
        x *= x
        x *= x
        x *= x
        x *= x
        x *= x
        x *= x
        x *= x
        work[2, k] = x * math.sqrt(work[0, k])
    total = rate = second = sensor = 0.0
    for k in range(count):
        share, inverse = work[2, k], work[0, k]
        total += share
        rate += share * inverse
        second += share * inverse * inverse
        sensor += share * inverse * variances[k]
    rate, second, sensor = rate / total, second / total, sensor / total
    doubt = squares * max(second - rate * rate, 0.0)
    return top + math.log(total), rate, doubt, sensor / rate
