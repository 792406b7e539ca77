"""The layout of the compiled likelihood's state: what each model is, and what it remembers.

The state of ``LANES`` models is one flat array of rows of ``LANES`` numbers, because a compiler can
tell that rows of one array do not overlap. Each name here is where a row begins. Numba freezes
these numbers into what it compiles, so whoever changes them deletes what it has cached.
"""

from __future__ import annotations

from bwbayes.model.creep import MOST_TIMES

# Models side by side: four vector registers of eight numbers, which hide each other's latency.
LANES = 32

# Rows of the state. First what a model is, in the order of `PARAMETERS`, then what it remembers.
# The coefficients of the dynamics come twice: with creep, the filter of the noise sees dynamics
# that follow at once, because the creep's stage has been through the true ones already.
PARAMETERS = (
    "level",
    "b0", "b1", "b2", "a1", "a2",
    "kept", "decay", "gain", "predicted", "variance", "surplus", "rate",
    "kept_12", "kept_22", "fresh_11", "fresh_12", "fresh_22", "sensor",
    "free_11", "free_12", "free_21", "free_22",
    "true_b0", "true_b1", "true_b2", "true_a1", "true_a2",
    "quadratic", "cubic", "rest", "growth",
    *(f"strength_{number}" for number in range(1, MOST_TIMES + 1)),
)  # fmt: skip
(
    LEVEL, B0, B1, B2, A1, A2,
    KEPT, DECAY, GAIN, PREDICTED, VARIANCE, SURPLUS, RATE,
    KEPT_12, KEPT_22, FRESH_11, FRESH_12, FRESH_22, SENSOR,
    FREE, FREE_12, FREE_21, FREE_22,
    TRUE_B0, TRUE_B1, TRUE_B2, TRUE_A1, TRUE_A2,
    QUADRATIC, CUBIC, REST, GROWTH,
    STRENGTH,
) = (LANES * row for row in range(len(PARAMETERS) - MOST_TIMES + 1))  # fmt: skip
MEMORY = 17 + MOST_TIMES
(
    X1, X2, UNSURE, SQUARES, RATIO, INVERSE, TRUST, LOG, TRUE_X1, TRUE_X2, CREEPS, SUM,
    UNSURE_12, UNSURE_22, CHANGE, TRUST_2, PULL_2, LAG,
) = (LANES * (len(PARAMETERS) + row) for row in range(MEMORY - MOST_TIMES + 1))  # fmt: skip

# The series that are filtered: the residual, the record's own offset, two free responses of the
# dynamics, those of the creep. Each has a value, an estimate (of both states of a smooth noise), an
# innovation; the free responses two numbers that their recursion keeps.
SERIES = 4 + MOST_TIMES
VALUE, ESTIMATE, INNOVATION, KEEP_1, KEEP_2, ESTIMATE_2 = (
    LANES * (len(PARAMETERS) + MEMORY + SERIES * row) for row in range(6)
)

# Sums of products of innovations over their variances, of each pair of series; and the log of the
# variances over that of the steady state.
PRODUCTS = LANES * (len(PARAMETERS) + MEMORY + SERIES * 6)
PAIRS = SERIES * (SERIES + 1) // 2
LOG_RATIO = PAIRS
SUMS = PAIRS + 1
STATE = PRODUCTS + LANES * PAIRS
