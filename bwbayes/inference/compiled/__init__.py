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
from bwbayes.inference.compiled.stages import DRIVES, STAGES, given
from bwbayes.inference.noise import Noise, SteadyState
from bwbayes.inference.table import ParameterTable
from bwbayes.model.actuator import Actuator
from bwbayes.model.creep import MOST_TIMES
from bwbayes.model.declaration import Values

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
    table = ParameterTable(actuator, noise)
    column = table.columns(theta)
    steady = noise.steady_state(table.noise(theta))
    slow = len(actuator.creep.times) if actuator.creep and free else 0
    unknowns = offset, free - slow, slow
    sums = np.empty((lanes.SUMS, len(theta)))
    record, parts = (voltage, displacement, skipped), _parts(actuator, voltage)
    able = np.zeros(len(theta), dtype=bool)
    prepare = STAGES.get(type(actuator.hysteresis))
    if prepare:
        memory = actuator.begin(column, voltage, from_rest=from_rest)
        stage = prepare(actuator.hysteresis, column, voltage, memory)
        able = stage.able
        models, own = _models(actuator, column, stage.rest, steady, voltage), stage.own
        if able.all():
            sums = kernels.sums(*record, models, stage.kind, own, stage.plan, *parts, *unknowns)
        else:
            mine = stage.kind, own[able], stage.plan
            sums[:, able] = kernels.sums(*record, models[able], *mine, *parts, *unknowns)
    others = np.flatnonzero(~able)
    size = max(LARGEST // voltage.size, 1)
    for rows in (others[i : i + size] for i in range(0, others.size, size)):
        drive = _drive(actuator, table.actuator(theta[rows]), voltage, from_rest=from_rest)
        rest = np.zeros(len(theta))
        rest[rows] = drive[:, 0]
        models = _models(actuator, column, rest, steady, voltage)[rows]
        stage = given(drive[:, 0], drive)
        mine = stage.kind, stage.own, stage.plan
        sums[:, rows] = kernels.sums(*record, models, *mine, *parts, *unknowns)
    size = 1 + offset + free
    products = np.empty((len(theta), size, size))
    for i in range(size):
        for j in range(i + 1):
            products[:, i, j] = products[:, j, i] = sums[i * (i + 1) // 2 + j]
    readings = np.count_nonzero(skipped >= 0)
    log_determinant = readings * np.log(steady.variance) + sums[lanes.LOG_RATIO]
    return products, log_determinant


def _drive(
    actuator: Actuator, theta: FloatArray, voltage: FloatArray, *, from_rest: bool
) -> FloatArray:
    """Return what the operator makes of a record's voltage, (models, samples), um."""
    compiled = DRIVES.get(type(actuator.hysteresis))
    if compiled is None:
        return actuator.hysteretic(theta, voltage, from_rest=from_rest)
    column = actuator.columns(theta)
    memory = actuator.begin(column, voltage, from_rest=from_rest)
    return compiled(actuator.hysteresis, column, voltage, memory)[0]


def _parts(actuator: Actuator, voltage: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what gain and creep know: ``curve``, ``lags`` and ``growth`` of the kernel."""
    curve, lags, growth = np.empty((0, 2)), np.empty((0, 3)), np.empty(0)
    if actuator.gain is not None:
        x = actuator.gain.scaled(voltage)
        curve = np.stack([x**2 - x[0] ** 2, x**3 - x[0] ** 3], axis=1)
    if actuator.creep is not None:
        every = actuator.creep.recursions(1, actuator.interval, actuator.hold)
        lags = np.array([[*one.numerator[0], -one.denominator[0, 1]] for one in every])
        if actuator.creep.growing:
            growth = actuator.creep.size(voltage)
    return curve, lags, growth


def _models(
    actuator: Actuator,
    column: Values,
    rest: FloatArray,
    steady: SteadyState,
    voltage: FloatArray,
) -> FloatArray:
    """Return the kernel's parameters (models, parameters); ``rest`` (models,) is w₀ without gain.

    With creep the kernel's dynamics follow at once: the creep's stage has the true ones.
    """
    models = rest.size
    sections = actuator.sections(column)
    drives = [rest]
    if actuator.gain is not None:
        drives = [rest + actuator.gain.displacement(column, voltage[:1])[:, 0]]
    if actuator.creep is not None:
        crept = actuator.creep.drive(column, drives[0][:, np.newaxis], voltage[:1])[:, 0]
        drives += [crept] * len(actuator.creep.times)
    level = column["offset"] + sum(g * w for g, w in zip(sections.gains, drives, strict=True))
    dynamics, nothing, one = sections.recursions[0], np.zeros(models), np.ones(models)
    b = [*dynamics.numerator.T, nothing, nothing][:3]
    a = [*dynamics.denominator.T, nothing, nothing][1:3]
    seen = [one, nothing, nothing, nothing, nothing] if actuator.creep is not None else [*b, *a]
    free = np.zeros((models, 2, 2))
    unknowns, memory = dynamics.free.shape[1:]
    free[:, :unknowns, :memory] = dynamics.free
    strengths = list(sections.gains[1:])
    rows = [
        level,
        *seen,
        steady.kept,
        np.exp(steady.log_decay),
        # φ − a, without its cancellation.
        steady.kept * steady.predicted / steady.variance,
        steady.predicted,
        steady.variance,
        steady.surplus,
        steady.rate,
        *free.reshape(models, 4).T,
        *b,
        *a,
        column.get("quadratic", nothing),
        column.get("cubic", nothing),
        drives[0],
        column.get("creep_growth", nothing),
        *strengths,
        *[nothing] * (MOST_TIMES - len(strengths)),
    ]
    made = np.empty((models, len(lanes.PARAMETERS)))
    for place, row in zip(made.T, rows, strict=True):
        place[:] = row
    return made
