"""The stage of asymmetric Bouc-Wen hysteresis: that of the plain one, with rates that change.

While the voltage keeps its sign and its direction, this is plain Bouc-Wen hysteresis; so the stage
hands it the samples in runs, with the rates that hold there.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled import bouc_wen
from bwbayes.inference.compiled.bouc_wen import AGAINST, AHEAD
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.model.declaration import Values
from bwbayes.model.operators.bouc_wen_asymmetric import SIGNS, rates

__all__ = ["bouc_wen_asymmetric", "rows"]

plain = bouc_wen.bouc_wen

# Behind the plain stage's rows: the rates against and ahead for each pair of signs.
PAIRS = bouc_wen.ROWS * LANES


def rows(column: Values, h: FloatArray, rest: FloatArray) -> FloatArray:
    """Return what the stage starts from, (models, rows): h (models,) and the drive w₀ (models,)."""
    own = [bouc_wen.rows({**column, "gamma": np.zeros_like(rest)}, h, rest)]
    for s in SIGNS:
        for x in SIGNS:
            slow, fast = rates(column, s, x)
            own.append(np.stack([slow - fast, slow + fast], axis=1))
    return np.concatenate(own, axis=1)


@njit(nogil=True, cache=True)
def bouc_wen_asymmetric(
    state: FloatArray, voltage: FloatArray, first: int, last: int, out: FloatArray
) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out`` and move h on."""
    t = first
    while t < last:
        now = voltage[t]
        before = voltage[t - 1] if t > 0 else now
        up, positive = now > before, now + before > 0.0
        piece = out[(t - first) * LANES :]
        if now * before < 0.0:
            # To zero volts, and on from there.
            _take(state, up, not up)
            plain(state, np.array([before, 0.0]), 1, 2, piece)
            _take(state, up, up)
            plain(state, np.array([0.0, now]), 1, 2, piece)
            t += 1
            continue
        end = t + 1
        while end < last and _is_alike(voltage[end - 1], voltage[end], up, positive):
            end += 1
        _take(state, up, positive)
        plain(state, voltage, t, end, piece)
        t = end


@njit(nogil=True, cache=True)
def _is_alike(before: float, now: float, up: bool, positive: bool) -> bool:
    """Tell whether a step has this direction and this sign of the voltage, all along."""
    same = (now > before) == up and (now + before > 0.0) == positive
    return bool(same and now * before >= 0.0)


@njit(nogil=True, cache=True)
def _take(state: FloatArray, up: bool, positive: bool) -> None:
    """Let the rates of a pair of signs hold."""
    pair = PAIRS + 2 * LANES * (2 * (not up) + (not positive))
    for i in range(LANES):
        state[AGAINST + i] = state[pair + i]
        state[AHEAD + i] = state[pair + LANES + i]
