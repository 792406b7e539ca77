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
from scipy.special import digamma, hyp2f1

from bwbayes.arrays import FloatArray
from bwbayes.model.inverse.steps import Gone, HysteresisStep, not_zero, of_one_state, relaxed
from bwbayes.model.operator import Span
from bwbayes.model.operators.duhem import phi_functions

__all__ = ["POWER_ROUNDS", "AsymmetricStep", "DuhemStep", "PowerStep"]

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

EPSILON = float(np.finfo(np.float64).eps)


class _OneState(HysteresisStep):
    """A step that remembers the voltage and one displacement, (models, 2)."""

    d: FloatArray

    def demagnetised(self) -> FloatArray:
        """Return zero volts and h = 0."""
        return np.zeros((self.d.size, 2))

    def remembered(self, memory: Any) -> FloatArray:
        """Return voltage and h."""
        return of_one_state(memory)

    def begun(self, voltage: FloatArray, initial: FloatArray, span: Span) -> FloatArray:  # noqa: ARG002  # the state says all of the past
        """Return voltage and h."""
        return np.stack([voltage, initial], axis=1)


@dataclass(frozen=True)
class AsymmetricStep(_OneState):
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

    def go(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return d u − h, its slope d − α + c g, and the voltage with h."""
        up = voltage >= memory[:, 0]
        s = np.where(up, 1.0, -1.0)
        start, travel = s * memory[:, 0], np.abs(voltage - memory[:, 0])
        early = np.clip(-start, 0.0, travel)
        # Towards zero volts first, where s x = −1; then away from them.
        before, after = ([np.where(up, c[1, x], c[0, 1 - x]) for c in self.rates] for x in (0, 1))
        g, slow = relaxed(s * memory[:, 1], early, self.alpha, *before)
        g, rate = relaxed(g, travel - early, self.alpha, *after)
        rate = np.where((start < 0) & (travel <= -start), slow, rate)
        h = s * g
        return Gone(self.d * voltage - h, self.d - self.alpha + rate * g, np.stack([voltage, h], 1))

    @property
    def rates(self) -> tuple[FloatArray, FloatArray]:
        """The rates c below zero and above, not exactly zero."""
        return not_zero(self.against), not_zero(self.ahead)

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
        against, ahead = (rate[..., 0].tolist() for rate in self.rates)
        numbers = {"d": float(self.d[0]), "alpha": float(self.alpha[0])}
        return {"kind": "asymmetric", **numbers, "against": against, "ahead": ahead}


@dataclass(frozen=True)
class DuhemStep(_OneState):
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

    def go(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return f(u) − h, its slope f′ − α(u) + s β h, and the voltage with h."""
        start, h = memory.T
        s = np.where(voltage < start, -1.0, 1.0)
        v = s * (voltage - start)
        strength, tilt, half = self._about(start)
        one, two, three = phi_functions(self.beta * v)
        step = v * (tilt * two + v * (2 * s * half * three))
        h = h + v * ((s * strength - self.beta * h) * one + step)
        d2, d3 = self.curve
        w = voltage * (self.d + voltage * (d2 + voltage * d3)) - h
        return Gone(w, self._slope(voltage) + s * self.beta * h, np.stack([voltage, h], axis=1))

    def _about(self, voltage: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return α, α′ and α″/2 at a voltage."""
        first, second, third = self.strength
        return first + voltage * (second + voltage * third), second + 2 * voltage * third, third

    def _slope(self, voltage: FloatArray) -> FloatArray:
        """Return f′ − α(u)."""
        d2, d3 = self.curve
        rise: FloatArray = self.d + voltage * (2 * d2 + 3 * voltage * d3) - self._about(voltage)[0]
        return rise

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return f′ − α(u) ∓ β h, with h on the loop over all of the limits: none is larger."""
        low, high = limits
        beta = np.maximum(self.beta, SLOW / (high - low))
        alike = replace(self, beta=beta)
        kept = np.exp(-beta * (high - low))

        def swept(start: float, end: float, h: FloatArray) -> FloatArray:
            return alike.go(np.stack([np.full_like(h, start), h], 1), np.full_like(h, end)).memory

        nothing = np.zeros_like(beta)
        rise, fall = swept(low, high, nothing)[:, 1], swept(high, low, nothing)[:, 1]
        at_high = (kept * fall + rise) / (1 - kept**2)
        at_low = kept * at_high + fall
        least, most = np.full_like(beta, np.inf), np.full_like(beta, -np.inf)
        for u in np.linspace(low, high, LOOKED):
            h = np.maximum(swept(low, u, at_low)[:, 1], -swept(high, u, at_high)[:, 1])
            slope = self._slope(np.full_like(beta, u))
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
class PowerStep(_OneState):
    """w = d u − h with Bouc-Wen hysteresis h of any exponent n ≥ 1.

    Along a step of direction s, g = s h follows dg/dv = α − c gⁿ with c = β + γ from zero on; below
    zero −g follows the same with c = γ − β, backwards. The voltage from g = 0 on is

        v(g) = (g/α) F(x),   F(x) = ₂F₁(1, 1/n; 1 + 1/n; x),   x = (c/α) gⁿ,

    so that a step adds to v(g), and g is where v(g) then is: Newton's rule between bounds, and
    bisection should that not do.

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

    def go(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return d u − h, its slope d − α + c gⁿ, and the voltage with h."""
        s = np.where(voltage < memory[:, 0], -1.0, 1.0)
        travel = np.abs(voltage - memory[:, 0])
        top = self.ceiling
        g = np.clip(s * memory[:, 1], -top, top)
        g = self._reached(g, travel)
        h = s * g
        slope = self.d - self.alpha * (1 - self._x(g))
        return Gone(self.d * voltage - h, slope, np.stack([voltage, h], axis=1))

    def _x(self, g: FloatArray) -> FloatArray:
        """Return x with the sign that 1 − x = h′/α asks for, (models,)."""
        below, above = self.rates
        return np.where(g < 0, below, above) * np.abs(g) ** self.exponent

    def _clock(self, g: FloatArray) -> FloatArray:
        """Return v(g), V; infinite at the ceiling."""
        part = 1 / self.exponent
        x = np.minimum(self._x(g), 1.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            v = g / self.alpha * hyp2f1(1.0, part, 1 + part, x)
        return np.where(x < 1, v, np.copysign(np.inf, g))

    def _reached(self, start: FloatArray, travel: FloatArray) -> FloatArray:
        """Return g (models,), um, after a travel (models,), V, from a start; a ceiling is kept."""
        until = self._clock(start) + travel
        # Nowhere is it steeper than at its start, or at zero.
        farthest = self.alpha * np.maximum(1 - self._x(start), 1.0) * travel
        low, high = start, np.minimum(self.ceiling, start + farthest)
        close = CLOSE * (np.abs(start) + farthest)
        newton, bisection = POWER_ROUNDS
        g = start
        for done in range(newton + bisection):
            with np.errstate(invalid="ignore"):
                off = self._clock(g) - until
                better = g - off * self.alpha * (1 - self._x(g))
            low, high = np.where(off < 0, g, low), np.where(off < 0, high, g)
            inside = (better >= low) & (better <= high) & (done < newton)
            better = np.where(inside, better, (low + high) / 2)
            moved, g = np.abs(better - g), better
            if np.all(moved <= close):
                break
        return np.where(np.isfinite(until) & (travel > 0), g, start)

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
