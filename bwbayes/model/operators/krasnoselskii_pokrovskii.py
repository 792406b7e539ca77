"""Krasnosel'skii-Pokrovskii: Preisach's model with relays that switch along a ramp.

A relay jumps; here it goes from down to up while the voltage rises by the ramp's width, and stays
where it is when the voltage turns half way. Such a ramp is a mean of relays whose two switching
voltages are shifted together. So the model is a Preisach model whose density, and with it its
Everett function, is averaged over that shift: wider bells with the same corner at small loops.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration, Values, lognormal
from bwbayes.model.operators.memory import INITIAL, Branch, RemembersExtrema, refuse
from bwbayes.model.operators.prandtl_ishlinskii import SLOPE
from bwbayes.model.operators.preisach import DENSITY

__all__ = ["KrasnoselskiiPokrovskii"]

# Ramps are at most this many times wider than the density's bell: wider ones are all alike, with
# the ramp for a bell.
WIDEST = 10.0

# A width on its bound may exceed it by rounding.
ROUNDED = 1 + 1e-9

# Beyond this many bells no relays are left: tanh is one to machine precision.
SATURATED = 20.0

# artanh(w) / w − 1 by its series, to 2e-16 of itself, where w² is no larger.
SMALL = 0.01
SERIES = tuple(1 / (2 * k + 1) for k in range(1, 9))


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
        width = Declaration(
            name="width",
            unit="V",
            label="a",
            description="rise of the voltage along which a relay switches",
            default=lambda context: lognormal(0.2 * context.ranges.voltage, 1.0),
            floor=0.0,
            reaches_floor=True,
            bounds=lambda known: (0.0, WIDEST * known.get("saturation", np.array(np.inf))),
            stated_bounds=f"width <= {WIDEST:g} saturation",
            loop=True,
        )
        rayleigh, saturation = DENSITY
        # Of a width that is fixed.
        saturation = replace(
            saturation, bounds=lambda known: (known.get("width", np.array(0.0)) / WIDEST, np.inf)
        )
        return (SLOPE, rayleigh, saturation, width, INITIAL)

    def check(self, column: Values) -> None:
        """Raise an InputError that names the parameter where a model is outside of the domain."""
        super().check(column)
        wide = column["width"] > WIDEST * ROUNDED * column["saturation"]
        refuse("width", wide, column["width"], f"must be at most {WIDEST:g} times saturation")

    def branch(self, column: Values) -> Branch:
        """Return E of the start and the voltage."""
        slope, scale, rayleigh, width = (
            column[name][:, np.newaxis] for name in ("d", "saturation", "rayleigh", "width")
        )
        omega = width / scale
        sinh, cosh = np.sinh(omega), np.cosh(omega)
        height = rayleigh * scale**2 * np.divide(sinh, omega, where=omega > 0, out=1 + 0 * omega)
        far = (omega / 2 + SATURATED) * scale

        def everett(start: float | FloatArray, voltage: FloatArray) -> FloatArray:
            near, turned = np.clip(voltage, -far, far), np.clip(start, -far, far)
            x, y = near / scale, turned / scale
            difference = np.sinh((near - turned) / scale)
            both, square = np.cosh(x + y), difference**2
            apart = np.sqrt(1 + square)
            c = both + apart * cosh
            corners = (np.cosh(2 * x) + cosh) * (np.cosh(2 * y) + cosh)
            moved = square * (apart + both * cosh) / corners
            moved += apart * _rest_of_artanh(difference * sinh / c)
            moved *= 2 * height / c
            moved += slope * np.abs(voltage - start)
            return np.asarray(moved)

        return everett


def _rest_of_artanh(v: FloatArray) -> FloatArray:
    """Return artanh(v) / v − 1."""
    square = v * v
    small = np.minimum(square, SMALL)
    series = np.zeros_like(small)
    for term in reversed(SERIES):
        series = (series + term) * small
    large = np.where(square > SMALL, v, 0.5)
    return np.where(square > SMALL, np.arctanh(large) / large - 1, series)
