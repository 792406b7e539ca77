"""Records of each of nine operators: the comparison names the right one, or leaves it open.

The parameters come from the prior of a typical actuator, the noise is 0.3 % of the range, 3,000
readings of which the last third is held out. Named wrongly is a record of which another operator is
recommended alone. Operators that are the same thing (Prandtl-Ishlinskii and Preisach or
Krasnosel'skii-Pokrovskii loops that are alike, backlash-like and Bouc-Wen with γ near zero) are
rightly left open. A wrong name with evidence odds of twenty to one comes by chance once in twenty
records at most, so three wrong names of twenty would be noticed as odd with a probability of 0.07.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from rich.console import Console

from bwbayes.app.config.keywords import config_of
from bwbayes.app.jobs.compare import Fitted, compare
from bwbayes.app.problem.problem import Problem, generator, resolve
from bwbayes.app.running.workers import one_thread
from bwbayes.arrays import FloatArray
from bwbayes.comparison.choice import Comparison
from bwbayes.data import Record
from bwbayes.errors import InputError
from bwbayes.inference import pointfit
from bwbayes.model.operators.no_hysteresis import NoHysteresis
from bwbayes.sampling.sampler import first_chain, sample
from tests.measured import keep

NINE = (
    "bouc-wen",
    "backlash-like",
    "duhem",
    "prandtl-ishlinskii",
    "maxwell-slip",
    "preisach",
    "krasnoselskii-pokrovskii",
    "jiles-atherton",
    "domain-wall",
)
INTERVAL, SAMPLES, FITTED = 0.01, 3000, 2000
NOISE = 0.003
RECORDS = 20


def voltage() -> FloatArray:
    """Return sweeps of many amplitudes, from rest: the later third repeats none of the first."""
    time = INTERVAL * np.arange(SAMPLES)
    size = 1 - 0.045 * time + 0.3 * np.sin(2 * np.pi * time / 11)
    drive = size * np.sin(2 * np.pi * 0.4 * time) + 0.2 * np.sin(2 * np.pi * 0.93 * time)
    drive *= 100 / np.max(np.abs(drive))
    return drive


def problem(record: Record, operator: str) -> Problem:
    keys: dict[str, Any] = {
        "hysteresis": operator,
        "dynamics": "none",
        "noise": "white",
        "from_rest": True,
        "train": (0.0, FITTED * INTERVAL),
        "validation": {"later": (FITTED * INTERVAL, SAMPLES * INTERVAL)},
        "ess": 200,
        "walkers": 32,
        "steps": 3000,
    }
    if operator == "maxwell-slip":
        keys["thresholds"] = 6
    config, records = config_of(record, keys)
    return resolve(config, Path(), records)


def simulated(operator: str, seed: int) -> Record:
    """Draw an actuator from the prior of a typical record, and measure it."""
    source = np.random.default_rng([seed, *operator.encode()])
    drive = voltage()
    typical = Record.from_arrays(
        drive, 0.6 * drive + source.normal(size=SAMPLES), interval=INTERVAL
    )
    of = problem(typical, operator).posterior
    theta = of.prior.theta(of.prior.draw(source, 1))
    actuator = of.likelihood.actuator
    clean = actuator.displacement(of.only.table.actuator(theta), drive, from_rest=True)[0]
    reading = clean + NOISE * np.ptp(clean) * source.normal(size=SAMPLES)
    return Record.from_arrays(drive, reading, interval=INTERVAL)


def run(record: Record, operator: str) -> Fitted:
    """Fit as a run does, without its files."""
    of = problem(record, operator)
    seed = of.config.seed
    with ThreadPoolExecutor(1) as pool, one_thread():
        point = pointfit.fit(of.posterior, generator(seed, "point fit"))
        chain = first_chain(of.posterior, point, of.plan, generator(seed, "sampling"))
        outcome = sample(of.posterior, of.plan, chain, pool)
    return Fitted(operator, of, cast(Any, chain), outcome)


def compared(record: Record, operators: Iterable[str], *, say: bool = False) -> Comparison:
    runs = []
    for operator in operators:
        begun = time.process_time()
        try:
            runs.append(run(record, operator))
        except (InputError, np.linalg.LinAlgError) as error:
            print(f"    {operator}: {error}")
        if say:
            print(f"    {operator} {time.process_time() - begun:.1f} s CPU", flush=True)
    return compare(runs, Console(quiet=True), workers=1, with_future=False)


def right(operator: str, made: Comparison) -> bool:
    """Whether the truth is named, or left open with what is named."""
    return operator == made.recommended or operator in made.alike


def none_worse(made: Comparison) -> bool:
    """Whether what is recommended is not worse on the held-out readings by two errors."""
    assert made.recommended is not None
    return not made.differences[made.recommended]["held_out"].beyond


@pytest.mark.slow
def test_the_right_operator_is_named_or_left_open() -> None:
    """In at least 18 of 20 records; what is recommended never scores worse for sure."""
    named, alone, worse = [], [], []
    for number in range(RECORDS):
        operator = NINE[number % len(NINE)]
        made = compared(simulated(operator, number), NINE)
        named.append(right(operator, made))
        alone.append(operator == made.recommended and not made.alike)
        worse.append(not none_worse(made))
        figures = {
            "records": len(named),
            "named or left open": int(np.sum(named)),
            "named alone": int(np.sum(alone)),
            "recommended with a worse score": int(np.sum(worse)),
        }
        keep("operators named", figures)
    assert not any(worse)
    assert np.sum(named) >= 18


@pytest.mark.slow
def test_a_bouc_wen_record_is_told_from_other_operators_and_from_none() -> None:
    """The quick twin, with three operators."""
    made = compared(simulated("bouc-wen", 1), ("bouc-wen", "maxwell-slip", "linear"))
    assert right("bouc-wen", made)
    assert none_worse(made)
    assert "linear" not in (made.recommended, *made.alike)


def test_a_record_without_hysteresis_is_said_to_have_none() -> None:
    record = simulated("linear", 1)
    assert isinstance(problem(record, "linear").posterior.only.actuator.hysteresis, NoHysteresis)
    made = compared(record, ("bouc-wen", "linear"))
    assert made.recommended == "linear"
    assert any("no hysteresis" in line for line in made.lines)
