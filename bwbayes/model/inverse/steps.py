"""Hysteresis a sample at a time, each model with a voltage of its own.

A simulation gives all models one voltage that is known beforehand. In a closed loop, and read
backwards, each has its own, and the next one hangs on what the last one did. Here an operator says
what its displacement would be if the voltage went straight from where it stands to somewhere else,
and how steep it is there. That takes a bounded time, whatever was before; operators whose memory
grows with the voltage's past, or that are integrated, have no such step, and are refused.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.operator import Span

__all__ = [
    "Gone",
    "HysteresisStep",
    "LinearStep",
    "PlaysStep",
    "not_zero",
    "of_one_state",
    "relaxed",
]

# Stands for a rate of exactly zero: (1 - exp(-c v)) / c is v to machine precision at this c.
TINY = 1e-100


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

    @abstractmethod
    def demagnetised(self) -> FloatArray:
        """Return the memory of a demagnetised actuator at zero volts."""

    @abstractmethod
    def go(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return what is once the voltage has gone there; the memory that is given stays."""

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


@dataclass(frozen=True)
class LinearStep(HysteresisStep):
    """w = d u − h with n = 1 Bouc-Wen hysteresis h, in closed form.

    Along a step of direction s, with v = |u − u₀| and g = s h, equation (6) of the paper is linear
    on either side of zero, dg/dv = α − c g with c = β − γ for g < 0 and c = β + γ above. The memory
    is the voltage and h.

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

    def demagnetised(self) -> FloatArray:
        """Return zero volts and h = 0, (models, 2)."""
        return np.zeros((self.d.size, 2))

    def remembered(self, memory: Any) -> FloatArray:
        """Return voltage and h."""
        return of_one_state(memory)

    def begun(self, voltage: FloatArray, initial: FloatArray, span: Span) -> FloatArray:  # noqa: ARG002  # the state says all of the past
        """Return voltage and h."""
        return np.stack([voltage, initial], axis=1)

    def go(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return d u − h, its slope d − α + c g, and the voltage with h."""
        direction = np.where(voltage < memory[:, 0], -1.0, 1.0)
        travel = np.abs(voltage - memory[:, 0])
        g, rate = relaxed(direction * memory[:, 1], travel, self.alpha, *self.rates)
        h = direction * g
        slope = self.d - self.alpha + rate * g
        return Gone(self.d * voltage - h, slope, np.stack([voltage, h], axis=1))

    @property
    def rates(self) -> tuple[FloatArray, FloatArray]:
        """The rates c below zero and above, not exactly zero."""
        return not_zero(self.beta - self.gamma), not_zero(self.beta + self.gamma)

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:  # noqa: ARG002  # anywhere
        """Return d − max(α, 2 α β / (β + γ)) and d: h is steepest just after a turn."""
        with np.errstate(divide="ignore", invalid="ignore"):
            turned = 2 * self.alpha * self.beta / (self.beta + self.gamma)
        turned = np.where(self.beta == 0, self.alpha, turned)
        return self.d - np.maximum(self.alpha, turned), self.d

    def coefficients(self) -> dict[str, Any]:
        """Return d, α and the two rates c."""
        against, ahead = self.rates
        numbers = {"d": self.d, "alpha": self.alpha, "against": against, "ahead": ahead}
        return {"kind": "linear"} | {name: float(values[0]) for name, values in numbers.items()}


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

    def demagnetised(self) -> FloatArray:
        """Return all plays at zero, (models, plays)."""
        return np.zeros_like(self.weights)

    def remembered(self, memory: Any) -> FloatArray:
        """Return where the extrema that count, and the voltage, have left the plays."""
        plays = self.demagnetised()
        for one in memory.extrema:
            plays = self._moved(plays, np.array(one.voltage if one.own is None else one.own))
        return self._moved(plays, np.array(memory.voltage))

    def begun(self, voltage: FloatArray, initial: FloatArray, span: Span) -> FloatArray:
        """Return the plays after a drive through the span, as the operators begin."""
        low, high = np.minimum(span.low, voltage), np.maximum(span.high, voltage)
        plays = self.demagnetised()
        for one in (high, low, voltage + (initial + 1) / 2 * (high - voltage), voltage):
            plays = self._moved(plays, one)
        return plays

    def _moved(self, plays: FloatArray, voltage: FloatArray) -> FloatArray:
        target = voltage[..., np.newaxis]
        return np.maximum(target - self.thresholds, np.minimum(target + self.thresholds, plays))

    def go(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return w, the slope d + Σ w_j of those plays that are moved, and all plays."""
        plays = self._moved(memory, voltage)
        carried = np.where(plays != memory, self.weights, 0.0)
        w = self.slope * voltage + np.einsum("mj,mj->m", self.weights, plays)
        return Gone(w, self.slope + carried.sum(axis=1), plays)

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


def relaxed(
    g: FloatArray, travel: FloatArray, alpha: FloatArray, against: FloatArray, ahead: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return g = s h (models,) after a travel (models,), V, in direction s, and the rate c then.

    dg/dv = α − c g, with the rate c ``against`` for g < 0 and ``ahead`` from there on, 1/V.
    """
    below = np.minimum(g, 0.0)
    # The travel to zero; a start above it has none.
    crossing = np.log1p(-below * against / alpha) / against
    early = np.minimum(travel, crossing)
    g = g - (below - alpha / against) * -np.expm1(-against * early)
    g = np.where(travel < crossing, g, np.maximum(g, 0.0))
    late = travel - early
    rate = np.where(travel < crossing, against, ahead)
    return g - (g - alpha / ahead) * -np.expm1(-ahead * late), rate


def not_zero(rate: FloatArray) -> FloatArray:
    """Return rates of which none is exactly zero."""
    return np.where(np.abs(rate) < TINY, TINY, rate)


def of_one_state(memory: Any) -> FloatArray:
    """Return voltage and state (models, 2) of an operator that remembers these alone."""
    return np.stack(np.broadcast_arrays(memory.voltage, memory.state), axis=1).astype(np.float64)
