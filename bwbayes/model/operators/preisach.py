"""Preisach: relays in parallel, most of them with switching voltages near zero.

A relay switches up at one voltage and down at a lower one. Here the density of relays is a product
of two bells, one over each of the switching voltages, so that loops are wide about zero volts and
narrow towards saturation. Loops between the same two voltages are alike, as in every Preisach
model; loops of the same size at another mean voltage are not, unlike in Prandtl-Ishlinskii.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Context, Declaration, Values, lognormal
from bwbayes.model.distributions import Distribution
from bwbayes.model.operators.memory import INITIAL, Branch, RemembersExtrema
from bwbayes.model.operators.prandtl_ishlinskii import SLOPE

__all__ = ["DENSITY", "Preisach"]


def _rayleigh_prior(context: Context) -> Distribution:
    ranges = context.ranges
    return lognormal(0.4 * ranges.gain / ranges.voltage, 1.0)


def _saturation_prior(context: Context) -> Distribution:
    ranges = context.ranges
    return lognormal(2 * (ranges.voltage + abs(ranges.bias)), 1.0)


DENSITY = (
    Declaration(
        name="rayleigh",
        unit="um/V^2",
        label=r"\alpha_R",
        description="growth of the slope with the length of a branch, about zero volts",
        default=_rayleigh_prior,
        floor=0.0,
        reaches_floor=True,
        loop=True,
    ),
    Declaration(
        name="saturation",
        unit="V",
        label="u_s",
        description="voltage beyond which relays become rare",
        default=_saturation_prior,
        floor=0.0,
        loop=True,
    ),
)


@dataclass(frozen=True)
class Preisach(RemembersExtrema):
    """Relays with a density that factorises, and a reversible part d u.

    The density of relays over the voltages a and b ≤ a at which they switch up and down is

        μ(a, b) = (α_R / 2) f(a) f(b),   f(x) = 1 / cosh²(x / u_s),

    relays being ± 1. With F(x) = ∫ f = u_s tanh(x / u_s) a branch from an extremum (u_r, w_r) is

        w = w_r ± E(u_r, u),   E = d |u − u_r| + (α_R / 2) (F(u) − F(u_r))²

    with w in um, voltages in V, d in um/V, α_R in um/V². Where u_s is far beyond the drive this is
    Rayleigh's law, with α_R as its coefficient. It is odd: from the demagnetised state w = d u ±
    α_R F(u)².

    Sources: F. Preisach, Z. Phys. 94 (1935) 277-302; I. D. Mayergoyz, Mathematical Models of
    Hysteresis (Springer, 1991).
    """

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, the density's α_R and u_s, and the start."""
        return (SLOPE, *DENSITY, INITIAL)

    def branch(self, column: Values) -> Branch:
        """Return E of the start and the voltage."""
        slope = column["d"][:, np.newaxis]
        scale = column["saturation"][:, np.newaxis]
        height = column["rayleigh"][:, np.newaxis] / 2 * scale**2

        def everett(start: float | FloatArray, voltage: FloatArray) -> FloatArray:
            moved: FloatArray = np.tanh(voltage / scale)
            moved -= np.tanh(start / scale)
            moved *= moved
            moved *= height
            moved += slope * np.abs(voltage - start)
            return moved

        return everett
