"""Hysteresis that relaxes exponentially, read backwards: n = 1 Bouc-Wen, asymmetric, and Duhem.

All of them are w = f(u) − h with a cubic f, a gain counted in. Along a step of direction s, with
v = |u − u₀| and g = s h, g follows dg/dv = α(u) − c g with a quadratic α, where the rate c may
change as h or the voltage passes zero. What a voltage adds to the drive is then a known function of
v, whose root Newton's rule finds: from a cubic that touches it, one round is usual.

Samples are found one after the other, for ``LANES`` models at once, so that a processor's vector
instructions take several models a step. What that does not reach, because a step is long, or passes
zero, or hardly rises, is done again by :func:`_walk`, a model at a time.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.model.inverse.compiled.slopes import flattest

__all__ = ["relaxed"]

# Models side by side, and samples of theirs that are in the cache together.
LANES, PIECE = 32, 64

# Rows of what a model is: f₀ to f₃ (um/Vᵏ), α₀ to α₂ (um/Vᵏ⁺¹), and its rates c (1/V); where it
# stands: voltage, h and drive; and scratch. Each name is where a row begins.
F0, F1, F2, F3, A0, A1, A2 = (LANES * row for row in range(7))
# For s and the sign x of the voltage of −1 and 1, first below zero, g < 0, and then above.
RATES = 8
C = LANES * 7
U, H, W, S, X, R, G, K, L1, L2, L3, T, V = (LANES * (7 + RATES + row) for row in range(13))
ROWS = 7 + RATES + 13

# ψ(z) = 6 (1/2 − (1 − φ₁(−z))/z)/z, φ₁(−z) = (1 − exp(−z))/z, by its series, to rounding up to z.
SHORT = 0.25
P1, P2, P3, P4, P5 = -1 / 4, 1 / 20, -1 / 120, 1 / 840, -1 / 6720
P6, P7, P8, P9 = 1 / 60480, -1 / 604800, 1 / 6652800, -1 / 79833600

# A step of Newton's below this part of the curve's length doubles the digits to more than there
# are; a slope that changes by more than this part of itself is left to `_walk`.
CLOSE, BENT = 1e-8, 0.5

# Newton's rounds for all, and at most for one, where bisection comes to its help.
SIDE_BY_SIDE, ROUNDS = 3, 200

EPSILON = float(np.finfo(np.float64).eps)

# Doublings of the first guess of how far the voltage goes, and stretches of a step.
DOUBLINGS, STRETCHES = 60, 8


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _turn(own: FloatArray, asked: FloatArray, row: int, signed: bool) -> None:
    """Find each model's direction, how far its drive is to go, and its rate."""
    for i in range(LANES):
        change = asked[row + i] - own[W + i]
        s = 1.0 if change >= 0.0 else -1.0
        own[S + i] = s
        own[R + i] = abs(change)
        own[G + i] = s * own[H + i]
    if not signed:
        for i in range(LANES):
            # Both are read first: a compiler does not make vectors of what is read on a condition.
            below = own[C + i]
            above = own[C + LANES + i]
            own[X + i] = below if own[G + i] < 0.0 else above
        return
    for i in range(LANES):
        below = own[G + i] < 0.0
        up = own[S + i] > 0.0
        # The sign of the voltage just after it has left.
        above = (own[S + i] * own[U + i] >= 0.0) == up
        c0 = own[C + i] if below else own[C + LANES + i]
        c1 = own[C + 2 * LANES + i] if below else own[C + 3 * LANES + i]
        c2 = own[C + 4 * LANES + i] if below else own[C + 5 * LANES + i]
        c3 = own[C + 6 * LANES + i] if below else own[C + 7 * LANES + i]
        down = c1 if above else c0
        rise = c3 if above else c2
        own[X + i] = rise if up else down


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _aim(own: FloatArray) -> None:
    """Expand what v adds to the drive, L₁ v + L₂ v² + (L₃ − T ψ) v³, and guess v from it."""
    for i in range(LANES):
        u = own[U + i]
        s = own[S + i]
        c = own[X + i]
        curved = own[A2 + i]
        third = own[F3 + i]
        strength = own[A0 + i] + u * (own[A1 + i] + u * curved)
        tilt = s * (own[A1 + i] + 2.0 * u * curved)
        first = strength - c * own[G + i]
        second = 0.5 * (tilt - c * first)
        tail = (curved - c * second) * (1.0 / 3.0)
        slope = own[F1 + i] + u * (2.0 * own[F2 + i] + 3.0 * u * third) - first
        bend = s * (own[F2 + i] + 3.0 * u * third) - second
        one = 1.0 / slope
        v = own[R + i] * one
        e = bend * one
        own[L1 + i] = slope
        own[L2 + i] = bend
        own[L3 + i] = third
        own[T + i] = tail
        own[V + i] = v * (1.0 - v * (e - v * (2.0 * e * e - (third - tail) * one)))


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _closer(own: FloatArray) -> int:
    """Take a step of Newton's; return how many models ask for another one."""
    far = 0
    for i in range(LANES):
        v = own[V + i]
        c = own[X + i]
        z = c * v
        slope = own[L1 + i]
        bend = own[L2 + i]
        third = own[L3 + i]
        tail = own[T + i]
        end = P5 + z * (P6 + z * (P7 + z * (P8 + z * P9)))
        psi = 1.0 + z * (P1 + z * (P2 + z * (P3 + z * (P4 + z * end))))
        rest = tail * psi
        off = v * (slope + v * (bend + v * (third - rest))) - own[R + i]
        steep = slope + v * (2.0 * bend + v * (3.0 * (third - tail) + z * rest))
        step = off / steep
        # Whatever is not a number is not close.
        curved = abs(c) * slope + abs(bend) + 3.0 * abs(third) * v
        close = curved * abs(step) <= CLOSE * slope
        far += not close
        own[V + i] = v - step
        own[K + i] = steep if close else 0.0
    return far


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _arrive(own: FloatArray, asked: FloatArray, row: int, passing: bool, signed: bool) -> int:
    """Write the voltages, and return how many are not right; K is above zero where they are."""
    wrong = 0
    for i in range(LANES):
        v = own[V + i]
        s = own[S + i]
        slope = own[L1 + i]
        u = own[U + i]
        goal = asked[row + i]
        reached = u + s * v
        f = own[F1 + i] + reached * (own[F2 + i] + reached * own[F3 + i])
        h = own[F0 + i] + reached * f - goal
        right = (slope > 0.0) & (own[K + i] > 0.0) & (v >= 0.0)
        right &= abs(own[X + i]) * v <= SHORT
        right &= 2.0 * abs(own[L2 + i]) * v <= BENT * slope
        right &= not (passing & (own[G + i] < 0.0) & (s * h > 0.0))
        right &= not (signed & (s * u < 0.0) & (s * reached > 0.0))
        wrong += not right
        own[K + i] = 1.0 if right else 0.0
        own[V + i] = reached
        own[R + i] = h
    return wrong


@njit(nogil=True, cache=True, error_model="numpy")
def _settle(
    own: FloatArray, asked: FloatArray, row: int, passing: bool, signed: bool, right: BoolArray
) -> None:
    """Do models again that were not right, and let all stand where they are now."""
    for i in range(LANES):
        if own[K + i] == 0.0:
            own[V + i], own[R + i] = own[U + i], own[H + i]
            if right[i] and asked[row + i] != own[W + i]:
                right[i] = _walk(own, i, asked[row + i], passing, signed)


@njit(nogil=True, cache=True, error_model="numpy")
def _walk(own: FloatArray, i: int, goal: float, passing: bool, signed: bool) -> bool:
    """Go to where the drive of one model is the goal, by any step; tell whether that can be."""
    u, left = own[U + i], abs(goal - own[W + i])
    s = 1.0 if goal >= own[W + i] else -1.0
    g = s * own[H + i]
    f1, f2, f3 = own[F1 + i], own[F2 + i], own[F3 + i]
    a0, a1, a2 = own[A0 + i], own[A1 + i], own[A2 + i]
    for _ in range(STRETCHES):
        above = (s * u >= 0.0) == (s > 0.0)
        place = 4 * int(s > 0.0) + 2 * int(above) + int(g >= 0.0)
        c = own[C + LANES * place + i]
        strength = a0 + u * (a1 + u * a2)
        line = (f1 + u * (2.0 * f2 + 3.0 * u * f3), s * (f2 + 3.0 * u * f3), f3)
        flow = (strength, s * (a1 + 2.0 * u * a2), a2)
        # As far as the rate stays.
        to_volts = -s * u if signed and s * u < 0.0 else math.inf
        to_state = _crossing(c, g / strength) if passing and g < 0.0 else math.inf
        v, rise, after = _root(line, flow, c, g, left, min(to_volts, to_state), 0.25 * abs(u))
        if not (v >= 0.0 and flattest(line, v) > _steepest(flow, c, g, after, v)):
            return False
        # Exactly zero, so that the next stretch has the other rate.
        u = 0.0 if v == to_volts else u + s * v
        g = 0.0 if v == to_state else after
        left -= rise
        if not left > 0.0:
            own[V + i] = u
            own[R + i] = own[F0 + i] + u * (f1 + u * (f2 + u * f3)) - goal
            return True
    return False


@njit(nogil=True, cache=True, error_model="numpy")
def _crossing(c: float, part: float) -> float:
    """Return the v at which g = part α < 0 has come to zero, infinite if it never does."""
    if c * part == 0.0:
        return -part
    return math.log1p(-c * part) / c if c * part < 1.0 else math.inf


@njit(nogil=True, cache=True, error_model="numpy")
def _root(
    line: tuple[float, float, float],
    flow: tuple[float, float, float],
    c: float,
    g: float,
    left: float,
    most: float,
    size: float,
) -> tuple[float, float, float]:
    """Return how far v the voltage goes until the drive has risen by what is left, or ``most``.

    By how much it has then risen, and g there; v is nan where it does not rise.
    """
    k = flow[0] - c * g
    slope, bend = line[0] - k, line[1] - 0.5 * (flow[1] - c * k)
    if not slope > 0.0:
        return math.nan, 0.0, g
    # Where a parabola that touches gets there.
    far = 2.0 * left / (slope + math.sqrt(max(slope * slope + 4.0 * bend * left, 0.0)))
    low, high = 0.0, min(far, most)
    rise, steep, after = _added(line, flow, c, g, high)
    for _ in range(DOUBLINGS):
        if not (rise < left and high < most):
            break
        low, high = high, min(2.0 * high, most)
        rise, steep, after = _added(line, flow, c, g, high)
    if not rise >= left:
        return (high if high == most else math.nan), rise, after
    v = high
    for _ in range(ROUNDS):
        closer = v - (rise - left) / steep
        if not (low <= closer <= high):
            closer = 0.5 * (low + high)
        moved, v = abs(closer - v), closer
        if moved <= EPSILON * (size + 2.0 * v):
            break
        rise, steep, after = _added(line, flow, c, g, v)
        if rise < left:
            low = v
        else:
            high = v
    return v, left, after


@njit(nogil=True, cache=True, error_model="numpy")
def _added(
    line: tuple[float, float, float],
    flow: tuple[float, float, float],
    c: float,
    g: float,
    v: float,
) -> tuple[float, float, float]:
    """Return what v adds to the drive, the slope there, and g there."""
    z = c * v
    if abs(z) <= SHORT:
        end = P5 + z * (P6 + z * (P7 + z * (P8 + z * P9)))
        three = 1.0 + z * (P1 + z * (P2 + z * (P3 + z * (P4 + z * end))))
        three *= 1.0 / 6.0
        two = 0.5 - z * three
        one = 1.0 - z * two
    else:
        one = -math.expm1(-z) / z
        two = (1.0 - one) / z
        three = (0.5 - two) / z
    climbed = v * ((flow[0] - c * g) * one + v * (flow[1] * two + v * 2.0 * flow[2] * three))
    after = g + climbed
    slope = line[0] + v * (2.0 * line[1] + 3.0 * v * line[2])
    slope -= flow[0] + v * (flow[1] + v * flow[2]) - c * after
    return v * (line[0] + v * (line[1] + v * line[2])) - climbed, slope, after


@njit(nogil=True, cache=True, error_model="numpy")
def _steepest(
    flow: tuple[float, float, float], c: float, g: float, after: float, v: float
) -> float:
    """Return the larger of g's slopes at both ends of a stretch v."""
    return max(flow[0] - c * g, flow[0] + v * (flow[1] + v * flow[2]) - c * after)


@njit(nogil=True, cache=True)
def relaxed(
    models: FloatArray,
    memory: FloatArray,
    drive: FloatArray,
    passing: bool,
    signed: bool,
) -> BoolArray:
    """Write the voltages of drives over them (models, samples); tell which models' are right.

    Parameters
    ----------
    models
        (models, 15): f₀ to f₃, α₀ to α₂ and the rates c, as the rows above.
    memory
        (models, 2), voltage and h where the paths start.
    drive
        (models, samples), um.
    passing, signed
        Whether the rate changes as h passes zero, and as the voltage does.
    """
    count = drive.shape[0]
    right = np.ones(count, dtype=np.bool_)
    own, asked = np.zeros(ROWS * LANES), np.empty(PIECE * LANES)
    for group in range(0, count, LANES):
        mine = np.ones(LANES, dtype=np.bool_)
        for i in range(LANES):
            # Lanes to spare repeat the last model.
            model = min(group + i, count - 1)
            for row in range(models.shape[1]):
                own[row * LANES + i] = models[model, row]
            u = memory[model, 0]
            own[U + i], own[H + i] = u, memory[model, 1]
            f = own[F1 + i] + u * (own[F2 + i] + u * own[F3 + i])
            own[W + i] = own[F0 + i] + u * f - own[H + i]
        _follow(own, asked, drive[group : group + LANES], passing, signed, mine)
        last = min(group + LANES, count)
        right[group:last] = mine[: last - group]
    return right


@njit(nogil=True, cache=True, error_model="numpy")
def _follow(
    own: FloatArray,
    asked: FloatArray,
    drive: FloatArray,
    passing: bool,
    signed: bool,
    right: BoolArray,
) -> None:
    """Turn the drives of a group of models (models, samples) into their voltages."""
    count, samples = drive.shape
    for first in range(0, samples, PIECE):
        last = min(first + PIECE, samples)
        for i in range(LANES):
            for t in range(first, last):
                asked[(t - first) * LANES + i] = drive[min(i, count - 1), t]
        for t in range(last - first):
            row = t * LANES
            _turn(own, asked, row, signed)
            _aim(own)
            far = LANES
            for _ in range(SIDE_BY_SIDE):
                if far > 0:
                    far = _closer(own)
            if _arrive(own, asked, row, passing, signed) > 0:
                _settle(own, asked, row, passing, signed, right)
            for i in range(LANES):
                own[W + i] = asked[row + i]
                own[U + i] = own[V + i]
                own[H + i] = own[R + i]
                asked[row + i] = own[V + i]
        for i in range(count):
            for t in range(first, last):
                drive[i, t] = asked[(t - first) * LANES + i]
