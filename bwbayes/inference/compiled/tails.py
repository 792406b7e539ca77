"""The filter of :mod:`~bwbayes.inference.heavy_tails`, model by model."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.caching import compile_cached
from bwbayes.inference.compiled.lanes import inner
from bwbayes.inference.heavy_tails import Steps


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
