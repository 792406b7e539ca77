"""The compiled likelihood's loops: one pass over the samples for a group of models side by side.

What :mod:`bwbayes.model` and :mod:`bwbayes.inference.noise` do with arrays is done here sample by
sample, for ``LANES`` models at once, so that a processor's vector instructions take several models
a step and nothing larger than a cache is written. A few dozen samples at a time pass two stages:

    drive        the hysteresis (:mod:`bwbayes.inference.compiled.stages`)
    innovations  linear dynamics, the noise's filter, and the sums its density needs

The second stage has three forms. Most of a record passes :func:`_settled`: each sample has a
reading, and the filter is in its steady state. Where readings are missing, or the filter is not
settled, or still hears of the start of the dynamics, the samples pass :func:`_exact`. An offset of
the record's own and the start of the creep are heard all along; what they need is added to the
settled form in :mod:`bwbayes.inference.compiled.responses`.

The state of all models is one flat array (:mod:`bwbayes.inference.compiled.lanes`). This module
needs numba; it knows arrays and nothing else.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray, IntArray

# isort: off
# fmt: off
from bwbayes.inference.compiled.lanes import (
    A1, A2, B0, B1, B2, CHANGE, DECAY, ESTIMATE, FREE, GAIN, INNOVATION, INVERSE, KEEP_1, KEEP_2,
    KEPT, LANES, LEVEL, LOG, LOG_RATIO, PAIRS, PARAMETERS, PRODUCTS, RATIO,
    SQUARES, STATE, STRENGTH, SUMS, SURPLUS, TRUE_A1, TRUE_A2, TRUST, UNSURE, UNSURE_22, VALUE,
    VARIANCE, X1, X2,
)
# fmt: on
# isort: on
from bwbayes.inference.compiled import rough, smooth
from bwbayes.inference.compiled.parts import creep, polynomial
from bwbayes.inference.compiled.responses import is_tracked, tracked_by
from bwbayes.inference.compiled.stages import Kind, drive_of

__all__ = ["sums"]

# Samples that pass the stages together: their drives fit into the first cache.
PIECE = 64

# Fewer until the filter has settled and forgotten the start, which is looked at after each piece.
SHORT_PIECE = 16

# What is below this part of its size at the start adds nothing.
FORGOTTEN = 1e-18


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _settled(
    state: FloatArray,
    second: bool | None,
    displacement: FloatArray,
    first: int,
    last: int,
    drive: FloatArray,
) -> None:
    """Let the dynamics follow the drive, and the noise's filter what the measurement has beyond.

    Every sample has a reading and the filter is in its steady state. One loop for both, which
    writes to the state alone: so the compiler can use vectors.
    """
    if second is not None:
        smooth.settled(state, displacement, first, last, drive)
        return
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


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _exact(
    state: FloatArray,
    second: bool | None,
    displacement: FloatArray,
    skipped: FloatArray,
    first: int,
    last: int,
    drive: FloatArray,
    lags: FloatArray,
    offset: int,
    free: int,
    slow: int,
) -> None:
    """Do the same for any samples, any state of the filter, and the responses of the start.

    ``skipped`` is negative where there is no reading. ``offset``, ``free`` and ``slow`` count the
    responses that are followed.
    """
    first_slow = 1 + offset + free
    for t in range(first, last):
        row = (t - first) * LANES
        for i in range(LANES):
            w = drive[row + i]
            x = state[B0 + i] * w + state[X1 + i]
            state[X1 + i] = state[B1 + i] * w - state[A1 + i] * x + state[X2 + i]
            state[X2 + i] = state[B2 + i] * w - state[A2 + i] * x
            state[VALUE + i] = displacement[t] - state[LEVEL + i] - x
        for k in range(1 + offset, first_slow):
            at = k * LANES
            for i in range(LANES):
                x = state[KEEP_1 + at + i]
                state[KEEP_1 + at + i] = state[KEEP_2 + at + i] - state[TRUE_A1 + i] * x
                state[KEEP_2 + at + i] = -state[TRUE_A2 + i] * x
                state[VALUE + at + i] = x
        for k in range(slow):
            at = (first_slow + k) * LANES
            decay = lags[k, 2]
            for i in range(LANES):
                state[VALUE + at + i] = state[KEEP_1 + at + i]
                state[KEEP_1 + at + i] *= decay
        if skipped[t] >= 0.0:
            _filtered(state, second, skipped[t], first_slow + slow)
    _take_logs(state)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _filtered(state: FloatArray, second: bool | None, missing: float, series: int) -> None:
    """Let the filter take a reading of each series, after some that are missing."""
    if missing > 0.0:
        _take_logs(state)
        if second is None:
            rough.skip(state, missing, series)
        else:
            smooth.skip(state, missing, series)
    if second is None:
        rough.unsure(state)
    else:
        smooth.unsure(state)
    pair = PRODUCTS
    for k in range(series):
        at = k * LANES
        for i in range(LANES):
            if second is None:
                estimate = state[ESTIMATE + at + i]
                innovation = state[VALUE + at + i] - estimate
                estimate += state[TRUST + i] * innovation
                state[ESTIMATE + at + i] = state[KEPT + i] * estimate
            else:
                innovation = smooth.advance(state, i, at)
            state[INNOVATION + at + i] = innovation
        for j in range(k + 1):
            other = j * LANES
            for i in range(LANES):
                product = state[INNOVATION + at + i] * state[INNOVATION + other + i]
                state[pair + i] += product * state[INVERSE + i]
            pair += LANES


@njit(nogil=True, cache=True)
def _take_logs(state: FloatArray) -> None:
    """Move the product of variances to the sum of logs, before it gets too large."""
    for i in range(LANES):
        state[LOG + i] += math.log(state[RATIO + i])
        state[RATIO + i] = 1.0


@njit(nogil=True, cache=True)
def _gather(state: FloatArray, readings: int) -> None:
    """Add what readings with one variance brought to the sums."""
    for i in range(LANES):
        state[PRODUCTS + i] += state[SQUARES + i] * state[INVERSE + i]
        state[SQUARES + i] = 0.0
        state[LOG + i] -= readings * math.log(state[INVERSE + i] * state[VARIANCE + i])


@njit(nogil=True, cache=True)
def _is_heard(state: FloatArray, series: int) -> bool:
    """Tell whether any model's filter still hears of the unknown start in one of its series."""
    for i in range(series * LANES, (series + 1) * LANES):
        largest = max(abs(state[KEEP_1 + i]), abs(state[KEEP_2 + i]), abs(state[ESTIMATE + i]))
        if largest > FORGOTTEN:
            return True
    return False


@njit(nogil=True, cache=True)
def _is_audible(state: FloatArray, offset: int, free: int) -> bool:
    """Tell whether any model's filter still hears of the start of the dynamics."""
    audible = False
    for k in range(1 + offset, 1 + offset + free):
        audible = audible or _is_heard(state, k)
    return audible


@njit(nogil=True, cache=True)
def _stay(
    state: FloatArray,
    lags: FloatArray,
    offset: int,
    free: int,
    decays: FloatArray,
    series: IntArray,
) -> int:
    """Count the responses that stay: the offset, and those of the creep that are heard still.

    ``decays`` and ``series`` are what :func:`tracked_by` follows them by.
    """
    count = offset
    for k in range(series.size - offset):
        if _is_heard(state, 1 + offset + free + k):
            decays[count], series[count] = lags[k, 2], 1 + offset + free + k
            count += 1
    return count


@njit(nogil=True, cache=True)
def _begin(state: FloatArray, offset: int, free: int, slow: int) -> None:
    """Put all that a model remembers to the record's first sample."""
    for i in range(len(PARAMETERS) * LANES, STATE):
        state[i] = 0.0
    for i in range(LANES):
        state[RATIO + i] = 1.0
        state[UNSURE + i] = state[UNSURE_22 + i] = state[SURPLUS + i]
        state[CHANGE + i] = 1.0
        if offset > 0:
            state[VALUE + LANES + i] = 1.0
            state[KEEP_1 + LANES + i] = 1.0
        for k in range(free):
            at = (1 + offset + k) * LANES + i
            state[KEEP_1 + at] = state[FREE + 2 * k * LANES + i]
            state[KEEP_2 + at] = state[FREE + (2 * k + 1) * LANES + i]
        for k in range(slow):
            at = (1 + offset + free + k) * LANES + i
            state[KEEP_1 + at] = state[STRENGTH + k * LANES + i]


@njit(nogil=True, cache=True, error_model="numpy")
def _group(
    second: bool | None,
    kind: Kind,
    group: FloatArray,
    plan: FloatArray,
    curve: FloatArray,
    lags: FloatArray,
    growth: FloatArray,
    state: FloatArray,
    voltage: FloatArray,
    displacement: FloatArray,
    skipped: FloatArray,
    offset: int,
    free: int,
    slow: int,
    result: FloatArray,
) -> None:
    """Walk one group of models through the record; ``result`` (SUMS, LANES)."""
    _begin(state, offset, free, slow)
    drive = _aligned(PIECE * LANES)
    decays, series = np.ones(offset + slow), np.ones(offset + slow, dtype=np.int64)
    staying = 0
    # Not a literal, which numba would compile all that follows for a second time.
    now, settled, audible, tracked = int(np.int64(0)), False, True, False
    while now < voltage.size:
        steady = settled and tracked and not audible
        last = min(now + (PIECE if steady else SHORT_PIECE), voltage.size)
        plain = steady and skipped[now] == 0.0
        if plain:
            # As far as every sample has a reading.
            end = now
            while end < last and skipped[end] == 0.0:
                end += 1
            last = end
        drive_of(kind, group, plan, voltage, now, last, drive)
        if curve.size > 0:
            polynomial(state, curve, now, last, drive)
        if lags.size > 0:
            creep(state, lags, growth, now, last, drive)
        if plain and staying == 0:
            _settled(state, second, displacement, now, last, drive)
        elif plain:
            followed = decays[:staying], series[:staying]
            tracked_by(state, displacement, now, last, drive, *followed)
        else:
            _exact(state, second, displacement, skipped, now, last, drive, lags, offset, free, slow)
            settled = rough.is_settled(state) if second is None else smooth.is_settled(state)
            audible = _is_audible(state, offset, free)
            staying = _stay(state, lags, offset, free, decays, series)
            tracked = settled and not audible
            if second is None:
                tracked = tracked and is_tracked(state, decays[:staying], series[:staying])
            else:
                tracked = tracked and staying == 0
        now = last
    for i in range(LANES):
        state[PRODUCTS + i] += state[SQUARES + i] / state[VARIANCE + i]
        for pair in range(PAIRS):
            result[pair, i] = state[PRODUCTS + pair * LANES + i]
        result[LOG_RATIO, i] = state[LOG + i]


@njit(nogil=True, cache=True)
def _aligned(size: int) -> FloatArray:
    """Return an empty row whose vectors do not straddle the cache's lines (of 64 bytes)."""
    row = np.empty(size + 8)
    skipped = (-row.ctypes.data // 8) % 8
    return row[skipped : skipped + size]


@njit(nogil=True, cache=True, error_model="numpy")
def sums(
    voltage: FloatArray,
    displacement: FloatArray,
    skipped: FloatArray,
    models: FloatArray,
    second: bool | None,
    kind: Kind,
    group: FloatArray,
    plan: FloatArray,
    curve: FloatArray,
    lags: FloatArray,
    growth: FloatArray,
    offset: int,
    free: int,
    slow: int,
) -> FloatArray:
    """Return what the noise's density needs, (SUMS, models).

    First Σ eᵢ eⱼ / S of the innovations e and their variances S, for the pairs i ≥ j of series:
    the residual (um), the offset's response if ``offset`` is one, ``free`` free responses of the
    dynamics and ``slow`` ones of the creep. Then Σ log S less that of the steady state.

    Parameters
    ----------
    voltage, displacement
        (samples,), V and um.
    skipped
        (samples,) how many readings are missing just before one, −1 where there is none.
    models
        (models, parameters), the columns as in ``PARAMETERS``.
    second
        None unless the noise has two states.
    kind, group, plan
        The stage that makes the drive, what each model is in it (models, rows), and what it knows
        of the voltage, as in :mod:`bwbayes.inference.compiled.stages`.
    curve, lags, growth
        What gain and creep know, as in :mod:`bwbayes.inference.compiled.parts`.
    """
    count = models.shape[0]
    result, results = np.empty((SUMS, count)), np.empty((SUMS, LANES))
    state, lane_group = _aligned(STATE), _aligned(group.shape[1] * LANES)
    for first in range(0, count, LANES):
        for i in range(LANES):
            # Lanes to spare repeat the last model.
            model = min(first + i, count - 1)
            for row in range(models.shape[1]):
                state[row * LANES + i] = models[model, row]
            for row in range(group.shape[1]):
                lane_group[row * LANES + i] = group[model, row]
        _group(
            second, kind, lane_group, plan, curve, lags, growth, state, voltage, displacement,
            skipped, offset, free, slow, results,
        )  # fmt: skip
        for row in range(SUMS):
            for i in range(min(LANES, count - first)):
                result[row, first + i] = results[row, i]
    return result
