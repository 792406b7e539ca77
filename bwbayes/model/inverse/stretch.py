"""Where along one monotone stretch a displacement is reached, for any operator.

Along a stretch the voltage goes one way, and so does the displacement. So each sample asks for one
root of one rising curve. :func:`reached` finds all of them together for any curve that can be
walked along.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from bwbayes.arrays import FloatArray

__all__ = ["first_crossing", "reached"]

# Doublings of the first reach, of which it needs a few.
DOUBLINGS = 40


def reached(
    along: Callable[[FloatArray], FloatArray],
    target: FloatArray,
    start: float,
    edge: float,
    first: float,
) -> FloatArray:
    """Return the voltages (samples,) at which a curve goes through its targets.

    Parameters
    ----------
    along
        The curve: displacements (points,), um, along voltages (points,) that go one way from the
        start, V.
    target
        (samples,), um, all on one side of where the curve starts, in the order of the path.
    start, edge
        Voltages at which the curve starts and beyond which it is not followed, V. Where a target
        lies beyond what the edge gives, the edge is returned.
    first
        A first guess of how far the path goes, V, above zero.

    Notes
    -----
    All samples lie on one path, so that one walk along it serves them all. The root search is that
    of T. R. Chandrupatla, Advances in Engineering Software 28, 145-149 (1997): inverse quadratic
    steps, and bisection where they are not safe.
    """
    s = 1.0 if edge >= start else -1.0
    here = float(along(np.array([start]))[0])
    goal = np.maximum.accumulate(np.maximum(s * (target - here), 0.0))
    farthest, room = _far_enough(
        along, start, edge, s, min(first, abs(edge - start)), here + s * goal[-1]
    )
    if room == 0.0:
        return np.full(target.shape, farthest)
    points = start + s * room * np.linspace(0.0, 1.0, 33)
    points[-1] = farthest
    heights = np.concatenate([[0.0], s * (along(points[1:]) - here)])
    heights = np.maximum.accumulate(heights)
    if goal[0] >= heights[-1]:
        return np.full(target.shape, farthest)
    above = np.clip(np.searchsorted(heights, goal), 1, points.size - 1)
    result = searched(
        lambda voltage: s * (_in_order(along, voltage, s) - here) - goal,
        (points[above - 1], points[above]),
        (heights[above - 1] - goal, heights[above] - goal),
    )
    return np.where(goal <= 0, start, np.where(goal >= heights[-1], farthest, result))


def _far_enough(
    along: Callable[[FloatArray], FloatArray],
    start: float,
    edge: float,
    s: float,
    reach: float,
    goal: float,
) -> tuple[float, float]:
    """Return a voltage beyond which the path need not be followed, and how far that is, V."""
    limit = abs(edge - start)
    for _ in range(DOUBLINGS):
        if reach >= limit:
            return edge, limit
        trial = start + s * reach
        if s * (float(along(np.array([trial]))[0]) - goal) >= 0:
            return trial, reach
        reach = 2 * reach
    return edge, limit


def _in_order(
    along: Callable[[FloatArray], FloatArray], voltage: FloatArray, s: float
) -> FloatArray:
    """Return the curve at voltages (samples,) in any order, walked along as a path."""
    order = np.argsort(s * voltage, kind="stable")
    values = np.empty_like(voltage)
    values[order] = along(voltage[order])
    return values


def first_crossing(
    off: Callable[[FloatArray], FloatArray],
    center: FloatArray,
    reach: FloatArray,
    low: float = -math.inf,
    high: float = math.inf,
) -> FloatArray:
    """Return the voltages (models,), V, at which a rising function ``off`` passes zero.

    Looked for from a center (models,) on, at first within a reach (models,), and between low and
    high: where it is zero nowhere, the last voltage looked at is returned.
    """
    start = off(center)
    s = np.where(start > 0, -1.0, 1.0)
    edge = np.where(s > 0, high, low)
    for _ in range(DOUBLINGS):
        end = np.clip(center + s * reach, low, high)
        beyond = off(end)
        short = (s * beyond < 0) & (end != edge)
        if not short.any():
            break
        reach = np.where(short, 2 * reach, reach)
    found = searched(off, (center, end), (start, beyond))
    return np.where(s * beyond < 0, end, found)


def searched(
    function: Callable[[FloatArray], FloatArray],
    ends: tuple[FloatArray, FloatArray],
    values: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Return the roots (samples,) of a function between ends where it has opposite signs."""
    (b, a), (fb, fa) = (end.copy() for end in ends), (value.copy() for value in values)
    c, fc = a.copy(), fa.copy()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        fraction = np.clip(np.nan_to_num(fa / (fa - fb), nan=0.5), 0.0, 1.0)
        for _ in range(100):  # it ends by far earlier
            x = a + fraction * (b - a)
            fx = function(x)
            same = np.sign(fx) == np.sign(fa)
            c, fc = np.where(same, a, b), np.where(same, fa, fb)
            b, fb = np.where(same, b, a), np.where(same, fb, fa)
            a, fa = x, fx
            best = np.where(np.abs(fa) < np.abs(fb), a, b)
            smallest = np.minimum(np.abs(fa), np.abs(fb))
            narrow = 2 * np.finfo(np.float64).eps * np.abs(best) / np.abs(b - a)
            if ((smallest == 0) | (narrow >= 0.5) | (a == b)).all():
                return best
            xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
            safe = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi)
            step = fa / (fb - fa) * fc / (fb - fc)
            step += (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
            fraction = np.where(safe & np.isfinite(step), step, 0.5)
            narrow = np.minimum(np.nan_to_num(narrow, nan=0.5), 0.5)
            fraction = np.clip(fraction, narrow, 1 - narrow)
    return best
