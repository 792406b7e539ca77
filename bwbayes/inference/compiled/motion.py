"""Displacement from the operator's drive, for ``LANES`` models side by side.

The nonlinearity adds to the drive, and the dynamics and the lags of the creep follow it. The input
of all of them is the drive's difference from that of the first sample, at which they may have been
at rest.
"""

from __future__ import annotations

import numpy as np

from bwbayes.arrays import FloatArray

# isort: off
# fmt: off
from bwbayes.inference.compiled.lanes import (
    A1, A2, B0, B1, B2, CREPT, CUBIC, EQUILIBRIUM, GROWTH, LAG, LANES, LEVEL, QUADRATIC,
    STRENGTH, X1, X2, inner,
)
# fmt: on
# isort: on
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Values
from bwbayes.model.linear import Sections

# Samples that pass the stages together: their drives fit into the first cache.
PIECE = 64


def shared(actuator: Actuator, voltage: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the arguments of :func:`displace` for nonlinearity and creep that all models share."""
    curve, lags, growth = np.empty((0, 2)), np.empty((0, 3)), np.zeros(voltage.size)
    if actuator.nonlinearity is not None:
        x = actuator.nonlinearity.scaled(voltage)
        curve = np.stack([x**2 - x[0] ** 2, x**3 - x[0] ** 3], axis=1)
    if actuator.creep is not None:
        recursions = actuator.creep.recursions(1, actuator.interval, actuator.hold)
        lags = np.array(
            [[*recursion.numerator[0], -recursion.denominator[0, 1]] for recursion in recursions]
        )
        if actuator.creep.growing:
            growth = actuator.creep.size(voltage)
    return curve, lags, growth


def physics(
    actuator: Actuator,
    sections: Sections,
    column: Values,
    equilibrium: FloatArray,
    voltage: FloatArray,
) -> dict[str, FloatArray]:
    """Return the numbers of models (models,) without a noise, by the names of ``PARAMETERS``.

    ``sections`` are the actuator's; ``equilibrium`` (models,) is w₀ without nonlinearity, um.
    """
    if actuator.nonlinearity is not None:
        equilibrium = equilibrium + actuator.nonlinearity.displacement(column, voltage[:1])[:, 0]
    level, rows = column["offset"] + equilibrium, {"equilibrium": equilibrium}
    if actuator.creep is not None:
        crept = actuator.creep.drive(column, equilibrium[:, np.newaxis], voltage[:1])[:, 0]
        level = level + crept * np.sum(sections.gains[1:], axis=0)
        rows |= {"crept": crept}
    dynamics = sections.recursions[0]
    rows |= dict(zip(("b0", "b1", "b2"), dynamics.numerator.T, strict=False))
    rows |= dict(zip(("a1", "a2"), dynamics.denominator.T[1:], strict=False))
    for unknown, tap in np.ndindex(dynamics.free.shape[1:]):
        rows[f"free_{unknown + 1}{tap + 1}"] = dynamics.free[:, unknown, tap]
    rows |= {f"strength_{k}": gain for k, gain in enumerate(sections.gains[1:], 1)}
    rows |= {"level": level}
    others = {"growth": "creep_growth", "quadratic": "quadratic", "cubic": "cubic"}
    return rows | {row: column[name] for row, name in others.items() if name in column}


def simulated(
    actuator: Actuator,  # noqa: ARG001  # its work is done
    sections: Sections,
    column: Values,  # noqa: ARG001
    first: FloatArray,
    voltage: FloatArray,  # noqa: ARG001
) -> dict[str, FloatArray]:
    """Return the same for models with a known displacement; ``first`` (models,) is its start, um.

    The displacement passes dynamics whose numerator is their denominator, which leave it as it is;
    free responses use the denominator alone.
    """
    dynamics, rows = sections.recursions[0], {"level": first, "b0": np.ones_like(first)}
    rows |= dict(zip(("b1", "b2"), dynamics.denominator.T[1:], strict=False))
    rows |= dict(zip(("a1", "a2"), dynamics.denominator.T[1:], strict=False))
    for unknown, tap in np.ndindex(dynamics.free.shape[1:]):
        rows[f"free_{unknown + 1}{tap + 1}"] = dynamics.free[:, unknown, tap]
    return rows


@inner()
def displace(
    state: FloatArray,
    curve: FloatArray,
    lags: FloatArray,
    growth: FloatArray,
    first: int,
    last: int,
    drive: FloatArray,
) -> None:
    """Replace the drive's difference from rest by the displacement, at samples first to last.

    ``curve`` (samples, 2) holds x² − x₀² and x³ − x₀³ of the nonlinearity, or is empty; ``lags``
    (times, 3) holds each lag's two coefficients of the drive and the part that it keeps of itself;
    ``growth`` (samples,) is |u| / U, or zero.
    """
    if curve.size > 0:
        _bend(state, curve, first, last, drive)
    if lags.size == 0:
        _follow(state, last - first, drive)
    else:
        _creep(state, lags, growth, first, last, drive)


@inner(fastmath={"contract", "nsz"})
def _bend(state: FloatArray, curve: FloatArray, first: int, last: int, drive: FloatArray) -> None:
    """Add q₂ (x² − x₀²) + q₃ (x³ − x₀³)."""
    for t in range(first, last):
        square, cube = curve[t, 0], curve[t, 1]
        row = (t - first) * LANES
        for i in range(LANES):
            drive[row + i] += square * state[QUADRATIC + i] + cube * state[CUBIC + i]


@inner(fastmath={"contract", "nsz"})
def _follow(state: FloatArray, samples: int, drive: FloatArray) -> None:
    """Apply the dynamics."""
    for t in range(samples):
        row = t * LANES
        for i in range(LANES):
            w = drive[row + i]
            x = state[B0 + i] * w + state[X1 + i]
            state[X1 + i] = state[B1 + i] * w - state[A1 + i] * x + state[X2 + i]
            state[X2 + i] = state[B2 + i] * w - state[A2 + i] * x
            drive[row + i] = state[LEVEL + i] + x


@inner()
def _creep(
    state: FloatArray,
    lags: FloatArray,
    growth: FloatArray,
    first: int,
    last: int,
    drive: FloatArray,
) -> None:
    """Apply dynamics and creep."""
    followed = np.empty_like(drive[: (last - first) * LANES])
    for t in range(first, last):
        row = (t - first) * LANES
        for i in range(LANES):
            w = drive[row + i] + state[EQUILIBRIUM + i]
            followed[row + i] = w * (1.0 + state[GROWTH + i] * growth[t]) - state[CREPT + i]
    _follow(state, last - first, drive)
    for k in range(lags.shape[0]):
        at, strength = LAG + k * LANES, STRENGTH + k * LANES
        lag = state[at : at + LANES].copy()
        _lag(followed, lags[k], state[strength : strength + LANES].copy(), lag, drive)
        for i in range(LANES):  # a slice's shape would be checked, by more code than all of this
            state[at + i] = lag[i]


@inner(fastmath={"contract", "nsz"})
def _lag(
    followed: FloatArray,
    coefficients: FloatArray,
    strength: FloatArray,
    lag: FloatArray,
    drive: FloatArray,
) -> None:
    """Add one of the creep's lags. Separate arrays let a compiler take several lanes at once."""
    now, later, keep = coefficients
    for t in range(followed.size // LANES):
        row = t * LANES
        for i in range(LANES):
            w = strength[i] * followed[row + i]
            x = now * w + lag[i]
            lag[i] = later * w + keep * x
            drive[row + i] += x
