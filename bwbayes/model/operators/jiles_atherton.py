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

# Levels of the continued fraction of L(y)/y: exact to rounding up to y = 1.
LEVELS = (15.0, 13.0, 11.0, 9.0, 7.0, 5.0, 3.0)

# Newton's steps to the inverse of L, from a start within 5 %.
STEPS = 4


@dataclass(frozen=True)
class JilesAtherton(Pinned):
    """Jiles-Atherton hysteresis, with L(y) = coth y − 1/y and an error below 1e-6 of the range.

    The displacement P in um follows the voltage u in V by

        P_an = P_s L((u + a P)/E₀),   P = c P_an + (1 − c) P_irr,
        dP_irr/du = (P_an − P_irr) / (k s − a (P_an − P_irr)),

    as in :class:`~bwbayes.model.operators.pinned.Pinned`, which names the parameters.

    Notes
    -----
    D. C. Jiles, D. L. Atherton, Theory of ferromagnetic hysteresis, Journal of Magnetism and
    Magnetic Materials 61, 48-60 (1986).
    """

    @property
    def slope_at_zero(self) -> float:
        """1/3."""
        return 1 / 3

    def curve(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return L = coth y − 1/y and L′ = 1/y² − 1/sinh² y, of any shape."""
        size = np.abs(y)
        near, far = np.minimum(size, 1.0), np.maximum(size, 1.0)
        quotient = np.zeros_like(near)
        for odd in LEVELS:
            quotient = 1 / (odd + near**2 * quotient)
        gone = np.exp(-2 * far)
        level = np.where(size < 1, near * quotient, 1 + 2 * gone / (1 - gone) - 1 / far)
        slope = np.where(
            size < 1, 1 - level**2 - 2 * quotient, (1 / far) ** 2 - 4 * gone / (1 - gone) ** 2
        )
        return np.copysign(level, y), slope

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
