"""The layout of the compiled likelihood's state: what each model is, and what it remembers.

The state of ``LANES`` models is one flat array of rows of ``LANES`` numbers, because a compiler can
tell that rows of one array do not overlap. Each name here is where a row begins. Numba freezes
these numbers into what it compiles, so whoever changes them deletes what it has cached.
"""

from __future__ import annotations

# Models side by side: four vector registers of eight numbers, which hide each other's latency.
LANES = 32

# Rows of the state. First what a model is, in the order of `PARAMETERS`, then what it remembers.
PARAMETERS = (
    "level",
    "b0", "b1", "b2", "a1", "a2",
    "kept", "decay", "gain", "predicted", "variance", "surplus", "rate",
    "free_11", "free_12", "free_21", "free_22",
)  # fmt: skip
(
    LEVEL, B0, B1, B2, A1, A2,
    KEPT, DECAY, GAIN, PREDICTED, VARIANCE, SURPLUS, RATE, FREE,
) = (LANES * row for row in range(14))  # fmt: skip
MEMORY = 8
(
    X1, X2, UNSURE, SQUARES, RATIO, INVERSE, TRUST, LOG,
) = (LANES * (len(PARAMETERS) + row) for row in range(MEMORY))  # fmt: skip

# The series that are filtered: the residual, the record's own offset, two free responses. Each has
# a value, an estimate, an innovation; the free responses two numbers that their recursion keeps.
SERIES = 4
VALUE, ESTIMATE, INNOVATION, KEEP_1, KEEP_2 = (
    LANES * (len(PARAMETERS) + MEMORY + SERIES * row) for row in range(5)
)

# Sums of products of innovations over their variances, of each pair of series; and the log of the
# variances over that of the steady state.
PRODUCTS = LANES * (len(PARAMETERS) + MEMORY + SERIES * 5)
PAIRS = SERIES * (SERIES + 1) // 2
LOG_RATIO = PAIRS
SUMS = PAIRS + 1
STATE = PRODUCTS + LANES * PAIRS
