"""Displacement from the operator's drive, for ``LANES`` models side by side.

The nonlinearity adds to the drive, and the dynamics and the lags of the creep follow it. The input
of all of them is the drive's difference from that of the first sample, at which they may have been
at rest.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES, Row, Struct, inner
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Values
from bwbayes.model.linear import MOST_TIMES, Sections

# Samples that pass the stages together: their drives fit into the first cache.
PIECE = 64

Times = Annotated[FloatArray, (MOST_TIMES,)]


class Motion(Struct):
    """Numbers and memory of nonlinearity, dynamics and creep."""

    level: Row
    quadratic: Row
    cubic: Row
    numerator: Annotated[FloatArray, (3,)]
    denominator: Annotated[FloatArray, (2,)]
    x1: Row
    x2: Row
    equilibrium: Row
    crept: Row
    growth: Row
    strength: Times
    lag: Times


class Shared(NamedTuple):
    """Constants of nonlinearity and creep that all models share.

    ``curve`` (samples, 2) holds x² − x₀² and x³ − x₀³ of the nonlinearity, or is empty; ``lags``
    (times, 3) holds each lag's two coefficients of the drive and the part that it keeps of itself;
    ``growth`` (samples,) is |u| / U, or zero.
    """

    curve: FloatArray
    lags: FloatArray
    growth: FloatArray

    @classmethod
    def of(cls, actuator: Actuator, voltage: FloatArray) -> Shared:
        """Return the constants of an actuator along a voltage."""
        curve, lags, growth = np.empty((0, 2)), np.empty((0, 3)), np.zeros(voltage.size)
        if actuator.nonlinearity is not None:
            x = actuator.nonlinearity.scaled(voltage)
            curve = np.stack([x**2 - x[0] ** 2, x**3 - x[0] ** 3], axis=1)
        if actuator.creep is not None:
            recursions = actuator.creep.recursions(1, actuator.interval, actuator.hold)
            lags = np.array([[*one.numerator[0], -one.denominator[0, 1]] for one in recursions])
            if actuator.creep.growing:
                growth = actuator.creep.size(voltage)
        return cls(curve, lags, growth)


def physics(
    actuator: Actuator,
    sections: Sections,
    column: Values,
    equilibrium: FloatArray,
    voltage: FloatArray,
) -> dict[str, FloatArray]:
    """Return the numbers of models (models, ...) by the rows of :class:`Motion`.

    ``sections`` are the actuator's; ``equilibrium`` (models,) is w₀ without nonlinearity, um.
    """
    if actuator.nonlinearity is not None:
        equilibrium = equilibrium + actuator.nonlinearity.displacement(column, voltage[:1])[:, 0]
    level, rows = column["offset"] + equilibrium, {"equilibrium": equilibrium}
    if actuator.creep is not None:
        crept = actuator.creep.drive(column, equilibrium[:, np.newaxis], voltage[:1])[:, 0]
        level = level + crept * np.sum(sections.gains[1:], axis=0)
        rows |= {"crept": crept, "strength": np.stack(sections.gains[1:], axis=1)}
    dynamics = sections.recursions[0]
    rows |= {"numerator": dynamics.numerator, "denominator": dynamics.denominator[:, 1:]}
    rows |= {"level": level}
    others = {"growth": "creep_growth", "quadratic": "quadratic", "cubic": "cubic"}
    return rows | {row: column[name] for row, name in others.items() if name in column}


def known_motion(
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
    passing = sections.recursions[0].denominator
    return {"level": first, "numerator": passing, "denominator": passing[:, 1:]}


@inner()
def displace(motion: Motion, shared: Shared, first: int, drive: FloatArray) -> None:
    """Turn the drive (samples, lanes) into displacement, at samples from ``first`` on."""
    if shared.curve.size > 0:
        _bend(motion, shared.curve, first, drive)
    if shared.lags.size == 0:
        _follow(motion, drive)
    else:
        _creep(motion, shared, first, drive)


@inner(fastmath={"contract", "nsz"})
def _bend(motion: Motion, curve: FloatArray, first: int, drive: FloatArray) -> None:
    """Add q₂ (x² − x₀²) + q₃ (x³ − x₀³)."""
    quadratic, cubic = motion.quadratic, motion.cubic
    for t in range(len(drive)):
        square, cube = curve[first + t, 0], curve[first + t, 1]
        for i in range(LANES):
            drive[t, i] += square * quadratic[i] + cube * cubic[i]


@inner(fastmath={"contract", "nsz"})
def _follow(motion: Motion, drive: FloatArray) -> None:
    """Apply the dynamics."""
    b0, b1, b2 = motion.numerator[0], motion.numerator[1], motion.numerator[2]
    a1, a2 = motion.denominator[0], motion.denominator[1]
    level, x1, x2 = motion.level, motion.x1, motion.x2
    for t in range(len(drive)):
        for i in range(LANES):
            w = drive[t, i]
            x = b0[i] * w + x1[i]
            x1[i] = b1[i] * w - a1[i] * x + x2[i]
            x2[i] = b2[i] * w - a2[i] * x
            drive[t, i] = level[i] + x


@inner()
def _creep(motion: Motion, shared: Shared, first: int, drive: FloatArray) -> None:
    """Apply dynamics and creep."""
    equilibrium, crept, growth = motion.equilibrium, motion.crept, motion.growth
    followed = np.empty_like(drive)
    for t in range(len(drive)):
        size = shared.growth[first + t]
        for i in range(LANES):
            w = drive[t, i] + equilibrium[i]
            followed[t, i] = w * (1.0 + growth[i] * size) - crept[i]
    _follow(motion, drive)
    for k in range(len(shared.lags)):
        _lag(followed, shared.lags[k], motion.strength[k], motion.lag[k], drive)


@inner(fastmath={"contract", "nsz"})
def _lag(
    followed: FloatArray,
    coefficients: FloatArray,
    strength: FloatArray,
    lag: FloatArray,
    drive: FloatArray,
) -> None:
    """Add one of the creep's lags."""
    now, later, keep = coefficients
    for t in range(len(followed)):
        for i in range(LANES):
            w = strength[i] * followed[t, i]
            x = now * w + lag[i]
            lag[i] = later * w + keep * x
            drive[t, i] += x
