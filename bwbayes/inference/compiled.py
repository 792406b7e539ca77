"""The likelihood on the compiled engine: the same numbers as with NumPy, ten times faster.

Coefficients of the dynamics and of the noise's filter come from the same functions that the NumPy
likelihood uses; :mod:`bwbayes.inference.kernels` walks through the samples. It works out n = 1 with
|γ| ≤ β itself; for other models h comes from :func:`bwbayes.model.boucwen.hysteresis`, and the
rest of the work is compiled still.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference import kernels
from bwbayes.inference.noise import SteadyState
from bwbayes.model.boucwen import hysteresis
from bwbayes.model.linear import Recursion

if TYPE_CHECKING:
    from bwbayes.inference.likelihood import Likelihood

__all__ = ["moments"]

# Elements (models x samples) of h that is worked out beforehand, at a time.
LARGEST = 1 << 23


def moments(likelihood: Likelihood, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return what :meth:`Likelihood.moments` does, at θ (models, parameters) with its initial h."""
    actuator, readings = likelihood.actuator, likelihood.readings
    column = dict(zip((*actuator.parameters, *likelihood.noise.parameters), theta.T, strict=True))
    spaced = likelihood.noise.at(actuator.interval * readings.stride)
    steady = spaced.steady_state(theta[:, len(actuator.parameters) :])
    voltage = likelihood.voltage[: readings.samples]
    models = _models(column, float(voltage[0]), actuator.recursion(column), steady)
    closed = (column["exponent"] == 1.0) & (np.abs(column["gamma"]) <= column["beta"])
    free = 0 if likelihood.from_rest else actuator.unknowns
    offset = 1 if likelihood.offset_sd else 0
    sums = np.empty((kernels.SUMS, len(theta)))
    record = voltage, likelihood.values, likelihood.skipped
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
    log_determinant = readings.rows.size * np.log(steady.variance) + sums[kernels.LOG_RATIO]
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
    return np.stack([rows[name] for name in kernels.PARAMETERS], axis=1)
