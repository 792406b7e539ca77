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
    COVARIANCE, COVARIANCE_12, COVARIANCE_22, FRESH, KEPT, LANES, LOG, PROCESS, RATIO, SENSOR,
    STATE,
)
# fmt: on
# isort: on
from bwbayes.inference.compiled.filter import gain, innovate
from bwbayes.inference.compiled.motion import PIECE


@njit(nogil=True, cache=True, error_model="numpy")
def whitened(
    models: FloatArray, second: bool | None, gaps: IntArray, steps: FloatArray, series: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return innovations (models, series, readings) over their sds, and log determinants (models,).

    Parameters
    ----------
    models, second, steps
        As in :func:`bwbayes.inference.compiled.kernels.sums`; of the models the filter alone.
    gaps
        (readings,) which of the gaps is just before a reading; 0 if none is.
    series
        (models, series, readings), um.
    """
    _, count, readings = series.shape
    white, logs, state = np.empty_like(series), np.empty(len(series)), np.zeros(STATE)
    estimate, other = np.zeros((count, LANES)), np.zeros((count, LANES))
    gains = np.empty((3, PIECE * LANES))
    values = np.zeros(PIECE * LANES)
    for group in range(len(models)):
        first = group * LANES
        lanes, over = min(len(series) - first, LANES), steps[group]
        for i in range(models.shape[1]):
            state[i] = models[group, i]
        for i in range(LANES):
            state[COVARIANCE + i] = state[COVARIANCE_22 + i] = state[PROCESS + i]
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
            typical = state[FRESH + i] + state[SENSOR + i]
            logs[first + i] = state[LOG + i] + readings * math.log(typical)
    return white, logs
