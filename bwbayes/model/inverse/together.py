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

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.inverse.stepped import DriveStep

__all__ = ["able", "followed", "voltages"]

# Stands for a rate of zero, 1/V.
TINY = 1e-100

# A step of Newton's below this part of 1/c, V, doubles the digits to more than there are.
CLOSE = 1e-8

# Samples that are turned round at a time, those of them that are looked for at once, and the steps
# that these get.
SLAB, PIECE, STEPS = 64, 16, 2

# Rounds where these do not do; three are usual.
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
    for first in range(0, drive.shape[1], SLAB):
        asked = drive[:, first : first + SLAB].T.copy()
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
        result[:, first : first + SLAB] = asked.T
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
    gain: PolynomialGain | None = None,
    out: FloatArray | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Return the voltages (models, samples), V, at which d u + q(u) − h is the drive.

    And whose are right (models,): without a gain q all, with one those whose drive rises with the
    voltage wherever they go.

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
    gain
        What gives q(u), um, its coefficients among the columns.
    out
        Where the voltages go, if not to an array of their own; it may be the drive.

    Notes
    -----
    From one sample to a later one, in direction s and with g = s h, v = |Δu| solves
    d v − (α/c − g) (1 − exp(−c v)) = s Δw with c = β − γ while g < 0 and c = β + γ from there on,
    by Newton's rule; a gain is another cubic in v. That holds for some samples in a row, whose
    voltages are found together; models that turn among them, or whose g passes zero, go from each
    sample to the next.
    """
    model = _models(column, gain)
    if start is None:
        u = model.without_hysteresis(drive[:, 0] + state)
    else:
        u = np.full(state.size, start)
    result = np.empty_like(drive) if out is None else out
    before, h = model.drive(u) - state, state
    right = np.isfinite(before)
    for first in range(0, drive.shape[1], SLAB):
        # A sample of all models lies together.
        slab = drive[:, first : first + SLAB].T.copy()
        for start_of in range(0, len(slab), PIECE):
            asked = slab[start_of : start_of + PIECE]
            made, exact = _ahead(model, asked, before, u, h)
            rows = np.flatnonzero(~exact)
            if rows.size:
                some = model.of(rows)
                made[:, rows], right[rows] = _one_by_one(
                    some, asked[:, rows], before[rows], u[rows], h[rows], right[rows]
                )
            before, u = asked[-1].copy(), made[-1]
            h = model.drive(u) - before
            asked[:] = made
        result[:, first : first + SLAB] = slab.T
    if gain is not None:
        right &= able({**column, "d": model.least_slope(result)}, state)
    return result, right


class _Line(NamedTuple):
    """What v adds to the drive in a direction, but for h: slope v + bend v² + twist v³.

    (models,), in um/V, um/V² and um/V³; bend and twist are None without a gain.
    """

    slope: FloatArray
    bend: FloatArray | None = None
    twist: FloatArray | None = None


class _Gain(NamedTuple):
    """A gain zero + square u² + cube u³; what it has of u itself is in d. Each (models,)."""

    zero: FloatArray
    square: FloatArray
    cube: FloatArray


class _Models(NamedTuple):
    """Models: d and α, um/V, c while g = s h is below zero and above, 1/V, and the gain.

    Each (models,). Without a gain, which most have, nothing is done for it.
    """

    d: FloatArray
    alpha: FloatArray
    against: FloatArray
    ahead: FloatArray
    gain: _Gain | None

    def of(self, rows: IntArray) -> _Models:
        """Return some of the models."""
        gain = self.gain and _Gain(*(one[rows] for one in self.gain))
        return _Models(self.d[rows], self.alpha[rows], self.against[rows], self.ahead[rows], gain)

    def drive(self, u: FloatArray) -> FloatArray:
        """Return the drive without h (models,), um, at voltages (models,)."""
        if self.gain is None:
            return self.d * u
        zero, square, cube = self.gain
        return zero + u * (self.d + u * (square + u * cube))

    def along(self, u: FloatArray, s: FloatArray) -> _Line:
        """Return how the drive without h goes on from voltages (models,) in directions s."""
        if self.gain is None:
            return _Line(self.d)
        _, square, cube = self.gain
        return _Line(self.d + u * (2 * square + 3 * u * cube), s * (square + 3 * u * cube), cube)

    def without_hysteresis(self, drive: FloatArray) -> FloatArray:
        """Return the voltages (models,) of drives without h, V; nan where Newton's rule fails."""
        u = drive / self.d
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(NEWTON if self.gain else 0):
                u = u - (self.drive(u) - drive) / self.along(u, np.ones_like(u)).slope
            met = np.abs(self.drive(u) - drive) <= CLOSE * np.abs(drive) + TINY
        return np.where(met, u, np.nan)

    def least_slope(self, voltage: FloatArray) -> FloatArray:
        """Return the least slope without h (models,) between the ends of voltages (models, any)."""
        if self.gain is None:
            return self.d
        low, high = voltage.min(axis=1), voltage.max(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            bottom = np.clip(-self.gain.square / (3 * self.gain.cube), low, high)
        places = low, high, np.where(np.isfinite(bottom), bottom, low)
        slopes = [self.along(u, np.ones_like(u)).slope for u in places]
        return np.asarray(np.min(slopes, axis=0))


def _models(column: Mapping[str, FloatArray], gain: PolynomialGain | None) -> _Models:
    d, alpha, beta = (column[name] for name in ("d", "alpha", "beta"))
    gamma = column.get("gamma", np.zeros_like(beta))
    against, ahead = np.maximum(beta - gamma, TINY), np.maximum(beta + gamma, TINY)
    if gain is None:
        return _Models(d, alpha, against, ahead, None)
    zero, slope, square, cube = gain.powers(column)
    return _Models(d + slope, alpha, against, ahead, _Gain(zero, square, cube))


def _ahead(
    model: _Models, asked: FloatArray, before: FloatArray, u: FloatArray, h: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the voltages (samples, models) of drives that go one way, and whose are exact.

    Before them the drive was ``before``, with a voltage u and h, (models,).
    """
    s = np.copysign(1.0, asked[-1] - before)
    g = s * h
    behind = g < 0
    rate = np.where(behind, model.against, model.ahead)
    curved = model.alpha - rate * g
    rise = asked - before
    rise *= s
    exact = (rise[0] >= 0) & (np.diff(rise, axis=0).min(axis=0, initial=0.0) >= 0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        v, last = _moved(model.along(u, s), rate, curved, rise, STEPS)
        exact &= np.abs(last).max(axis=0) * rate <= CLOSE
        if model.gain is not None:
            exact &= v.min(axis=0) >= 0
    v *= s
    v += u
    exact &= ~behind | (s * (model.drive(v[-1]) - asked[-1]) <= 0)
    return v, exact


def _one_by_one(
    model: _Models,
    asked: FloatArray,
    before: FloatArray,
    u: FloatArray,
    h: FloatArray,
    right: BoolArray,
) -> tuple[FloatArray, BoolArray]:
    """Return the voltages (samples, models) of any drives, as :func:`_ahead`, and whose are right.

    Those that were not ``right`` before stay so.
    """
    made = np.empty_like(asked)
    for t, goal in enumerate(asked):
        change = goal - before
        s = np.copysign(1.0, change)
        g = s * h
        behind = g < 0
        rate = np.where(behind, model.against, model.ahead)
        rise = np.abs(change)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            v, last = _moved(model.along(u, s), rate, model.alpha - rate * g, rise, ROUNDS)
        if model.gain is not None:
            right = right & (np.abs(last) * rate <= CLOSE) & (v >= 0)
        begun, u = u, u + s * v
        h = model.drive(u) - goal
        rows = np.flatnonzero(behind & (s * h > 0))
        if rows.size:
            # Their rate changes where g passes zero.
            some = model.of(rows)
            u[rows] = _across(some, begun[rows], s[rows], g[rows], rise[rows])
            h = model.drive(u) - goal
        made[t], before = u, goal
    return made, right


def _across(
    model: _Models, u: FloatArray, s: FloatArray, g: FloatArray, rise: FloatArray
) -> FloatArray:
    """Return where voltages (models,) go in directions s, V, with g from below zero to above."""
    crossing = np.log1p(-g * model.against / model.alpha) / model.against
    middle = u + s * crossing
    late = np.maximum(rise - s * (model.drive(middle) - model.drive(u)) - g, 0.0)
    return middle + s * _moved(model.along(middle, s), model.ahead, model.alpha, late, ROUNDS)[0]


def _moved(
    line: _Line, rate: FloatArray, curved: FloatArray, rise: FloatArray, rounds: int
) -> tuple[FloatArray, FloatArray]:
    """Return v ≥ 0, V, at which line(v) − k (1 − exp(−c v))/c is the rise, and the last step to it.

    ``curved`` is k, (models,), the rise (samples, models) or (models,). What rises with v is
    convex without a gain, or concave where h is beyond the ceiling, so that Newton's rule finds v
    from anywhere; it starts near the parabola that touches at v = 0, and with a step of Halley's.
    """
    straight, bend, twist = line
    slope = straight - curved
    curve, minus, missing = rate * curved, -rate, curved / rate
    v = rise / slope
    near = (2 * (curve if bend is None else curve + 2 * bend) / slope) * v
    bent = (rate / 3) * v
    bent *= near
    near += 1
    np.maximum(near, 0.0, out=near)
    np.sqrt(near, out=near)
    near += 1
    bent += 4
    v *= bent
    v /= near
    v *= 0.5
    gone, step, steep = np.empty_like(v), near, bent
    for done in range(rounds):
        np.multiply(minus, v, out=gone)
        np.expm1(gone, out=gone)
        np.multiply(straight, v, out=step)
        np.multiply(curved, gone, out=steep)
        np.subtract(slope, steep, out=steep)
        step -= rise
        step += missing * gone
        if bend is not None and twist is not None:
            twisted = twist * v
            steep += (2 * bend + 3 * twisted) * v
            step += (bend + twisted) * v**2
        step /= steep
        if done == 0:
            gone += 1
            gone *= 0.5 * curve
            if bend is not None:
                gone += bend + 3 * twisted
            gone *= step
            gone /= steep
            np.subtract(1.0, gone, out=gone)
            step /= gone
        v -= step
        if rounds > STEPS and np.max(np.abs(step) * rate) <= CLOSE:
            break
    return v, step
