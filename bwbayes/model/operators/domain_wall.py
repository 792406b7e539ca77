"""The domain wall model of ferroelectrics: pinned walls behind the curve of Ising spins.

:mod:`~bwbayes.model.operators.pinned` has the equation, which is that of the Jiles-Atherton model
with another anhysteretic curve, and what solves it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.operators.pinned import Pinned

__all__ = ["DomainWall"]


@dataclass(frozen=True)
class DomainWall(Pinned):
    """Domain wall hysteresis, with L(y) = tanh y and an error below 1e-6 of the range.

    The displacement P in um is proportional to the polarization; it follows the voltage u in V, to
    which the electric field is proportional, by

        P_an = P_s tanh((u + a P)/E₀),   P = c P_an + (1 − c) P_irr,
        dP_irr/du = (P_an − P_irr) / (k s − a (P_an − P_irr)),

    with s the voltage's direction, and P_irr constant where P_an − P_irr does not have the sign of
    s. P_s in um is the displacement at saturation, E₀ in V the scale of the field, a P in V the
    field that the displacement itself makes (a in V/um), k in V the pinning, and c the reversible
    part. In place of E₀ and a, the parameters are the slope d = P_s L′(0) / (E₀ (1 − η)) in um/V
    and the coupling η = a P_s L′(0) / E₀, with L′(0) = 1.

    Notes
    -----
    R. C. Smith, Z. Ounaies, A domain wall model for hysteresis in piezoelectric materials, Journal
    of Intelligent Material Systems and Structures 11, 62-79 (2000); the paper's reference 19.
    """

    @property
    def slope_at_zero(self) -> float:
        """1."""
        return 1.0

    def curve(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return L = tanh y and L′ = 1 − L² (models,), of any shape."""
        decay = np.exp(-2 * np.abs(y))
        return np.tanh(y), 4 * decay / (1 + decay) ** 2

    def bend(self, y: FloatArray, level: FloatArray, slope: FloatArray) -> FloatArray:  # noqa: ARG002  # the curve says it all
        """Return L″ = −2 L L′."""
        return -2 * level * slope

    def field_at(self, level: FloatArray) -> FloatArray:
        """Return artanh, infinite at ±1."""
        with np.errstate(divide="ignore"):
            return np.arctanh(level)
