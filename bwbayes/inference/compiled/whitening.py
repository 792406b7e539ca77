"""The noise's filter along series that come from NumPy: their innovations themselves, not sums.

The recursions are those of :mod:`bwbayes.inference.compiled.filter`: the covariance goes on once
for all series of a model, and each series follows with the gains of its model.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray, IntArray

# isort: off
# fmt: off
from bwbayes.inference.compiled.lanes import (
    COVARIANCE, COVARIANCE_12, COVARIANCE_22, KEPT, LANES, LOG, PROCESS, RATIO, SENSOR, STATE, STEP,
)
# fmt: on
# isort: on
from bwbayes.inference.compiled.filter import gain, innovate
from bwbayes.inference.compiled.motion import PIECE


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
    estimate, other = np.zeros((count, LANES)), np.zeros((count, LANES))
    gains = np.empty((3, PIECE * LANES))
    values = np.zeros(PIECE * LANES)
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
        estimate[:], other[:] = 0.0, 0.0
        usual = state[KEPT : KEPT + 3 * LANES]
        for now in range(0, readings, PIECE):
            ahead = gaps[now : now + PIECE]
            gain(state, second, ahead, over, gains[0], gains[1], gains[2])
            for k in range(count):
                for i in range(lanes):
                    for t in range(ahead.size):
                        values[t * LANES + i] = series[first + i, k, now + t]
                innovate(
                    second, ahead, over, usual, gains[0], gains[1], estimate[k], other[k], values
                )
                for i in range(lanes):
                    for t in range(ahead.size):
                        row = t * LANES + i
                        white[first + i, k, now + t] = values[row] * math.sqrt(gains[2, row])
        for i in range(lanes):
            typical = step[first + i, 3] + sensor[first + i]
            logs[first + i] = state[LOG + i] + readings * math.log(typical)
    return white, logs
