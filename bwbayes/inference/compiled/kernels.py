"""The compiled likelihood's loop: one pass over the samples for a group of models side by side.

The loop does the work of :mod:`bwbayes.model` and :mod:`bwbayes.inference.state_space` sample by
sample instead of by arrays, for ``LANES`` models at once, so that a processor's vector instructions
take several models a step and nothing larger than a cache is written. A few dozen samples at a time
pass three stages:

    drive         the hysteresis (:mod:`bwbayes.inference.compiled.stages`)
    displacement  nonlinearity, linear dynamics, creep (:mod:`bwbayes.inference.compiled.motion`)
    innovations   the noise's filter (:mod:`bwbayes.inference.compiled.filter`)

The numbers and the memory of models are structs of rows of lanes
(:mod:`bwbayes.inference.compiled.lanes`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import float64, from_dtype, int64, none, types

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.compiled import filter as noise
from bwbayes.inference.compiled.filter import SERIES, FilterState, Transition
from bwbayes.inference.compiled.lanes import LANES, Structs, compile_cached, inner
from bwbayes.inference.compiled.motion import PIECE, Motion, Shared, displace
from bwbayes.inference.compiled.stages import Models, Owner, drive_of


class RecordArrays(NamedTuple):
    """A record (samples,): voltage, V, and displacement, um.

    ``gaps`` has the index of the gap just before a reading: −1 at a sample without a reading, 0
    without a gap.
    """

    voltage: FloatArray
    displacement: FloatArray
    gaps: IntArray


class Unknowns(NamedTuple):
    """Numbers of unknowns with responses: the offset, and states of dynamics and creep."""

    offset: int
    free: int
    slow: int


@inner()
def _one_by_one(
    motion: Motion,
    state: FilterState,
    second: bool | None,
    readings: FloatArray,
    gaps: IntArray,
    steps: Structs,
    lags: FloatArray,
    unknowns: Unknowns,
    simulated: FloatArray,
    work: FloatArray,
) -> None:
    """Filter the readings of samples one by one, with all responses to the initial state.

    ``work`` (3 + SERIES, samples, lanes) is room for gains and innovations.
    """
    # Take whole rows, which a compiler knows to be contiguous.
    gain, gain_2, inverse = work[0], work[1], work[2]
    noise.gain(state, second, gaps, steps, gain, gain_2, inverse)
    keeping, nothing = np.empty(LANES), np.zeros(LANES)
    moving = 1 + unknowns.offset
    slow = moving + unknowns.free
    for k in range(slow + unknowns.slow):
        values = work[3 + k]
        response, later = state.response[k], state.response_2[k]
        if k == 0:
            _subtract(readings, simulated, values)
        elif k < moving:
            values[:] = 1.0
        elif k < slow:
            _respond(
                gaps.size, motion.denominator[0], motion.denominator[1], response, later, values
            )
        else:
            # A slow response of the creep keeps a part of itself, and nothing of the sample before.
            keeping[:] = -lags[k - slow, 2]
            _respond(gaps.size, keeping, nothing, response, later, values)
        noise.innovate(
            second, gaps, steps, gain, gain_2, state.estimate[k], state.estimate_2[k], values
        )
        for j in range(k + 1):
            total = state.products[k * (k + 1) // 2 + j]
            _add_products(gaps, inverse, values, work[3 + j], total)


@inner()
def _subtract(readings: FloatArray, simulated: FloatArray, residual: FloatArray) -> None:
    """Write readings (samples,) less the models' displacement (samples, lanes)."""
    for t in range(readings.size):
        for i in range(LANES):
            residual[t, i] = readings[t] - simulated[t, i]


@inner(fastmath={"contract", "nsz"})
def _respond(
    samples: int,
    a1: FloatArray,
    a2: FloatArray,
    response: FloatArray,
    later: FloatArray,
    values: FloatArray,
) -> None:
    """Write a free response along samples (samples, lanes), and advance it (lanes,)."""
    for t in range(samples):
        for i in range(LANES):
            x = response[i]
            values[t, i] = x
            response[i] = later[i] - a1[i] * x
            later[i] = -a2[i] * x


@inner(fastmath={"contract", "nsz"})
def _add_products(
    gaps: IntArray, inverse: FloatArray, first: FloatArray, second: FloatArray, total: FloatArray
) -> None:
    """Add up eᵢ eⱼ / S of two series (samples, lanes) to a total (lanes,)."""
    for t in range(gaps.size):
        if gaps[t] >= 0:
            for i in range(LANES):
                total[i] += first[t, i] * second[t, i] * inverse[t, i]


@compile_cached(error_model="numpy")
def sums(
    record: RecordArrays,
    owner: Owner,
    models: Models,
    shared: Shared,
    motions: Structs,
    filters: Structs,
    steps: Structs,
    second: bool | None,
    unknowns: Unknowns,
) -> None:
    """Filter a record: work out the ``products`` and ``log`` of filters, which the density needs.

    Parameters
    ----------
    record, owner, models
        The readings; a stage's formula and models (:mod:`bwbayes.inference.compiled.stages`).
    shared, motions, filters
        Constants of all models, and structs (groups,) of :class:`Motion` and :class:`FilterState`.
        The series are the residual (um), the offset's response if it is unknown, free responses of
        the dynamics and those of the creep.
    steps
        Structs (groups, gaps) of the filter's :class:`Transition` over what is missing in each gap;
        the first is the step from one reading to the next.
    second
        None unless the noise has two states.
    """
    voltage, displacement, gaps = record
    lags, offset, slow = shared.lags, unknowns.offset, unknowns.slow
    drives, work = np.empty((PIECE, LANES)), np.empty((3 + SERIES, PIECE, LANES))
    # Responses that remain: the offset, and those of the creep that still matter.
    decays, series = np.ones(offset + slow), np.ones(offset + slow, dtype=np.int64)
    for group in range(len(motions)):
        motion, state = motions[group], filters[group]
        noise.begin(state)
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
            drive, readings = drives[: last - now], displacement[now:last]
            drive_of(owner, models, group, voltage, now, drive)
            displace(motion, shared, now, drive)
            if complete:
                noise.follow(state, second, readings, drive, decays[:staying], series[:staying])
                pending += last - now
            else:
                noise.gather(state, pending)
                pending = 0
                _one_by_one(
                    motion, state, second, readings, gaps[now:last], steps[group], lags, unknowns,
                    drive, work,
                )  # fmt: skip
                steady = noise.is_settled(state)
                slowly = 1 + offset + unknowns.free
                for k in range(1 + offset, slowly):
                    steady = not noise.is_heard(state, k) and steady
                staying = offset
                for k in range(slow):
                    if noise.is_heard(state, slowly + k):
                        decays[staying], series[staying] = lags[k, 2], slowly + k
                        staying += 1
                steady = steady and noise.is_tracked(
                    state, second, decays[:staying], series[:staying]
                )
            now = last
        noise.gather(state, pending)


def compile_common() -> bool:
    """Compile the functions that :func:`sums` needs for every operator, with a noise of one state.

    Functions that one process has compiled are cached for others, such as one that compiles the
    operator. Returns whether all were cached already.
    """
    flat, table, integers = float64[::1], float64[:, ::1], int64[::1]
    motion, state, step = (
        from_dtype(struct.layout) for struct in (Motion, FilterState, Transition)
    )
    shared = types.NamedTuple((table, table, flat), Shared)  # type: ignore[no-untyped-call]
    unknowns = types.NamedUniTuple(int64, 3, Unknowns)  # type: ignore[no-untyped-call]
    _one_by_one.compile(
        (motion, state, none, flat, integers, step[::1], table, unknowns, table, float64[:, :, ::1])
    )
    noise.follow.compile((state, none, flat, table, flat, integers))
    displace.compile((motion, shared, int64, table))
    compiled_now = (_one_by_one, noise.follow, displace)
    return not any(sum(function.stats.cache_misses.values()) for function in compiled_now)
