"""Every part of a model is calibrated: each operator, gain, creep, on records that start in motion.

As in :mod:`tests.test_calibration_moving`: default priors are resolved once, from a typical record
of a ring bender cut out of a running drive, and replicates draw their truth from them, with another
record that starts in a state and a history of its own.

150 replicates are of backlash-like hysteresis beside a gain, and of Prandtl-Ishlinskii, whose
memory is a stack of extrema, with priors of someone who knows the kind of actuator for the
hysteresis. All parameters of a replicate are tested together (:mod:`tests.together`) at a level of
0.01. That raises a false alarm in one of 100; sds a fifth too small, or a bias of 0.3 sd, it finds
nearly always, and twins plant both on the draws. Means of coverages are held to the spread between
replicates (Bonferroni's bound: one false alarm in 100 for each model).

150 replicates of each part have default priors, and are asked what a calibration asks; they may
take twice as many steps, for posteriors from four seconds may be long and curved.
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
from bwbayes.data.io.formats import write_record
from bwbayes.model.registry import HYSTERESIS
from bwbayes.results.replicates import Experiment, Replicate, replicates
from tests.measured import keep
from tests.test_calibration_moving import (
    CONFIG,
    MOST_UNCONVERGED,
    SEED,
    band_limit,
    figures,
    off,
    typical,
)
from tests.together import LEVEL, Plant, narrowed, shifted, together_test

pytestmark = pytest.mark.slow

REPLICATES = 150

PLAYS_KNOWN = """\
d = { prior = { distribution = "lognormal", median = 0.43, sigma = 0.3 } }
alpha = { prior = { distribution = "lognormal", median = 0.43, sigma = 0.3 } }
threshold = { prior = { distribution = "lognormal", median = 60.0, sigma = 0.3 } }
"""
BACKLASH_KNOWN = """\
d = { prior = { distribution = "lognormal", median = 0.7, sigma = 0.3 } }
alpha = { prior = { distribution = "lognormal", median = 0.35, sigma = 0.3 } }
beta = { prior = { distribution = "lognormal", median = 0.03, sigma = 0.4 } }
"""
GAIN = 'gain = ["quadratic", "cubic"]\n'
CREEP = "creep = true\n"

KNOWN = {
    "prandtl-ishlinskii": ('hysteresis = "prandtl-ishlinskii"\n', PLAYS_KNOWN),
    "backlash-like and gain": (f'hysteresis = "backlash-like"\n{GAIN}', BACKLASH_KNOWN),
}
# Ten plays, or five shape terms, have 15 to 17 parameters, of which four seconds tell few.
OPTIONS = {
    "plays": "thresholds = 4\n",
    "maxwell-slip": "thresholds = 4\n",
    "bouc-wen-asymmetric": 'terms = ["b3", "b5", "b6"]\n',
}
EVERY = {name: f'hysteresis = "{name}"\n{OPTIONS.get(name, "")}' for name in HYSTERESIS}
EVERY |= {"gain": GAIN, "creep": CREEP}


# Steps of a replicate at most, with priors that know the hysteresis and with default ones.
STEPS = 3000
LONG_STEPS = 6000


def resolved(model: str, parameters: str, folder: Path, steps: int = STEPS) -> Experiment:
    """Resolve the default priors once, from typical records."""
    generator = np.random.default_rng(SEED)
    write_record(typical(0.02, 4.0, 1.0, generator), folder / "typical.csv")
    write_record(typical(0.025, 4.0, 0.7, generator), folder / "other.csv")
    text = CONFIG.format(dynamics="lag", steps=steps).replace("[model]\n", f"[model]\n{model}")
    # More walkers than usual: of 13 parameters, 32 would barely span the space.
    return experiment(resolve(parse(text.replace("= 32", "= 40") + parameters, "typical"), folder))


def made(common: Experiment, count: int) -> list[Replicate]:
    """Make the first replicates."""
    with one_thread(), ThreadPoolExecutor(1) as pool:
        return list(replicates(common, SEED, range(count), pool))


Sound = tuple[Experiment, list[Replicate]]


@pytest.fixture(scope="module", params=KNOWN)
def sound(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Sound:
    common = resolved(*KNOWN[request.param], tmp_path_factory.mktemp("typical"))
    return common, made(common, REPLICATES)


def test_parts_are_calibrated(sound: Sound) -> None:
    common, every = sound
    result = figures(common, every)
    assert [] == result["shortcomings"]
    assert result["unconverged"] <= MOST_UNCONVERGED * REPLICATES
    assert together_test(every, common.posterior.prior) > LEVEL
    limit = band_limit(18, REPLICATES)
    assert {} == {name: t for name, t in off(every).items() if not abs(t) < limit}


@pytest.mark.parametrize("defect", [narrowed, shifted])
def test_twin_planted_defect_is_found(sound: Sound, defect: Plant) -> None:
    common, every = sound
    assert together_test(every, common.posterior.prior, defect) < LEVEL


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
