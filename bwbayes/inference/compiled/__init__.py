"""The likelihood on the compiled engine: the same numbers as with NumPy, ten times faster.

Coefficients of the dynamics and of the noise's filter come from the same functions that the NumPy
likelihood uses; :mod:`~bwbayes.inference.compiled.kernels` walks through the samples. Operators
with a compiled stage (:mod:`~bwbayes.inference.compiled.stages`) are walked through with it; for
others the drive comes from NumPy, and the rest of the work is compiled still.
"""

from __future__ import annotations

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled import kernels, lanes
from bwbayes.inference.compiled.stages import GIVEN, STAGES
from bwbayes.inference.noise import Noise, SteadyState
from bwbayes.inference.table import Table
from bwbayes.model.actuator import Actuator
from bwbayes.model.linear import Recursion

__all__ = ["moments"]

# Elements (models x samples) of the drive that is worked out beforehand, at a time.
LARGEST = 1 << 23


def moments(
    theta: FloatArray,
    voltage: FloatArray,
    displacement: FloatArray,
    skipped: FloatArray,
    actuator: Actuator,
    noise: Noise,
    offset: int,
    free: int,
    *,
    from_rest: bool,
) -> tuple[FloatArray, FloatArray]:
    """Return products and log determinants as :class:`~bwbayes.inference.likelihood.Moments` does.

    Parameters
    ----------
    theta
        (models, parameters), those of the actuator and of the noise, inside the model's domain.
    voltage, displacement
        (samples,), V and um, from the record's first sample to its last reading.
    skipped
        (samples,) readings that are missing just before one; −1 where there is none.
    actuator, noise
        The model; the noise for the interval between readings.
    offset, free
        How many offsets and free responses of the dynamics are unknown.
    from_rest
        The record starts from rest.
    """
    table = Table(actuator, noise)
    column = table.columns(theta)
    steady = noise.steady_state(table.noise(theta))
    recursion = actuator.recursion(column)
    sums = np.empty((lanes.SUMS, len(theta)))
    record = voltage, displacement, skipped
    able = np.zeros(len(theta), dtype=bool)
    prepare = STAGES.get(type(actuator.hysteresis))
    if prepare:
        memory = actuator.begin(column, voltage, from_rest=from_rest)
        stage = prepare(actuator.hysteresis, column, voltage, memory)
        able = stage.able
        models = _models(stage.rest + column["offset"], recursion, steady)[able]
        mine = stage.kind, stage.own[able], stage.plan
        sums[:, able] = kernels.sums(*record, models, *mine, offset, free)
    others = np.flatnonzero(~able)
    size = max(LARGEST // voltage.size, 1)
    for rows in (others[i : i + size] for i in range(0, others.size, size)):
        drive = actuator.drive(table.actuator(theta[rows]), voltage, from_rest=from_rest)
        rest = np.zeros(len(theta))
        rest[rows] = drive[:, 0]
        models = _models(rest + column["offset"], recursion, steady)[rows]
        own = np.stack([np.arange(rows.size), drive[:, 0]], axis=1)
        sums[:, rows] = kernels.sums(*record, models, GIVEN, own, drive, offset, free)
    size = 1 + offset + free
    products = np.empty((len(theta), size, size))
    for i in range(size):
        for j in range(i + 1):
            products[:, i, j] = products[:, j, i] = sums[i * (i + 1) // 2 + j]
    readings = np.count_nonzero(skipped >= 0)
    log_determinant = readings * np.log(steady.variance) + sums[lanes.LOG_RATIO]
    return products, log_determinant


def _models(level: FloatArray, recursion: Recursion, steady: SteadyState) -> FloatArray:
    """Return the kernel's parameters (models, parameters); ``level`` (models,) is x at rest, um."""
    nothing = np.zeros(steady.kept.size)
    b = [*recursion.numerator.T, nothing, nothing]
    a = [*recursion.denominator.T, nothing, nothing]
    free = np.zeros((nothing.size, 2, 2))
    unknowns, memory = recursion.free.shape[1:]
    free[:, :unknowns, :memory] = recursion.free
    rows = {
        "level": level,
        "b0": b[0],
        "b1": b[1],
        "b2": b[2],
        "a1": a[1],
        "a2": a[2],
        "kept": steady.kept,
        "decay": np.exp(steady.log_decay),
        # φ − a, without its cancellation.
        "gain": steady.kept * steady.predicted / steady.variance,
        "predicted": steady.predicted,
        "variance": steady.variance,
        "surplus": steady.surplus,
        "rate": steady.rate,
        "free_11": free[:, 0, 0],
        "free_12": free[:, 0, 1],
        "free_21": free[:, 1, 0],
        "free_22": free[:, 1, 1],
    }
    return np.stack([rows[name] for name in lanes.PARAMETERS], axis=1)
