"""Steps of hysteresis that is bent in other ways than plain n = 1 Bouc-Wen loops are.

Loops that are not symmetric, that grow with the voltage, or whose transition is smoother than
exponential: each still goes from one voltage straight to another in a bounded time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from scipy.special import digamma

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.model.elementwise import anywhere, look_up, select
from bwbayes.model.exponent import ExponentFlow
from bwbayes.model.inverse.steps import Gone, OneStateStep, not_zero, relaxed
from bwbayes.model.operator import Span
from bwbayes.model.operators.duhem import phi_functions

__all__ = ["AsymmetricStep", "DuhemStep", "PowerStep", "clock", "find_cell", "height_at"]

# Voltages at which a slope is looked at.
LOOKED = 1001

# Rounds at most in which a power's h is found: some of Newton's, of which it needs a few, and
# should they not do, bisection.
POWER_ROUNDS = (20, 60)

# A search ends when it moves h by less than this part of what it may have become.
CLOSE = 1e-15

# Stands for a rate of zero times a range of voltages.
SLOW = 1e-6

# Stands for a rate of zero, beside the others.
SMALL = 1e-30

# Where the table begins among the numbers of a power's step; rounds of Newton's rule in a cell.
TABLE, NEWTON_ROUNDS = 7, 4

# By so much of itself h may be above its ceiling.
ROUNDED = 1e-9

EPSILON = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class AsymmetricStep(OneStateStep):
    """w = d u − h with asymmetric n = 1 Bouc-Wen hysteresis, in closed form.

    It is :class:`~bwbayes.model.operators.bouc_wen_asymmetric.BoucWenAsymmetric`.
    Where the voltage goes in direction s and has the sign x it is n = 1 Bouc-Wen hysteresis with
    rates c of its own; a step across zero volts is two.

    Parameters
    ----------
    d, alpha
        (models,), um/V.
    against, ahead
        c = β′ − γ′ and c = β′ + γ′, 1/V, (2, 2, models): for s and x of −1 and 1.
    """

    d: FloatArray
    alpha: FloatArray
    against: FloatArray
    ahead: FloatArray

    @cached_property
    def parameters(self) -> FloatArray:
        """d, α, and the rates c below zero and above, by s and x, not exactly zero."""
        models = self.d.size
        rates = [not_zero(c).reshape(-1, models) for c in (self.against, self.ahead)]
        return np.vstack([self.d, self.alpha, *rates]).T

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return d u − h and its slope d − α + c g."""
        d, alpha = parameters[0], parameters[1]
        up = voltage >= memory[0]
        s = select(up, 1.0, -1.0)
        start, travel = s * memory[0], np.abs(voltage - memory[0])
        early = np.minimum(np.maximum(-start, 0.0), travel)
        # Towards zero volts first, where s x = −1; then away from them.
        g, slow = s * memory[1], 0.0 * s
        if anywhere(start < 0.0):
            against = select(up, parameters[4], parameters[3])
            ahead = select(up, parameters[8], parameters[7])
            g, slow = relaxed(g, early, alpha, against, ahead)
        against = select(up, parameters[5], parameters[2])
        ahead = select(up, parameters[9], parameters[6])
        g, rate = relaxed(g, travel - early, alpha, against, ahead)
        rate = select((start < 0.0) & (travel <= -start), slow, rate)
        after[0], after[1] = voltage, s * g
        return d * voltage - s * g, d - alpha + rate * g

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:  # noqa: ARG002  # anywhere
        """Return d − α + c g at the ceilings: h is steepest just after a turn."""
        tops = self.alpha / not_zero(self.ahead.min(axis=1))
        least = [
            self.alpha + np.maximum(self.against[s, x], 0.0) * tops[1 - s]
            for s, x in product((0, 1), repeat=2)
        ]
        most = [self.ahead[s, x] * tops[s] - self.alpha for s, x in product((0, 1), repeat=2)]
        return self.d - np.max(least, axis=0), self.d + np.max(most, axis=0)

    def coefficients(self) -> dict[str, Any]:
        """Return d, α and the rates c by direction and sign."""
        against, ahead = self.parameters[0, 2:].reshape(2, 2, 2).tolist()
        numbers = {"d": float(self.d[0]), "alpha": float(self.alpha[0])}
        return {"kind": "asymmetric", **numbers, "against": against, "ahead": ahead}


@dataclass(frozen=True)
class DuhemStep(OneStateStep):
    """w = f(u) − h with Duhem hysteresis, exact.

    It is :class:`~bwbayes.model.operators.duhem.Duhem`. Along a step of direction
    s, with v = |u − u₀| and s α(u₀ + s v) = Σ p_k v^k, it is
    h = h₀ exp(−β v) + Σ k! p_k v^(k+1) φ_(k+1)(−β v). Without α it is linear.

    Parameters
    ----------
    d, curve
        d, um/V, and d₂, d₃, um/V² and um/V³, (models,) and (2, models).
    strength
        α, α₁ and α₂, um/V, um/V² and um/V³, (3, models).
    beta
        (models,), 1/V.
    """

    d: FloatArray
    curve: FloatArray
    strength: FloatArray
    beta: FloatArray

    @cached_property
    def parameters(self) -> FloatArray:
        """d, d₂, d₃, α, α₁, α₂ and β."""
        return np.stack([self.d, *self.curve, *self.strength, self.beta], axis=1)

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return f(u) − h and its slope f′ − α(u) + s β h."""
        d, d2, d3 = parameters[0], parameters[1], parameters[2]
        alpha, alpha1, alpha2, beta = parameters[3], parameters[4], parameters[5], parameters[6]
        start, h = memory[0], memory[1]
        s = select(voltage < start, -1.0, 1.0)
        v = s * (voltage - start)
        one, two, three = phi_functions(beta * v)
        tilt = alpha1 + 2 * start * alpha2
        step = v * (tilt * two + v * (2 * s * alpha2 * three))
        strength = alpha + start * (alpha1 + start * alpha2)
        h = h + v * ((s * strength - beta * h) * one + step)
        after[0], after[1] = voltage, h
        slope = d + voltage * (2 * d2 + 3 * voltage * d3)
        slope = slope - (alpha + voltage * (alpha1 + voltage * alpha2)) + s * beta * h
        return voltage * (d + voltage * (d2 + voltage * d3)) - h, slope

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return f′ − α(u) ∓ β h, with h on the loop over all of the limits: none is larger."""
        low, high = limits
        beta = np.maximum(self.beta, SLOW / (high - low))
        alike = replace(self, beta=beta)
        kept = np.exp(-beta * (high - low))

        def swept(start: float, end: float, h: FloatArray) -> Gone:
            return alike.go(np.stack([np.full_like(h, start), h], 1), np.full_like(h, end))

        nothing = np.zeros_like(beta)
        rise, fall = (swept(*ends, nothing).memory[:, 1] for ends in ((low, high), (high, low)))
        at_high = (kept * fall + rise) / (1 - kept**2)
        at_low = kept * at_high + fall
        least, most = np.full_like(beta, np.inf), np.full_like(beta, -np.inf)
        for u in np.linspace(low, high, LOOKED):
            up, down = swept(low, u, at_low), swept(high, u, at_high)
            h = np.maximum(up.memory[:, 1], -down.memory[:, 1])
            # Without any h it is f′ − α.
            slope = swept(u, u, nothing).slope
            least = np.minimum(least, slope - self.beta * h)
            most = np.maximum(most, slope + self.beta * h)
        return least, most

    def coefficients(self) -> dict[str, Any]:
        """Return the coefficients of f and α, and β."""
        names = ("d2", "d3", "alpha", "alpha1", "alpha2")
        rows = zip(names, (*self.curve, *self.strength), strict=True)
        numbers = {name: float(values[0]) for name, values in rows}
        return {"kind": "duhem", "d": float(self.d[0]), **numbers, "beta": float(self.beta[0])}


@dataclass(frozen=True)
class PowerStep(OneStateStep):
    """w = d u − h with Bouc-Wen hysteresis h of any exponent n ≥ 1.

    Along a step of direction s, g = s h follows dg/dv = α − c gⁿ with c = β + γ from zero on; below
    zero −g follows the same with c = γ − β, backwards. In units of the ceiling it is on a curve
    that depends on n alone (:class:`~bwbayes.model.exponent.ExponentFlow`), whose time is looked up
    in a table; a step adds to that time, and the table says which g is there.

    Parameters
    ----------
    d, alpha, beta, gamma, exponent
        (models,), um/V, um/V, um^(1−n)/V, um^(1−n)/V, and without unit.
    """

    d: FloatArray
    alpha: FloatArray
    beta: FloatArray
    gamma: FloatArray
    exponent: FloatArray

    @cached_property
    def rates(self) -> tuple[FloatArray, FloatArray]:
        """C over α for g below zero and above."""
        return (self.gamma - self.beta) / self.alpha, (self.beta + self.gamma) / self.alpha

    @cached_property
    def ceiling(self) -> FloatArray:
        """Largest |h|, (α / (β + γ))^(1/n), um; infinite where there is none."""
        with np.errstate(divide="ignore", over="ignore"):
            return np.asarray((1 / self.rates[1]) ** (1 / self.exponent))

    @cached_property
    def parameters(self) -> FloatArray:
        """d, α, c/α, scales and rates below zero and above, n, and the curves' table."""
        flow = ExponentFlow(self.alpha, self.beta, self.gamma, self.exponent)
        numbers = self.d, self.alpha, *self.rates, *flow.scales, self.exponent
        return np.column_stack([*numbers, flow.table().reshape(self.d.size, -1)])

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return d u − h and its slope d − α + c gⁿ."""
        d, alpha, n = parameters[0], parameters[1], parameters[6]
        s = select(voltage < memory[0], -1.0, 1.0)
        g = s * memory[1]
        scale = select(g < 0.0, parameters[4], parameters[5])
        time = clock(parameters, g < 0.0, np.abs(g) / scale) * scale / alpha
        time = select(g < 0.0, -time, time) + np.abs(voltage - memory[0])
        scale = select(time < 0.0, parameters[4], parameters[5])
        height = scale * height_at(parameters, time < 0.0, np.abs(time) * alpha / scale)
        h = s * select(time < 0.0, -height, height)
        after[0], after[1] = voltage, h
        x = select(time < 0.0, parameters[2], parameters[3]) * height**n
        return d * voltage - h, d - alpha * (1 - x)

    def holds(self, memory: FloatArray) -> BoolArray:
        """Tell which models' h is not above the ceiling, from where it would come down."""
        return np.asarray(np.abs(memory[:, 1]) <= self.ceiling * (1 + ROUNDED))

    def _x(self, g: FloatArray) -> FloatArray:
        """Return x with the sign that 1 − x = h′/α asks for, (models,)."""
        below, above = self.rates
        return np.where(g < 0, below, above) * np.abs(g) ** self.exponent

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return d − max(α, 2 α β / (β + γ)) and d: h is steepest just after a turn."""
        top = np.minimum(self.ceiling, self.alpha * (limits.high - limits.low))
        turned = self.alpha * np.maximum(1 - self._x(-top), 1.0)
        return self.d - turned, self.d

    def coefficients(self) -> dict[str, Any]:
        """Return the parameters, and what a program needs to sum F(x)."""
        n = float(self.exponent[0])
        below, above = (float(rate[0]) for rate in self.rates)
        # A rate of zero has no ceiling; this is far beyond all voltages.
        above = max(above, SMALL)
        lowest = min(below / above, 0.0)
        # Of a sum over (x/(x − 1))^k, as many terms as the lowest x that is ever reached asks for.
        terms = np.log(EPSILON / 4) / np.log(min(max(lowest / (lowest - 1), 0.5), 1 - 1e-3))
        return {
            "kind": "power",
            "d": float(self.d[0]),
            "alpha": float(self.alpha[0]),
            "below": below,
            "above": above,
            "exponent": n,
            "level": float(digamma(1.0) - digamma(1 / n)),
            "terms": int(np.ceil(terms)),
            "rounds": POWER_ROUNDS,
            "close": CLOSE,
            "ceiling": above ** (-1 / n),
        }


def clock(parameters: Any, below: Any, height: Any) -> Any:
    """Return the time at which the curve below zero, or above, is at a height."""
    cells = (len(parameters) - TABLE) // 24
    cell = find_cell(parameters, below, 1, height)
    start, width = look_up(parameters, cell + 2 * cells), look_up(parameters, cell + 3 * cells)
    low = look_up(parameters, cell + 4 * cells)
    ends = 0.0 * low
    for order in range(1, 8):
        ends = ends + look_up(parameters, cell + (4 + order) * cells)
    part = (height - low) / select(ends == 0.0, 1.0, ends)
    for _ in range(NEWTON_ROUNDS):
        part = np.minimum(np.maximum(part, 0.0), 1.0)
        value, slope = 0.0 * low, 0.0 * low
        for order in range(7, -1, -1):
            slope = slope * part + value
            value = value * part + look_up(parameters, cell + (4 + order) * cells)
        part = part - (value - height) / select(slope == 0.0, 1.0, slope)
    return start + width * np.minimum(np.maximum(part, 0.0), 1.0)


def height_at(parameters: Any, below: Any, time: Any) -> Any:
    """Return the height at which the curve below zero, or above, is at a time."""
    cells = (len(parameters) - TABLE) // 24
    cell = find_cell(parameters, below, 0, time)
    part = (time - look_up(parameters, cell + 2 * cells)) / look_up(parameters, cell + 3 * cells)
    part, value = np.minimum(np.maximum(part, 0.0), 1.0), 0.0 * time
    for order in range(7, -1, -1):
        value = value * part + look_up(parameters, cell + (4 + order) * cells)
    return value


def find_cell(parameters: Any, below: Any, row: int, value: Any) -> Any:
    """Return where the cell of a curve begins in whose range a value of the row lies."""
    cells = (len(parameters) - TABLE) // 24
    first = select(below, 1.0 * TABLE + 12 * cells, 1.0 * TABLE)
    cell, half = first, cells // 2
    while half > 0:
        later = cell + half
        cell = select(look_up(parameters, later + row * cells) <= value, later, cell)
        half //= 2
    return cell
