"""Hysteresis a sample at a time, each model with a voltage of its own.

A simulation gives all models one voltage that is known beforehand. In a closed loop, and read
backwards, each has its own, and the next one hangs on what the last one did. Here an operator says
what its displacement would be if the voltage went straight from where it stands to somewhere else,
and how steep it is there. That takes a bounded time, whatever was before; operators whose memory
grows with the voltage's past, or that are integrated, have no such step, and are refused.

A step's ``move`` is written once, for numbers and for arrays: with rows of arrays (models,) NumPy
moves all models of a closed loop at once, and compiled with numbers it moves one model after the
other (:mod:`bwbayes.model.inverse.compiled`), from which any such operator is read backwards. So it
is made of what :mod:`bwbayes.model.elementwise` says.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.model.elementwise import anywhere, select
from bwbayes.model.operator import Span

__all__ = [
    "Gone",
    "HysteresisStep",
    "LinearStep",
    "OneStateStep",
    "PlaysStep",
    "not_zero",
    "phi",
    "relaxed",
]

# Stands for a rate of exactly zero: (1 - exp(-c v)) / c is v to machine precision at this c.
TINY = 1e-100

# φ(z) = Σ (−z)^k / (k + 1)!, up to so large a z to rounding.
SHORT = 0.1
C0, C1, C2, C3, C4, C5, C6, C7, C8 = ((-1.0) ** k / math.factorial(k + 1) for k in range(9))


class Gone(NamedTuple):
    """What is once a voltage has gone there: w (models,), um, dw/du (models,), and the memory."""

    w: FloatArray
    slope: FloatArray
    memory: FloatArray


class HysteresisStep(ABC):
    """A hysteresis operator w = Γ[u] that goes from one voltage (models,) straight to the next.

    Voltages are in V, displacements in um, slopes in um/V, all (models,). What it remembers is an
    array (models, any).
    """

    @property
    @abstractmethod
    def parameters(self) -> FloatArray:
        """What ``move`` needs to know of the models, (models, any)."""

    @staticmethod
    @abstractmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return w and dw/du once the voltage has gone there, and write the memory ``after`` it.

        Of one model, whose parameters and memory are numbers in a row, or of all, (any, models).
        """

    @abstractmethod
    def demagnetised(self) -> FloatArray:
        """Return the memory of a demagnetised actuator at zero volts."""

    @abstractmethod
    def remembered(self, memory: Any) -> FloatArray:
        """Return the memory (models, any) of what the operator itself remembers."""

    @abstractmethod
    def begun(self, voltage: FloatArray, initial: FloatArray, span: Span) -> FloatArray:
        """Return the memory (models, any) of models that start at voltages (models,), V.

        In the states that the ``initial`` ones (models,) say, within a span of earlier voltages.
        """

    @abstractmethod
    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return bounds of dw/du that hold on every path from the demagnetised state.

        The path keeps within limits, V.
        """

    @abstractmethod
    def coefficients(self) -> dict[str, Any]:
        """Return what a program needs to know of the first model: its ``kind`` and numbers."""

    def holds(self, memory: FloatArray) -> BoolArray:
        """Tell which models (models,) the step is for, where they stand; by default all."""
        return np.ones(len(memory), dtype=np.bool_)

    def go(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return what is once the voltage has gone there; the memory that is given stays."""
        after = np.empty_like(memory)
        return Gone(*self.move(self.parameters.T, memory.T, voltage, after.T), after)


class OneStateStep(HysteresisStep):
    """A step that remembers the voltage and one displacement h, (models, 2)."""

    d: FloatArray

    def demagnetised(self) -> FloatArray:
        """Return zero volts and h = 0."""
        return np.zeros((self.d.size, 2))

    def remembered(self, memory: Any) -> FloatArray:
        """Return voltage and h."""
        return np.stack(np.broadcast_arrays(memory.voltage, memory.state), 1).astype(np.float64)

    def begun(self, voltage: FloatArray, initial: FloatArray, span: Span) -> FloatArray:  # noqa: ARG002  # the state says all of the past
        """Return voltage and h."""
        return np.stack([voltage, initial], axis=1)


@dataclass(frozen=True)
class LinearStep(OneStateStep):
    """w = d u − h with n = 1 Bouc-Wen hysteresis h, in closed form.

    Along a step of direction s, with v = |u − u₀| and g = s h, equation (6) of the paper is linear
    on either side of zero, dg/dv = α − c g with c = β − γ for g < 0 and c = β + γ above.

    Parameters
    ----------
    d, alpha
        (models,), um/V.
    beta, gamma
        (models,), 1/V.
    """

    d: FloatArray
    alpha: FloatArray
    beta: FloatArray
    gamma: FloatArray

    @cached_property
    def parameters(self) -> FloatArray:
        """d, α, and the rates c below zero and above, not exactly zero."""
        rates = not_zero(self.beta - self.gamma), not_zero(self.beta + self.gamma)
        return np.stack([self.d, self.alpha, *rates], axis=1)

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return d u − h and its slope d − α + c g."""
        d, alpha = parameters[0], parameters[1]
        direction = select(voltage < memory[0], -1.0, 1.0)
        travel = np.abs(voltage - memory[0])
        g, rate = relaxed(direction * memory[1], travel, alpha, parameters[2], parameters[3])
        after[0], after[1] = voltage, direction * g
        return d * voltage - direction * g, d - alpha + rate * g

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:  # noqa: ARG002  # anywhere
        """Return d − max(α, 2 α β / (β + γ)) and d: h is steepest just after a turn."""
        with np.errstate(divide="ignore", invalid="ignore"):
            turned = 2 * self.alpha * self.beta / (self.beta + self.gamma)
        turned = np.where(self.beta == 0, self.alpha, turned)
        return self.d - np.maximum(self.alpha, turned), self.d

    def coefficients(self) -> dict[str, Any]:
        """Return d, α and the two rates c."""
        names = ("d", "alpha", "against", "ahead")
        numbers = dict(zip(names, self.parameters[0].tolist(), strict=True))
        return {"kind": "linear", **numbers}


@dataclass(frozen=True)
class PlaysStep(HysteresisStep):
    """w = d u + Σ w_j z_j with plays z_j = max(u − r_j, min(u + r_j, z_j)); the memory are these.

    Parameters
    ----------
    slope
        d, (models,), um/V.
    weights
        w_j, (models, plays), um/V.
    thresholds
        r_j, (models or 1, plays), V.
    """

    slope: FloatArray
    weights: FloatArray
    thresholds: FloatArray

    @cached_property
    def parameters(self) -> FloatArray:
        """d, all weights, and all thresholds."""
        volts = np.broadcast_to(self.thresholds, self.weights.shape)
        return np.column_stack([self.slope, self.weights, volts])

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return w, and the slope d + Σ w_j of those plays that are moved."""
        slope, plays = parameters[0], len(memory)
        w = slope * voltage
        for j in range(plays):
            weight, threshold = parameters[1 + j], parameters[1 + plays + j]
            play = np.maximum(voltage - threshold, np.minimum(voltage + threshold, memory[j]))
            slope = slope + select(play != memory[j], weight, 0.0)
            w = w + weight * play
            after[j] = play
        return w, slope

    def demagnetised(self) -> FloatArray:
        """Return all plays at zero, (models, plays)."""
        return np.zeros_like(self.weights)

    def remembered(self, memory: Any) -> FloatArray:
        """Return where the extrema that count, and the voltage, have left the plays."""
        ends = [one.voltage if one.own is None else one.own for one in memory.extrema]
        return self._led(*ends, memory.voltage)

    def begun(self, voltage: FloatArray, initial: FloatArray, span: Span) -> FloatArray:
        """Return the plays after a drive through the span, as the operators begin."""
        low, high = np.minimum(span.low, voltage), np.maximum(span.high, voltage)
        return self._led(high, low, voltage + (initial + 1) / 2 * (high - voltage), voltage)

    def _led(self, *ends: float | FloatArray) -> FloatArray:
        """Return where a voltage that goes to each of its ends leaves demagnetised plays."""
        plays = self.demagnetised()
        for voltage in ends:
            plays = self.go(plays, np.broadcast_to(voltage, self.slope.shape)).memory
        return plays

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:  # noqa: ARG002  # anywhere
        """Return d, and d + Σ w_j."""
        return self.slope, self.slope + self.weights.sum(axis=1)

    def coefficients(self) -> dict[str, Any]:
        """Return d, the weights and the thresholds."""
        return {
            "kind": "plays",
            "d": float(self.slope[0]),
            "weights": self.weights[0].tolist(),
            "thresholds": self.thresholds[0].tolist(),
        }


def relaxed(g: Any, travel: Any, alpha: Any, against: Any, ahead: Any) -> tuple[Any, Any]:
    """Return g = s h after a travel, V, in direction s, and the rate c then.

    dg/dv = α − c g, with the rate c ``against`` for g < 0 and ``ahead`` from there on, 1/V.
    """
    rate = select(g < 0.0, against, ahead)
    reached = g + (alpha - rate * g) * travel * phi(rate * travel)
    passed = (g < 0.0) & (reached > 0.0)
    if anywhere(passed):
        below = select(passed, g, 0.0)
        left = np.maximum(travel - np.log1p(-below * against / alpha) / against, 0.0)
        reached = select(passed, alpha * left * phi(ahead * left), reached)
        rate = select(passed, ahead, rate)
    return reached, rate


def phi(z: Any) -> Any:
    """Return (1 − exp(−z))/z, by its series where z is small."""
    y = z * z
    even = C0 + y * (C2 + y * (C4 + y * (C6 + y * C8)))
    near = even + z * (C1 + y * (C3 + y * (C5 + y * C7)))
    if anywhere(np.abs(z) > SHORT):
        far = select(np.abs(z) > SHORT, z, 1.0)
        return select(np.abs(z) > SHORT, -np.expm1(-far) / far, near)
    return near


def not_zero(rate: FloatArray) -> FloatArray:
    """Return rates of which none is exactly zero."""
    return np.where(np.abs(rate) < TINY, TINY, rate)
