"""Many models read backwards side by side.

One model is inverted fastest along whole stretches. Of a thousand draws each has its own voltage
and its own turns, and then it is many times faster to go from sample to sample, compiled
(:mod:`bwbayes.model.inverse.compiled`): for whatever has a step
(:mod:`bwbayes.model.inverse.steps`), and where there is numba.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.model.actuator import State
from bwbayes.model.inverse.alone import One
from bwbayes.model.inverse.curved_steps import AsymmetricStep, DuhemStep, PowerStep
from bwbayes.model.inverse.rows import of_rows
from bwbayes.model.inverse.stepped import DriveStep, has_step, step_of
from bwbayes.model.inverse.steps import HysteresisStep, LinearStep, PlaysStep
from bwbayes.model.inverse.stretch import searched
from bwbayes.model.inverse.undoing import undo, undoable

__all__ = ["MANY", "follow", "together"]

# From so many models on they go side by side.
MANY = 50

# Doublings of the first reach, V at least, for the voltage at which a record starts.
DOUBLINGS, SHORTEST = 30, 1e-9

# Creep that grows with the voltage is made to agree with it in rounds: of so many models at a time,
# which fit into the cache; of at most so many; until the growth moves by no more than this, after
# which one more round would hardly move the displacement by its rounding.
PART, ROUNDS, AGREED = 64, 30, 1e-11

# Rates of a relaxation, for each direction and sign of the voltage and sign of h.
RATES = 8


def together(
    ones: Sequence[One],
    columns: Mapping[str, FloatArray],
    state: State | None,
    asked: FloatArray,
    result: FloatArray,
) -> BoolArray:
    """Write the voltages without limits of models that go side by side; tell which (models,) do.

    Parameters
    ----------
    ones, columns, state
        The models, by themselves and all together, (models,) each, and where they stand.
    asked
        The displacements (models, samples), um.
    result
        Where their voltages go, (models, samples), V.
    """
    actuator, known = ones[0].actuator, np.zeros(len(ones), dtype=np.bool_)
    if len(ones) < MANY or find_spec("numba") is None or not has_step(actuator.hysteresis):
        return known
    growing = actuator.creep is not None and actuator.creep.growing
    # All at once; in rounds, as many as are in the cache.
    size = PART if growing else len(ones)
    for first in range(0, len(ones), size):
        rows = slice(first, first + size)
        here = {name: values[rows] for name, values in columns.items()}
        known[rows] = _part(ones[rows], here, of_rows(state, rows), asked[rows], result[rows])
    return known


def _part(
    ones: Sequence[One],
    columns: Mapping[str, FloatArray],
    state: State | None,
    asked: FloatArray,
    result: FloatArray,
) -> BoolArray:
    """Do the same for some models.

    Creep that grows with the voltage is undone for the voltage of the round before, until they
    agree.
    """
    actuator, creep = ones[0].actuator, ones[0].actuator.creep
    shaped = DriveStep(step_of(actuator.hysteresis, columns), actuator.gain, columns)
    offset, sections = columns["offset"][:, np.newaxis], actuator.sections(columns)
    peak = np.maximum(asked.max(axis=1) - offset[:, 0], offset[:, 0] - asked.min(axis=1))
    most = [one.anywhere(size).high for one, size in zip(ones, peak.tolist(), strict=True)]
    growing = creep is not None and creep.growing
    growth = np.ones_like(result) if growing else None
    known = np.full(len(ones), not growing)
    if growing and not undoable(sections):
        return known
    for _ in range(ROUNDS if growing else 1):
        np.subtract(asked, offset, out=result)
        undo(ones, sections, state, growth, result)
        memory, start, right = _start(ones, shaped, columns, state, result[:, 0])
        right &= follow(shaped, memory, start, result)
        if creep is None or growth is None:
            break
        before = growth
        growth = 1 + columns["creep_growth"][:, np.newaxis] * creep.size(result)
        known = np.max(np.abs(growth - before), axis=1) <= AGREED
        if (known | ~right).all():
            break
    return known & right & (np.maximum(result.max(axis=1), -result.min(axis=1)) < most)


def _start(
    ones: Sequence[One],
    shaped: DriveStep,
    columns: Mapping[str, FloatArray],
    state: State | None,
    drive: FloatArray,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return memories and voltages (models,), V, where the paths start, and who has one."""
    known = np.ones(len(ones), dtype=np.bool_)
    if state is not None:
        memory, start = shaped.step.remembered(state.hysteresis), state.hysteresis.voltage
    elif ones[0].from_rest:
        operator = ones[0].actuator.hysteresis
        at_rest = operator.begin(columns, 0.0, ones[0].span, from_rest=True)
        memory, start = shaped.step.remembered(at_rest), 0.0
    else:
        memory, start, known = _begun(ones, shaped, columns["initial"], drive)
    return memory, np.broadcast_to(start, known.shape), known


def _begun(
    ones: Sequence[One], shaped: DriveStep, initial: FloatArray, drive: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the memories where records start whose past is not known, and the voltages, V.

    That is where the first drive (models,), um, is what the initial state makes of the voltage.
    And tell for which models (models,) there is such a voltage.
    """
    span, slope = ones[0].span, np.array([one.slope for one in ones])

    def off(voltage: FloatArray) -> FloatArray:
        return shaped.go(shaped.step.begun(voltage, initial, span), voltage).w - drive

    middle = np.full_like(drive, span.middle)
    missing = off(middle)
    s = np.where(missing > 0, -1.0, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        guess = np.where(slope > 0, np.abs(missing) / slope, 0.0)
    reach = np.maximum(guess, max(span.half, SHORTEST))
    for _ in range(DOUBLINGS):
        beyond = off(middle + s * reach)
        short = s * beyond < 0
        if not short.any():
            break
        reach = np.where(short, 2 * reach, reach)
    start = searched(off, (middle, middle + s * reach), (missing, beyond))
    return shaped.step.begun(start, initial, span), start, ~short


def follow(
    shaped: DriveStep, memory: FloatArray, start: FloatArray, drive: FloatArray
) -> BoolArray:
    """Write the voltages of drives over them, and tell which models' (models,) are right.

    Those whose drive rises with the voltage wherever they go; the others go alone.

    Parameters
    ----------
    shaped
        Hysteresis and gain.
    memory, start
        That of the step (models, any), and the voltages (models,), V, where the paths start.
    drive
        (models, samples), um; voltages, V, once this is done.
    """
    # Here, because numba may not be installed, and takes half a second to load.
    from bwbayes.model.inverse.compiled.plays import played  # noqa: PLC0415
    from bwbayes.model.inverse.compiled.powers import powered  # noqa: PLC0415
    from bwbayes.model.inverse.compiled.relaxing import relaxed  # noqa: PLC0415

    step, curve = shaped.step, np.zeros((start.size, 4))
    if shaped.gain is not None:
        curve += shaped.gain.powers(shaped.column).T
    right: BoolArray
    if isinstance(step, PlaysStep):
        bent = curve if shaped.gain is not None else np.empty((start.size, 0))
        right = played(step.slope, step.weights, step.thresholds, bent, memory, start, drive)
    elif isinstance(step, PowerStep):
        curve[:, 1] += step.d
        right = powered(
            np.stack([step.alpha, *step.rates, step.exponent], axis=1), curve, memory, drive
        )
    else:
        d, flow, rates = _relaxing(step)
        curve[:, 1:] += d
        models = np.concatenate([curve, flow, rates], axis=1)
        signed = isinstance(step, AsymmetricStep)
        right = relaxed(models, memory, drive, not isinstance(step, DuhemStep), signed)
    return right


def _relaxing(step: HysteresisStep) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return f's coefficients of u to u³, α's of 1 to u², and the rates, for the signs s, x and g.

    (models, 3), (models, 3) and (models, 8).
    """
    if isinstance(step, DuhemStep):
        d = np.column_stack([step.d, *step.curve])
        return d, step.strength.T, np.repeat(step.beta[:, np.newaxis], RATES, axis=1)
    assert isinstance(step, LinearStep | AsymmetricStep)
    nothing = np.zeros_like(step.d)
    rates = np.stack(step.rates, axis=-2).reshape(-1, step.d.size)
    return (
        np.column_stack([step.d, nothing, nothing]),
        np.column_stack([step.alpha, nothing, nothing]),
        np.tile(rates.T, RATES // len(rates)),
    )
