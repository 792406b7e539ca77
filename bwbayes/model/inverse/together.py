"""Many models read backwards, compiled.

One model is inverted fastest along whole stretches. Of a thousand draws each has its own voltage
and its own turns, and then it is many times faster to go from sample to sample, compiled
(:mod:`bwbayes.model.inverse.compiled`): for whatever has a step
(:mod:`bwbayes.model.step`), and where there is numba.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.model.actuator import State
from bwbayes.model.gain import DriveStep
from bwbayes.model.inverse.alone import SHORTEST, One
from bwbayes.model.inverse.stretch import first_crossing
from bwbayes.model.linear import Sections
from bwbayes.model.operator import Operator

__all__ = ["MANY", "together"]

# From so many models on they go from sample to sample.
MANY = 50

# By rounding a zero may be so far beyond the unit circle, and a voltage so far from its limit.
ROUNDED = 1e-6


def together(
    singles: Sequence[One],
    columns: Mapping[str, FloatArray],
    state: State | None,
    target: FloatArray,
    result: FloatArray,
) -> BoolArray:
    """Write the voltages without limits of models that go together; tell which (models,) do.

    Those whose displacement rises with the voltage wherever they go; the others go alone.

    Parameters
    ----------
    ones, columns, state
        The models, by themselves and all together, (models,) each, and where they stand.
    target
        The displacements (models, samples), um.
    result
        Where their voltages go, (models, samples), V.
    """
    actuator, models = singles[0].actuator, len(singles)
    stepped = type(actuator.hysteresis).step is not Operator.step
    if models < MANY or find_spec("numba") is None or not stepped:
        return np.zeros(models, dtype=np.bool_)
    # Here, because numba may not be installed, and takes half a second to load.
    from bwbayes.model.inverse.compiled import Chains, invert  # noqa: PLC0415

    drive = DriveStep(actuator.hysteresis.step(columns), actuator.gain, columns)
    sections, creep, growth = actuator.sections(columns), actuator.creep, np.zeros(models)
    if creep is not None and creep.growing:
        growth = columns["creep_growth"] * creep.size(np.array(1.0))
    np.subtract(target, columns["offset"][:, np.newaxis], out=result)
    if state is not None:
        memory, start = drive.step.remembered(state.hysteresis), state.hysteresis.voltage
    elif singles[0].from_rest:
        at_rest = actuator.hysteresis.begin(columns, 0.0, singles[0].span, from_rest=True)
        memory, start = drive.step.remembered(at_rest), 0.0
    else:
        start = _first(singles, drive, columns["initial"], sections, growth, result[:, 0])
        memory = drive.step.begun(start, columns["initial"], singles[0].span)
    start = np.broadcast_to(start, models).astype(np.float64)
    w, slope, _ = drive.go(memory, start)
    largest = np.maximum(result.max(axis=1), -result.min(axis=1))
    farthest = [
        single.anywhere(size).high for single, size in zip(singles, largest.tolist(), strict=True)
    ]
    curve = np.zeros((4, models)) if actuator.gain is None else actuator.gain.powers(columns)
    chains = Chains(
        np.ascontiguousarray(curve.T),
        *sections.taps,
        growth,
        largest,
        start,
        np.array(farthest),
        w,
        slope,
        *_carried(sections, state),
        state is None,
    )
    right = invert(drive.step, memory, chains, result)
    right &= np.max(np.abs(sections.zeros), axis=1, initial=0.0) <= 1 + ROUNDED
    # Bisection ends just before what is too far away.
    limit = (1 - ROUNDED) * chains.farthest
    return right & (np.maximum(result.max(axis=1), -result.min(axis=1)) < limit)


def _carried(sections: Sections, state: State | None) -> tuple[FloatArray, FloatArray]:
    """Return drives (models, sections), um, at which the sections rested, and what they carry on.

    That is (models, sections, 2).
    """
    equilibrium = np.zeros((sections.gains[0].size, len(sections.gains)))
    filters = np.zeros((*equilibrium.shape, 2))
    if state is not None:
        for number, (drive, filtered) in enumerate(zip(state.rest, state.filter, strict=True)):
            equilibrium[:, number] = drive
            filters[:, number, : filtered.shape[1]] = filtered
    return equilibrium, filters


def _first(
    singles: Sequence[One],
    drive: DriveStep,
    initial: FloatArray,
    sections: Sections,
    growth: FloatArray,
    displacement: FloatArray,
) -> FloatArray:
    """Return the voltages (models,), V, where records start whose past is not known.

    There the first displacement (models,), um, is what the initial state makes of the voltage, with
    dynamics and creep at rest.
    """
    span, slope = singles[0].span, np.array([single.slope for single in singles])
    plain, *creeping = sections.gains

    def off(voltage: FloatArray) -> FloatArray:
        factor = plain + sum(creeping) * (1 + growth * np.abs(voltage))
        w = drive.go(drive.step.begun(voltage, initial, span), voltage).w
        return np.asarray(factor * w - displacement)

    center = np.full_like(displacement, span.middle)
    with np.errstate(divide="ignore", invalid="ignore"):
        guess = np.where(slope > 0, np.abs(off(center)) / slope, 0.0)
    # Where there is none it is so far away that the inverse does not begin there.
    return first_crossing(off, center, np.maximum(guess, max(span.half, SHORTEST)))
