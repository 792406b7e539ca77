"""The actuator read backwards: for a displacement over time, the voltage that gives it.

The offset is taken off, creep and dynamics are undone (:mod:`bwbayes.model.inverse.dynamics`), and
what is left, the drive, is what hysteresis and gain must make. They do so along stretches that go
one way: the drive turns where the voltage does, so that each stretch is one search, or one closed
form, for all of its samples (:meth:`bwbayes.model.operator.Operator.inverse`).

What is done to each model is done to it alone (:mod:`bwbayes.model.inverse.alone`): the models of a
batch have voltages of their own. Where there are many, those whose hysteresis has a step go side by
side instead, which is much faster (:mod:`bwbayes.model.inverse.together`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator, State
from bwbayes.model.inverse.alone import One
from bwbayes.model.inverse.limits import Limits
from bwbayes.model.inverse.stepped import DriveStep, step_of
from bwbayes.model.inverse.together import able, followed, voltages
from bwbayes.model.operator import UNIT
from bwbayes.model.operators.backlash_like import BacklashLike
from bwbayes.model.operators.bouc_wen import BoucWen

__all__ = ["inverse"]

# From so many models on they go side by side, and so many of them at a time.
MANY, BATCH = 50, 1000


def inverse(
    actuator: Actuator,
    theta: ArrayLike,
    displacement: ArrayLike,
    state: State | None = None,
    *,
    from_rest: bool = False,
    limits: Limits | None = None,
    nearest: bool = False,
) -> FloatArray:
    """Return the voltage with which :meth:`Actuator.displacement` is the given one.

    Parameters
    ----------
    actuator
        Its ``span`` says which voltages earlier drives had, where the start is not from rest.
    theta
        (models, parameters), as of :meth:`Actuator.displacement`.
    displacement
        What is asked for, (samples,) or (models, samples), um, at the actuator's interval.
    state
        Where an earlier piece of a record left the models (of one voltage, with as many models);
        by default a record starts: the dynamics are at rest at the first sample, and the
        hysteresis is in the state that θ's initial one says.
    from_rest
        The voltage comes from zero, where the actuator was at rest.
    limits
        Those of the amplifier; by default none.
    nearest
        Give the nearest command where the limits do not allow for the one that is asked for: with
        each drive as close to the one asked for as the limits let it be, given what came before.

    Returns
    -------
    FloatArray
        (models, samples), V. With it, the displacement is the one that is asked for to rounding
        (Jiles-Atherton and domain walls: to their own error), but for what nothing can reach: the
        second sample with a held voltage, which acts one sample later, and the first ones where a
        mass on a spring is sampled much faster than it swings, if it does not begin at rest.

    Raises
    ------
    InputError
        A displacement that is empty, not finite or of another shape; one that no voltage reaches,
        or none within the limits, with its place and time.
    """
    models = np.atleast_2d(np.asarray(theta, dtype=np.float64))
    asked = _checked(displacement, len(models))
    columns = actuator.columns(models)
    actuator.check(columns)
    slopes = np.broadcast_to(
        np.abs(actuator.hysteresis.gain(columns, actuator.span or UNIT)), len(models)
    )
    ones = []
    for row, slope in enumerate(slopes.tolist()):
        column = {name: values[row : row + 1] for name, values in columns.items()}
        ones.append(One(actuator, column, from_rest, _row(state, row), slope))
    asked = np.broadcast_to(asked, (len(models), asked.shape[1]))
    result = np.empty(asked.shape)
    known = _together(ones, columns, asked, result)
    for row, one in enumerate(ones):
        if limits is not None or not known[row]:
            made = result[row] if known[row] else None
            result[row] = one.voltage(asked[row], limits or Limits(), nearest, made)
    return result


def _together(
    ones: Sequence[One], columns: Mapping[str, FloatArray], asked: FloatArray, result: FloatArray
) -> BoolArray:
    """Write the voltages without limits of models that go side by side; tell which do."""
    actuator, known = ones[0].actuator, np.zeros(len(ones), dtype=np.bool_)
    growing = actuator.creep is not None and actuator.creep.growing
    if len(ones) < MANY or growing or not _has_step(actuator, columns):
        return known
    if isinstance(actuator.hysteresis, BoucWen | BacklashLike):
        state, start = columns["initial"], 0.0 if ones[0].from_rest else None
        if ones[0].state is not None:
            begun = [one.begun(0.0, one.anywhere(0.0))[1] for one in ones]
            state, start = np.array([one.state[0] for one in begun]), float(begun[0].voltage)
        for part in _parts(np.flatnonzero(able(columns, state))):
            here, drive = _drives(ones, columns, asked, part, result)
            made, known[part] = voltages(here, drive, state[part], start, actuator.gain, drive)
            _put(made, part, result)
    # Fewer are done sooner alone.
    left = np.flatnonzero(~known)
    for part in _parts(left) if left.size >= MANY else ():
        here, drive = _drives(ones, columns, asked, part, result)
        made, known[part] = _stepped([ones[row] for row in part.tolist()], here, drive)
        _put(made, part, result)
    peak = np.maximum(asked.max(axis=1) - columns["offset"], columns["offset"] - asked.min(axis=1))
    most = [one.anywhere(size).high for one, size in zip(ones, peak.tolist(), strict=True)]
    return known & (np.maximum(result.max(axis=1), -result.min(axis=1)) < most)


def _parts(rows: IntArray) -> Iterator[IntArray]:
    """Yield rows that are done at a time."""
    for first in range(0, rows.size, BATCH):
        yield rows[first : first + BATCH]


def _put(made: FloatArray, rows: IntArray, result: FloatArray) -> None:
    """Write what rows are to the result, unless it is there."""
    if made is not result:
        result[rows] = made


def _has_step(actuator: Actuator, columns: Mapping[str, FloatArray]) -> bool:
    try:
        step_of(actuator.hysteresis, columns)
    except InputError:
        return False
    return True


def _drives(
    ones: Sequence[One],
    columns: Mapping[str, FloatArray],
    asked: FloatArray,
    rows: IntArray,
    result: FloatArray,
) -> tuple[dict[str, FloatArray], FloatArray]:
    """Return the columns of rows and their drives; of all rows, in the place of the result."""
    here = {name: values[rows] for name, values in columns.items()}
    sections = ones[0].actuator.sections(here)
    drive = result if rows.size == len(result) else np.empty((rows.size, result.shape[1]))
    for place, row in enumerate(rows.tolist()):
        its = _of_row(sections, place)
        drive[place] = ones[row].drive(asked[row] - columns["offset"][row], its)
    return here, drive


def _stepped(
    ones: Sequence[One], here: Mapping[str, FloatArray], drive: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the voltages of models for their drives, and tell which are right."""
    actuator = ones[0].actuator
    shaped = DriveStep(step_of(actuator.hysteresis, here), actuator.gain, here)
    memory, start = shaped.step.demagnetised(), np.empty(len(ones))
    for place, one in enumerate(ones):
        path = one.anywhere(float(np.max(np.abs(drive[place]))))
        start[place], its = one.begun(float(drive[place, 0]), path)
        memory[place] = step_of(actuator.hysteresis, one.column).remembered(its)[0]
    return followed(shaped, drive, memory, start)


def _checked(displacement: ArrayLike, models: int) -> FloatArray:
    asked = np.atleast_2d(np.asarray(displacement, dtype=np.float64))
    if asked.ndim != 2 or asked.shape[1] == 0 or len(asked) not in (1, models):
        raise InputError(
            f"reference: has shape {asked.shape}; give a non-empty row of samples, or one for each "
            "model"
        )
    if not np.isfinite(asked).all():
        sample = int(np.argmin(np.isfinite(asked).all(axis=0)))
        raise InputError(f"reference: not a finite number in sample {sample}; give every sample")
    return asked


def _row(state: State | None, row: int) -> State | None:
    """Return the state of one of a batch's models."""
    if state is None:
        return None
    return State(
        _of_row(state.hysteresis, row),
        tuple(one[row : row + 1] for one in state.rest),
        tuple(one[row : row + 1] for one in state.filter),
    )


def _of_row(memory: Any, row: int) -> Any:
    """Return a memory with its arrays (models,) cut to one model, whatever it is made of."""
    if isinstance(memory, np.ndarray):
        return memory[row : row + 1]
    if isinstance(memory, tuple):
        parts = [_of_row(one, row) for one in memory]
        return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)
    if hasattr(memory, "__dataclass_fields__"):
        return type(memory)(
            **{name: _of_row(getattr(memory, name), row) for name in memory.__dataclass_fields__}
        )
    return memory
