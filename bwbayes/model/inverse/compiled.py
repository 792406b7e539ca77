"""Many models read backwards, one after the other: compiled, and the same for any operator.

At each sample one number is looked for: the voltage at which the hysteresis' step
(:mod:`bwbayes.model.step`), with the gain, and behind it dynamics and creep, make the
displacement that is asked for. Newton's rule finds it, kept between bounds, and bisection where
that does not do. Nothing here knows what the hysteresis is but through its step.

It needs numba, which is loaded when many models are read backwards, not before.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.model.compiled import INNER, move
from bwbayes.model.step import HysteresisStep

__all__ = ["Chains", "invert"]

# The displacement is right when it is so near, as a part of the largest that is asked for.
CLOSE = 1e-13

# By how much of it a step is bent.
BENT = 0.25

# Rounds at most: of Newton's rule, of which it needs a few, and of bisection to the last bit.
NEWTON_ROUNDS, ROUNDS = 40, 120


class Chains(NamedTuple):
    """What stands behind the hysteresis of models, and where they begin.

    Parameters
    ----------
    curve
        What the gain adds to the drive, coefficients of 1, u, u² and u³, (models, 4), um/Vᵏ.
    numerator, denominator, gains
        (models, sections, 3) and (models, sections): the dynamics' recursion, and the creep's.
    growth
        What the creep grows by with the voltage, (models,), 1/V.
    largest
        The largest displacement that is asked for, (models,), um.
    voltage, farthest
        Where the paths start and how far from zero they may go, (models,), V.
    drive, slope
        Hysteresis and gain there, (models,), um, and their slope, um/V.
    rest, filters
        (models, sections): the drives, um, at which the sections were at rest; and
        (models, sections, 2), what they carry on; both change on the way.
    begins
        Whether a record begins, at rest at its first sample; then there is neither of these.
    """

    curve: FloatArray
    numerator: FloatArray
    denominator: FloatArray
    gains: FloatArray
    growth: FloatArray
    largest: FloatArray
    voltage: FloatArray
    farthest: FloatArray
    drive: FloatArray
    slope: FloatArray
    rest: FloatArray
    filters: FloatArray
    begins: bool


def invert(
    step: HysteresisStep, memory: FloatArray, chains: Chains, samples: FloatArray
) -> BoolArray:
    """Write the voltages over displacements (models, samples); tell which models' are right.

    Parameters
    ----------
    step
        The hysteresis.
    memory
        The step's (models, any), where the paths start.
    chains
        What stands behind the hysteresis.
    samples
        (models, samples), um without the offset, and then V.
    """
    right: BoolArray = _invert(
        step, np.ascontiguousarray(step.parameters), np.ascontiguousarray(memory), chains, samples
    )
    return right


@njit(nogil=True, cache=True, error_model="numpy")
def _invert(
    step: HysteresisStep,
    parameters: FloatArray,
    memory: FloatArray,
    chains: Chains,
    samples: FloatArray,
) -> BoolArray:
    right, after = np.ones(samples.shape[0], dtype=np.bool_), np.empty(memory.shape[1])
    for model in range(samples.shape[0]):
        right[model] = _invert_one(
            step, parameters[model], memory[model], after, chains, model, samples[model]
        )
    return right


@njit(**INNER)
def _invert_one(
    step: HysteresisStep,
    parameters: FloatArray,
    memory: FloatArray,
    after: FloatArray,
    chains: Chains,
    model: int,
    samples: FloatArray,
) -> bool:
    """Turn one model's displacement into its voltage; tell whether it rises with that all along."""
    top, bottom, gains = chains.numerator[model], chains.denominator[model], chains.gains[model]
    equilibrium, filters = chains.rest[model], chains.filters[model]
    curve, kappa, farthest = chains.curve[model], chains.growth[model], chains.farthest[model]
    # A drive that is held acts one sample later, and is found from the next sample.
    late = int(top[0, 0] == 0.0)
    u, w = chains.voltage[model], chains.drive[model]
    # Nearer than the rounding of where it starts there is nothing to find.
    close = max(CLOSE * chains.largest[model], 1e-15 * abs(u * chains.slope[model]))
    here = u, w, chains.slope[model], 0.0, 1.0
    for t in range(samples.size):
        first = chains.begins and t == 0
        if first or t + late < samples.size:
            # The displacement is that of drives w and w (1 + κ |u|), which count so much at once.
            missing = samples[t] if first else samples[t + late]
            plain, creeping = 0.0, 0.0
            for i in range(gains.size):
                count = gains[i] if first else gains[i] * top[i, late]
                if not first:
                    carried = filters[i, 0]
                    if late:
                        carried = filters[i, 1] - bottom[i, 1] * carried
                    missing -= gains[i] * (equilibrium[i] + carried) - count * equilibrium[i]
                if i == 0:
                    plain = count
                else:
                    creeping += count
            demand = plain, creeping, kappa, missing
            here = _solve(step, parameters, curve, memory, after, here, demand, farthest, close)
            u, w, slope, _, _ = here
            if math.isnan(slope):
                return False
        for i in range(gains.size):
            drive = w if i == 0 else w * (1.0 + kappa * abs(u))
            if first:
                equilibrium[i] = drive
                filters[i] = 0.0
            moved = top[i, 0] * (drive - equilibrium[i]) + filters[i, 0]
            filters[i, 0] = (
                top[i, 1] * (drive - equilibrium[i]) - bottom[i, 1] * moved + filters[i, 1]
            )
            filters[i, 1] = top[i, 2] * (drive - equilibrium[i]) - bottom[i, 2] * moved
        samples[t] = u
    return True


@njit(**INNER)
def _solve(
    step: HysteresisStep,
    parameters: FloatArray,
    curve: FloatArray,
    memory: FloatArray,
    after: FloatArray,
    here: tuple[float, float, float, float, float],
    demand: tuple[float, float, float, float],
    farthest: float,
    close: float,
) -> tuple[float, float, float, float, float]:
    """Solve (p + c (1 + κ |u|)) w(u) = missing, and move the memory there.

    From where these are ``here``, return voltage, w, its slope and how fast that changes, and the
    direction. A slope of nan is that of models whose displacement falls on the way, or which do not
    get there.
    """
    plain, creeping, kappa, missing = demand
    start, w, slope, bend, direction = here
    u, low, high, done = start, -farthest, farthest, 0
    factor = plain + creeping * (1.0 + kappa * abs(u))
    off = factor * w - missing
    # Just after a turn the slope is another one.
    turned = off * direction > 0.0 and abs(off) > close
    if turned:
        bend, direction = 0.0, -direction
    while abs(off) > close and done < ROUNDS:
        low, high = (u, high) if off < 0.0 else (low, u)
        steep = factor * slope + creeping * kappa * (w if u >= 0.0 else -w)
        # On the parabola that touches, as far as that is a small correction.
        inverse_slope = 1.0 / steep
        change = -off * inverse_slope
        bent = min(max(0.5 * bend * factor * change * inverse_slope, -BENT), BENT)
        better = u + change * (1.0 - bent)
        if not (steep > 0.0 and low < better < high and done < NEWTON_ROUNDS):
            better = 0.5 * (low + high)
        fell = not steep > 0.0 and (u - start) * off < 0.0
        before, flatter, u = u, slope, better
        w, slope = _drive(step, parameters, curve, memory, u, after)
        factor = plain + creeping * (1.0 + kappa * abs(u))
        off = factor * w - missing
        if u != before and not (turned and before == start):
            bend = (slope - flatter) / (u - before)
        done = ROUNDS if fell or u == before else done + 1
        slope = math.nan if fell else slope
    if u != start:
        for j in range(memory.size):
            memory[j] = after[j]
    return u, w, slope if slope > 0.0 else math.nan, bend, direction


@njit(**INNER)
def _drive(
    step: HysteresisStep,
    parameters: FloatArray,
    curve: FloatArray,
    memory: FloatArray,
    u: float,
    after: FloatArray,
) -> tuple[float, float]:
    """Return hysteresis and gain, um, and their slope, um/V; and write the memory ``after``."""
    w, slope = move(step, parameters, memory, u, after)
    w += curve[0] + u * (curve[1] + u * (curve[2] + u * curve[3]))
    return w, slope + curve[1] + u * (2.0 * curve[2] + 3.0 * u * curve[3])
