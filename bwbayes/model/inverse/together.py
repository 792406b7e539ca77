"""Many n = 1 Bouc-Wen models read backwards side by side, sample by sample.

One model is inverted fastest along whole stretches. Of a thousand draws each has its own voltage
and its own turns, and then one sample of all of them at a time is several times faster.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray

__all__ = ["able", "voltages"]

# Stands for a rate of zero, 1/V.
TINY = 1e-100

# Newton's steps double the digits: after one below this part of 1/c, V, all of them are right.
CLOSE = 1e-8

# Samples that are turned round at a time.
PIECE = 64

# Rounds of Newton; two are usual.
ROUNDS = 50


def able(column: Mapping[str, FloatArray], state: FloatArray) -> BoolArray:
    """Tell which models (models,) can be read backwards here, from a state h (models,), um.

    Those with n = 1 and |γ| ≤ β, whose slope is above zero wherever they turn: h is at most where
    it starts, or α/(β + γ), and just after a turn the slope is d − α − (β − γ) |h|.
    """
    d, alpha, beta = (column[name] for name in ("d", "alpha", "beta"))
    gamma = column.get("gamma", np.zeros_like(beta))
    linear = column.get("exponent", np.ones_like(beta)) == 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        most = np.maximum(np.abs(state), alpha / (beta + gamma))
        steep = alpha + (beta - gamma) * most < d
    inside: BoolArray = linear & (np.abs(gamma) <= beta) & steep
    return inside


def voltages(
    column: Mapping[str, FloatArray],
    drive: FloatArray,
    state: FloatArray,
    start: float | None,
) -> FloatArray:
    """Return the voltages (models, samples), V, at which d u − h is the drive.

    Parameters
    ----------
    column
        d, α, β and, unless it is zero, γ, each (models,), of models that are :func:`able`.
    drive
        (models, samples), um.
    state
        h (models,), um, where the path starts.
    start
        The voltage, V, at which it starts; None: at the first sample, whatever its voltage.

    Notes
    -----
    From one sample to the next, in direction s and with g = s h, v = |Δu| solves
    d v − (α/c − g) (1 − exp(−c v)) = s Δw with c = β − γ while g < 0 and c = β + γ from there on.
    Its left side is convex, or concave where h is beyond the ceiling, and rises with v, so that
    Newton's method finds v from anywhere; it starts from the parabola that touches at v = 0.
    """
    d, alpha, beta = (column[name] for name in ("d", "alpha", "beta"))
    gamma = column.get("gamma", np.zeros_like(beta))
    against, ahead = np.maximum(beta - gamma, TINY), np.maximum(beta + gamma, TINY)
    close = CLOSE / float(np.max(np.maximum(against, ahead)))
    u = (drive[:, 0] + state) / d if start is None else np.full(d.size, start)
    before = d * u - state
    result = np.empty_like(drive)
    h = state
    # A sample of all models lies together, in pieces that a processor's cache holds.
    for first in range(0, drive.shape[1], PIECE):
        goals = drive[:, first : first + PIECE].T.copy()
        for t, goal in enumerate(goals):
            change = goal - before
            s = np.where(change < 0, -1.0, 1.0)
            g, rise = s * h, np.abs(change)
            behind = g < 0
            v = _moved(d, alpha, np.where(behind, against, ahead), g, rise, close)
            u = u + s * v
            h = d * u - goal
            crossed = behind & (s * h > 0)
            if crossed.any():
                _cross(crossed, (d, alpha, against, ahead), (s, g, rise, v), u, close)
                h = d * u - goal
            before = goal.copy()
            goals[t] = u
        result[:, first : first + PIECE] = goals.T
    return result


def _moved(
    d: FloatArray,
    alpha: FloatArray,
    rate: FloatArray,
    g: FloatArray,
    rise: FloatArray,
    close: float,
) -> FloatArray:
    """Return how far the voltages (models,) go, V, all with one rate each."""
    missing = alpha / rate - g
    curved = rate * missing
    slope = d - curved
    v = 2 * rise / (slope + np.sqrt(np.maximum(slope * slope + 2 * rate * curved * rise, 0.0)))
    for _ in range(ROUNDS):
        gone = np.expm1(-rate * v)
        step = (d * v + missing * gone - rise) / (slope - curved * gone)
        v = v - step
        if np.max(np.abs(step)) <= close:
            break
    return v


def _cross(
    crossed: BoolArray,
    model: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    step: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    u: FloatArray,
    close: float,
) -> None:
    """Correct the voltages of models whose g passes zero within a step: its rate changes there."""
    rows = np.flatnonzero(crossed)
    d, alpha, against, ahead = (one[rows] for one in model)
    s, g, rise, v = (one[rows] for one in step)
    crossing = np.log1p(-g * against / alpha) / against
    late = np.maximum(rise - (d * crossing + g), 0.0)
    beyond = _moved(d, alpha, ahead, np.zeros_like(g), late, close)
    u[rows] += s * (crossing + beyond - v)
