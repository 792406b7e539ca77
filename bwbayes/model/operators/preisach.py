"""Preisach: relays in parallel, most of them with switching voltages near zero.

A relay switches up at one voltage and down at a lower one. Here the density of relays is a product
of two bells, one over each of the switching voltages, so that loops are wide about zero volts and
narrow toward saturation. Loops between the same two voltages are alike, as in every Preisach
model; loops of the same size at another mean voltage are not, unlike in Prandtl-Ishlinskii.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray, gone
from bwbayes.model.declaration import Declaration, Values, positive
from bwbayes.model.operators.extremum_memory import INITIAL, RemembersExtrema
from bwbayes.model.operators.prandtl_ishlinskii import SLOPE

# Beyond this 2 u / u_s no relays are left: tanh is one to machine precision.
SATURATED = 40.0


DENSITY = (
    positive(
        "rayleigh",
        "um/V^2",
        r"\alpha_R",
        "growth of the slope with the length of a branch, about zero volts",
        lambda ranges: 0.4 * ranges.slope / ranges.voltage,
        reaches_floor=True,
    ),
    positive(
        "saturation",
        "V",
        "u_s",
        "voltage beyond which relays become rare",
        lambda ranges: 2 * ranges.farthest,
    ),
)


@dataclass(frozen=True)
class Preisach(RemembersExtrema):
    """Relays with a density that factorizes, and a reversible part d u.

    The density of relays over the voltages a and b ≤ a at which they switch up and down is

        μ(a, b) = (α_R / 2) f(a) f(b),   f(x) = 1 / cosh²(x / u_s),

    relays being ± 1. With F(x) = ∫ f = u_s tanh(x / u_s) a branch from an extremum (u_r, w_r) is

        w = w_r ± E(u_r, u),   E = d |u − u_r| + (α_R / 2) (F(u) − F(u_r))²

    with w in um, voltages in V, d in um/V, α_R in um/V². Where u_s is far beyond the drive this is
    Rayleigh's law, with α_R as its coefficient. It is odd: from the demagnetized state w = d u ±
    α_R F(u)².

    Sources: F. Preisach, Z. Phys. 94 (1935) 277-302; I. D. Mayergoyz, Mathematical Models of
    Hysteresis (Springer, 1991).
    """

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, the density's α_R and u_s, and the start."""
        return (SLOPE, *DENSITY, INITIAL)

    def numbers(self, column: Values) -> FloatArray:
        """Return d, α_R u_s² / 2 and 2 / u_s."""
        scale = column["saturation"]
        return np.column_stack([column["d"], column["rayleigh"] / 2 * scale**2, 2 / scale])

    @staticmethod
    def everett(numbers: Any, start: Any, voltage: Any) -> Any:
        """Return E, by tanh x − tanh y = 2 (g − h) / ((2 − g) (2 − h)) with g = 1 − exp(−2x)."""
        risen = gone(np.minimum(np.maximum(numbers[2] * voltage, -SATURATED), SATURATED))
        rose = gone(np.minimum(np.maximum(numbers[2] * start, -SATURATED), SATURATED))
        difference = 2.0 * (risen - rose) / ((2.0 - risen) * (2.0 - rose))
        return numbers[0] * np.abs(voltage - start) + numbers[1] * difference * difference
