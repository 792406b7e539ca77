"""Layout of the compiled likelihood's state: the numbers of each model, and its memory.

The state of ``LANES`` models is one flat array of rows of ``LANES`` numbers, because a compiler can
tell that rows of one array do not overlap. Each name here is the offset of a row. Numba freezes
these numbers into the compiled code, so delete its cache after a change of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.caching import compile_cached
from bwbayes.model.linear import MOST_TIMES


def inner(**options: Any) -> Any:
    """Compile a function that only compiled functions call, without the wrappers for Python."""
    options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return compile_cached(**options)


# Models side by side: four vector registers of eight numbers, which hide each other's latency.
LANES = 32

# Rows of the state: the numbers of a model in the order of `PARAMETERS`, then its memory.
PARAMETERS = (
    "level", "b0", "b1", "b2", "a1", "a2",
    "f_11", "f_12", "f_21", "f_22", "q_11", "q_12", "q_22", "stationary", "sensor",
    "free_11", "free_12", "free_21", "free_22",
    "quadratic", "cubic", "equilibrium", "crept", "growth",
    *(f"strength_{number}" for number in range(1, MOST_TIMES + 1)),
)  # fmt: skip
(
    LEVEL, B0, B1, B2, A1, A2,
    F, F_12, F_21, F_22, Q, Q_12, Q_22, STATIONARY, SENSOR,
    FREE, FREE_12, FREE_21, FREE_22,
    QUADRATIC, CUBIC, EQUILIBRIUM, CREPT, GROWTH,
    STRENGTH,
) = (LANES * row for row in range(len(PARAMETERS) - MOST_TIMES + 1))  # fmt: skip

# The filter's step over a gap, in the order of the rows from `F` on; states of the dynamics;
# covariance and gains of the filter, and the sums of a piece.
STEP = 7
MEMORY = STEP + 14 + MOST_TIMES
(
    GAP, X1, X2, DRIVE, COVARIANCE, COVARIANCE_12, COVARIANCE_22, GAIN, GAIN_2, INVERSE, RATIO, LOG,
    CHANGE, SQUARES, LATEST, LAG,
) = (
    LANES * (len(PARAMETERS) + row) for row in (0, *range(STEP, STEP + 15))
)  # fmt: skip

# The series that are filtered: the residual, the record's own offset, two free responses of the
# dynamics, those of the creep. Each has a value, estimates of both states of the noise and an
# innovation; a response also has the two numbers of its recursion.
SERIES = 4 + MOST_TIMES
VALUE, ESTIMATE, ESTIMATE_2, INNOVATION, RESPONSE, RESPONSE_2 = (
    LANES * (len(PARAMETERS) + MEMORY + SERIES * row) for row in range(6)
)

# Sums of products of innovations over their variances, of each pair of series; and the sum of the
# variances' logarithms.
PRODUCTS = LANES * (len(PARAMETERS) + MEMORY + SERIES * 6)
PAIRS = SERIES * (SERIES + 1) // 2
LOG_DETERMINANT = PAIRS
SUMS = PAIRS + 1
STATE = PRODUCTS + LANES * PAIRS


def by_rows(named: Mapping[str, FloatArray], size: int = len(PARAMETERS)) -> FloatArray:
    """Return models (models, size) with values by the names of `PARAMETERS`; others are 0."""
    models = np.zeros((max(values.size for values in named.values()), size))
    for name, values in named.items():
        models[:, PARAMETERS.index(name)] = values
    return models


def in_lanes(models: FloatArray) -> FloatArray:
    """Put models (..., models, rows) side by side, (..., groups, rows times lanes).

    Spare lanes repeat the last model.
    """
    *others, count, rows = models.shape
    if spare := -count % LANES:
        last = np.repeat(models[..., -1:, :], spare, axis=-2)
        models = np.concatenate([models, last], axis=-2)
    groups = (count + spare) // LANES
    lanes = models.reshape(*others, groups, LANES, rows).swapaxes(-1, -2)
    return lanes.reshape(*others, groups, rows * LANES)
