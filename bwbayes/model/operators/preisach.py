"""Preisach: relays in parallel, most of them with switching voltages near zero.

A relay switches up at one voltage and down at a lower one. Here the density of relays is a product
of two bells, one over each of the switching voltages, so that loops are wide about zero volts and
narrow toward saturation. Loops between the same two voltages are alike, as in every Preisach
model; loops of the same size at another mean voltage are not, unlike in Prandtl-Ishlinskii.

Krasnosel'skii-Pokrovskii is Preisach's model with relays that switch along a ramp. A relay jumps;
here it goes from down to up while the voltage rises by the ramp's width, and stays where it is when
the voltage turns half way. Such a ramp is a mean of relays whose two switching voltages are shifted
together. So the model is a Preisach model whose density, and with it its Everett function, is
averaged over that shift: wider bells with the same corner at small loops.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray, gone, select
from bwbayes.model.declaration import Declaration, Values, positive, refuse
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


# Ramps are at most this many times wider than the density's bell: wider ones are all alike, with
# the ramp for a bell.
WIDEST = 10.0

# artanh(w) / w − 1 by so many terms of its series, to 2e-16 of itself, where w² is no larger.
SMALL, TERMS = 0.01, 8


@dataclass(frozen=True)
class KrasnoselskiiPokrovskii(RemembersExtrema):
    """Relays with ramps of width a, and a reversible part d u.

    The density of the ramps' middles is that of :class:`Preisach
    <bwbayes.model.operators.preisach.Preisach>`, and for a = 0 the two models are the same. A
    branch from an extremum (u_r, w_r) is

        w = w_r ± E(u_r, u),
        E = d |u − u_r| + (α_R / 2a) ∫ (F(u − t) − F(u_r − t))² dt,   |t| ≤ a / 2,

    F(x) = u_s tanh(x / u_s), with w in um, voltages and a in V, d in um/V, α_R in um/V². With
    x = u / u_s, y = u_r / u_s, δ = x − y, σ = x + y and ω = a / u_s the integral is, without
    differences of nearly equal numbers,

        a u_s² (4 sinh ω / ω) (sinh²δ (cosh δ + cosh σ cosh ω) / (C D) + cosh δ / C · ρ(v)),
        C = cosh σ + cosh δ cosh ω,   v = sinh δ sinh ω / C,   ρ(v) = artanh(v) / v − 1,
        D = (cosh 2x + cosh ω) (cosh 2y + cosh ω).

    Sources: M. A. Krasnosel'skii and A. V. Pokrovskii, Systems with Hysteresis (Springer, 1989),
    and for ramps as means of relays I. D. Mayergoyz, Mathematical Models of Hysteresis (Springer,
    1991).
    """

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, the density's α_R and u_s, the ramps' width a, and the start."""
        width = positive(
            "width",
            "V",
            "a",
            "rise of the voltage along which a relay switches",
            lambda ranges: 0.2 * ranges.voltage,
            reaches_floor=True,
            bounds=lambda earlier: (0.0, WIDEST * earlier["saturation"]),
            stated_bounds=f"width <= {WIDEST:g} saturation",
        )
        rayleigh, saturation = DENSITY
        # The bound of a width that is fixed.
        saturation = replace(saturation, bounds=lambda earlier: (earlier["width"] / WIDEST, np.inf))
        return (SLOPE, rayleigh, saturation, width, INITIAL)

    def check(self, column: Values) -> None:
        """Raise an InputError that names the parameter where a model is outside of the domain."""
        super().check(column)
        # A width on its bound may exceed it by rounding.
        wide = column["width"] > WIDEST * (1 + 1e-9) * column["saturation"]
        refuse("width", wide, column["width"], f"must be at most {WIDEST:g} times saturation")

    def numbers(self, column: Values) -> FloatArray:
        """Return d, u_s, 2 α_R u_s² sinh ω / ω, sinh ω, cosh ω, and beyond what E is flat, V."""
        scale, omega = column["saturation"], column["width"] / column["saturation"]
        sinh = np.sinh(omega)
        height = 2 * column["rayleigh"] * scale**2
        height *= np.divide(sinh, omega, where=omega > 0, out=np.ones_like(omega))
        # Beyond twenty bells no relays are left: tanh is one to machine precision.
        limit = (omega / 2 + 20.0) * scale
        return np.column_stack([column["d"], scale, height, sinh, np.cosh(omega), limit])

    @staticmethod
    def everett(numbers: Any, start: Any, voltage: Any) -> Any:
        """Return E."""
        scale, sinh, cosh, limit = numbers[1], numbers[3], numbers[4], numbers[5]
        near = np.minimum(np.maximum(voltage, -limit), limit)
        turned = np.minimum(np.maximum(start, -limit), limit)
        x, y = near / scale, turned / scale
        difference = np.sinh((near - turned) / scale)
        cosh_sum, square = np.cosh(x + y), difference * difference
        root = np.sqrt(1.0 + square)
        c = cosh_sum + root * cosh
        corners = (np.cosh(2.0 * x) + cosh) * (np.cosh(2.0 * y) + cosh)
        moved = square * (root + cosh_sum * cosh) / corners
        moved = moved + root * rest_of_artanh(difference * sinh / c)
        return numbers[2] / c * moved + numbers[0] * np.abs(voltage - start)


def rest_of_artanh(v: Any) -> Any:
    """Return artanh(v) / v − 1."""
    square = v * v
    small, series = np.minimum(square, SMALL), 0.0 * square
    for order in range(TERMS, 0, -1):
        series = (series + 1.0 / (2.0 * order + 1.0)) * small
    large = select(square > SMALL, v, 0.5)
    return select(square > SMALL, np.arctanh(large) / large - 1.0, series)
