"""The displacement on the compiled engine: models that walk along a voltage, piece by piece.

What the likelihood does sample by sample, without its noise: the same stages, gain and dynamics,
for ``LANES`` models side by side.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import (
    A1,
    A2,
    B0,
    B1,
    B2,
    CUBIC,
    LANES,
    LEVEL,
    QUADRATIC,
    STATE,
    X1,
    X2,
)
from bwbayes.inference.compiled.parts import polynomial
from bwbayes.inference.compiled.stages import DRIVES, STAGES, Stage, drive_of, given
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Values
from bwbayes.model.operator import Operator

__all__ = ["Walk", "walk"]

# Samples that pass stage and dynamics together.
PIECE = 64


class Walk:
    """Models on their way along a voltage; see :func:`walk`.

    ``drive`` makes the next piece of the operator's drive, where that has no stage of its own.
    """

    def __init__(
        self,
        stage: Stage,
        curve: FloatArray,
        state: FloatArray,
        voltage: FloatArray,
        drive: _GivenDrive | None,
    ) -> None:
        self.stage, self.curve, self.state, self.voltage = stage, curve, state, voltage
        self.drive = drive
        groups = np.reshape(stage.own[_lanes(len(stage.own))], (len(state), LANES, -1))
        self.own = np.ascontiguousarray(groups.swapaxes(1, 2)).reshape(len(state), -1)
        self.now = 0

    def to(self, last: int) -> FloatArray:
        """Displacement (models, samples), um, from where the models are to before a sample."""
        displacement = np.empty((len(self.stage.own), last - self.now))
        known, begin, end = (self.stage.plan, self.curve, self.voltage), self.now, last
        if self.drive is not None:
            piece = slice(begin, end)
            known = self.drive.along(self.voltage[piece]), self.curve[piece], self.voltage[piece]
            begin, end = 0, last - self.now
        plan, curve, voltage = known
        _walk(self.stage.kind, self.own, plan, curve, self.state, voltage, begin, end, displacement)
        self.now = last
        return displacement


class _GivenDrive:
    """What an operator without a stage makes of a voltage, piece by piece."""

    def __init__(self, operator: Operator, column: Values, memory: Any) -> None:
        self.operator, self.column, self.memory = operator, column, memory
        self.make = DRIVES[type(operator)]

    def along(self, voltage: FloatArray) -> FloatArray:
        """Return the drive (models, samples), um, along the next piece."""
        drive, self.memory = self.make(self.operator, self.column, voltage, self.memory)
        return drive


def walk(
    actuator: Actuator,
    theta: FloatArray,
    voltage: FloatArray,
    unrest: FloatArray | None = None,
    *,
    from_rest: bool = False,
) -> Walk | None:
    """Put models to a voltage's first sample; None if they are left to NumPy.

    That is so with creep, for an operator that is not compiled, and where a stage cannot do a
    model. Parameters and errors are those of :meth:`~bwbayes.model.actuator.Actuator.advance`, but
    that the ``voltage`` (samples,) is known up to the end.
    """
    operator, drive = actuator.hysteresis, None
    compiled = STAGES.keys() | DRIVES.keys()
    if actuator.creep is not None or type(operator) not in compiled:
        return None
    column = actuator.columns(theta)
    actuator.check(column)
    memory = actuator.begin(column, voltage, from_rest=from_rest)
    if type(operator) in DRIVES:
        drive = _GivenDrive(operator, column, memory)
        stage = given(drive.along(voltage[:1])[:, 0], np.empty((0, 0)))
    else:
        stage = STAGES[type(operator)](operator, column, voltage, memory)
    if not stage.able.all():
        return None
    nothing, rest, curve = np.zeros(len(theta)), stage.rest, np.empty((0, 2))
    if actuator.gain is not None:
        rest = rest + actuator.gain.displacement(column, voltage[:1])[:, 0]
        x = actuator.gain.scaled(voltage)
        curve = np.stack([x**2 - x[0] ** 2, x**3 - x[0] ** 3], axis=1)
    sections = actuator.sections(column)
    dynamics, moving = sections.recursions[0], sections.begin(unrest)[0]
    b = [*dynamics.numerator.T, nothing, nothing][:3]
    a = [*dynamics.denominator.T, nothing, nothing][1:3]
    x1, x2 = [*moving.T, nothing, nothing][:2]
    rows = {LEVEL: column["offset"] + rest, B0: b[0], B1: b[1], B2: b[2], A1: a[0], A2: a[1]}
    rows |= {X1: x1, X2: x2}
    rows |= {QUADRATIC: column.get("quadratic", nothing), CUBIC: column.get("cubic", nothing)}
    at = _lanes(len(theta))
    state = np.zeros((at.size // LANES, STATE))
    for row, values in rows.items():
        state[:, row : row + LANES] = values[at].reshape(-1, LANES)
    return Walk(stage, curve, state, voltage, drive)


def _lanes(models: int) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return the model of each lane; lanes to spare repeat the last one."""
    return np.minimum(np.arange(-(-models // LANES) * LANES), models - 1)


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _follow(state: FloatArray, samples: int, drive: FloatArray) -> None:
    """Let the dynamics follow the drive's distance from rest, and put the displacement there."""
    for t in range(samples):
        row = t * LANES
        for i in range(LANES):
            w = drive[row + i]
            x = state[B0 + i] * w + state[X1 + i]
            state[X1 + i] = state[B1 + i] * w - state[A1 + i] * x + state[X2 + i]
            state[X2 + i] = state[B2 + i] * w - state[A2 + i] * x
            drive[row + i] = state[LEVEL + i] + x


@njit(nogil=True, cache=True)
def _walk(
    kind: int,
    own: FloatArray,
    plan: FloatArray,
    curve: FloatArray,
    state: FloatArray,
    voltage: FloatArray,
    first: int,
    last: int,
    displacement: FloatArray,
) -> None:
    """Move all models on from sample ``first`` to ``last``; write what they do on the way."""
    drive = np.empty(PIECE * LANES)
    for group in range(state.shape[0]):
        models = min(LANES, displacement.shape[0] - group * LANES)
        for now in range(first, last, PIECE):
            end = min(now + PIECE, last)
            drive_of(kind, own[group], plan, voltage, now, end, drive)
            if curve.size > 0:
                polynomial(state[group], curve, now, end, drive)
            _follow(state[group], end - now, drive)
            for i in range(models):
                for t in range(now, end):
                    displacement[group * LANES + i, t - first] = drive[(t - now) * LANES + i]
