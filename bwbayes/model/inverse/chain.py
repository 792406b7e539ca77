"""The actuator read backwards: for a displacement over time, the voltage that gives it.

The offset is taken off, creep and dynamics are undone (:mod:`bwbayes.model.inverse.dynamics`), and
what is left, the drive, is what hysteresis and gain must make. They do so along stretches that go
one way: the drive turns where the voltage does, so that each stretch is one search for all of its
samples (:func:`bwbayes.model.inverse.stretch.reached`), whatever the operator.

What is done to each model is done to it alone (:mod:`bwbayes.model.inverse.alone`): the models of a
batch have voltages of their own. Where there are many, those whose hysteresis has a step go side by
side instead, which is much faster (:mod:`bwbayes.model.inverse.together`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator, State
from bwbayes.model.inverse.alone import One
from bwbayes.model.inverse.limits import Limits
from bwbayes.model.inverse.together import together
from bwbayes.model.operator import UNIT

__all__ = ["inverse"]


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
    target = _checked(displacement, len(models))
    columns = actuator.columns(models)
    actuator.check(columns)
    slopes = np.broadcast_to(
        np.abs(actuator.hysteresis.gain(columns, actuator.span or UNIT)), len(models)
    )
    singles = []
    for row, slope in enumerate(slopes.tolist()):
        column = {name: values[row : row + 1] for name, values in columns.items()}
        singles.append(One(actuator, column, from_rest, of_rows(state, slice(row, row + 1)), slope))
    target = np.broadcast_to(target, (len(models), target.shape[1]))
    result = np.empty(target.shape)
    solved = together(singles, columns, state, target, result)
    for row, single in enumerate(singles):
        if limits is not None or not solved[row]:
            solution = result[row] if solved[row] else None
            result[row] = single.voltage(target[row], limits or Limits(), nearest, solution)
    return result


def of_rows(memory: Any, rows: slice) -> Any:
    """Return a memory with its arrays (models, ...) cut to some models, whatever it is made of."""
    if isinstance(memory, np.ndarray):
        return memory[rows]
    if isinstance(memory, tuple):
        parts = [of_rows(member, rows) for member in memory]
        return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)
    if hasattr(memory, "__dataclass_fields__"):
        return type(memory)(
            **{name: of_rows(getattr(memory, name), rows) for name in memory.__dataclass_fields__}
        )
    return memory


def _checked(displacement: ArrayLike, models: int) -> FloatArray:
    target = np.atleast_2d(np.asarray(displacement, dtype=np.float64))
    if target.ndim != 2 or target.shape[1] == 0 or len(target) not in (1, models):
        raise InputError(
            f"reference: has shape {target.shape}; give a non-empty row of samples, or one for "
            "each model"
        )
    if not np.isfinite(target).all():
        sample = int(np.argmin(np.isfinite(target).all(axis=0)))
        raise InputError(f"reference: not a finite number in sample {sample}; give every sample")
    return target
