"""A steady sine, the commonest bench test: a few periods are enough for an answer, and soon.

Three periods of 150 V at 1 Hz, 250 readings a second, from rest. One loop tells less than a
decaying drive: gamma of the other sign with another d is the next best explanation, tens of nats
worse, and no ensemble should spend its time there.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.config.config import parse
from bwbayes.app.problem.problem import Problem, resolve
from bwbayes.model.actuator import Actuator
from bwbayes.record import Record, write_record
from bwbayes.sampling.chain import draws
from tests.measured import keep
from tests.prediction.process import process
from tests.sampled import sampled

RATE = 250.0
TRUTH = {
    "d": 0.7,
    "alpha": 0.3575,
    "beta": 0.0272,
    "gamma": 0.0172,
    "exponent": 1.0,
    "initial": 0.0,
    "lag": 0.004,
    "offset": 0.0,
    "sensor_sd": 0.3,
    "discrepancy_sd": 0.5,
    "discrepancy_time": 0.3,
}

# In the study and its figures: the noise's discrepancy is hardly told by three seconds.
PHYSICAL = ("d", "alpha", "beta", "gamma", "initial", "lag", "offset", "sensor_sd")

RECORDS = 40


def steady_sine(seed: int, folder: Path, periods: int = 3) -> Problem:
    """Simulate a record and put the default config's problem together."""
    source = np.random.default_rng([7, seed])
    voltage = 150 * np.sin(2 * np.pi * np.arange(periods * RATE) / RATE)
    actuator = Actuator("lag", "first", 1 / RATE)
    theta = np.array([[TRUTH[name] for name in actuator.parameters]])
    slow = process(voltage.size, 1 / RATE / TRUTH["discrepancy_time"], source)
    displacement = actuator.displacement(theta, voltage)[0] + TRUTH["discrepancy_sd"] * slow
    displacement += TRUTH["sensor_sd"] * source.standard_normal(voltage.size)
    path = folder / f"sine_{seed}.csv"
    write_record(Record(voltage, displacement, 1 / RATE), path)
    config = parse(f'seed = {seed}\n[record]\nfile = "{path.name}"\n', "steady sine")
    return resolve(config, folder)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_steady_sine_converges_within_hundreds_of_steps(seed: int, tmp_path: Path) -> None:
    """Pilot and all. Two of four ensembles in the hopeless mode took 3,000 for the pilot alone."""
    outcome, chain = sampled(steady_sine(seed, tmp_path), workers=2)
    assert outcome.converged, outcome.stop_reason
    assert chain.steps("pilot") + chain.steps("sampling") <= 1200


@pytest.mark.slow
def test_forty_steady_sines_converge_and_their_intervals_cover(tmp_path: Path) -> None:
    """All converge within two minutes; each parameter's 95 % interval covers 33 times or more.

    Of intervals that cover 95 % that is missed once in 1,000 by one parameter, once in 100 by one
    of eight; of those that cover 70 % it is missed in 94 of 100.
    """
    both = np.zeros((2, RECORDS, len(PHYSICAL)))
    steps, seconds = [], []
    for seed in range(RECORDS):
        problem = steady_sine(seed, tmp_path)
        begun = time.monotonic()
        outcome, chain = sampled(problem, workers=2)
        seconds.append(time.monotonic() - begun)
        steps.append(chain.steps("pilot") + chain.steps("sampling"))
        assert outcome.converged, (seed, outcome.stop_reason)
        every = draws(problem.posterior, chain).reshape(-1, len(problem.posterior.names))
        for i, name in enumerate(PHYSICAL):
            below = np.mean(every[:, problem.posterior.names.index(name)] < TRUTH[name])
            both[:, seed, i] = abs(below - 0.5) < np.array([0.475, 0.25])
    covers = [dict(zip(PHYSICAL, x.sum(axis=0).astype(int).tolist(), strict=True)) for x in both]
    keep(
        "steady sine",
        {
            "records": RECORDS,
            "converged": RECORDS,
            "most steps": max(steps),
            "mean steps": float(np.mean(steps)),
            "most seconds": round(max(seconds), 1),
            "covered 95": covers[0],
            "covered 50": covers[1],
        },
    )
    assert max(seconds) < 120
    assert min(covers[0].values()) >= 33, covers[0]
