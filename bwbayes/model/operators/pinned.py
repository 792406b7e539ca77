"""What the Jiles-Atherton and the domain wall model share: walls that are pinned, and bend.

Without pinning sites the polarization would follow the effective field along the anhysteretic
curve, saturating at either end. Walls that are pinned lag behind it: they move irreversibly only
once the field pulls them forward, and bend reversibly in between. Both models are one equation,
with another field and another anhysteretic curve.

There is no closed form. Where the walls do not move, one implicit equation remains, which is
solved to rounding; where they move, a Runge-Kutta method of order five with steps of its own for
each model follows them, with an error below 1e-6 of the range of the displacement.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import numpy as np
from scipy.integrate import RK45

from bwbayes.arrays import ArrayLike, FloatArray, IntArray
from bwbayes.model.declaration import Declaration, Values, lognormal, normal
from bwbayes.model.distributions import Distribution
from bwbayes.model.drive import monotone_stretches
from bwbayes.model.operator import Span
from bwbayes.model.operators.one_state import OneState, refuse

__all__ = ["Pinned"]

# Samples that one stretch is followed for: a number that does not depend on the batch.
LONGEST = 2048

# Error of a step, in units of the displacement along the stretch.
TOLERANCE = 1e-8

# How much a step may grow or shrink, and what part of the best step is taken.
GROW, SHRINK, SAFE = 5.0, 0.2, 0.9

# The first step of walls that begin to move, as a part of the voltage that they lag behind.
FIRST = 0.1

# Newton's method has converged when a step is below this part of the field's scale.
CONVERGED, ROUNDS = 1e-15, 200

# Weaker pinning, as a part of the field's scale, would open no loop, and stronger coupling leaves
# hardly any slope before the loop closes.
WEAKEST, STRONGEST = 1e-3, 0.98


class Walls(NamedTuple):
    """Models by the numbers of the equation, each (models,) or (models, 1).

    ``saturation`` P_s, um; ``field`` E₀, V; ``coupling`` a, V/um; ``pinning`` k, V; ``reversible``
    c; ``lag`` is the largest that |P_an − P_irr| can get, um; ``slope`` that of the anhysteretic
    displacement at zero, with the coupling, um/V.
    """

    saturation: FloatArray
    field: FloatArray
    coupling: FloatArray
    pinning: FloatArray
    reversible: FloatArray
    lag: FloatArray
    slope: FloatArray

    def rows(self, which: IntArray) -> Walls:
        """Return some of the models."""
        return Walls(*(values[which] for values in self))

    def columns(self) -> Walls:
        """Return the models with an axis for points."""
        return Walls(*(values[:, np.newaxis] for values in self))


class Pinned(OneState):
    """Hysteresis by pinned walls, with an error below 1e-6 of the range.

    The displacement P in um follows the voltage u in V by

        P_an = P_s L((u + a P)/E₀),   P = c P_an + (1 − c) P_irr,
        dP_irr/du = (P_an − P_irr) / (k s − a (P_an − P_irr)),

    with s the voltage's direction; where P_an − P_irr has not the sign of s, P_irr stays. L is the
    anhysteretic curve, L(±∞) = ±1. Parameters are

    - d = P_s L′(0) / (E₀ (1 − η)), the slope of the anhysteretic displacement at zero, um/V,
    - P_s, the displacement at saturation, um,
    - η = a P_s L′(0) / E₀, how much of that slope the coupling makes, without unit,
    - k, the voltage by which pinned walls lag behind, V,
    - c, the reversible part, without unit,
    - P_irr at the first sample, um.

    With 0 ≤ η < 1 nothing is polarized by itself, |P_an − P_irr| stays below k d (1 − η), and the
    denominator keeps its sign. A start further away, which no drive leaves, moves at the rate that
    is the largest there.
    """

    @property
    @abstractmethod
    def slope_at_zero(self) -> float:
        """L′(0)."""

    @abstractmethod
    def curve(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return L and L′ at fields in units of E₀, of any shape."""

    @abstractmethod
    def field_at(self, level: FloatArray) -> FloatArray:
        """Return the field in units of E₀ at which L is ``level``, between −1 and 1."""

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """d, the saturation, the coupling, the pinning, the reversible part, and the start."""
        return (
            Declaration(
                "d",
                "um/V",
                r"d",
                "slope of the displacement without hysteresis, at zero volts",
                lambda known: lognormal(1.2 * known.ranges.gain, 0.6),
                floor=0.0,
                loop=True,
                aliases=("gain", "d33"),
            ),
            Declaration(
                "saturation",
                "um",
                r"P_s",
                "displacement at saturation",
                lambda known: lognormal(4.0 * known.ranges.reach, 1.0),
                floor=0.0,
                loop=True,
            ),
            Declaration(
                "coupling",
                "-",
                r"\eta",
                "share of the slope that the coupling of the walls makes",
                lambda _: Distribution("beta", {"a": 1.0, "b": 3.0}),
                floor=0.0,
                reaches_floor=True,
                bounds=lambda _: (0.0, STRONGEST),
                stated_bounds=f"0 <= coupling <= {STRONGEST:g}",
                loop=True,
            ),
            Declaration(
                "pinning",
                "V",
                r"k",
                "voltage by which pinned walls lag behind",
                lambda known: lognormal(0.25 * known.ranges.voltage, 1.0),
                floor=0.0,
                bounds=self._pinning_bounds,
                stated_bounds=f"at least {WEAKEST:g} of the field's scale",
                loop=True,
            ),
            Declaration(
                "reversible",
                "-",
                r"c",
                "part of the walls' motion that is reversible",
                lambda _: Distribution("beta", {"a": 2.0, "b": 2.0}),
                floor=0.0,
                reaches_floor=True,
                bounds=lambda _: (0.0, STRONGEST),
                stated_bounds=f"0 <= reversible <= {STRONGEST:g}",
                loop=True,
            ),
            Declaration(
                "initial",
                "um",
                r"P_0",
                "irreversible displacement at the first sample",
                lambda known: normal(0.0, known.ranges.reach),
                bounds=_initial_bounds,
                stated_bounds="|initial| < saturation",
                scope="record",
            ),
        )

    def check(self, column: Values) -> None:
        """Raise an InputError where a parameter is not finite or outside of its bounds."""
        for declared in self.parameters:
            name = declared.name
            refuse(column, name, ~np.isfinite(column[name]), "must be finite")
        for name in ("d", "saturation", "pinning"):
            refuse(column, name, column[name] <= 0, "must be positive")
        for name in ("coupling", "reversible"):
            values = column[name]
            wrong = (values < 0) | (values > STRONGEST)
            refuse(column, name, wrong, f"must lie between 0 and {STRONGEST:g}")
        weak = column["pinning"] < (1 - 1e-9) * WEAKEST * self._walls(column).field
        demand = f"must be at least {WEAKEST:g} of saturation/d, the voltage that saturates"
        refuse(column, "pinning", weak, demand)
        beyond = np.abs(column["initial"]) > column["saturation"]
        refuse(column, "initial", beyond, "must lie between -saturation and saturation")

    def opening(self, column: Values, half_range: float) -> FloatArray:
        """Return U/k."""
        return half_range / column["pinning"]

    def gain(self, column: Values, span: Span) -> FloatArray:  # noqa: ARG002  # at zero volts
        """Return d."""
        return column["d"]

    def unbiased(self, column: Values, voltage: float) -> FloatArray:
        """Return the displacement (models,) without hysteresis at a voltage."""
        walls = self._walls(column).columns()
        everything = walls._replace(reversible=np.ones_like(walls.field))
        none = np.zeros_like(walls.field)
        return self._at_rest(everything, none, np.full_like(none, voltage))[:, 0]

    def trace(
        self, column: Values, voltage: FloatArray, state: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the displacement P (models, samples), and P_irr at the end."""
        walls = self._walls(column)
        result = np.empty((state.size, voltage.size))
        result[:, :1] = self._at_rest(
            walls.columns(), state[:, np.newaxis], voltage[np.newaxis, :1]
        )
        for first, last, s in monotone_stretches(voltage, LONGEST):
            # The mirrored models rise.
            along, state = self._rise(walls, s * state, s * voltage[first : last + 1])
            result[:, first + 1 : last + 1], state = s * along, s * state
        return result, state

    def _walls(self, column: Values) -> Walls:
        bare = column["d"] * (1 - column["coupling"])
        field = self.slope_at_zero * column["saturation"] / bare
        return Walls(
            column["saturation"],
            field,
            column["coupling"] / bare,
            column["pinning"],
            column["reversible"],
            column["pinning"] * bare,
            column["d"],
        )

    def _pinning_bounds(self, earlier: Values) -> tuple[ArrayLike, ArrayLike]:
        if not {"d", "saturation", "coupling"} <= set(earlier):
            return 0.0, np.inf
        bare = earlier["d"] * (1 - earlier["coupling"])
        return WEAKEST * self.slope_at_zero * earlier["saturation"] / bare, np.inf

    def _rise(
        self, walls: Walls, fixed: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return P (models, points - 1) along rising voltages (points,), and P_irr at the end.

        ``fixed`` is P_irr (models,) at the first.
        """
        # From where P_an reaches P_irr, walls move forward until the voltage turns.
        level = np.clip(fixed / walls.saturation, -1.0, 1.0)
        free = walls.field * self.field_at(level) - walls.coupling * fixed
        since = np.maximum(free, u[0])
        resting = int(np.searchsorted(u, np.max(since, initial=u[0]), side="right"))
        along = np.empty((fixed.size, u.size))
        along[:, :resting] = self._at_rest(
            walls.columns(), fixed[:, np.newaxis], u[np.newaxis, :resting]
        )
        moving = np.flatnonzero(since < u[-1])
        if moving.size == 0:
            return along[:, 1:], fixed
        some = walls.rows(moving)
        start = np.where(free >= u[0], fixed, along[:, 0])[moving]
        part = along[moving]
        end = self._move(some, since[moving], start, u, part)
        along[moving] = part
        after = fixed.copy()
        after[moving] = self._irreversible(some, end, float(u[-1]))
        return along[:, 1:], after

    def _at_rest(self, walls: Walls, fixed: FloatArray, u: FloatArray) -> FloatArray:
        """Solve P = c P_an + (1 − c) P_irr for P (models, points), by Newton's method.

        In the effective field x = u + a P. From a start beyond the root, seen from zero, the steps
        never leave its side. An element that has converged stays, whatever the others do.
        """
        ws, e0, a, _, c, _, _ = walls
        base = u + a * (1 - c) * fixed
        share = a * c * ws
        near = np.abs(base) / (1 - share * self.slope_at_zero / e0)
        x = np.copysign(np.minimum(near, np.abs(base) + share), base)
        for _ in range(ROUNDS):
            level, slope = self.curve(x / e0)
            step = (x - base - share * level) / (1 - share * slope / e0)
            going = np.abs(step) > CONVERGED * (np.abs(x) + e0)
            if not going.any():
                break
            x = x - np.where(going, step, 0.0)
        return c * ws * self.curve(x / e0)[0] + (1 - c) * fixed

    def _irreversible(self, walls: Walls, p: FloatArray, u: float) -> FloatArray:
        """Return P_irr (models,) of a displacement."""
        level, _ = self.curve((u + walls.coupling * p) / walls.field)
        fixed: FloatArray = (p - walls.reversible * walls.saturation * level) / (
            1 - walls.reversible
        )
        return fixed

    def _slope(self, walls: Walls, u: FloatArray, p: FloatArray) -> FloatArray:
        """Return dP/du (models,) while walls move forward under a rising voltage."""
        ws, e0, a, k, c, most, _ = walls
        level, slope = self.curve((u + a * p) / e0)
        behind = np.clip((ws * level - p) / (1 - c), 0.0, most)
        slope = slope * ws / e0
        irreversible = behind / (k - a * behind)
        forward: FloatArray = (c * slope + (1 - c) * irreversible) / (1 - a * c * slope)
        return forward

    def _move(
        self,
        walls: Walls,
        u: FloatArray,
        p: FloatArray,
        points: FloatArray,
        along: FloatArray,
    ) -> FloatArray:
        """Let walls move from voltages u and displacements p (models,) to the last point.

        Fills in P ``along`` (models, points) after u, and returns the last. Dormand and Prince's
        method; every model has its own steps, so that it does not depend on the others.
        """
        u, p, end = u.copy(), p.copy(), points[-1]
        scale = TOLERANCE * np.minimum(walls.saturation, walls.slope * (end - u))
        step = FIRST * (walls.pinning - walls.coupling * walls.lag)
        slope = self._slope(walls, u, p)
        rows = np.arange(u.size)
        while rows.size:
            some = walls.rows(rows)
            at, now = u[rows], p[rows]
            last = step[rows] >= end - at
            h = np.where(last, end - at, step[rows])
            stages = [slope[rows]]
            for place, weights in zip(RK45.C[1:], RK45.A[1:], strict=True):
                change = h * _weighted(weights, stages)
                stages.append(self._slope(some, at + place * h, now + change))
            reached = now + h * _weighted(RK45.B, stages)
            arrived = np.where(last, end, at + h)
            stages.append(self._slope(some, arrived, reached))
            error = np.abs(h * _weighted(RK45.E, stages)) / scale[rows]
            good = error <= 1
            with np.errstate(divide="ignore"):
                step[rows] = h * np.clip(SAFE * error**-0.2, SHRINK, GROW)
            done = rows[good]
            u[done], p[done], slope[done] = arrived[good], reached[good], stages[-1][good]
            terms = [_weighted(power, stages)[good] for power in RK45.P.T]
            _fill(along, points, done, at[good], arrived[good], now[good], terms)
            rows = rows[~(good & last)]
        return p


def _weighted(weights: FloatArray, stages: list[FloatArray]) -> FloatArray:
    """Return the weighted sum of slopes (models,), term by term, so that no row sees another."""
    total: FloatArray = weights[0] * stages[0]
    for weight, one in zip(weights[1:], stages[1:], strict=False):
        total = total + weight * one
    return total


def _fill(
    along: FloatArray,
    points: FloatArray,
    rows: IntArray,
    first: FloatArray,
    last: FloatArray,
    start: FloatArray,
    terms: list[FloatArray],
) -> None:
    """Fill in the points of a step from ``first`` to ``last`` (rows,), by its polynomial."""
    low, high = (np.searchsorted(points, ends, side="right") for ends in (first, last))
    counts = high - low
    which = np.repeat(np.arange(rows.size), counts)
    column = np.arange(which.size) - np.repeat(np.cumsum(counts) - counts - low, counts)
    travel = points[column] - first[which]
    part = travel / (last - first)[which]
    polynomial = np.zeros(which.size)
    for term in terms[::-1]:
        polynomial = polynomial * part + term[which]
    along[rows[which], column] = start[which] + travel * polynomial


def _initial_bounds(earlier: Values) -> tuple[ArrayLike, ArrayLike]:
    if "saturation" not in earlier:
        return -np.inf, np.inf
    return -earlier["saturation"], earlier["saturation"]
