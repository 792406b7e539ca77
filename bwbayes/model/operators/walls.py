"""What solves the equation of pinned walls along a rising voltage, for any anhysteretic curve.

The displacement P in um follows the voltage u in V by

    P_an = P_s L((u + a P)/E₀),   P = c P_an + (1 − c) P_irr,
    dP_irr/du = (P_an − P_irr) / (k − a (P_an − P_irr))   where P_an > P_irr,

and P_irr stays elsewhere. There, P follows from an implicit equation, which is solved to rounding;
from where P_an reaches P_irr, which is known in closed form, an implicit method of order five
(:mod:`~bwbayes.model.operators.rosenbrock`) takes over, with steps of its own for each model: walls
that are hardly pinned follow P_an within a voltage k that is small against all others.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.model.operators.rosenbrock import (
    BETWEEN,
    COUPLINGS,
    DRIFTS,
    END,
    PLACES,
    SHIFT,
    STAGES,
    WEIGHTS,
)

__all__ = ["Solver", "Walls"]

# Error of a step, in units of the displacement along the stretch.
TOLERANCE = 1e-8

# How much a step may grow or shrink, and what part of the best step is taken.
GROW, SHRINK, SAFE = 5.0, 0.2, 0.9

# The first step of walls that begin to move, as a part of the voltage that they lag behind.
FIRST = 0.1

# Steps are at most the field's scale, or this part of the way to its zero: a longer one could jump
# over the bend of the curve, from saturation to saturation. They are so many notches to an octave:
# on a grid what is rounding in an estimated error does not grow from step to step.
NOTCHES = 4
FARTHEST = 0.25

# Closer to saturation than this the field at which P_an reaches P_irr is not sharp; walls are
# followed from a smaller one on, and do not move before it.
SATURATED = 1 - 1e-6

# Newton's method has converged when a step is below this part of the field's scale.
CONVERGED, ROUNDS = 1e-15, 200


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


class Solver(ABC):
    """Pinned walls behind an anhysteretic curve L, L(±∞) = ±1, that is steepest at zero."""

    @property
    @abstractmethod
    def slope_at_zero(self) -> float:
        """L′(0)."""

    @abstractmethod
    def curve(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return L and L′ at fields in units of E₀, of any shape."""

    @abstractmethod
    def bend(self, y: FloatArray, level: FloatArray, slope: FloatArray) -> FloatArray:
        """Return L″ at fields at which :meth:`curve` is known."""

    @abstractmethod
    def field_at(self, level: FloatArray) -> FloatArray:
        """Return the field in units of E₀ at which L is ``level``, between −1 and 1."""

    def rise(self, walls: Walls, fixed: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return P (models, points - 1) along rising voltages (points,), and P_irr at the end.

        ``fixed`` is P_irr (models,) at the first.
        """
        # From where P_an reaches P_irr, walls move forward until the voltage turns.
        level = np.clip(fixed / walls.saturation, -SATURATED, SATURATED)
        free = walls.field * self.field_at(level) - walls.coupling * fixed
        since = np.maximum(free, u[0])
        resting = int(np.searchsorted(u, np.max(since, initial=u[0]), side="right"))
        along = np.empty((fixed.size, u.size))
        along[:, :resting] = self.at_rest(
            walls.columns(), fixed[:, np.newaxis], u[np.newaxis, :resting]
        )
        moving = np.flatnonzero(since < u[-1])
        if moving.size == 0:
            return along[:, 1:], fixed
        movers = walls.rows(moving)
        path, begin = along[moving], since[moving]
        start = self.at_rest(movers, fixed[moving], begin)
        end = self._move(movers, begin, start, u, path)
        along[moving] = path
        after = fixed.copy()
        after[moving] = self._irreversible(movers, end, float(u[-1]))
        return along[:, 1:], after

    def at_rest(self, walls: Walls, fixed: FloatArray, u: FloatArray) -> FloatArray:
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
        """Return f = dP/du (models,) while walls move forward under a rising voltage."""
        ws, e0, a, k, c, lag_limit, _ = walls
        level, slope = self.curve((u + a * p) / e0)
        behind = np.clip((ws * level - p) / (1 - c), 0.0, lag_limit)
        slope = slope * ws / e0
        forward: FloatArray = (c * slope + (1 - c) * behind / (k - a * behind)) / (
            1 - a * c * slope
        )
        return forward

    def _slopes(
        self, walls: Walls, u: FloatArray, p: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return f, f_u and f_p (models,)."""
        ws, e0, a, k, c, lag_limit, _ = walls
        y = (u + a * p) / e0
        level, slope = self.curve(y)
        bend = self.bend(y, level, slope) * ws / e0**2
        behind = np.clip((ws * level - p) / (1 - c), 0.0, lag_limit)
        slope = slope * ws / e0
        feedback, moving = 1 - a * c * slope, k - a * behind
        forward = (c * slope + (1 - c) * behind / moving) / feedback
        # How f grows as walls lag further behind P_an.
        pull = k / (moving**2 * feedback)
        along = c * (1 + a * forward) / feedback * bend + pull * slope
        return forward, along, a * along - pull

    def _move(
        self,
        walls: Walls,
        u: FloatArray,
        p: FloatArray,
        points: FloatArray,
        along: FloatArray,
    ) -> FloatArray:
        """Let walls move from voltages u and displacements p (models,) to the last point.

        Fills in P ``along`` (models, points) after u, and returns the last. Every model has its own
        steps, so that it does not depend on the others.
        """
        u, p, end = u.copy(), p.copy(), points[-1]
        scale = TOLERANCE * np.minimum(walls.saturation, walls.slope * (end - u))
        step = FIRST * (walls.pinning - walls.coupling * walls.lag)
        rows = np.arange(u.size)
        while rows.size:
            subset = walls.rows(rows)
            at, now = u[rows], p[rows]
            away = np.abs(at + subset.coupling * now) / (1 + subset.coupling * subset.slope)
            largest = np.maximum(FARTHEST * away / subset.field, 1.0)
            notch = np.floor(NOTCHES * np.log2(np.minimum(step[rows] / subset.field, largest)))
            best = subset.field * np.exp2(notch / NOTCHES)
            last = best >= end - at
            h = np.where(last, end - at, best)
            slope, drift, jacobian = self._slopes(subset, at, now)
            shifted, stages = 1 / (SHIFT * h) - jacobian, list[FloatArray]()
            for stage in range(STAGES):
                if stage > 0:
                    near = now + _weighted(WEIGHTS[stage], stages)
                    slope = self._slope(subset, at + PLACES[stage] * h, near)
                coupled = _weighted(COUPLINGS[stage], stages) / h
                stages.append((slope + DRIFTS[stage] * h * drift + coupled) / shifted)
            change = _weighted(END, stages)
            inner = [_weighted(weights, stages) for weights in BETWEEN]
            # In between it is as good as the slope in the middle says that it is.
            midpoint = now + 0.5 * change + 0.25 * (inner[0] + 0.5 * (inner[1] + 0.5 * inner[2]))
            off = (
                self._slope(subset, at + 0.5 * h, midpoint)
                - (change + 0.25 * (inner[1] + inner[2])) / h
            )
            error = np.maximum(np.abs(stages[-1]), np.abs(off / shifted)) / scale[rows]
            good = error <= 1
            with np.errstate(divide="ignore"):
                step[rows] = h * np.clip(SAFE * error**-0.2, SHRINK, GROW)
            done, arrived = rows[good], np.where(last, end, at + h)
            u[done], p[done] = arrived[good], (now + change)[good]
            terms = [term[good] for term in (change, *inner)]
            _fill(along, points, done, at[good], arrived[good], now[good], terms)
            rows = rows[~(good & last)]
        return p


def _weighted(weights: FloatArray, stages: list[FloatArray]) -> FloatArray:
    """Return the weighted sum of stages (models,), term by term, so that no row sees another."""
    total = np.zeros(())
    for weight, stage in zip(weights, stages, strict=False):
        total = total + weight * stage
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
    fraction = (points[column] - first[which]) / (last - first)[which]
    change, *inner = (term[which] for term in terms)
    between = (1 - fraction) * (inner[0] + fraction * (inner[1] + fraction * inner[2]))
    along[rows[which], column] = start[which] + fraction * (change + between)
