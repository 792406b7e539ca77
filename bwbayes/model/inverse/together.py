"""Many models read backwards side by side.

One model is inverted fastest along whole stretches. Of a thousand draws each has its own voltage
and its own turns, and then one sample of all of them at a time is many times faster:
:func:`followed`, for whatever has a step. n = 1 Bouc-Wen models, :func:`voltages`, go even some
samples at a time.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.model.inverse.stepped import DriveStep

__all__ = ["able", "followed", "voltages"]

# Stands for a rate of zero, 1/V.
TINY = 1e-100

# A step of Halley's below this part of 1/c, V, triples the digits to more than there are.
CLOSE = 1e-5

# Samples that are looked for at once, and steps of Halley's that these get.
PIECE, STEPS = 16, 2

# Rounds of Halley's where these do not do; two are usual.
ROUNDS = 50


# Newton's rounds for a sample of all models; three are usual. A drive is met to this part of it.
NEWTON, MET = 30, 4e-15


def followed(
    shaped: DriveStep, drive: FloatArray, memory: FloatArray, start: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the voltages (models, samples), V, of drives, and tell which models' are right.

    Each next voltage is where Newton's rule meets the drive; models with which it does not, or
    whose drive falls with the voltage there, are left out from there on.

    Parameters
    ----------
    shaped
        Hysteresis and gain.
    drive
        (models, samples), um.
    memory, start
        That of the steps (models, any), and the voltages (models,), V, where the paths start.
    """
    result = np.empty_like(drive)
    close = MET * np.max(np.abs(drive), axis=1)
    right = np.ones(start.size, dtype=np.bool_)
    u, moved = start, np.zeros_like(start)
    for first in range(0, drive.shape[1], PIECE):
        asked = drive[:, first : first + PIECE].T.copy()
        for t, goal in enumerate(asked):
            guess = u + moved
            for _ in range(NEWTON):
                w, slope, after = shaped.go(memory, guess)
                off = np.where(right, w - goal, 0.0)
                far = np.abs(off) > close
                if not far.any():
                    break
                right &= slope > 0
                guess = guess - np.where(right, off / np.where(slope > 0, slope, 1.0), 0.0)
            right &= ~far & (slope > 0)
            moved = np.where(right, guess - u, 0.0)
            u, memory = guess, after
            asked[t] = u
        result[:, first : first + PIECE] = asked.T
    return result, right


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
    From one sample to a later one, in direction s and with g = s h, v = |Δu| solves
    d v − (α/c − g) (1 − exp(−c v)) = s Δw with c = β − γ while g < 0 and c = β + γ from there on,
    by Halley's method. That holds for some samples in a row, whose voltages are found together;
    models that turn among them, or whose g passes zero, go from each sample to the next.
    """
    d, alpha, beta = (column[name] for name in ("d", "alpha", "beta"))
    gamma = column.get("gamma", np.zeros_like(beta))
    model = _Models(d, alpha, np.maximum(beta - gamma, TINY), np.maximum(beta + gamma, TINY))
    u = (drive[:, 0] + state) / d if start is None else np.full(d.size, start)
    result = np.empty_like(drive)
    before, h = d * u - state, state
    for first in range(0, drive.shape[1], PIECE):
        # A sample of all models lies together.
        asked = drive[:, first : first + PIECE].T.copy()
        made, exact = _ahead(model, asked, before, u, h)
        rows = np.flatnonzero(~exact)
        if rows.size:
            made[:, rows] = _one_by_one(
                _Models(*(one[rows] for one in model)),
                asked[:, rows],
                before[rows],
                u[rows],
                h[rows],
            )
        result[:, first : first + PIECE] = made.T
        before, u = asked[-1], made[-1]
        h = d * u - before
    return result


class _Models(NamedTuple):
    """d and α, um/V, and c while g = s h is below zero and above, 1/V, each (models,)."""

    d: FloatArray
    alpha: FloatArray
    against: FloatArray
    ahead: FloatArray


def _ahead(
    model: _Models, asked: FloatArray, before: FloatArray, u: FloatArray, h: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the voltages (samples, models) of drives that go one way, and whose are exact.

    Before them the drive was ``before``, with a voltage u and h, (models,).
    """
    d, alpha, against, ahead = model
    s = np.copysign(1.0, asked[-1] - before)
    g = s * h
    behind = g < 0
    rate = np.where(behind, against, ahead)
    curved = alpha - rate * g
    rise = asked - before
    rise *= s
    exact = (rise[0] >= 0) & (np.diff(rise, axis=0).min(axis=0, initial=0.0) >= 0)
    with np.errstate(invalid="ignore", over="ignore"):
        v, last = _moved(d, rate, curved, rise, STEPS)
        exact &= np.abs(last).max(axis=0) * rate <= CLOSE
    v *= s
    v += u
    exact &= ~behind | (s * (d * v[-1] - asked[-1]) <= 0)
    return v, exact


def _one_by_one(
    model: _Models, asked: FloatArray, before: FloatArray, u: FloatArray, h: FloatArray
) -> FloatArray:
    """Return the voltages (samples, models) of any drives, as :func:`_ahead`."""
    d, alpha, against, ahead = model
    made = np.empty_like(asked)
    for t, goal in enumerate(asked):
        change = goal - before
        s = np.copysign(1.0, change)
        g = s * h
        behind = g < 0
        rate = np.where(behind, against, ahead)
        rise = np.abs(change)
        v, _ = _moved(d, rate, alpha - rate * g, rise, ROUNDS)
        u = u + s * v
        h = d * u - goal
        rows = np.flatnonzero(behind & (s * h > 0))
        if rows.size:
            # Their rate changes where g passes zero.
            some = _Models(*(one[rows] for one in model))
            u[rows] += s[rows] * (_across(some, g[rows], rise[rows]) - v[rows])
            h = d * u - goal
        made[t], before = u, goal
    return made


def _across(model: _Models, g: FloatArray, rise: FloatArray) -> FloatArray:
    """Return how far the voltages (models,) go, V, from g below zero to above."""
    d, alpha, against, ahead = model
    crossing = np.log1p(-g * against / alpha) / against
    late = np.maximum(rise - (d * crossing + g), 0.0)
    return crossing + _moved(d, ahead, alpha, late, ROUNDS)[0]


def _moved(
    d: FloatArray, rate: FloatArray, curved: FloatArray, rise: FloatArray, rounds: int
) -> tuple[FloatArray, FloatArray]:
    """Return v ≥ 0, V, at which d v − k (1 − exp(−c v))/c is the rise, and the last step to it.

    ``curved`` is k, (models,), the rise (samples, models) or (models,). What rises with v is
    convex, or concave where h is beyond the ceiling, so that Halley's method finds v from anywhere;
    it starts near the parabola that touches at v = 0.
    """
    slope = d - curved
    curve = rate * curved
    v = rise / slope
    bent = (curve / slope) * v
    near = 2 * bent
    near += 1
    np.maximum(near, 0.0, out=near)
    np.sqrt(near, out=near)
    near += 1
    bent *= (rate / 6) * v
    bent += 1
    v *= bent
    v *= 2
    v /= near
    half, missing = 0.5 * curve, curved / rate
    for _ in range(rounds):
        gone = np.expm1(-rate * v)
        steep = slope - curved * gone
        step = d * v
        step += missing * gone
        step -= rise
        step /= steep
        gone += 1
        gone *= half
        gone *= step
        gone /= steep
        step /= 1 - gone
        v -= step
        if rounds > STEPS and np.max(np.abs(step) * rate) <= CLOSE:
            break
    return v, step
