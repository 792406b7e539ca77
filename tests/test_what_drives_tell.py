"""What ten seconds of a drive tell of an actuator, and what a fit costs: the README's two tables.

The virtual test stand without a discrepancy, its sensor's noise 0.5 um of a range of 120, default
priors, at 10 Hz (100 readings) and at 1 kHz (10,000). A slow study keeps its figures; README's
tables quote them.
"""

import time
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.record import Record
from bwbayes.record.teststand import RingBender, VirtualTestStand
from bwbayes.record.waveforms import Decay, Sine, Staircase, Waveform
from tests.measured import keep

DRIVES = {
    "decaying sine": Waveform(Sine(100.0, 1.0), 10.0, decay=Decay(0.0, 0.1)),
    "decaying sine, 20 V": Waveform(Sine(20.0, 1.0), 10.0, decay=Decay(0.0, 0.1)),
    "constant sine": Waveform(Sine(100.0, 1.0), 10.0),
    "staircase": Waveform(Staircase((25.0, 50.0, 75.0, 100.0, 75.0, 50.0, 25.0), 1.4), 10.0),
}
RATES = (10.0, 1000.0)

MODELS: dict[str, dict[str, Any]] = {
    "bouc-wen": {},
    "bouc-wen, creep": {"creep": True},
    "maxwell-slip": {"hysteresis": "maxwell-slip", "thresholds": 4},
}
LENGTHS = dict.fromkeys(MODELS, (100, 1000, 10000)) | {"bouc-wen": (100, 1_000, 10_000, 100_000)}


def measured_on(drive: Waveform, rate: float) -> Record:
    stand = VirtualTestStand(discrepancy="none", sample_rate=rate)
    return stand.run(drive, np.random.default_rng(1))


def fitted(record: Record, **model: Any) -> tuple[bw.Run, float, float]:
    """Fit a named model; return the fit, core seconds, and evaluations per effective draw."""
    begun = time.process_time()
    fit = bw.fit(record, dynamics="lag", search="none", progress=False, **model)
    seconds = time.process_time() - begun
    assert fit.converged, fit.outcome.stop_reason
    plan = fit.plan
    steps = sum(fit.chain.steps(phase) for phase in ("pilot", "tuning", "sampling"))
    count = steps * plan.walkers * plan.ensembles * plan.tries
    return fit, seconds, count / fit.outcome.check.lowest_ess


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_what_drives_tell_of_each_parameter() -> None:
    """SDs over the true values, %; all truths lie within four SDs of the means."""
    truth = {name: getattr(RingBender, name) for name in ("d", "alpha", "beta", "gamma")}
    truth["lag"] = RingBender.damping / RingBender.stiffness
    percent: dict[str, dict[str, dict[str, float]]] = {}
    for name, drive in DRIVES.items():
        percent[name] = {}
        for rate in RATES:
            record = measured_on(drive, rate)
            table = fitted(record)[0].summary
            off = {
                key: (table["mean"][key] - true) / table["sd"][key] for key, true in truth.items()
            }
            assert max(map(abs, off.values())) < 4, (name, rate, off)
            sds = {key: 100 * float(table["sd"][key]) / true for key, true in truth.items()}
            percent[name][f"{record.voltage.size}"] = sds
            print(name, rate, sds, flush=True)
    keep("what drives tell", percent)
    plain, small = percent["decaying sine"], percent["decaying sine, 20 V"]
    assert all(plain["10000"][key] < plain["100"][key] for key in truth)
    assert all(plain["100"][key] < small["100"][key] for key in ("d", "alpha", "beta", "gamma"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_what_fits_cost_by_length_and_model() -> None:
    """Core seconds from the record to the converged posterior, 2,000 effective draws."""
    drive = DRIVES["decaying sine"]
    fitted(measured_on(drive, RATES[0]))  # loads what is compiled
    cost: dict[str, dict[str, dict[str, float]]] = {}
    for name, model in MODELS.items():
        cost[name] = {}
        for length in LENGTHS[name]:
            _, seconds, evaluations = fitted(measured_on(drive, length / drive.duration), **model)
            cost[name][f"{length}"] = {"core s": seconds, "evaluations a draw": evaluations}
            print(name, length, cost[name][f"{length}"], flush=True)
    keep("cost of a fit", cost)
    assert all(each["10000"]["core s"] < 300 for each in cost.values())
