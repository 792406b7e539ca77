"""What it costs to read many draws backwards, a sample at a time, against simulating them."""

from __future__ import annotations

from functools import partial

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.sampled import SampledModel
from bwbayes.model.actuator import Actuator
from bwbayes.model.creep import Creep
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.operator import Operator
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.bouc_wen_asymmetric import BoucWenAsymmetric
from bwbayes.model.operators.duhem import Duhem
from bwbayes.model.operators.maxwell_slip import MaxwellSlip
from bwbayes.model.operators.prandtl_ishlinskii import Plays
from bwbayes.record.waveforms import signal
from tests.benchmarks.cases import Effort
from tests.benchmarks.measuring import Cell, Table, interleaved
from tests.control import cases

SAMPLES, DRAWS = 500, 1000

# Hysteresis, dynamics, gain and creep of models that are read backwards.
INVERTED: dict[str, tuple[Operator, str, PolynomialGain | None, Creep | None]] = {
    "bouc-wen": (BoucWen(), "none", None, None),
    "bouc-wen, lag": (BoucWen(), "lag", None, None),
    "bouc-wen, second-order": (BoucWen(), "second-order", None, None),
    "bouc-wen, lag, creep": (BoucWen(), "lag", None, cases.CREEP),
    "bouc-wen, lag, gain": (BoucWen(), "lag", cases.GAIN, None),
    "plays, lag": (Plays(10), "lag", None, None),
    "maxwell-slip, lag": (MaxwellSlip(10), "lag", None, None),
    "asymmetric bouc-wen, lag": (BoucWenAsymmetric(), "lag", None, None),
    "duhem, lag": (Duhem(), "lag", None, None),
    "bouc-wen n = 1.7, lag": (BoucWen(), "lag", None, None),
}


def read_backwards(model: SampledModel, displacement: FloatArray) -> FloatArray:
    """Return the voltages (samples, models) of a displacement (samples,), um."""
    state, voltages = model.begin(np.zeros(model.models)), []
    for asked in displacement:
        voltage, state = model.inverse(state, np.full(model.models, asked), cases.SPAN)
        voltages.append(voltage)
    return np.array(voltages)


def inversion(effort: Effort) -> Table:
    """Measure the inverse of many draws against simulating them, on the paper's record.

    What is asked for is the displacement of their middle; each draw gets a voltage of its own.
    """
    voltage = signal("identification").sample(1000.0)[1][:SAMPLES]
    rows: list[dict[str, Cell]] = []
    for name, (hysteresis, dynamics, gain, creep) in INVERTED.items():
        actuator = Actuator(dynamics, "first", 1e-3, hysteresis, gain, creep, cases.SPAN)
        theta = cases.theta(actuator, DRAWS, name)
        simulate = partial(actuator.displacement, theta, voltage, from_rest=True)
        asked = simulate().mean(axis=0)
        invert = partial(read_backwards, SampledModel.of(actuator, theta), asked)
        costs = interleaved({"simulate": simulate, "invert": invert}, min(effort.rounds, 2))
        forward, backward = costs["simulate"].wall, costs["invert"].wall
        rows.append(
            {
                "model": name,
                "simulate, ms": 1e3 * forward,
                "invert, ms": 1e3 * backward,
                "ratio": backward / forward,
            }
        )
    return Table("inversion", "Inversion", f"{SAMPLES:,} samples, {DRAWS:,} draws", rows)
