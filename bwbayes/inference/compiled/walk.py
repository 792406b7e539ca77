"""The displacement on the compiled engine: models that walk along a voltage, piece by piece.

What the likelihood does sample by sample, without its noise: the same stages, gain and dynamics,
for ``LANES`` models side by side.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.caching import compile_cached
from bwbayes.inference.compiled.lanes import LAG, LANES, STATE, X1, by_rows, in_lanes
from bwbayes.inference.compiled.motion import PIECE, displace, physics, shared
from bwbayes.inference.compiled.stages import Kind, advance_of, drive_of, given, prepared
from bwbayes.model.actuator import Actuator


def walk(
    actuator: Actuator,
    theta: FloatArray,
    voltage: FloatArray,
    unrest: FloatArray | None = None,
    *,
    from_rest: bool = False,
) -> Callable[[int], FloatArray]:
    """Put models to a voltage's first sample; what is returned walks them on to a sample.

    Called with growing numbers of samples, it returns the displacement (models, samples), um, from
    where they are. Parameters and errors are those of
    :meth:`~bwbayes.model.actuator.Actuator.advance`, but that the ``voltage`` (samples,) is known
    up to the end.
    """
    operator = actuator.hysteresis
    column = actuator.columns(theta)
    actuator.check(column)
    memory = actuator.begin(column, voltage, from_rest=from_rest)
    compiled, advance = prepared(operator, column, voltage, memory), advance_of(operator)
    stage = compiled or given(advance(operator, column, voltage[:1], memory)[0])
    sections = actuator.sections(column)
    named = physics(actuator, sections, column, stage.rest, voltage)
    models = by_rows(named, STATE // LANES)
    moving, *crept = sections.begin(unrest)
    models[:, X1 // LANES : X1 // LANES + moving.shape[1]] = moving
    for row, lag in enumerate(crept, LAG // LANES):
        models[:, row] = lag[:, 0]
    groups, state, now = in_lanes(stage.group), in_lanes(models), 0
    # Not to be written to, whatever it was: of one type, for which one walk is compiled.
    known = np.broadcast_to(voltage, voltage.shape)
    curve, lags, growth = shared(actuator, voltage)

    def onwards(last: int) -> FloatArray:
        nonlocal memory, now
        displacement = np.empty((len(theta), last - now))
        piece, begin, plan = slice(0, None), now, stage.plan
        if compiled is None:
            # The drive of this piece is known, and what goes with it begins where it does.
            piece, begin = slice(now, last), 0
            drive, memory = advance(operator, column, voltage[piece], memory)
            plan = np.ascontiguousarray(drive)
        _walk(
            stage.kind, groups, plan, curve[piece], lags, growth[piece], state, known[piece], begin,
            begin + last - now, displacement,
        )  # fmt: skip
        now = last
        return displacement

    return onwards


@compile_cached()
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
