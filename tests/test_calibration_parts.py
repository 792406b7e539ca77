"""Every part of a model is calibrated: each operator, gain, creep, on records that start in motion.

As in :mod:`tests.test_calibration_moving`: default priors are resolved once, from a typical record
of a ring bender cut out of a running drive, and replicates draw their truth from them, with another
record that starts in a state and a history of its own.

The default suite makes ten replicates of Prandtl-Ishlinskii, and the slow one of gain and of creep
as well, with priors of someone who knows the kind of
actuator for the hysteresis. All parameters of a replicate are tested together
(:mod:`tests.together`) at a level of 0.01. That raises a false alarm in one of 100; it finds sds
that are half of what they should be 93 times in 100, and a bias of half a sd 96 times (200
simulated calibrations of nine parameters). Twins plant both on the draws. Means of coverages are
held to the spread between replicates (Bonferroni's bound: one false alarm in 100 for each model).

``-m slow`` makes 150 replicates of each part with default priors, and asks what a calibration asks;
they may take twice as many steps, for posteriors from four seconds may be long and curved.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.config.config import parse
from bwbayes.app.jobs.calibrate import experiment
from bwbayes.app.problem.problem import resolve
from bwbayes.app.running.workers import one_thread
from bwbayes.arrays import FloatArray
from bwbayes.data.io.formats import write_record
from bwbayes.model.registry import HYSTERESIS
from bwbayes.results.replicates import Experiment, Replicate, replicates
from tests.measured import keep
from tests.test_calibration_moving import (
    CONFIG,
    KNOWN,
    MOST_UNCONVERGED,
    SEED,
    band_limit,
    figures,
    off,
    typical,
)
from tests.together import LEVEL, Plant, together_test

QUICK = 10
REPLICATES = 150

PLAYS_KNOWN = """\
d = { prior = { distribution = "lognormal", median = 0.43, sigma = 0.3 } }
alpha = { prior = { distribution = "lognormal", median = 0.43, sigma = 0.3 } }
threshold = { prior = { distribution = "lognormal", median = 60.0, sigma = 0.3 } }
"""
GAIN = 'gain = ["quadratic", "cubic"]\n'
CREEP = "creep = true\n"

THREE = {
    "prandtl-ishlinskii": ('hysteresis = "prandtl-ishlinskii"\n', PLAYS_KNOWN),
    "gain": (GAIN, KNOWN),
    "creep": (CREEP, KNOWN),
}
EVERY = {name: f'hysteresis = "{name}"\n' for name in HYSTERESIS} | {"gain": GAIN, "creep": CREEP}


# Steps of a replicate at most, with priors that know the hysteresis and with default ones.
STEPS = 3000
LONG_STEPS = 6000


def resolved(model: str, parameters: str, folder: Path, steps: int = STEPS) -> Experiment:
    """Resolve the default priors once, from typical records."""
    generator = np.random.default_rng(SEED)
    write_record(typical(0.02, 4.0, 1.0, generator), folder / "typical.csv")
    write_record(typical(0.025, 4.0, 0.7, generator), folder / "other.csv")
    text = CONFIG.format(dynamics="lag", steps=steps).replace("[model]\n", f"[model]\n{model}")
    # Ten plays have more parameters than 32 walkers could span.
    return experiment(resolve(parse(text.replace("= 32", "= 40") + parameters, "typical"), folder))


def made(common: Experiment, count: int) -> list[Replicate]:
    """Make the first replicates."""
    with one_thread(), ThreadPoolExecutor(1) as pool:
        return list(replicates(common, SEED, range(count), pool))


Sound = tuple[Experiment, list[Replicate]]


QUICKEST = "prandtl-ishlinskii"


@pytest.fixture(
    scope="module",
    params=[QUICKEST, *(pytest.param(n, marks=pytest.mark.slow) for n in THREE if n != QUICKEST)],
)
def sound(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Sound:
    common = resolved(*THREE[request.param], tmp_path_factory.mktemp("typical"))
    return common, made(common, QUICK)


def test_parts_are_calibrated(sound: Sound) -> None:
    common, every = sound
    assert together_test(every, common.posterior.prior) > LEVEL
    limit = band_limit(18, QUICK)
    assert {} == {name: t for name, t in off(every).items() if not abs(t) < limit}


def halved(draws: FloatArray) -> FloatArray:
    """Make the sds of draws (draws, free) half as large."""
    middle = np.mean(draws, axis=0)
    return middle + 0.5 * (draws - middle)


def biased(draws: FloatArray) -> FloatArray:
    """Put a bias of half a sd on every coordinate."""
    return draws + 0.5 * np.std(draws, axis=0)


@pytest.mark.parametrize("defect", [halved, biased])
def test_twin_planted_defect_is_found(sound: Sound, defect: Plant) -> None:
    common, every = sound
    assert together_test(every, common.posterior.prior, defect) < LEVEL


@pytest.mark.slow
@pytest.mark.parametrize("part", EVERY)
def test_every_part_is_calibrated(part: str, tmp_path: Path) -> None:
    common = resolved(EVERY[part], "", tmp_path, LONG_STEPS)
    every = made(common, REPLICATES)
    result = figures(common, every)
    keep(f"calibrated part, {part}", result)
    assert [] == result["shortcomings"]
    assert result["unconverged"] <= MOST_UNCONVERGED * REPLICATES
    assert together_test(every, common.posterior.prior) > LEVEL
    limit = band_limit(18, REPLICATES)
    assert {} == {name: t for name, t in off(every).items() if not abs(t) < limit}
