"""An ordinary record gets an answer: of correct plants in motion nearly all pass, hardly one fails.

A stand that the fitted model describes is recorded for 10 s at 200 Hz, between 0 and 100 V, and
once more while its drive runs, with another offset. Nothing is said of lead-ins. 36 of 40 such
records have to pass, and at most 1% may fail, which is none: where 97% pass in truth, 1 of 100
studies has fewer; where 80% do, one of 13 has as many. The twin is another actuator, with a fifth
more gain: of 40 one may pass, as one does whose discrepancy hides it, at the limit of what may be
luck.
"""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.validation import BandValidation
from bwbayes.record import write_record
from tests.measured import keep
from tests.prediction.runs import judge, study_of
from tests.stand import Stand

RATE, SECONDS, SEEDS = 200.0, 10.0, 40


def drive(generator: np.random.Generator, seconds: float) -> FloatArray:
    """Return a voltage between 0 and 100 V, from 0 V on: a sine that decays, or does not."""
    time = np.arange(round(seconds * RATE)) / RATE
    frequency, decay = generator.uniform(0.5, 2.0), generator.choice([0.0, 0.5])
    size = 50 * (1 - decay * time / seconds)
    voltage: FloatArray = size * (1 - np.cos(2 * np.pi * frequency * time))
    return voltage


def answers(seed: int, folder: Path, gain: float = 1.0) -> dict[str, BandValidation]:
    """Record the stand, and once more in motion; fit the first and predict the other.

    The other has so many times the displacement.
    """
    generator = np.random.default_rng([20261123, seed])
    stand = Stand(
        lag=float(generator.choice([0.004, 0.02])),
        discrepancy=float(generator.choice([0.3, 1.5])),
        memory=float(np.exp(generator.uniform(np.log(0.1), np.log(0.5)))),
        sensor=float(generator.choice([0.1, 0.5])),
        rate=RATE,
    )
    first = stand.measure(drive(generator, SECONDS), generator)
    before = float(generator.uniform(1, 3))
    moving = drive(generator, SECONDS + before)
    other = stand.measure(
        moving, generator, offset=float(generator.normal(0, 20)), cut=round(before * RATE)
    )
    assert other.displacement is not None
    other = replace(other, displacement=gain * other.displacement)
    write_record(first, folder / "record.h5")
    write_record(other, folder / "another.h5")
    text = """
        [record]
        file = "record.h5"
        [validation.other]
        file = "another.h5"
    """
    return dict(judge(study_of(text, folder), generator, again=False).validation)


@pytest.mark.parametrize("gain", [1.0, 1.2])
def test_an_ordinary_record_gets_the_right_answer(tmp_path: Path, gain: float) -> None:
    """Another actuator, with a fifth more gain, is no correct plant."""
    assert answers(1, tmp_path, gain)["other"].passed is (gain == 1.0)


@pytest.mark.slow
def test_ordinary_records_get_an_answer(tmp_path: Path) -> None:
    said: dict[float, Counter[str]] = {1.0: Counter(), 1.2: Counter()}
    for seed in range(SEEDS):
        for gain, counts in said.items():
            verdict = answers(seed, tmp_path, gain)["other"]
            counts[str(verdict.passed)] += 1
            print(seed, gain, verdict.passed, verdict.line, flush=True)
    right, wrong = said.values()
    keep("ordinary answers", {"seeds": SEEDS, "correct": dict(right), "other": dict(wrong)})
    assert right["True"] >= 0.9 * SEEDS
    assert right["False"] <= 0.01 * SEEDS
    assert wrong["True"] <= 1
