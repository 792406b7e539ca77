"""The compiled likelihood's loop: one pass over the samples for a group of models side by side.

The loop does the work of :mod:`bwbayes.model` and :mod:`bwbayes.inference.state_space` sample by
sample instead of by arrays, for ``LANES`` models at once, so that a processor's vector instructions
take several models a step and nothing larger than a cache is written. A few dozen samples at a time
pass three stages:

    drive         the hysteresis (:mod:`bwbayes.inference.compiled.stages`)
    displacement  nonlinearity, linear dynamics, creep (:mod:`bwbayes.inference.compiled.motion`)
    innovations   the noise's filter (:mod:`bwbayes.inference.compiled.filter`)

The state of all models is one flat array (:mod:`bwbayes.inference.compiled.lanes`).
"""

from __future__ import annotations

import numpy as np
from numba import float64, int64, none

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled import filter as noise
from bwbayes.inference.compiled.caching import compile_cached

# isort: off
# fmt: off
from bwbayes.inference.compiled.lanes import (
    A1, A2, CHANGE, COVARIANCE, COVARIANCE_22, ESTIMATE, ESTIMATE_2, F, FREE, LANES, LOG,
    LOG_DETERMINANT, PAIRS, PARAMETERS, PRODUCTS, RATIO, RESPONSE, RESPONSE_2, SERIES, STATE,
    STATIONARY, SUMS, VALUE, inner,
)
# fmt: on
# isort: on
from bwbayes.inference.compiled.motion import PIECE, displace
from bwbayes.inference.compiled.stages import Kind, drive_of


@inner()
def _one_by_one(
    state: FloatArray,
    second: bool | None,
    displacement: FloatArray,
    gaps: IntArray,
    steps: FloatArray,
    simulated: FloatArray,
    lags: FloatArray,
    offset: int,
    free: int,
    work: FloatArray,
) -> None:
    """Filter the readings of samples one by one, with all responses to the initial state.

    ``work`` (3 + SERIES, samples times lanes) is room for gains and innovations.
    """
    # Take whole rows, which a compiler knows to be contiguous.
    gain, gain_2, inverse = work[0], work[1], work[2]
    noise.gain(state, second, gaps, steps, gain, gain_2, inverse)
    step = state[F : F + 4 * LANES]
    keeping, nothing = np.empty(LANES), np.zeros(LANES)
    for k in range(1 + offset + free + lags.shape[0]):
        at, values = k * LANES, work[3 + k]
        response = state[RESPONSE + at : RESPONSE + at + LANES]
        later = state[RESPONSE_2 + at : RESPONSE_2 + at + LANES]
        if k == 0:
            _subtract(displacement, simulated, values)
        elif k < 1 + offset:
            values[:] = 1.0
        elif k < 1 + offset + free:
            a1, a2 = state[A1 : A1 + LANES], state[A2 : A2 + LANES]
            _respond(gaps.size, a1, a2, response, later, values)
        else:
            # A slow response of the creep keeps a part of itself, and nothing of the sample before.
            keeping[:] = -lags[k - 1 - offset - free, 2]
            _respond(gaps.size, keeping, nothing, response, later, values)
        estimate = state[ESTIMATE + at : ESTIMATE + at + LANES]
        other = state[ESTIMATE_2 + at : ESTIMATE_2 + at + LANES]
        noise.innovate(second, gaps, steps, step, gain, gain_2, estimate, other, values)
        for j in range(k + 1):
            pair = PRODUCTS + (k * (k + 1) // 2 + j) * LANES
            _add_products(gaps, inverse, values, work[3 + j], state[pair : pair + LANES])


@inner()
def _subtract(displacement: FloatArray, simulated: FloatArray, residual: FloatArray) -> None:
    """Write readings (samples,) less the models' displacement (samples times lanes,)."""
    for t in range(displacement.size):
        row = t * LANES
        for i in range(LANES):
            residual[row + i] = displacement[t] - simulated[row + i]


@inner(fastmath={"contract", "nsz"})
def _respond(
    samples: int,
    a1: FloatArray,
    a2: FloatArray,
    response: FloatArray,
    later: FloatArray,
    values: FloatArray,
) -> None:
    """Write a free response along samples (samples times lanes,), and advance it (lanes,)."""
    for t in range(samples):
        row = t * LANES
        for i in range(LANES):
            x = response[i]
            values[row + i] = x
            response[i] = later[i] - a1[i] * x
            later[i] = -a2[i] * x


@inner(fastmath={"contract", "nsz"})
def _add_products(
    gaps: IntArray, inverse: FloatArray, first: FloatArray, second: FloatArray, total: FloatArray
) -> None:
    """Add up eᵢ eⱼ / S of two series (samples times lanes,) to a total (lanes,)."""
    for t in range(gaps.size):
        row = t * LANES
        if gaps[t] >= 0:
            for i in range(LANES):
                total[i] += first[row + i] * second[row + i] * inverse[row + i]


@inner()
def _is_heard(state: FloatArray, series: int) -> bool:
    """Tell whether the unknown initial state still matters to any model in one of its series.

    A response below 10⁻¹⁸ of its initial size adds nothing. A response that no longer matters is
    set to zero: numbers that decay for ever become subnormal, with which a processor takes ten
    times as long.
    """
    has_reading = False
    for i in range(series * LANES, (series + 1) * LANES):
        response = max(abs(state[RESPONSE + i]), abs(state[RESPONSE_2 + i]))
        estimate = max(abs(state[ESTIMATE + i]), abs(state[ESTIMATE_2 + i]))
        if max(response, estimate) > 1e-18:
            has_reading = True
        else:
            state[RESPONSE + i] = state[RESPONSE_2 + i] = 0.0
            state[ESTIMATE + i] = state[ESTIMATE_2 + i] = 0.0
    return has_reading


@inner()
def _begin(state: FloatArray, offset: int, free: int, slow: int) -> None:
    """Set the memory of all models to the record's first sample."""
    for i in range(len(PARAMETERS) * LANES, STATE):
        state[i] = 0.0
    for i in range(LANES):
        state[RATIO + i], state[CHANGE + i] = 1.0, np.inf
        state[COVARIANCE + i] = state[COVARIANCE_22 + i] = state[STATIONARY + i]
        if offset > 0:
            state[VALUE + LANES + i] = state[RESPONSE + LANES + i] = 1.0
        for k in range(free):
            at = (1 + offset + k) * LANES + i
            state[RESPONSE + at] = state[FREE + 2 * k * LANES + i]
            state[RESPONSE_2 + at] = state[FREE + (2 * k + 1) * LANES + i]
        for k in range(slow):
            at = (1 + offset + free + k) * LANES + i
            state[RESPONSE + at] = 1.0


@inner()
def _copy(values: FloatArray, row: FloatArray) -> None:
    """Write values to the beginning of a row: a slice would need much code to check its shape."""
    for i in range(values.size):
        row[i] = values[i]


@inner()
def _aligned(size: int) -> FloatArray:
    """Return an empty row whose vectors do not straddle the cache's lines (of 64 bytes)."""
    row = np.empty(size + 8)
    skipped = (-row.ctypes.data // 8) % 8
    return row[skipped : skipped + size]


@compile_cached(error_model="numpy")
def sums(
    voltage: FloatArray,
    displacement: FloatArray,
    gaps: IntArray,
    models: FloatArray,
    steps: FloatArray,
    second: bool | None,
    kind: Kind,
    groups: FloatArray,
    plan: FloatArray,
    curve: FloatArray,
    lags: FloatArray,
    growth: FloatArray,
    offset: int,
    free: int,
    slow: int,
) -> FloatArray:
    """Return the sums that the noise's density needs, (SUMS, lanes of all groups).

    The first are Σ eᵢ eⱼ / S of the innovations e and their variances S, for the pairs i ≥ j of
    series: the residual (um), the offset's response if ``offset`` is one, ``free`` free responses
    of the dynamics and ``slow`` ones of the creep. The last is Σ log S, less that of Q₁₁ + s².

    Parameters
    ----------
    voltage, displacement
        (samples,), V and um.
    gaps
        (samples,) index of the gap just before a reading: −1 at a sample without a reading, 0
        without a gap.
    models, steps
        (groups, lanes times parameters), in the order of ``PARAMETERS``, and (groups, gaps, lanes
        times rows) of the filter's step over each gap, as from ``F`` on.
    second
        None unless the noise has two states.
    kind, groups, plan
        The stage that makes the drive, its rows of the models (groups, lanes times rows), and its
        plan of the voltage, as in :mod:`bwbayes.inference.compiled.stages`.
    curve, lags, growth
        Constants of nonlinearity and creep, as in :mod:`bwbayes.inference.compiled.motion`.
    """
    result, state = np.empty((SUMS, len(models) * LANES)), _aligned(STATE)
    group, drive = _aligned(groups.shape[1]), _aligned(PIECE * LANES)
    work = np.empty((3 + SERIES, PIECE * LANES))
    # Responses that remain: the offset, and those of the creep that still matter.
    decays, series = np.ones(offset + slow), np.ones(offset + slow, dtype=np.int64)
    for number in range(len(models)):
        _copy(models[number], state)
        _copy(groups[number], group)
        _begin(state, offset, free, slow)
        # Avoid literals, for which numba would compile the rest for a second time.
        now, pending = int(np.int64(0)), int(np.int64(0))
        staying, steady = 0, False
        while now < voltage.size:
            # Pieces are short until the filter has settled and forgotten the initial state, which
            # is checked after each.
            last = min(now + (PIECE if steady else 32), voltage.size)
            complete = steady and gaps[now] == 0
            if complete:
                # End the piece at the first sample without a reading.
                end = now
                while end < last and gaps[end] == 0:
                    end += 1
                last = end
            drive_of(kind, group, plan, voltage, now, last, drive)
            displace(state, curve, lags, growth, now, last, drive)
            readings = displacement[now:last]
            if complete:
                noise.follow(state, second, readings, drive, decays[:staying], series[:staying])
                pending += last - now
            else:
                noise.gather(state, pending)
                pending = 0
                _one_by_one(
                    state, second, readings, gaps[now:last], steps[number], drive, lags[:slow],
                    offset, free, work,
                )  # fmt: skip
                steady = noise.is_settled(state)
                for k in range(1 + offset, 1 + offset + free):
                    steady = not _is_heard(state, k) and steady
                staying = offset
                for k in range(slow):
                    if _is_heard(state, 1 + offset + free + k):
                        decays[staying], series[staying] = lags[k, 2], 1 + offset + free + k
                        staying += 1
                steady = steady and noise.is_tracked(
                    state, second, decays[:staying], series[:staying]
                )
            now = last
        noise.gather(state, pending)
        for i in range(LANES):
            lane = number * LANES + i
            for pair in range(PAIRS):
                result[pair, lane] = state[PRODUCTS + pair * LANES + i]
            result[LOG_DETERMINANT, lane] = state[LOG + i]
    return result


def compile_common() -> bool:
    """Compile the functions that :func:`sums` needs for every operator, with a noise of one state.

    Functions that one process has compiled are cached for others, such as one that compiles the
    operator. Returns whether all were cached already.
    """
    flat, table, integers = float64[::1], float64[:, ::1], int64[::1]
    _begin.compile((flat, int64, int64, int64))
    _one_by_one.compile((flat, none, flat, integers, table, flat, table, int64, int64, table))
    noise.follow.compile((flat, none, flat, flat, flat, integers))
    displace.compile((flat, table, table, flat, int64, int64, flat))
    compiled_now = (_begin, _one_by_one, noise.follow, displace)
    return not any(sum(function.stats.cache_misses.values()) for function in compiled_now)
