"""The Jiles-Atherton and the domain wall model compiled: model by model, stretch by stretch.

The same steps as :mod:`bwbayes.model.operators.walls` takes, so that both engines have the same
error. An integrator's steps do not end at samples, so this is not a stage that takes samples as
they come: it makes the drive of a whole record, which is then taken as given.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.model.declaration import Values
from bwbayes.model.drive import monotone_stretches
from bwbayes.model.operators.domain_wall import DomainWall
from bwbayes.model.operators.jiles_atherton import ABOVE, BELOW, STEPS, TINY
from bwbayes.model.operators.one_state import StateMemory
from bwbayes.model.operators.pinned import LONGEST, Pinned
from bwbayes.model.operators.rosenbrock import (
    BETWEEN,
    COUPLINGS,
    DRIFTS,
    END,
    PLACES,
    SHIFT,
    STAGES,
    WEIGHTS,
)
from bwbayes.model.operators.walls import (
    CONVERGED,
    FARTHEST,
    FIRST,
    GROW,
    NOTCHES,
    ROUNDS,
    SAFE,
    SATURATED,
    SHRINK,
    TOLERANCE,
)

__all__ = ["drive"]


def drive(
    operator: Pinned, column: Values, voltage: FloatArray, memory: StateMemory
) -> tuple[FloatArray, StateMemory]:
    """Return w (models, samples), um, and the memory after it, as ``operator.advance`` does."""
    joined = np.concatenate([[memory.voltage], voltage])
    stretches = list(monotone_stretches(joined, LONGEST))
    ends = np.array([[stretch.first, stretch.last] for stretch in stretches], dtype=np.int64)
    directions = np.array([stretch.direction for stretch in stretches])
    walls = np.stack(operator.walls(column), axis=1)
    spins = isinstance(operator, DomainWall)
    state = np.array(memory.state)
    w = _follow(spins, walls, joined, ends, directions, state)[:, 1:]
    return w, StateMemory(float(joined[-1]), state)


@njit(nogil=True, cache=True)
def _follow(
    spins: bool,
    walls: FloatArray,
    voltage: FloatArray,
    ends: IntArray,
    directions: FloatArray,
    state: FloatArray,
) -> FloatArray:
    """Return w (models, samples) along stretches, and move irreversible displacements on."""
    result = np.empty((state.size, voltage.size))
    for model in range(state.size):
        group, fixed = walls[model], state[model]
        out = result[model]
        out[0] = _at_rest(spins, group, fixed, voltage[0])
        for stretch in range(directions.size):
            first, last = ends[stretch]
            s = directions[stretch]
            fixed = s * _rise(spins, group, s * fixed, s, voltage[first : last + 1], out[first:])
        state[model] = fixed
    return result


@njit(nogil=True, cache=True)
def _rise(
    spins: bool, group: FloatArray, fixed: float, s: float, voltage: FloatArray, out: FloatArray
) -> float:
    """Fill in w along s u, which rises, after its first sample; return the last s P_irr."""
    ws, e0, a, c = group[0], group[1], group[2], group[4]
    level = min(max(fixed / ws, -SATURATED), SATURATED)
    free = e0 * _field_at(spins, level) - a * fixed
    begin, end = s * voltage[0], s * voltage[-1]
    since = max(free, begin)
    t = 1
    while t < voltage.size and s * voltage[t] <= since:
        out[t] = s * _at_rest(spins, group, fixed, s * voltage[t])
        t += 1
    if not since < end:
        return fixed
    start = _at_rest(spins, group, fixed, since)
    p = _move(spins, group, since, start, s, voltage, t, out)
    level, _ = _curve(spins, (end + a * p) / e0)
    return float((p - c * ws * level) / (1 - c))


@njit(nogil=True, cache=True)
def _move(
    spins: bool,
    group: FloatArray,
    u: float,
    p: float,
    s: float,
    voltage: FloatArray,
    t: int,
    out: FloatArray,
) -> float:
    """Let walls move from s u and s P on; fill in w from sample t on, and return the last s P."""
    end = s * voltage[-1]
    scale = TOLERANCE * min(group[0], group[6] * (end - u))
    step = FIRST * (group[3] - group[2] * group[5])
    k = np.empty(STAGES)
    while True:
        away = abs(u + group[2] * p) / (1 + group[2] * group[6])
        largest = max(FARTHEST * away / group[1], 1.0)
        notch = math.floor(NOTCHES * math.log2(min(step / group[1], largest)))
        step = group[1] * 2.0 ** (notch / NOTCHES)
        last = step >= end - u
        h = end - u if last else step
        slope, drift, down = _slopes(spins, group, u, p)
        shifted = 1 / (SHIFT * h) - down
        for stage in range(STAGES):
            if stage > 0:
                near = p + _weighted(WEIGHTS[stage], k, stage)
                slope = _slope(spins, group, u + PLACES[stage] * h, near)
            coupled = _weighted(COUPLINGS[stage], k, stage) / h
            k[stage] = (slope + DRIFTS[stage] * h * drift + coupled) / shifted
        change = _weighted(END, k, STAGES)
        first = _weighted(BETWEEN[0], k, STAGES)
        second = _weighted(BETWEEN[1], k, STAGES)
        third = _weighted(BETWEEN[2], k, STAGES)
        midpoint = p + 0.5 * change + 0.25 * (first + 0.5 * (second + 0.5 * third))
        off = _slope(spins, group, u + 0.5 * h, midpoint) - (change + 0.25 * (second + third)) / h
        error = max(abs(k[STAGES - 1]), abs(off / shifted)) / scale
        step = h * (min(max(SAFE * error**-0.2, SHRINK), GROW) if error > 0.0 else GROW)
        if not error <= 1.0:
            continue
        arrived = end if last else u + h
        while t < voltage.size and s * voltage[t] <= arrived:
            fraction = (s * voltage[t] - u) / (arrived - u)
            between = (1 - fraction) * (first + fraction * (second + fraction * third))
            out[t] = s * (p + fraction * (change + between))
            t += 1
        u, p = arrived, p + change
        if last:
            return p


@njit(nogil=True, cache=True)
def _weighted(weights: FloatArray, stages: FloatArray, count: int) -> float:
    total = 0.0
    for stage in range(count):
        total += weights[stage] * stages[stage]
    return total


@njit(nogil=True, cache=True)
def _slope(spins: bool, group: FloatArray, u: float, p: float) -> float:
    """Return f = dP/du while walls move under a rising voltage."""
    ws, e0, a, k, c, lag_limit = group[0], group[1], group[2], group[3], group[4], group[5]
    level, slope = _curve(spins, (u + a * p) / e0)
    behind = min(max((ws * level - p) / (1 - c), 0.0), lag_limit)
    slope = slope * ws / e0
    return float((c * slope + (1 - c) * behind / (k - a * behind)) / (1 - a * c * slope))


@njit(nogil=True, cache=True)
def _slopes(spins: bool, group: FloatArray, u: float, p: float) -> tuple[float, float, float]:
    """Return f, f_u and f_p."""
    ws, e0, a, k, c, lag_limit = group[0], group[1], group[2], group[3], group[4], group[5]
    y = (u + a * p) / e0
    level, slope = _curve(spins, y)
    bend = _bend(spins, y, level, slope) * ws / e0**2
    behind = min(max((ws * level - p) / (1 - c), 0.0), lag_limit)
    slope = slope * ws / e0
    feedback, moving = 1 - a * c * slope, k - a * behind
    forward = (c * slope + (1 - c) * behind / moving) / feedback
    pull = k / (moving**2 * feedback)
    along = c * (1 + a * forward) / feedback * bend + pull * slope
    return forward, along, a * along - pull


@njit(nogil=True, cache=True)
def _at_rest(spins: bool, group: FloatArray, fixed: float, u: float) -> float:
    """Solve P = c P_an + (1 − c) P_irr for P, by Newton's method in u + a P."""
    ws, e0, a, c = group[0], group[1], group[2], group[4]
    base, share = u + a * (1 - c) * fixed, a * c * ws
    near = abs(base) / (1 - share * (1.0 if spins else 1 / 3) / e0)
    x = math.copysign(min(near, abs(base) + share), base)
    for _ in range(ROUNDS):
        level, slope = _curve(spins, x / e0)
        step = (x - base - share * level) / (1 - share * slope / e0)
        if not abs(step) > CONVERGED * (abs(x) + e0):
            break
        x -= step
    level, _ = _curve(spins, x / e0)
    return float(c * ws * level + (1 - c) * fixed)


@njit(nogil=True, cache=True)
def _curve(spins: bool, y: float) -> tuple[float, float]:
    """Return L and L′ of either model."""
    size = abs(y)
    if spins:
        decay = math.exp(-2 * size)
        return math.tanh(y), 4 * decay / (1 + decay) ** 2
    if size < 1.0:
        square = size * size
        above = ((ABOVE[0] * square + ABOVE[1]) * square + ABOVE[2]) * square + ABOVE[3]
        below = ((BELOW[0] * square + BELOW[1]) * square + BELOW[2]) * square + BELOW[3]
        quotient = above / below
        level = size * quotient
        return math.copysign(level, y), 1 - level * level - 2 * quotient
    inverse = 1 / size
    decay = math.exp(-2 * size)
    ratio = 2 * decay / (1 - decay)
    return math.copysign(1 + ratio - inverse, y), inverse * inverse - 2 * ratio / (1 - decay)


@njit(nogil=True, cache=True)
def _bend(spins: bool, y: float, level: float, slope: float) -> float:
    """Return L″ of either model."""
    if spins:
        return -2 * level * slope
    if abs(y) < TINY:
        return -2 * y / 15
    return -2 * level * slope - 2 * (slope - level / y) / y


@njit(nogil=True, cache=True)
def _field_at(spins: bool, level: float) -> float:
    """Return the inverse of L below saturation."""
    size = abs(level)
    if spins:
        return math.atanh(level)
    y = size * (3 - size**2) / (1 - size**2)
    for _ in range(STEPS):
        reached, slope = _curve(False, y)
        y -= (reached - size) / slope
    return math.copysign(y, level)
