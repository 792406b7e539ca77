"""The displacement on the compiled engine: models that walk along a voltage, piece by piece.

What the likelihood does sample by sample, without its noise: the same stages, gain and dynamics,
for ``LANES`` models side by side.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LAG, LANES, PARAMETERS, STATE, X1, X2, in_lanes
from bwbayes.inference.compiled.motion import PIECE, displace, physics, shared
from bwbayes.inference.compiled.stages import DRIVES, Kind, Stage, drive_of, given, prepared
from bwbayes.model.actuator import Actuator


class Walk:
    """Models on their way along a voltage; see :func:`walk`.

    ``drive`` makes the next piece of the operator's drive, where that has no stage of its own.
    """

    def __init__(
        self,
        stage: Stage,
        known: tuple[FloatArray, FloatArray, FloatArray],
        state: FloatArray,
        voltage: FloatArray,
        drive: Callable[[FloatArray], FloatArray] | None,
    ) -> None:
        self.stage, self.known, self.state, self.voltage = stage, known, state, voltage
        self.drive = drive
        self.groups = in_lanes(stage.group)
        self.now = 0

    def to(self, last: int) -> FloatArray:
        """Displacement (models, samples), um, from where the models are to before a sample."""
        displacement = np.empty((len(self.stage.group), last - self.now))
        begin, end, plan, voltage = self.now, last, self.stage.plan, self.voltage
        curve, lags, growth = self.known
        if self.drive is not None:
            piece = slice(begin, end)
            voltage, curve, begin, end = voltage[piece], curve[piece], 0, last - self.now
            growth = growth[piece]
            plan = np.ascontiguousarray(self.drive(voltage))
        _walk(
            self.stage.kind, self.groups, plan, curve, lags, growth, self.state, voltage, begin,
            end, displacement,
        )  # fmt: skip
        self.now = last
        return displacement


def walk(
    actuator: Actuator,
    theta: FloatArray,
    voltage: FloatArray,
    unrest: FloatArray | None = None,
    *,
    from_rest: bool = False,
) -> Walk | None:
    """Put models to a voltage's first sample; None if they are left to NumPy.

    That is so for an operator that is not compiled. Parameters and errors are those of
    :meth:`~bwbayes.model.actuator.Actuator.advance`, but that the ``voltage`` (samples,) is known
    up to the end.
    """
    operator, drive = actuator.hysteresis, None
    column = actuator.columns(theta)
    actuator.check(column)
    memory = actuator.begin(column, voltage, from_rest=from_rest)
    stage: Stage | None
    if type(operator) in DRIVES:
        make = DRIVES[type(operator)]

        def along(piece: FloatArray) -> FloatArray:
            nonlocal memory
            moved, memory = make(operator, column, piece, memory)
            return moved

        drive, stage = along, given(along(voltage[:1])[:, 0], np.empty((0, 0)))
    else:
        stage = prepared(operator, column, voltage, memory)
    if stage is None:
        return None
    rows = {
        PARAMETERS.index(name): values
        for name, values in physics(actuator, column, stage.rest, voltage).items()
    }
    moving, *crept = actuator.sections(column).begin(unrest)
    rows |= dict(zip((X1 // LANES, X2 // LANES), moving.T, strict=False))
    rows |= {LAG // LANES + k: lag[:, 0] for k, lag in enumerate(crept)}
    models = np.zeros((len(theta), STATE // LANES))
    for row, values in rows.items():
        models[:, row] = values
    # Not to be written to, whatever it was: of one type, for which one walk is compiled.
    known = np.broadcast_to(voltage, voltage.shape)
    return Walk(stage, shared(actuator, voltage), in_lanes(models), known, drive)


@njit(nogil=True, cache=True)
def _walk(
    kind: Kind,
    groups: FloatArray,
    plan: FloatArray,
    curve: FloatArray,
    lags: FloatArray,
    growth: FloatArray,
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
            drive_of(kind, groups[group], plan, voltage, now, end, drive)
            displace(state[group], curve, lags, growth, now, end, drive)
            for i in range(models):
                for t in range(now, end):
                    displacement[group * LANES + i, t - first] = drive[(t - now) * LANES + i]
