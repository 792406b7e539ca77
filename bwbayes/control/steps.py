"""Hysteresis a sample at a time, each model with a voltage of its own, as a controller needs it.

A simulation gives all models one voltage that is known beforehand. In a closed loop each has its
own, and the next one hangs on what the last one did. Here an operator says what its displacement
would be if the voltage went straight from where it stands to somewhere else, and how steep it is
there. That takes a bounded time, whatever was before; operators whose memory grows with the
voltage's past have no such step, and are refused.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.declaration import Values
from bwbayes.model.operator import Operator
from bwbayes.model.operators.backlash_like import BacklashLike
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.maxwell_slip import MaxwellSlip
from bwbayes.model.operators.prandtl_ishlinskii import Plays, threshold_volts

__all__ = ["STEPPED", "Gone", "HysteresisStep", "LinearStep", "PlaysStep", "step_of"]

# Names, as a config has them, of the operators that have a step.
STEPPED = ("bouc-wen with n = 1", "backlash-like", "plays", "maxwell-slip")

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
    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """Return bounds of dw/du that hold on every path from the demagnetised state."""

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

    def go(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return d u − h, its slope d − α + c g, and the voltage with h."""
        direction = np.where(voltage < memory[:, 0], -1.0, 1.0)
        travel = np.abs(voltage - memory[:, 0])
        g = direction * memory[:, 1]
        against, ahead = self._rates
        below = np.minimum(g, 0.0)
        # The travel to zero; a start above it has none.
        crossing = np.log1p(-below * against / self.alpha) / against
        early = np.minimum(travel, crossing)
        g = g - (below - self.alpha / against) * -np.expm1(-against * early)
        g = np.where(travel < crossing, g, np.maximum(g, 0.0))
        late = travel - early
        rate = np.where(travel < crossing, against, ahead)
        g = g - (g - self.alpha / ahead) * -np.expm1(-ahead * late)
        h = direction * g
        slope = self.d - self.alpha + rate * g
        return Gone(self.d * voltage - h, slope, np.stack([voltage, h], axis=1))

    @property
    def _rates(self) -> tuple[FloatArray, FloatArray]:
        """The rates c below zero and above, not exactly zero."""
        rates = self.beta - self.gamma, self.beta + self.gamma
        against, ahead = (np.where(np.abs(rate) < TINY, TINY, rate) for rate in rates)
        return against, ahead

    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """Return d − max(α, 2 α β / (β + γ)) and d: h is steepest just after a turn."""
        with np.errstate(divide="ignore", invalid="ignore"):
            turned = 2 * self.alpha * self.beta / (self.beta + self.gamma)
        turned = np.where(self.beta == 0, self.alpha, turned)
        return self.d - np.maximum(self.alpha, turned), self.d

    def coefficients(self) -> dict[str, Any]:
        """Return d, α and the two rates c."""
        against, ahead = self._rates
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

    def go(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return w, the slope d + Σ w_j of those plays that are moved, and all plays."""
        target = voltage[:, np.newaxis]
        plays = np.maximum(target - self.thresholds, np.minimum(target + self.thresholds, memory))
        carried = np.where(plays != memory, self.weights, 0.0)
        w = self.slope * voltage + np.einsum("mj,mj->m", self.weights, plays)
        return Gone(w, self.slope + carried.sum(axis=1), plays)

    def slopes(self) -> tuple[FloatArray, FloatArray]:
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


def step_of(operator: Operator, column: Values) -> HysteresisStep:
    """Return the step of an operator, for models given by their columns (models,).

    Raises
    ------
    InputError
        The operator has no step of bounded time; the text says which have.
    """
    match operator:
        case BoucWen():
            if np.any(column["exponent"] != 1.0):
                raise _refused("bouc-wen with another exponent than 1")
            return LinearStep(*(column[name] for name in ("d", "alpha", "beta", "gamma")))
        case BacklashLike():
            d, alpha, beta = (column[name] for name in ("d", "alpha", "beta"))
            return LinearStep(d, alpha, beta, np.zeros_like(beta))
        case Plays():
            return _plays(operator.thresholds, "weight", column, held=0.0)
        case MaxwellSlip():
            return _plays(operator.thresholds, "alpha", column, held=1.0)
    raise _refused(type(operator).__name__)


def _plays(
    thresholds: int | tuple[float, ...], name: str, column: Mapping[str, FloatArray], held: float
) -> PlaysStep:
    """Return plays; what the elements hold back of d, or a part of it, is not in their slope."""
    volts = threshold_volts(thresholds, column)
    weights = np.stack([column[f"{name}_{j + 1}"] for j in range(volts.shape[1])], axis=1)
    return PlaysStep(column["d"] - held * weights.sum(axis=1), weights, volts)


def _refused(what: str) -> InputError:
    return InputError(
        f"hysteresis: {what} has no step of bounded time for a controller; those that have one "
        f"are {', '.join(STEPPED)}"
    )
