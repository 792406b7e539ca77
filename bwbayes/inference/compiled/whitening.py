"""The noise's filter along series that come from NumPy: their innovations themselves, not sums.

The gains are the same for all series of a model, so the covariance goes on once, as in
:mod:`bwbayes.inference.compiled.filter`, and each series follows with the gains of its model.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray, IntArray

# isort: off
# fmt: off
from bwbayes.inference.compiled.lanes import (
    COVARIANCE, COVARIANCE_12, COVARIANCE_22, FRESH, GAIN, GAIN_2, INVERSE, KEPT, LANES, LOG,
    PROCESS, RATIO, SENSOR, STATE, STEP,
)
# fmt: on
# isort: on
from bwbayes.inference.compiled.filter import advance, is_settled, skip, take_logs

__all__ = ["whitened"]

# After so many readings it is looked at whether the gains stay as they are.
LOOK = 16


@njit(nogil=True, cache=True, error_model="numpy")
def whitened(
    step: FloatArray,
    process: FloatArray,
    sensor: FloatArray,
    second: bool | None,
    gaps: IntArray,
    steps: FloatArray,
    series: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return innovations (models, series, readings) over their sds, and log determinants (models,).

    Parameters
    ----------
    step
        (models, ``STEP``) the filter's step from reading to reading.
    process, sensor
        (models,) variances of the discrepancy and of the sensor, um².
    second
        None unless the noise has two states.
    gaps
        (readings,) which of the gaps is just before a reading; 0 if none is.
    steps
        (gaps, models, ``STEP``) the filter's step over each gap.
    series
        (models, series, readings), um.
    """
    models, count, readings = series.shape
    white, logs = np.empty_like(series), np.empty(models)
    state, over = np.zeros(STATE), np.zeros((steps.shape[0], STEP * LANES))
    gains = np.empty((min(models, LANES), 3, readings))
    for first in range(0, models, LANES):
        lanes = min(models - first, LANES)
        for i in range(LANES):
            model = min(first + i, models - 1)
            for row in range(STEP):
                state[KEPT + row * LANES + i] = step[model, row]
                for gap in range(steps.shape[0]):
                    over[gap, row * LANES + i] = steps[gap, model, row]
            state[SENSOR + i], state[PROCESS + i] = sensor[model], process[model]
            state[COVARIANCE + i] = state[COVARIANCE_22 + i] = process[model]
            state[COVARIANCE_12 + i] = state[LOG + i] = 0.0
            state[RATIO + i] = 1.0
        _gains(state, second, gaps, over, gains[:lanes])
        for i in range(lanes):
            model = first + i
            logs[model] = state[LOG + i] + readings * math.log(step[model, 3] + sensor[model])
            for k in range(count):
                _follow(
                    step[model], gaps, steps[:, model], gains[i], series[model, k], white[model, k]
                )
    return white, logs


@njit(nogil=True, cache=True)
def _follow(
    step: FloatArray,
    gaps: IntArray,
    steps: FloatArray,
    gains: FloatArray,
    series: FloatArray,
    white: FloatArray,
) -> None:
    """Write the innovations of one series (readings,), over their sds, into ``white``."""
    a, b, d = step[:3]
    estimate, other = 0.0, 0.0
    for t in range(series.size):
        if gaps[t] > 0:
            a_gap, b_gap, d_gap = steps[gaps[t] - 1, :3]
            estimate, other = a_gap * estimate + b_gap * other, d_gap * other - b_gap * estimate
        innovation = series[t] - estimate
        white[t] = innovation * gains[2, t]
        estimate, other = (
            a * estimate + b * other + gains[0, t] * innovation,
            d * other - b * estimate + gains[1, t] * innovation,
        )


@njit(nogil=True, cache=True, error_model="numpy")
def _gains(
    state: FloatArray, second: bool | None, gaps: IntArray, steps: FloatArray, gains: FloatArray
) -> None:
    """Write both gains of each reading and one over its sd: ``gains`` (lanes, 3, readings)."""
    lanes, _, readings = gains.shape
    settled = False
    for t in range(readings):
        if gaps[t] > 0:
            skip(state, second, steps[gaps[t] - 1])
            settled = False
        if settled:
            for i in range(lanes):
                state[RATIO + i] /= state[INVERSE + i] * (state[FRESH + i] + state[SENSOR + i])
        else:
            advance(state, second)
        if t % LOOK == 0:
            take_logs(state)
            settled = is_settled(state)
        for i in range(lanes):
            gains[i, 0, t] = state[GAIN + i]
            gains[i, 1, t] = state[GAIN_2 + i]
            gains[i, 2, t] = math.sqrt(state[INVERSE + i])
    take_logs(state)
