"""Pinned walls that bend: common base of the Jiles-Atherton and the domain wall model.

Without pinning sites the polarization would follow the effective field along the anhysteretic
curve, saturating at either end. Walls that are pinned lag behind it: they move irreversibly only
once the field pulls them forward, and bend reversibly in between. Both models are one equation,
with another field and another anhysteretic curve.

There is no closed form. Where the walls do not move, one implicit equation remains, which is
solved to rounding; where they move, an implicit method of order five with steps of its own for
each model follows them, with an error below 1e-6 of the range of the displacement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration, Distribution, Values, check, positive, refuse
from bwbayes.model.inputs import Span, monotone_stretches
from bwbayes.model.operators.scalar_memory import OneState, initial
from bwbayes.model.operators.walls import (
    KNOTS,
    LINES,
    STAGES,
    Walls,
    at_rest,
    curve,
    first_step,
    integrate,
    interpolate,
    irreversible,
    moves_from,
)

# Samples that one stretch is followed for: a number that does not depend on the batch.
LONGEST = 2048

# Weaker pinning, as a part of the field's scale, would open no loop, and stronger coupling leaves
# hardly any slope before the loop closes.
WEAKEST, STRONGEST = 1e-3, 0.98


class Pinned(OneState):
    """Hysteresis by pinned walls, with an error below 1e-6 of the range.

    The displacement P in um follows the voltage u in V, to which the field is proportional, by

        P_an = P_s L((u + a P)/E₀),   P = c P_an + (1 − c) P_irr,
        dP_irr/du = (P_an − P_irr) / (k s − a (P_an − P_irr)),

    with s the voltage's direction, and P_irr constant where P_an − P_irr does not have the sign of
    s. L is what the walls would follow without pinning, E₀ in V the scale of the field, and a P in
    V the field that the displacement itself makes (a in V/um). Parameters are

    - d = P_s L′(0) / (E₀ (1 − η)), the slope of the anhysteretic displacement at zero, um/V,
    - P_s, the displacement at saturation, um,
    - η = a P_s L′(0) / E₀, how much of that slope the coupling makes, without unit,
    - k, the voltage by which pinned walls lag behind, V,
    - c, the reversible part, without unit,
    - P_an − P_irr at the first sample, um: how far walls lag behind, positive after a rise.

    With 0 ≤ η < 1 nothing is polarized by itself, |P_an − P_irr| stays below k d (1 − η), and the
    denominator keeps its sign.
    """

    spins: ClassVar[bool]

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, the saturation, the coupling, the pinning, the reversible part, and the start."""
        return (
            positive(
                "d",
                "um/V",
                r"d",
                "slope of the displacement without hysteresis, at zero volts",
                lambda ranges: 1.2 * ranges.slope,
                0.6,
                aliases=("gain", "d33"),
            ),
            positive(
                "saturation", "um", r"P_s", "displacement at saturation", lambda r: 4.0 * r.reach
            ),
            _fraction(
                "coupling", r"\eta", "share of the slope that the walls' coupling makes", 1.0, 3.0
            ),
            positive(
                "pinning",
                "V",
                r"k",
                "voltage by which pinned walls lag behind",
                lambda ranges: 0.25 * ranges.voltage,
                bounds=lambda earlier: (WEAKEST * self._field(earlier), np.inf),
                stated_bounds=f"at least {WEAKEST:g} of the field's scale",
            ),
            _fraction("reversible", "c", "part of the walls' motion that is reversible", 2.0, 2.0),
            replace(
                initial(),
                description="how far the walls lag behind at the first sample",
                bounds=lambda e: (-(lag := e["pinning"] * e["d"] * (1 - e["coupling"])), lag),
                stated_bounds="|initial| <= pinning d (1 - coupling)",
            ),
        )

    def check(self, column: Values) -> None:
        """Raise an InputError where a parameter is not finite or outside of its bounds."""
        check(self.parameters, column)
        for name in ("coupling", "reversible"):
            refuse(name, column[name] > STRONGEST, column[name], f"must be at most {STRONGEST:g}")
        weak = column["pinning"] < (1 - 1e-9) * WEAKEST * self.walls(column).field
        demand = f"must be at least {WEAKEST:g} of saturation/d, the voltage that saturates"
        refuse("pinning", weak, column["pinning"], demand)
        bound = (1 + 1e-9) * self.walls(column).lag
        demand = "must lie within pinning d (1 - coupling) of zero"
        refuse("initial", np.abs(column["initial"]) > bound, column["initial"], demand)

    def opening(self, column: Values, half_range: float) -> FloatArray:
        """Return U/k."""
        return half_range / column["pinning"]

    def first_state(self, column: Values, voltage: float | FloatArray) -> FloatArray:
        """Return P_irr (models,) of walls that lag behind P_an by ``initial``, um.

        P = P_an − (1 − c) (P_an − P_irr), so that P_an is what all walls would do in another field.
        """
        walls, behind = self.walls(column), column["initial"]
        reversible = walls._replace(reversible=np.ones_like(behind))
        elsewhere = voltage - walls.coupling * (1 - walls.reversible) * behind
        total = at_rest(self.spins, reversible, np.zeros_like(behind), elsewhere)
        return np.asarray(total - behind)

    def left(self, column: Values, voltage: float, span: Span) -> FloatArray:
        """Return how far behind (2, models) sweeps through the span leave the walls, um."""
        walls, behind = self.walls(column), []
        for fixed in self.swept(column, voltage, span):
            p = at_rest(self.spins, walls, fixed, np.full_like(fixed, voltage))
            level, _ = curve(self.spins, (voltage + walls.coupling * p) / walls.field)
            behind.append(np.clip(walls.saturation * level - fixed, -walls.lag, walls.lag))
        return np.stack(behind)

    def trace(
        self, column: Values, voltage: FloatArray, state: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the displacement P (models, samples), and P_irr at the end."""
        walls = self.walls(column)
        result = np.empty((state.size, voltage.size))
        result[:, 0] = at_rest(self.spins, walls, state, np.full_like(state, voltage[0]))
        for first, last, s in monotone_stretches(voltage, LONGEST):
            # The mirrored models rise.
            along, state = self._rise(walls, s * state, s * voltage[first : last + 1])
            result[:, first + 1 : last + 1], state = s * along[:, 1:], s * state
        return result, state

    def _rise(
        self, walls: Walls, fixed: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return P (models, points) along rising voltages (points,), and P_irr at the end.

        ``fixed`` is P_irr (models,) at the first.
        """
        # From where P_an reaches P_irr, walls move forward until the voltage turns.
        here = moves_from(self.spins, walls, fixed, u[0], u[-1])
        resting = int(np.searchsorted(u, np.max(here, initial=u[0]), side="right"))
        along = np.empty((fixed.size, u.size))
        columns = Walls(*(values[:, np.newaxis] for values in walls))
        along[:, :resting] = at_rest(self.spins, columns, fixed[:, np.newaxis], u[:resting])
        moving = here < u[-1]
        p, step = at_rest(self.spins, walls, fixed, here), first_step(walls)
        scale = np.minimum(walls.saturation, walls.slope * np.where(moving, u[-1] - here, 1.0))
        stages, knots = np.zeros((STAGES, fixed.size)), np.empty((KNOTS, LINES, fixed.size))
        while (here < u[-1]).any():
            start = here
            here, p, step, count = integrate(
                self.spins, walls, start, p, step, u[-1], scale, stages, knots
            )
            for model in np.flatnonzero(start < here):
                steps = knots[:count, :, model]
                interpolate(steps, start[model], here[model], u, along[model])
        return along, np.where(moving, irreversible(self.spins, walls, p, u[-1]), fixed)

    def walls(self, column: Values) -> Walls:
        """Return the numbers of the equation."""
        bare = column["d"] * (1 - column["coupling"])
        return Walls(
            column["saturation"],
            self._field(column),
            column["coupling"] / bare,
            column["pinning"],
            column["reversible"],
            column["pinning"] * bare,
            column["d"],
        )

    def _field(self, column: Values) -> FloatArray:
        """Return E₀ = P_s L′(0) / (d (1 − η)), V."""
        slope = 1.0 if self.spins else 1 / 3
        return slope * column["saturation"] / (column["d"] * (1 - column["coupling"]))


def _fraction(name: str, label: str, description: str, a: float, b: float) -> Declaration:
    """Declare a number from zero to nearly one, with a beta distribution for its prior."""
    return Declaration(
        name,
        "-",
        label,
        description,
        lambda _: Distribution("beta", {"a": a, "b": b}),
        floor=0.0,
        reaches_floor=True,
        bounds=lambda _: (0.0, STRONGEST),
        stated_bounds=f"0 <= {name} <= {STRONGEST:g}",
        loop=True,
    )


@dataclass(frozen=True)
class JilesAtherton(Pinned):
    """Jiles-Atherton hysteresis: pinned walls with L(y) = coth y − 1/y, L′(0) = 1/3.

        P_an = P_s L((u + a P)/E₀),   P = c P_an + (1 − c) P_irr,
        dP_irr/du = (P_an − P_irr) / (k s − a (P_an − P_irr)),

    with s the voltage's direction, as in :class:`Pinned`.

    Notes
    -----
    D. C. Jiles, D. L. Atherton, Theory of ferromagnetic hysteresis, Journal of Magnetism and
    Magnetic Materials 61, 48-60 (1986), doi:10.1016/0304-8853(86)90066-1.
    """

    spins = False


@dataclass(frozen=True)
class DomainWall(Pinned):
    """Domain wall hysteresis: pinned walls with L(y) = tanh y, L′(0) = 1.

        P_an = P_s L((u + a P)/E₀),   P = c P_an + (1 − c) P_irr,
        dP_irr/du = (P_an − P_irr) / (k s − a (P_an − P_irr)),

    with s the voltage's direction, as in :class:`Pinned`.

    Notes
    -----
    R. C. Smith, Z. Ounaies, A domain wall model for hysteresis in piezoelectric materials, Journal
    of Intelligent Material Systems and Structures 11, 62-79 (2000); the paper's reference 19.
    """

    spins = True
