"""The likelihood on the compiled engine: the same numbers as with NumPy, ten times faster.

Coefficients of the dynamics and of the noise's filter come from the same functions that the NumPy
likelihood uses; :mod:`bwbayes.inference.kernels` walks through the samples. It works out n = 1 with
|γ| ≤ β itself; for other models h comes from :func:`bwbayes.model.boucwen.hysteresis`, and the
rest of the work is compiled still.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference import kernels, lanes
from bwbayes.inference.noise import Noise, SteadyState
from bwbayes.model.actuator import Actuator
from bwbayes.model.boucwen import hysteresis
from bwbayes.model.linear import Recursion

__all__ = ["moments"]

# Elements (models x samples) of h that is worked out beforehand, at a time.
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
    """
    column = dict(zip((*actuator.parameters, *noise.parameters), theta.T, strict=True))
    steady = noise.steady_state(theta[:, len(actuator.parameters) :])
    models = _models(column, float(voltage[0]), actuator.recursion(column), steady)
    closed = (column["exponent"] == 1.0) & (np.abs(column["gamma"]) <= column["beta"])
    sums = np.empty((lanes.SUMS, len(theta)))
    record = voltage, displacement, skipped
    if closed.any():
        unknown = np.empty((int(closed.sum()), 0))
        sums[:, closed] = kernels.sums(*record, models[closed], unknown, offset, free)
    others = np.flatnonzero(~closed)
    size = max(LARGEST // voltage.size, 1)
    for rows in (others[i : i + size] for i in range(0, others.size, size)):
        names = ("alpha", "beta", "gamma", "exponent", "initial")
        known = hysteresis(voltage, **{name: column[name][rows] for name in names})
        sums[:, rows] = kernels.sums(*record, models[rows], known, offset, free)
    size = 1 + offset + free
    products = np.empty((len(theta), size, size))
    for i in range(size):
        for j in range(i + 1):
            products[:, i, j] = products[:, j, i] = sums[i * (i + 1) // 2 + j]
    readings = np.count_nonzero(skipped >= 0)
    log_determinant = readings * np.log(steady.variance) + sums[lanes.LOG_RATIO]
    return products, log_determinant


def _models(
    column: Mapping[str, FloatArray],
    first_voltage: float,
    recursion: Recursion,
    steady: SteadyState,
) -> FloatArray:
    """Return the kernel's parameters, (models, parameters)."""
    nothing = np.zeros(steady.kept.size)
    b = [*recursion.numerator.T, nothing, nothing]
    a = [*recursion.denominator.T, nothing, nothing]
    free = np.zeros((nothing.size, 2, 2))
    unknowns, memory = recursion.free.shape[1:]
    free[:, :unknowns, :memory] = recursion.free
    rest = column["d"] * first_voltage - column["initial"]
    rows = {
        "initial": column["initial"],
        "alpha": column["alpha"],
        "against": column["beta"] - column["gamma"],
        "ahead": column["beta"] + column["gamma"],
        "d": column["d"],
        "rest": rest,
        "level": rest + column["offset"],
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
