"""The compiled likelihood's loops: one pass over the samples for a group of models side by side.

What :mod:`bwbayes.model` and :mod:`bwbayes.inference.noise` do with arrays is done here sample by
sample, for ``LANES`` models at once, so that a processor's vector instructions take several models
a step and nothing larger than a cache is written. A few dozen samples at a time pass two stages:

    drive        hysteresis, and the drive w = d u − h it leaves
    innovations  linear dynamics, the noise's steady-state filter, and the sums its density needs

The state of all models is one flat array of rows of ``LANES`` numbers, because a compiler can tell
that rows of one array do not overlap. This module needs numba; it knows arrays and nothing else.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray, IntArray

__all__ = ["LANES", "PARAMETERS", "sums"]

# Models side by side: four vector registers of eight numbers, which hide each other's latency.
LANES = 32

# Samples that pass the stages together: their drives fit into the first cache.
PIECE = 64

# Rows of the state. First what a model is, in the order of `PARAMETERS`, then what it remembers.
PARAMETERS = (
    "initial", "alpha", "against", "ahead", "d", "rest", "level",
    "b0", "b1", "b2", "a1", "a2", "decay", "gain", "share",
)  # fmt: skip
(H, ALPHA, AGAINST, AHEAD, D, REST, LEVEL, B0, B1, B2, A1, A2, DECAY, GAIN, SHARE) = (
    LANES * row for row in range(len(PARAMETERS))
)
X1, X2, ESTIMATE, POWER, INNOVATION, SQUARES, PULL, FIRST, BEFORE, Z, PHI = (
    LANES * (len(PARAMETERS) + row) for row in range(11)
)
STATE = LANES * (len(PARAMETERS) + 11)

# φ(z) = (1 − exp(−z)) / z by its series, to 3e-14 of itself up to this z; doubled beyond.
SHORT = 0.1
C1, C2, C3, C4, C5, C6, C7 = -1 / 2, 1 / 6, -1 / 24, 1 / 120, -1 / 720, 1 / 5040, -1 / 40320

# Powers of the filter's decay below this add nothing to the start's correction.
FORGOTTEN = 1e-18


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _drive(
    state: FloatArray, voltage: FloatArray, first: int, last: int, steepest: float, out: FloatArray
) -> None:
    """Write w − w₀ of samples ``first`` to ``last`` to ``out`` and move h on.

    Along a step of v = |Δu| in direction s, g = s h follows dg/dv = α − c g exactly by
    g + (α − c g) v φ(c v), which has no difference of nearly equal numbers at small steps.
    """
    for t in range(first, last):
        u = voltage[t]
        step = u - voltage[t - 1] if t > 0 else 0.0
        row = (t - first) * LANES
        s = 1.0 if step > 0.0 else -1.0
        v = abs(step)
        crossings = 0
        if step == 0.0:
            for i in range(LANES):
                out[row + i] = state[D + i] * u - state[H + i] - state[REST + i]
        elif v * steepest <= SHORT:
            crossings = _short_step(state, s, u, v, row, out)
        else:
            crossings = _long_step(state, s, u, v, steepest, row, out)
        if crossings > 0:
            _cross(state, s, u, v, row, out)


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _short_step(state: FloatArray, s: float, u: float, v: float, row: int, out: FloatArray) -> int:
    """Move h along a step whose z is small; return how many models passed zero."""
    crossings = 0
    for i in range(LANES):
        g = s * state[H + i]
        # Both are read first: a compiler does not make vectors of what is read on a condition.
        ahead = state[AHEAD + i]
        against = state[AGAINST + i]
        c = against if g < 0.0 else ahead
        z = c * v
        end = C4 + z * (C5 + z * (C6 + z * C7))
        phi = 1.0 + z * (C1 + z * (C2 + z * (C3 + z * end)))
        new = g + (state[ALPHA + i] - c * g) * (v * phi)
        crossings += (g < 0.0) & (new > 0.0)
        h = s * new
        state[BEFORE + i] = g
        state[H + i] = h
        out[row + i] = state[D + i] * u - h - state[REST + i]
    return crossings


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _long_step(
    state: FloatArray, s: float, u: float, v: float, steepest: float, row: int, out: FloatArray
) -> int:
    """Move h along a step of any size: φ(2z) = φ(z) (1 − z φ(z) / 2) from a small z on."""
    part, doublings = v, 0
    while part * steepest > SHORT:
        part *= 0.5
        doublings += 1
    for i in range(LANES):
        g = s * state[H + i]
        ahead = state[AHEAD + i]
        against = state[AGAINST + i]
        z = (against if g < 0.0 else ahead) * part
        end = C4 + z * (C5 + z * (C6 + z * C7))
        state[PHI + i] = 1.0 + z * (C1 + z * (C2 + z * (C3 + z * end)))
        state[Z + i] = z
        state[BEFORE + i] = g
    for _ in range(doublings):
        for i in range(LANES):
            z = state[Z + i]
            phi = state[PHI + i]
            state[PHI + i] = phi * (1.0 - 0.5 * z * phi)
            state[Z + i] = 2.0 * z
    crossings = 0
    for i in range(LANES):
        g = state[BEFORE + i]
        new = g + (state[ALPHA + i] * v - state[Z + i] * g) * state[PHI + i]
        crossings += (g < 0.0) & (new > 0.0)
        h = s * new
        state[H + i] = h
        out[row + i] = state[D + i] * u - h - state[REST + i]
    return crossings


@njit(nogil=True, cache=True)
def _cross(state: FloatArray, s: float, u: float, v: float, row: int, out: FloatArray) -> None:
    """Redo the models whose g passed zero within the step, where its rate changes."""
    for i in range(LANES):
        g, alpha = state[BEFORE + i], state[ALPHA + i]
        if g < 0.0 < s * state[H + i]:
            against, ahead = state[AGAINST + i], state[AHEAD + i]
            ratio = -g * against / alpha
            # What is left of v after zero, and how far g gets in it: with limits at a rate of zero.
            left = max(v - (-g / alpha if ratio == 0.0 else math.log1p(ratio) / against), 0.0)
            gone = ahead * left
            h = s * alpha * (left if gone == 0.0 else -math.expm1(-gone) / ahead)
            state[H + i] = h
            out[row + i] = state[D + i] * u - h - state[REST + i]


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _given(
    state: FloatArray,
    voltage: FloatArray,
    first: int,
    last: int,
    hysteretic: FloatArray,
    out: FloatArray,
) -> None:
    """Write w − w₀ for h (lanes, samples) that is known already."""
    for t in range(first, last):
        for i in range(LANES):
            w = state[D + i] * voltage[t] - hysteretic[i, t]
            out[(t - first) * LANES + i] = w - state[REST + i]


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _innovations(
    state: FloatArray, displacement: FloatArray, first: int, last: int, drive: FloatArray
) -> None:
    """Let the dynamics follow the drive, and the noise's filter what the measurement has beyond.

    One loop for both, which writes to the state alone: so the compiler can use vectors.
    """
    remembered = _remembered(state)
    for t in range(first, last):
        y = displacement[t]
        row = (t - first) * LANES
        for i in range(LANES):
            w = drive[row + i]
            x = state[B0 + i] * w + state[X1 + i]
            state[X1 + i] = state[B1 + i] * w - state[A1 + i] * x + state[X2 + i]
            state[X2 + i] = state[B2 + i] * w - state[A2 + i] * x
            residual = y - state[LEVEL + i] - x
            estimate = state[ESTIMATE + i]
            innovation = residual - estimate
            state[ESTIMATE + i] = state[DECAY + i] * estimate + state[GAIN + i] * residual
            state[SQUARES + i] += innovation * innovation
            state[INNOVATION + i] = innovation
        if remembered:
            for i in range(LANES):
                state[PULL + i] += state[POWER + i] * state[INNOVATION + i]
                state[POWER + i] *= state[DECAY + i]


@njit(nogil=True, cache=True)
def _remembered(state: FloatArray) -> bool:
    """Tell whether any model's filter remembers its start."""
    longest = 0.0
    for i in range(LANES):
        longest = max(longest, state[POWER + i])
    return longest > FORGOTTEN


@njit(nogil=True, cache=True)
def _begin(state: FloatArray) -> None:
    """Start the noise's filter at a window's first sample, whose residual is the innovation."""
    for i in range(LANES):
        # From the residual's own estimate of the discrepancy: what is left to correct is small.
        r = state[INNOVATION + i]
        state[FIRST + i] = r
        estimate = state[SHARE + i] * r
        state[ESTIMATE + i] = state[DECAY + i] * estimate + state[GAIN + i] * r
        state[PULL + i] = r - estimate
        state[SQUARES + i] = (r - estimate) ** 2
        state[POWER + i] = state[DECAY + i]


@njit(nogil=True, cache=True)
def _group(
    state: FloatArray,
    voltage: FloatArray,
    displacement: FloatArray,
    windows: IntArray,
    hysteretic: FloatArray,
    result: FloatArray,
) -> None:
    """Walk one group of models through the record; ``result`` (windows, 3, LANES)."""
    steepest = 0.0
    for i in range(LANES):
        steepest = max(steepest, state[AHEAD + i], state[AGAINST + i])
        state[X1 + i] = state[X2 + i] = state[POWER + i] = 0.0
    drive = _aligned(PIECE * LANES)
    now = 0
    for k in range(windows.shape[0]):
        start, stop = windows[k, 0], windows[k, 1]
        while now < stop:
            # A window's first sample goes alone: the filter starts there.
            last = min(now + PIECE, start if now < start else start + 1 if now == start else stop)
            if hysteretic.shape[1] > 0:
                _given(state, voltage, now, last, hysteretic, drive)
            else:
                _drive(state, voltage, now, last, steepest, drive)
            if now == start:
                # Without an estimate the innovation is the residual.
                for i in range(LANES):
                    state[ESTIMATE + i] = 0.0
            _innovations(state, displacement, now, last, drive)
            if now == start:
                _begin(state)
            now = last
        for i in range(LANES):
            result[k, 0, i] = state[SQUARES + i]
            result[k, 1, i] = state[PULL + i]
            result[k, 2, i] = state[FIRST + i]


@njit(nogil=True, cache=True)
def _aligned(size: int) -> FloatArray:
    """Return an empty row whose vectors do not straddle the cache's lines (of 64 bytes)."""
    row = np.empty(size + 8)
    skipped = (-row.ctypes.data // 8) % 8
    return row[skipped : skipped + size]


@njit(nogil=True, cache=True)
def sums(
    voltage: FloatArray,
    displacement: FloatArray,
    windows: IntArray,
    models: FloatArray,
    hysteretic: FloatArray,
) -> FloatArray:
    """Return what the noise's density needs of every window, (windows, 3, models).

    These are Σ η'², Σ aᵗ η' and the first residual, in um² and um; η' are the innovations of a
    filter that starts at ``share`` of the first residual.

    Parameters
    ----------
    voltage, displacement
        (samples,), V and um.
    windows
        (windows, 2), first and last sample (excluded) of each, ascending and apart.
    models
        (models, parameters), the columns as in ``PARAMETERS``.
    hysteretic
        h, (models, samples), um, if it is known; (models, 0) to be worked out for n = 1.
    """
    count = models.shape[0]
    result = np.empty((windows.shape[0], 3, count))
    state = _aligned(STATE)
    part = np.empty((windows.shape[0], 3, LANES))
    known = np.empty((LANES, hysteretic.shape[1]))
    for first in range(0, count, LANES):
        for i in range(LANES):
            # Lanes to spare repeat the last model.
            model = min(first + i, count - 1)
            for row in range(models.shape[1]):
                state[row * LANES + i] = models[model, row]
            for t in range(hysteretic.shape[1]):
                known[i, t] = hysteretic[model, t]
        _group(state, voltage, displacement, windows, known, part)
        for k in range(windows.shape[0]):
            for total in range(3):
                for i in range(min(LANES, count - first)):
                    result[k, total, first + i] = part[k, total, i]
    return result
