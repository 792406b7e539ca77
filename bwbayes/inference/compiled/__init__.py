"""The likelihood on the compiled engine: the same numbers as with NumPy, ten times faster.

Coefficients of the dynamics and of the noise's filter come from the same functions that the NumPy
likelihood uses; :mod:`~bwbayes.inference.compiled.kernels` walks through the samples. Operators
with a compiled stage (:mod:`~bwbayes.inference.compiled.stages`) are walked through with it; for
others the drive comes from NumPy, and the rest of the work is compiled still.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled import kernels, lanes
from bwbayes.inference.compiled.stages import DRIVES, Stage, given, prepared
from bwbayes.inference.noise import Noise
from bwbayes.inference.table import ParameterTable
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Values

__all__ = ["moments", "parts", "physics"]

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
    table = ParameterTable(actuator, noise)
    column = table.columns(theta)
    coefficients = noise.coefficients(table.noise(theta))
    # What is None is left out when it is compiled.
    second = True if "kept_12" in coefficients else None
    slow = len(actuator.creep.times) if actuator.creep and free else 0
    unknowns = offset, free - slow, slow
    sums = np.empty((lanes.SUMS, len(theta)))
    record, prepared = (voltage, displacement, skipped), parts(actuator, voltage)
    for rows, stage in _staged(actuator, column, theta, voltage, from_rest=from_rest):
        equilibrium = np.zeros(len(theta))
        equilibrium[rows] = stage.rest
        models = _models(actuator, column, equilibrium, coefficients, voltage)[rows]
        drive = stage.kind, stage.group, stage.plan
        sums[:, rows] = kernels.sums(*record, models, second, *drive, *prepared, *unknowns)
    size = 1 + offset + free
    products = np.empty((len(theta), size, size))
    for i in range(size):
        for j in range(i + 1):
            products[:, i, j] = products[:, j, i] = sums[i * (i + 1) // 2 + j]
    readings = np.count_nonzero(skipped >= 0)
    log_determinant = readings * np.log(coefficients["variance"]) + sums[lanes.LOG_RATIO]
    return products, log_determinant


def _staged(
    actuator: Actuator, column: Values, theta: FloatArray, voltage: FloatArray, *, from_rest: bool
) -> Iterator[tuple[IntArray | slice, Stage]]:
    """Yield which models go together, and the stage that makes their drive."""
    operator, others = actuator.hysteresis, np.arange(len(theta))
    compiled = DRIVES.get(type(operator))
    if compiled is None:
        memory = actuator.begin(column, voltage, from_rest=from_rest)
        stage = prepared(operator, column, voltage, memory)
        if stage is not None:
            yield slice(None), stage
            return
    size = max(LARGEST // voltage.size, 1)
    for rows in (others[i : i + size] for i in range(0, others.size, size)):
        values = {name: column[name][rows] for name in actuator.parameters}
        memory = actuator.begin(values, voltage, from_rest=from_rest)
        drive = (compiled or type(operator).advance)(operator, values, voltage, memory)[0]
        yield rows, given(drive[:, 0], drive)


def parts(actuator: Actuator, voltage: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what gain and creep know: ``curve``, ``lags`` and ``growth`` of the kernel."""
    curve, lags, growth = np.empty((0, 2)), np.empty((0, 3)), np.empty(0)
    if actuator.gain is not None:
        x = actuator.gain.scaled(voltage)
        curve = np.stack([x**2 - x[0] ** 2, x**3 - x[0] ** 3], axis=1)
    if actuator.creep is not None:
        recursions = actuator.creep.recursions(1, actuator.interval, actuator.hold)
        lags = np.array(
            [[*recursion.numerator[0], -recursion.denominator[0, 1]] for recursion in recursions]
        )
        if actuator.creep.growing:
            growth = actuator.creep.size(voltage)
    return curve, lags, growth


def physics(
    actuator: Actuator, column: Values, equilibrium: FloatArray, voltage: FloatArray
) -> dict[str, FloatArray]:
    """Return what models (models,) are without a noise, by the names of ``PARAMETERS``.

    ``equilibrium`` (models,) is w₀ without gain, um.

    With creep the kernel's dynamics follow at once: the creep's stage has the true ones.
    """
    sections = actuator.sections(column)
    drives = [equilibrium]
    if actuator.gain is not None:
        drives = [equilibrium + actuator.gain.displacement(column, voltage[:1])[:, 0]]
    if actuator.creep is not None:
        crept = actuator.creep.drive(column, drives[0][:, np.newaxis], voltage[:1])[:, 0]
        drives += [crept] * len(actuator.creep.times)
    level = column["offset"] + sum(g * w for g, w in zip(sections.gains, drives, strict=True))
    dynamics, nothing = sections.recursions[0], np.zeros(equilibrium.size)
    b = [*dynamics.numerator.T, nothing, nothing][:3]
    a = [*dynamics.denominator.T, nothing, nothing][1:3]
    rows = dict(zip(("true_b0", "true_b1", "true_b2", "true_a1", "true_a2"), (*b, *a), strict=True))
    seen = [nothing + 1, *[nothing] * 4] if actuator.creep is not None else [*b, *a]
    rows |= dict(zip(("b0", "b1", "b2", "a1", "a2"), seen, strict=True))
    rows |= {f"strength_{k}": gain for k, gain in enumerate(sections.gains[1:], 1)}
    rows |= {"level": level, "rest": drives[0], "growth": column.get("creep_growth", nothing)}
    return rows | {name: column.get(name, nothing) for name in ("quadratic", "cubic")}


def _models(
    actuator: Actuator,
    column: Values,
    equilibrium: FloatArray,
    noise: Mapping[str, FloatArray],
    voltage: FloatArray,
) -> FloatArray:
    """Return the kernel's parameters (models, parameters); ``equilibrium`` as in `physics`."""
    rows = physics(actuator, column, equilibrium, voltage)
    rows |= noise
    free = actuator.sections(column).recursions[0].free
    for unknown in range(free.shape[1]):
        for part in range(free.shape[2]):
            rows[f"free_{unknown + 1}{part + 1}"] = free[:, unknown, part]
    table = np.zeros((equilibrium.size, len(lanes.PARAMETERS)))
    for row, name in enumerate(lanes.PARAMETERS):
        table[:, row] = rows.get(name, 0.0)
    return table
