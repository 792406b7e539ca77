"""The hysteresis stages of the compiled likelihood: which operators have one, and who calls it.

A stage writes the drive's distance from that of the first sample, w − w₀, of a piece of a record
for ``LANES`` models side by side. What a model is and remembers stands in rows of ``LANES`` numbers
of one flat array, ``own``; what the stage may know of the voltage beforehand is its ``plan``. An
operator without a stage is worked out beforehand, and its drive is the plan.

A new stage is a file of its own, a line in ``STAGES`` or ``DRIVES`` and one in :func:`drive_of`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.inference.compiled import (
    bells,
    bouc_wen,
    bouc_wen_asymmetric,
    duhem,
    exponential,
    lines,
    pinned,
)
from bwbayes.inference.compiled.extrema import ExtremaPlan
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.model.declaration import Values
from bwbayes.model.operator import Operator
from bwbayes.model.operators.backlash_like import BacklashLike
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.bouc_wen_asymmetric import BoucWenAsymmetric
from bwbayes.model.operators.domain_wall import DomainWall
from bwbayes.model.operators.duhem import Duhem
from bwbayes.model.operators.jiles_atherton import JilesAtherton
from bwbayes.model.operators.maxwell_slip import MaxwellSlip
from bwbayes.model.operators.prandtl_ishlinskii import Plays, PrandtlIshlinskii
from bwbayes.model.operators.preisach import Preisach

__all__ = ["DRIVES", "GIVEN", "STAGES", "Stage", "drive_of", "given"]

GIVEN, BOUC_WEN, BOUC_WEN_ASYMMETRIC, DUHEM, EXPONENTIAL, LINES, BELLS = range(7)


class Stage(NamedTuple):
    """What a compiled stage starts from.

    ``kind`` says which; ``able`` (models,) for which models; ``rest`` (models,) is w₀, um; ``own``
    (models, rows) and ``plan`` are the stage's own.
    """

    kind: int
    able: BoolArray
    rest: FloatArray
    own: FloatArray
    plan: FloatArray


def _bouc_wen(operator: Operator, column: Values, voltage: FloatArray, memory: Any) -> Stage:
    """Take n = 1 with |γ| ≤ β."""
    del operator
    able = (column["exponent"] == 1.0) & (np.abs(column["gamma"]) <= column["beta"])
    rest = column["d"] * voltage[0] - memory.state
    own = bouc_wen.rows(column, memory.state, rest)
    return Stage(BOUC_WEN, able, rest, own, np.empty((0, 0)))


def _exponential(operator: Operator, column: Values, voltage: FloatArray, memory: Any) -> Stage:
    """Take all models."""
    del operator
    plan = ExtremaPlan.of(voltage, memory)
    own = exponential.rows(column, plan, memory)
    able = np.ones(len(own), dtype=bool)
    return Stage(EXPONENTIAL, able, memory.displacement, own, plan.rows)


def _lines(operator: Operator, column: Values, voltage: FloatArray, memory: Any) -> Stage:
    """Take models that share their thresholds."""
    assert isinstance(operator, Plays | MaxwellSlip)
    plan, of = ExtremaPlan.of(voltage, memory), operator.lines(column)
    own = lines.rows(of, plan, memory)
    able = np.full(len(own), len(of.corners) == 1)
    return Stage(LINES, able, memory.displacement, own, lines.planned(of, plan, voltage))


def _bells(operator: Operator, column: Values, voltage: FloatArray, memory: Any) -> Stage:
    """Take models whose saturation is not out of all proportion to the voltage."""
    del operator
    plan = ExtremaPlan.of(voltage, memory)
    own = bells.rows(column, plan, memory)
    highest = float(np.max(np.abs(voltage)))
    ratio = highest / column["saturation"]
    able = (ratio > bells.FARTHEST) & (ratio < bells.NEAREST)
    return Stage(BELLS, able, memory.displacement, own, plan.rows)


def _backlash_like(operator: Operator, column: Values, voltage: FloatArray, memory: Any) -> Stage:
    """Take all models: Bouc-Wen hysteresis with n = 1 and γ = 0."""
    nothing = np.zeros_like(column["beta"])
    values = {**column, "gamma": nothing, "exponent": nothing + 1}
    return _bouc_wen(operator, values, voltage, memory)


def _bouc_wen_asymmetric(
    operator: Operator, column: Values, voltage: FloatArray, memory: Any
) -> Stage:
    del operator
    rest = column["d"] * voltage[0] - memory.state
    own = bouc_wen_asymmetric.rows(column, memory.state, rest)
    able = np.ones(rest.size, dtype=bool)
    return Stage(BOUC_WEN_ASYMMETRIC, able, rest, own, np.empty((0, 0)))


def _duhem(operator: Operator, column: Values, voltage: FloatArray, memory: Any) -> Stage:
    assert isinstance(operator, Duhem)
    rest = operator.polynomial(column, voltage[:1])[:, 0] - memory.state
    own = duhem.rows(column, memory.state, rest)
    return Stage(DUHEM, np.ones(rest.size, dtype=bool), rest, own, np.empty((0, 0)))


STAGES: Mapping[type[Operator], Callable[[Operator, Values, FloatArray, Any], Stage]] = {
    BoucWen: _bouc_wen,
    PrandtlIshlinskii: _exponential,
    Plays: _lines,
    MaxwellSlip: _lines,
    Preisach: _bells,
    BacklashLike: _backlash_like,
    BoucWenAsymmetric: _bouc_wen_asymmetric,
    Duhem: _duhem,
}

# What makes the drive of a whole piece at once, (models, samples), as the operator's ``advance``.
DRIVES: Mapping[
    type[Operator], Callable[[Any, Values, FloatArray, Any], tuple[FloatArray, Any]]
] = {
    JilesAtherton: pinned.drive,
    DomainWall: pinned.drive,
}


def given(rest: FloatArray, drive: FloatArray) -> Stage:
    """Take a drive (models, samples), um, that is known, and at the first sample was ``rest``."""
    own = np.stack([np.arange(rest.size), rest], axis=1)
    return Stage(GIVEN, np.ones(rest.size, dtype=bool), rest, own, drive)


@njit(nogil=True, cache=True)
def drive_of(
    kind: int,
    own: FloatArray,
    plan: FloatArray,
    voltage: FloatArray,
    first: int,
    last: int,
    out: FloatArray,
) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out``, and move the memory on."""
    if kind == BOUC_WEN:
        bouc_wen.bouc_wen(own, voltage, first, last, out)
    elif kind == EXPONENTIAL:
        exponential.exponential(own, plan, voltage, first, last, out)
    elif kind == LINES:
        lines.lines(own, plan, voltage, first, last, out)
    elif kind == BELLS:
        bells.bells(own, plan, voltage, first, last, out)
    elif kind == BOUC_WEN_ASYMMETRIC:
        bouc_wen_asymmetric.bouc_wen_asymmetric(own, voltage, first, last, out)
    elif kind == DUHEM:
        duhem.duhem(own, voltage, first, last, out)
    else:
        _given(own, plan, first, last, out)


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _given(own: FloatArray, plan: FloatArray, first: int, last: int, out: FloatArray) -> None:
    """Take a drive that is known: row i of the plan for the model whose number is own[0][i]."""
    for i in range(LANES):
        drive = plan[int(own[i])]
        for t in range(first, last):
            out[(t - first) * LANES + i] = drive[t] - own[LANES + i]
