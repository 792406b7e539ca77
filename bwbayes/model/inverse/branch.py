"""Where along one branch displacements are reached, for any operator.

Along a branch the voltage goes one way, and so does the displacement. So each sample asks for one
root of one rising curve, and one walk along the curve serves all samples.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bwbayes.arrays import FloatArray

__all__ = ["solve_branch"]

Curve = Callable[[FloatArray], FloatArray]


def solve_branch(
    curve: Curve, rise: FloatArray, room: float, guess: float, resolution: float
) -> FloatArray:
    """Return the travels (samples,), V, after which a curve has risen as far as is asked for.

    Parameters
    ----------
    curve
        The rise (points,), um, after travels (points,) that grow, V; zero at the start.
    rise
        (samples,), um, not negative and never falling.
    room
        Travel beyond which the curve is not followed, V; returned where it does not rise enough.
    guess
        A first guess of how far the path goes, V.
    resolution
        What a travel need not be more exact than, V.

    Notes
    -----
    C. Ridders, A new algorithm for computing a single root of a real continuous function, IEEE
    Transactions on Circuits and Systems 26, 979-980 (1979), within brackets from a coarse walk.
    """
    reach = min(guess, room)
    while reach < room and curve(np.array([reach]))[0] < rise[-1]:
        reach = min(2 * reach, room)
    points = reach * np.linspace(0.0, 1.0, 33)
    heights = np.maximum.accumulate(np.concatenate([[0.0], curve(points[1:])]))
    above = np.clip(np.searchsorted(heights, rise), 1, points.size - 1)
    # Those that are not reached, or not left, need no search.
    low = np.where(rise <= 0, 0.0, np.where(rise >= heights[-1], reach, points[above - 1]))
    high = np.where((rise <= 0) | (rise >= heights[-1]), low, points[above])
    below, beyond = heights[above - 1] - rise, heights[above] - rise
    return _roots(
        lambda travel: _in_order(curve, travel) - rise, low, high, below, beyond, resolution
    )


def _in_order(curve: Curve, travel: FloatArray) -> FloatArray:
    """Return the curve after travels (samples,) in any order, walked along as a path."""
    order = np.argsort(travel, kind="stable")
    values = np.empty_like(travel)
    values[order] = curve(travel[order])
    return values


def _roots(
    function: Curve,
    low: FloatArray,
    high: FloatArray,
    below: FloatArray,
    beyond: FloatArray,
    resolution: float,
) -> FloatArray:
    """Return the roots (samples,) of rising functions, which are below and beyond zero at ends."""
    latest = low
    for _ in range(60):
        middle = (low + high) / 2
        between = function(middle)
        root = np.sqrt(np.maximum(between**2 - below * beyond, 0.0))
        step = np.divide(between, root, out=np.zeros_like(root), where=root > 0)
        before, latest = latest, np.clip(middle - (middle - low) * step, low, high)
        value = function(latest)
        for place, height in ((middle, between), (latest, value)):
            under = height < 0
            low, below = np.where(under, place, low), np.where(under, height, below)
            high, beyond = np.where(under, high, place), np.where(under, beyond, height)
        settled = np.abs(latest - before) <= resolution
        if (settled | (value == 0) | (high - low <= resolution)).all():
            break
    return latest
