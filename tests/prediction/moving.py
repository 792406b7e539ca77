"""Records cut out of a running drive, and how well bands cover them when the model is right.

The actuator has been driven for several periods when a record begins: at any phase, at a turning
point, at full speed, or knocked away from where the drive holds it. Parameters are the true ones,
so all that bands can get wrong is the start of the record. Any operator may be in it, with the true
values that the virtual stand has for it.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.departures import LEAD_IN_ALARM
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import InitialConditions
from bwbayes.model.actuator import Actuator
from bwbayes.model.registry import HYSTERESIS, STAGES, build_part
from bwbayes.prediction.bands import KINDS, Bands, Kind
from bwbayes.prediction.prediction import predict_record
from bwbayes.record.record import Record
from bwbayes.record.teststand import TABLE_1, true_values
from tests.inference.problems import posterior_of
from tests.prediction.runs import covered as inside
from tests.stand import process

Cut = Literal["any", "turn", "speed", "knocked"]

RATE = 200.0
DURATION = 8.0
KNOCK = 20.0

# Draws of the start: they are spread evenly, so that few will do.
DRAWS = 64

TRUE = dict(TABLE_1) | {
    "sensor_sd": 0.1,
    "discrepancy_time": 0.3,
    # Rings at 6 Hz, and dies out within a fifth of a second.
    "mass": 300.0,
    "damping": 3000.0,
}


@dataclass(frozen=True)
class Case:
    """One kind of records: dynamics, lag (s), discrepancy (um), lead-in (s), where it is cut."""

    dynamics: str = "lag"
    lag: float = 38e-3
    discrepancy: float = 0.3
    lead_in: float = 1.0
    cut: Cut = "any"
    from_rest: bool = False
    hysteresis: str = "bouc-wen"
    stages: tuple[str, ...] = ()

    @property
    def actuator(self) -> Actuator:
        """The model."""
        operator = build_part("hysteresis", self.hysteresis, HYSTERESIS, {})
        stages = tuple(STAGES[name]() for name in self.stages)
        return Actuator(self.dynamics, "first", 1 / RATE, operator, stages=stages)

    @property
    def true(self) -> dict[str, float]:
        """All true values by name."""
        own = {"lag": self.lag, "discrepancy_sd": self.discrepancy, "backlash": 2.0}
        return TRUE | true_values(self.actuator, TRUE) | own


def posterior_of_case(case: Case) -> Posterior:
    """Return the model, its voltage range, and the width of its record; all parameters fixed."""
    actuator, true = case.actuator, case.true
    voltage = 100 * np.sin(2 * np.pi * np.arange(400) / RATE)
    names = (*actuator.parameters, "sensor_sd", "discrepancy_sd", "discrepancy_time")
    # Where in its play a record begins, nobody knows.
    fixed = {name: true[name] for name in names if name != "backlash_start"}
    posterior = posterior_of(voltage, 0.6 * voltage, actuator, "discrepancy", fixed)
    return replace(posterior, engine="numba")


def record_of(case: Case, generator: np.random.Generator) -> Record:
    """Drive the actuator from rest, and cut a record out of the drive; its offset is anything."""
    actuator, true = case.actuator, case.true
    theta = np.array([[true[name] for name in actuator.parameters]])
    before = 0.0 if case.from_rest else generator.uniform(2.0, 4.0)
    if case.cut in ("turn", "speed"):
        before = np.round(2 * before) / 2 + (0.25 if case.cut == "turn" else 0.0)
    time = np.arange(int((before + DURATION) * RATE)) / RATE
    size, slow = generator.uniform(40, 70), generator.uniform(0.05, 0.2)
    amplitude = size + (100 - size) * np.sin(2 * np.pi * slow * time) ** 2
    voltage = amplitude * np.sin(2 * np.pi * time)
    cut = time.size - int(DURATION * RATE)
    displacement = actuator.displacement(theta, voltage, from_rest=True)[0][cut:]
    if case.cut == "knocked":
        column = dict(zip(actuator.parameters, theta.T, strict=True))
        free = actuator.sections(column).free_responses(displacement.size)[0]
        displacement = displacement + KNOCK * free[0]
    step = 1 / RATE / TRUE["discrepancy_time"]
    truth = displacement + case.discrepancy * process(displacement.size, step, generator)
    truth = truth + generator.normal(0, 30)
    reading = truth + TRUE["sensor_sd"] * generator.standard_normal(truth.size)
    return Record(voltage[cut:], reading, interval=1 / RATE, truth=truth, origin="cut")


def predicted(case: Case, posterior: Posterior, record: Record, seed: int) -> Bands:
    start = InitialConditions(case.from_rest, lead_in=case.lead_in)
    draws = np.zeros((DRAWS, posterior.prior.dimensions))
    return predict_record(posterior, draws, record, start, np.random.default_rng(seed))


def studied(case: Case, records: int, seed: int = 0) -> list[Bands]:
    posterior = posterior_of_case(case)
    generator = np.random.default_rng(seed)
    return [
        predicted(case, posterior, record_of(case, generator), number) for number in range(records)
    ]


def covered(every: list[Bands], level: int) -> FloatArray:
    """Part of the judged readings inside the sensor band, (records,)."""
    return np.array([inside(bands, level) for bands in every])


def errors_off(parts: FloatArray, level: int) -> float:
    """Distance of the mean coverage from nominal, in standard errors between records."""
    return float((parts.mean() - level / 100) / (parts.std(ddof=1) / np.sqrt(parts.size)))


def alarms(every: list[Bands]) -> int:
    """Lead-ins that are said not to fit."""
    p = [bands.lead_in.p_value for bands in every if bands.lead_in is not None]
    assert len(p) == len(every)
    return int(np.sum(np.array(p) < LEAD_IN_ALARM))


def width(bands: Bands, kind: Kind) -> float:
    """Mean width of the 95% band where it is judged, um."""
    return float(np.mean((bands.upper[kind, 95] - bands.lower[kind, 95])[bands.scored_from :]))


def widening(case: Case, records: int) -> float:
    """How many times as wide bands are where nobody says that a record starts from rest."""
    rested = replace(case, from_rest=True)
    posterior, generator = posterior_of_case(case), np.random.default_rng(2)
    ratios = []
    for number in range(records):
        record = record_of(rested, generator)
        known = predicted(rested, posterior, record, number)
        unknown = predicted(case, posterior, record, number)
        ratios.append([width(unknown, kind) / width(known, kind) for kind in KINDS[1:]])
    return float(np.max(np.mean(ratios, axis=0)))
