"""Ordinary runs are calibrated: default priors, records that start in motion, other records.

The default priors are resolved once, from a typical record of a ring bender that is cut out of a
running drive, as the package does with a user's file; then the replicates draw ten or eleven
parameters from them, simulate the record and fit it as a run does. Nothing is known of its start.
Each replicate then makes another record with the same truth, cut from another drive at another
rate, with a start and an offset of its own, and predicts it after a lead-in of a second. Default
priors are so wide that some truths have next to no hysteresis; their posteriors are long and
curved. A replicate that does not converge in its budget is ranked as it is; one in ten may.

The default suite makes 10 replicates with the lag, and with priors of someone who knows the kind
of actuator for d and the hysteresis alone, which takes a third of the steps. All parameters are
tested together (:mod:`tests.together`), and each by the calibration's own tests; twins plant a
wrong width and a bias on the draws (sds 45% too small are seen with a probability of 0.95, a bias
of 0.65 sd with 0.97; of 32 replicates of the 150, a fifth with 0.89 and 0.3 sd with 0.96).
Coverages of the 18 bands are held to the spread between replicates: by
chance one in 100 sound calibrations has one that is off by more (Bonferroni's bound). ``-m slow``
makes 150 of each variant and of each part of a model, and 50 with a free exponent beside known
hysteresis: four
seconds of a record do not tell an exponent, a loop and its shape of which nothing is known.
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy import stats

from bwbayes.app.config.config import parse
from bwbayes.app.jobs.calibrate import experiment
from bwbayes.app.study.resolve import resolve_config
from bwbayes.calibration.calibration import (
    Calibration,
    CalibrationSetup,
    Replicate,
    evaluate_calibration,
)
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.model.actuator import Actuator
from bwbayes.model.registry import HYSTERESIS
from bwbayes.record.io.formats import write_record
from bwbayes.record.record import Record
from bwbayes.record.teststand import TABLE_1
from tests.measured import keep
from tests.together import LEVEL, SEED, Plant, errors_off, made, narrowed, shifted, together_test

# Replicates of the default suite, and of the slow one.
QUICK, REPLICATES = 10, 150

# Part of the replicates that may end before they have converged.
MOST_UNCONVERGED = 0.1

# Probability that one of a sound calibration's bands is off by more than is allowed.
FALSE_ALARM = 0.01

CONFIG = """\
[record]
file = "typical.csv"
train = [[0.0, 3.0]]

[model]
dynamics = "{dynamics}"
{model}
[sampling]
ess = {ess}
steps = {steps}
walkers = {walkers}
block = 25

[validation.held_out]
window = [3.0, 4.0]

[validation.other]
file = "other.csv"

[parameters]
{parameters}"""

KNOWN = """\
d = { prior = { distribution = "lognormal", median = 0.7, sigma = 0.3 } }
alpha = { prior = { distribution = "lognormal", median = 0.35, sigma = 0.3 } }
beta = { prior = { distribution = "lognormal", median = 0.03, sigma = 0.4 } }
gamma = { prior = { distribution = "normal", mean = 0.0, sd = 0.02 } }
"""

# h at its largest is alpha / beta to the power 1 / n: 12 um, as of those above.
CURVED = """\
d = { prior = { distribution = "lognormal", median = 0.7, sigma = 0.3 } }
alpha = { prior = { distribution = "lognormal", median = 0.35, sigma = 0.3 } }
beta = { prior = { distribution = "lognormal", median = 0.0084, sigma = 0.4 } }
gamma = { prior = { distribution = "normal", mean = 0.0, sd = 0.006 } }
exponent = { prior = { distribution = "lognormal", median = 1.5, sigma = 0.3 } }
"""


class Variant(NamedTuple):
    """A setting to calibrate: the dynamics, the priors that are not defaults, and what it takes."""

    dynamics: str
    parameters: str = ""
    model: str = ""
    steps: int = 3000
    walkers: int = 32
    ess: int = 500
    replicates: int = REPLICATES


VARIANTS = {
    "known hysteresis": Variant("lag", KNOWN),
    "lag": Variant("lag"),
    "second order": Variant(
        "second-order", "mass = { fixed = 300.0 }\nstiffness = { fixed = 4.1e5 }\n"
    ),
    "free exponent": Variant("lag", CURVED, steps=6000, replicates=50),
    "little noise": Variant(
        "lag",
        'sensor_sd = { prior = { distribution = "lognormal", median = 0.03, sigma = 0.5 } }\n'
        'discrepancy_sd = { prior = { distribution = "lognormal", median = 0.3, sigma = 0.5 } }\n',
    ),
}

# Ten plays, or five shape terms, have 15 to 17 parameters, of which four seconds tell few.
OPTIONS = {
    "plays": "thresholds = 4\n",
    "maxwell-slip": "thresholds = 4\n",
    "bouc-wen-asymmetric": 'terms = ["b3", "b5", "b6"]\n',
}
PARTS = {name: f'hysteresis = "{name}"\n{OPTIONS.get(name, "")}' for name in HYSTERESIS}
PARTS |= {"gain": 'nonlinearity = ["quadratic", "cubic"]\n', "creep": "creep = true\n"}

# More walkers than usual: of 13 parameters, 32 would barely span the space.
STUDIED = {f"calibration, {name}": variant for name, variant in VARIANTS.items()} | {
    f"calibrated part, {name}": Variant("lag", "", model, steps=6000, walkers=40)
    for name, model in PARTS.items()
}

TRUE = dict(TABLE_1) | {"lag": 0.02}


def typical(
    interval: float, duration: float, frequency: float, generator: np.random.Generator
) -> Record:
    """Cut a record out of a running drive of the ring bender with a lag."""
    before = 2.3
    time = interval * np.arange(round((before + duration) / interval))
    voltage = 100 * np.exp(-0.1 * time) * np.sin(2 * np.pi * frequency * time)
    actuator = Actuator("lag", "first", interval)
    clean = actuator.displacement([[TRUE[name] for name in actuator.parameters]], voltage)[0]
    slow, sensor = DiscrepancyNoise(interval).draw(
        np.array([[0.3, 1.0, 0.3]]), time.size, generator
    )
    reading = clean + slow + sensor
    cut = time.size - round(duration / interval)
    return Record(voltage[cut:], reading[cut:], interval=interval)


def typical_experiment(variant: Variant, folder: Path) -> CalibrationSetup:
    """Resolve the default priors once, from typical records."""
    generator = np.random.default_rng(SEED)
    write_record(typical(0.02, 4.0, 1.0, generator), folder / "typical.csv")
    write_record(typical(0.025, 4.0, 0.7, generator), folder / "other.csv")
    text = CONFIG.format(**variant._asdict())
    return experiment(resolve_config(parse(text, "typical"), folder))


Sound = tuple[CalibrationSetup, list[Replicate]]


def band_limit(bands: int, count: int) -> float:
    """Return the t-value that one of so many bands exceeds in 100 calibrations (Bonferroni)."""
    return float(stats.t.isf(FALSE_ALARM / 2 / bands, count - 1))


def calibrated(variant: Variant, folder: Path, count: int) -> Sound:
    common = typical_experiment(variant, folder)
    return common, made(common, count)


def remarks(outcome: Calibration) -> list[str]:
    """Return a calibration's shortcomings but for replicates that have not converged."""
    return [text for text in outcome.failures if "did not converge" not in text]


def figures(common: CalibrationSetup, every: list[Replicate]) -> dict[str, Any]:
    outcome = evaluate_calibration([one.entry for one in every], np.random.default_rng(SEED))
    ranked = [one for one in every if len(one.draws)]
    return {
        "replicates": len(every),
        "unconverged": len(outcome.unconverged),
        "shortcomings": remarks(outcome),
        "smallest adjusted p": round(min(one.adjusted for one in outcome.statistics.values()), 4),
        "all parameters together, p": round(together_test(ranked, common.posterior.prior), 4),
        "bands, standard errors off": {name: round(t, 2) for name, t in errors_off(every).items()},
        "bands cover": {name: round(one.mean, 4) for name, one in outcome.bands.items()},
    }


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Sound:
    # Fewer walkers and effective draws rank a truth as well, and cost less.
    variant = VARIANTS["known hysteresis"]._replace(walkers=24, ess=250)
    return calibrated(variant, tmp_path_factory.mktemp("typical"), QUICK)


def test_default_priors_and_records_in_motion_are_calibrated(sound: Sound) -> None:
    common, every = sound
    outcome = evaluate_calibration([one.entry for one in every], np.random.default_rng(SEED))
    assert [] == remarks(outcome)
    assert len(outcome.unconverged) <= MOST_UNCONVERGED * len(every)
    assert together_test(every, common.posterior.prior) > LEVEL
    off = errors_off(every)
    assert 18 == len(off)
    assert {} == {name: t for name, t in off.items() if not abs(t) < band_limit(18, len(every))}


@pytest.mark.parametrize("defect", [partial(narrowed, by=0.45), partial(shifted, sds=0.65)])
def test_twin_planted_defect_is_found(sound: Sound, defect: Plant) -> None:
    common, every = sound
    assert together_test(every, common.posterior.prior, defect) < LEVEL


# Where the discrepancy is nearly all of the noise, the held-out part of a record begins with what
# the fitted part leaves of it, and its bands take the discrepancy as a new record would have it:
# they cover more than they promise, 93% for 90 and 97% for 95.
TOO_WIDE = pytest.mark.xfail(strict=True, reason="bands of the held-out part cover too much")


@pytest.mark.slow
@pytest.mark.parametrize(
    "study", [pytest.param(name, marks=TOO_WIDE if "little" in name else ()) for name in STUDIED]
)
def test_every_variant_is_calibrated(study: str, tmp_path: Path) -> None:
    variant = STUDIED[study]
    common, every = calibrated(variant, tmp_path, variant.replicates)
    outcome = figures(common, every)
    keep(study, outcome)
    assert [] == outcome["shortcomings"]
    assert outcome["unconverged"] <= MOST_UNCONVERGED * variant.replicates
    assert together_test(every, common.posterior.prior) > LEVEL
    if study == "calibration, known hysteresis":
        for defect in (narrowed, shifted):
            assert together_test(every[:32], common.posterior.prior, defect) < LEVEL
    limit = band_limit(18, variant.replicates)
    assert {} == {name: t for name, t in errors_off(every).items() if not abs(t) < limit}
