"""Which operators have a step of bounded time, which step it is, and the drive with their gain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.declaration import Values
from bwbayes.model.gain import TERMS, PolynomialGain
from bwbayes.model.inverse.curved_steps import AsymmetricStep, DuhemStep, PowerStep
from bwbayes.model.inverse.steps import Gone, HysteresisStep, LinearStep, PlaysStep
from bwbayes.model.operator import Operator
from bwbayes.model.operators.backlash_like import BacklashLike
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.bouc_wen_asymmetric import SIGNS, BoucWenAsymmetric, rates
from bwbayes.model.operators.duhem import Duhem
from bwbayes.model.operators.maxwell_slip import MaxwellSlip
from bwbayes.model.operators.no_hysteresis import NoHysteresis
from bwbayes.model.operators.prandtl_ishlinskii import Plays, threshold_volts

__all__ = ["STEPPED", "DriveStep", "has_step", "step_of"]

# Names, as a config has them, of the operators that have a step.
STEPPED = (
    "linear",
    "bouc-wen",
    "bouc-wen-asymmetric",
    "backlash-like",
    "duhem",
    "plays",
    "maxwell-slip",
)


@dataclass(frozen=True)
class DriveStep:
    """Hysteresis and polynomial gain together, each model with a voltage of its own.

    Parameters
    ----------
    step
        The hysteresis.
    gain
        What is added to it, or None.
    column
        The gain's coefficients (models,), um, by name.
    """

    step: HysteresisStep
    gain: PolynomialGain | None
    column: Values

    def go(self, memory: FloatArray, voltage: FloatArray) -> Gone:
        """Return the drive, its slope and the memory once voltages (models,) have gone there."""
        w, slope, after = self.step.go(memory, voltage)
        if self.gain is None:
            return Gone(w, slope, after)
        x = self.gain.scaled(voltage)
        for name in self.gain.terms:
            w = w + self.column[name] * x ** TERMS[name].power
        return Gone(w, slope + self.added_slope(voltage), after)

    def added_slope(self, voltage: FloatArray) -> FloatArray:
        """Return the gain's own slope, um/V, at voltages (models,) or (any, 1)."""
        added = np.zeros(np.broadcast_shapes(voltage.shape, self.column["offset"].shape))
        if self.gain is None or not self.gain.reference.half > 0:
            return added
        x = self.gain.scaled(voltage)
        for name in self.gain.terms:
            power = TERMS[name].power
            added += self.column[name] * power * x ** (power - 1) / self.gain.reference.half
        return added


def has_step(operator: Operator) -> bool:
    """Tell whether an operator has a step of bounded time."""
    kinds = BoucWen, BacklashLike, BoucWenAsymmetric, Duhem, NoHysteresis, Plays, MaxwellSlip
    return isinstance(operator, kinds)


def step_of(operator: Operator, column: Values) -> HysteresisStep:
    """Return the step of an operator, for models given by their columns (models,).

    Raises
    ------
    InputError
        The operator has no step of bounded time; the text says which have.
    """
    step: HysteresisStep
    match operator:
        case BoucWen():
            step = _bouc_wen(column)
        case BacklashLike():
            step = _bouc_wen({"gamma": np.zeros_like(column["d"]), **column})
        case BoucWenAsymmetric():
            step = _asymmetric(column)
        case Duhem() | NoHysteresis():
            step = _duhem(column)
        case Plays():
            step = _plays(operator.thresholds, "weight", column, held=0.0)
        case MaxwellSlip():
            step = _plays(operator.thresholds, "alpha", column, held=1.0)
        case _:
            raise InputError(
                f"hysteresis: {type(operator).__name__} has no step of bounded time for a "
                f"controller; those that have one are {', '.join(STEPPED)}"
            )
    return step


def _bouc_wen(column: Values) -> LinearStep | PowerStep:
    d, alpha, beta, gamma = (column[name] for name in ("d", "alpha", "beta", "gamma"))
    exponent = column.get("exponent", np.ones_like(d))
    if np.all(exponent == 1.0):
        return LinearStep(d, alpha, beta, gamma)
    return PowerStep(d, alpha, beta, gamma, exponent)


def _asymmetric(column: Values) -> AsymmetricStep:
    """Return the rates for either direction of the voltage, and either sign of it."""
    pairs = [rates(column, s, x) for s, x in product(reversed(SIGNS), repeat=2)]
    models = column["d"].size
    against, ahead = (
        np.array([np.broadcast_to(slow + part * fast, models) for slow, fast in pairs])
        for part in (-1.0, 1.0)
    )
    shape = (2, 2, models)
    return AsymmetricStep(
        column["d"], column["alpha"], against.reshape(shape), ahead.reshape(shape)
    )


def _duhem(column: Values) -> DuhemStep:
    """Return Duhem loops; what has no column, as all of the hysteresis may have none, is zero."""
    names = ("d2", "d3", "alpha", "alpha1", "alpha2", "beta")
    *curve, rate = (column.get(name, np.zeros_like(column["d"])) for name in names)
    return DuhemStep(column["d"], np.stack(curve[:2]), np.stack(curve[2:]), rate)


def _plays(
    thresholds: int | tuple[float, ...], name: str, column: Mapping[str, FloatArray], held: float
) -> PlaysStep:
    """Return plays; what the elements hold back of d, or a part of it, is not in their slope."""
    volts = threshold_volts(thresholds, column)
    weights = np.stack([column[f"{name}_{j + 1}"] for j in range(volts.shape[1])], axis=1)
    return PlaysStep(column["d"] - held * weights.sum(axis=1), weights, volts)
