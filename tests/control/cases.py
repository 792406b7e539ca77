"""Actuators with every part that has a step, their parameters, and voltages to drive them."""

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.loop import LoopNoise
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Hold, Span
from bwbayes.model.linear import Creep
from bwbayes.model.nonlinearity import PolynomialNonlinearity
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.bouc_wen_asymmetric import BoucWenAsymmetric
from bwbayes.model.operators.duhem import BacklashLike, Duhem
from bwbayes.model.operators.no_hysteresis import NoHysteresis
from bwbayes.model.operators.prandtl_ishlinskii import MaxwellSlip, Plays

SPAN = Span(-100.0, 100.0)
HOLDS: tuple[Hold, ...] = ("first", "zero")

NONLINEARITY = PolynomialNonlinearity(("quadratic", "cubic"), SPAN)
CREEP = Creep((0.1, 1.0, 10.0), False, SPAN)
GROWING = Creep((0.1, 1.0), True, SPAN)

# Hysteresis, dynamics, gain and creep.
ACTUATORS = {
    "bouc-wen": (BoucWen(), "none", None, None),
    "bouc-wen not passive": (BoucWen(passive=False), "lag", None, None),
    "bouc-wen, second-order": (BoucWen(), "second-order", None, None),
    "bouc-wen, lag, nonlinearity": (BoucWen(), "lag", NONLINEARITY, None),
    "bouc-wen with all": (BoucWen(), "second-order", NONLINEARITY, GROWING),
    "backlash-like, lag, creep": (BacklashLike(), "lag", None, CREEP),
    "plays, lag, nonlinearity": (Plays(6), "lag", NONLINEARITY, None),
    "bouc-wen, n = 1.7, lag": (BoucWen(), "lag", None, None),
    "bouc-wen, n = 1.05 and gamma < 0": (BoucWen(), "none", NONLINEARITY, None),
    "bouc-wen-asymmetric, lag": (BoucWenAsymmetric(), "lag", None, None),
    "duhem, lag": (Duhem(odd=False), "lag", None, None),
    "linear, second-order, creep": (NoHysteresis(), "second-order", None, CREEP),
    "maxwell-slip with all": (MaxwellSlip((5.0, 20.0, 70.0)), "lag", NONLINEARITY, GROWING),
}

# Near Table 1 of the paper.
VALUES = {
    "d": 0.7, "alpha": 0.3575, "beta": 0.0272, "gamma": 0.0172, "exponent": 1.0, "initial": 0.0,
    "lag": 3.8e-3, "mass": 1.34e-3, "damping": 1580.0, "stiffness": 4.1e5, "quadratic": 1.5,
    "cubic": -0.8, "creep_1": 0.012, "creep_2": 0.009, "creep_3": 0.01, "creep_growth": 0.4,
    "threshold": 100.0, "offset": 0.0, "d2": 2e-4, "d3": 4e-6, "alpha1": 3e-4, "alpha2": 1e-5,
    "b2": 0.06, "b3": 0.05, "b4": -0.07, "b5": 0.04, "b6": 0.08,
}  # fmt: skip

# Other values for some of them; without γ, h is twice as steep after a turn as at zero.
OTHERS = {
    "not passive": {"gamma": 0.035},
    "backlash": {"alpha": 0.25},
    "n = 1.7": {"exponent": 1.7, "beta": 0.006, "gamma": 0.003},
    "n = 1.05": {"exponent": 1.05, "beta": 0.025, "gamma": -0.01, "alpha": 0.12},
    "asymmetric": {"alpha": 0.25},
    "duhem": {"alpha": 0.25, "beta": 0.03},
}


def actuator(name: str, hold: Hold = "first", interval: float = 1e-3) -> Actuator:
    hysteresis, dynamics, nonlinearity, creep = ACTUATORS[name]
    return Actuator(dynamics, hold, interval, hysteresis, nonlinearity, creep, SPAN)


def theta(made: Actuator, models: int = 1, name: str = "") -> FloatArray:
    """Return parameters (models, parameters), the first the table's, the others near them."""
    values = dict(VALUES)
    for part, others in OTHERS.items():
        values |= others if part in name else {}
    row = [values.get(one, 0.06) for one in made.parameters]
    rows = np.tile(row, (models, 1))
    rows[1:] *= 1 + 0.05 * np.random.default_rng(7).uniform(-1, 1, rows[1:].shape)
    if values["exponent"] == 1.0:
        rows[:, [i for i, one in enumerate(made.parameters) if one == "exponent"]] = 1.0
    return rows


def drive(samples: int = 3000, interval: float = 1e-3) -> FloatArray:
    """Return a voltage (samples,) with sines, small loops, jumps and rests, within the span."""
    generator = np.random.default_rng(5)
    time = interval * np.arange(samples)
    voltage: FloatArray = 60 * np.sin(2 * np.pi * 1.3 * time) + 25 * np.sin(2 * np.pi * 11 * time)
    voltage[samples // 2 : samples // 2 + 50] = 40.0
    jumps = generator.uniform(-95, 95, samples // 10)
    voltage[-2 * jumps.size :] = np.repeat(jumps, 2)
    return voltage


def noise_of(count: int, *values: float) -> LoopNoise:
    """Return a rough discrepancy's sensor sd, sd and time, the same of a number of draws."""
    return LoopNoise(DiscrepancyNoise(), np.tile(values, (count, 1)))
