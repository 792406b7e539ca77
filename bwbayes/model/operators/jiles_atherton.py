"""The Jiles-Atherton model: pinned walls behind the anhysteretic curve of Langevin.

Made for ferromagnets and used for ferroelectrics: the field is the voltage, the magnetization the
displacement. :mod:`~bwbayes.model.operators.pinned` has the equation and what solves it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.operators.pinned import Pinned

__all__ = ["JilesAtherton"]

# L(y)/y is a quotient of polynomials of y², its continued fraction cut off: to 4e-14 up to y = 1.
# Coefficients, highest power first.
ABOVE = (1.0, 594.0, 45045.0, 675675.0)
BELOW = (36.0, 6930.0, 270270.0, 2027025.0)

# Below this field the first term of the series of L″ is better than its closed form.
TINY = 1e-4

# Newton's steps to the inverse of L, from a start within 5 %.
STEPS = 4


@dataclass(frozen=True)
class JilesAtherton(Pinned):
    """Jiles-Atherton hysteresis, with L(y) = coth y − 1/y and an error below 1e-6 of the range.

    The displacement P in um follows the voltage u in V by

        P_an = P_s L((u + a P)/E₀),   P = c P_an + (1 − c) P_irr,
        dP_irr/du = (P_an − P_irr) / (k s − a (P_an − P_irr)),

    with s the voltage's direction, and P_irr constant where P_an − P_irr does not have the sign of
    s. P_s in um is the displacement at saturation, E₀ in V the scale of the field, a P in V the
    field that the displacement itself makes (a in V/um), k in V the pinning, and c the reversible
    part. In place of E₀ and a, the parameters are the slope d = P_s L′(0) / (E₀ (1 − η)) in um/V
    and the coupling η = a P_s L′(0) / E₀, with L′(0) = 1/3.

    Notes
    -----
    D. C. Jiles, D. L. Atherton, Theory of ferromagnetic hysteresis, Journal of Magnetism and
    Magnetic Materials 61, 48-60 (1986), doi:10.1016/0304-8853(86)90066-1.
    """

    @property
    def slope_at_zero(self) -> float:
        """1/3."""
        return 1 / 3

    def curve(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return L = coth y − 1/y and L′ = 1/y² − 1/sinh² y, of any shape."""
        size = np.abs(y)
        near = size < 1
        if near.all():
            level, slope = _near(size)
        elif not near.any():
            level, slope = _far(size)
        else:
            branches = _near(np.minimum(size, 1.0)), _far(np.maximum(size, 1.0))
            level, slope = (np.where(near, *values) for values in zip(*branches, strict=True))
        return np.copysign(level, y), slope

    def bend(self, y: FloatArray, level: FloatArray, slope: FloatArray) -> FloatArray:
        """Return L″ = −2 L L′ − 2 (L′ − L/y)/y, and −2 y/15 where that is rounding."""
        small = np.abs(y) < TINY
        safe = np.where(small, 1.0, y)
        return np.where(small, -2 * y / 15, -2 * level * slope - 2 * (slope - level / safe) / safe)

    def field_at(self, level: FloatArray) -> FloatArray:
        """Return the inverse of L, infinite at ±1."""
        size = np.abs(level)
        with np.errstate(divide="ignore", invalid="ignore"):
            y = size * (3 - size**2) / (1 - size**2)
            for _ in range(STEPS):
                reached, slope = self.curve(y)
                y = np.where(size < 1, y - (reached - size) / slope, np.inf)
        field: FloatArray = np.copysign(y, level)
        return field


def _near(y: FloatArray) -> tuple[FloatArray, FloatArray]:
    square = y * y
    above, below = np.full_like(y, ABOVE[0]), np.full_like(y, BELOW[0])
    for coefficient in ABOVE[1:]:
        above *= square
        above += coefficient
    for coefficient in BELOW[1:]:
        below *= square
        below += coefficient
    quotient = above / below
    level = y * quotient
    return level, 1 - level * level - 2 * quotient


def _far(y: FloatArray) -> tuple[FloatArray, FloatArray]:
    inverse = 1 / y
    decay = np.exp(-2 * y)
    ratio = 2 * decay / (1 - decay)
    return 1 + ratio - inverse, inverse * inverse - 2 * ratio / (1 - decay)
