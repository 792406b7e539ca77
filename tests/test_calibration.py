"""The package's posteriors are calibrated, and a calibration notices when they are not.

``-m slow`` makes 500 replicates of ``runs/calibration.toml``: each draws nine parameters from the
prior, simulates a record and fits it as a run does. The calibration itself must pass; it raises a
false alarm once in 100 times. A sharper test looks at all parameters of a replicate together
(:mod:`tests.together`), at a level of 0.01; 10 replicates, as in the default suite's
``test_calibration_moving.py``, find sds 45% too small or a bias of 0.65 sd 19 times in 20, 500 sds
a tenth too small.

These are planted on the stored draws, as twins. The other defects are planted in the likelihood or
the prior, with as few replicates as show them, and fewer free parameters, because these defects are
large: the twins without a defect are the sound replicates. The default suite has one of each.

Bands are held to three standard errors from the spread between the replicates. One of the nine
comparisons, which depend on each other, is off by chance in one calibration of 28. The
white noise model, fitted to records of the same kind, fails by far.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.config.config import load, parse
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.calibrate import experiment
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray, IntArray
from bwbayes.calibration.calibration import (
    LIMIT,
    Calibration,
    CalibrationSetup,
    Replicate,
    evaluate_calibration,
)
from bwbayes.inference.noise import WhiteNoise
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.posterior import Posterior
from tests.measured import keep
from tests.together import (
    LEVEL,
    SEED,
    WrongCorrelation,
    errors_off,
    made,
    narrowed,
    shifted,
    together_test,
)

CONFIG = Path(__file__).resolve().parents[1] / "runs" / "calibration.toml"
FEW = 7

FULL = 500


def problem(fixed: tuple[str, ...] = (), **priors: str) -> Run:
    config = load(CONFIG)
    medians = {"d": 0.7, "alpha": 0.35, "beta": 0.03, "gamma": 0.0, "lag": 0.03, "offset": 0.0}
    lines = [f"{name} = {{ fixed = {medians[name]} }}" for name in fixed]
    lines += [f"{name} = {{ prior = {text} }}" for name, text in priors.items()]
    changed = parse("[record]\nfile = 'x'\n[parameters]\n" + "\n".join(lines), "changes")
    parameters = config.parameters | changed.parameters
    return resolve_config(config.model_copy(update={"parameters": parameters}), CONFIG.parent)


def judged(outcome: list[Replicate]) -> Calibration:
    return evaluate_calibration([one.entry for one in outcome], np.random.default_rng(SEED))


@pytest.mark.slow
def test_five_hundred_replicates_pass_and_find_small_defects() -> None:
    common = experiment(problem())
    sound, prior = made(common, FULL, SEED + 1), common.posterior.prior
    outcome, off = judged(sound), errors_off(sound)
    keep(
        "calibration",
        {
            "replicates": outcome.replicates,
            "unconverged": len(outcome.unconverged),
            "tests": len(outcome.statistics),
            "shortcomings": len(outcome.failures),
            "power": round(outcome.power["20% too small"], 3),
            "bands": {name: round(band.mean, 4) for name, band in outcome.bands.items()},
        },
    )
    assert () == outcome.failures
    assert () == outcome.unconverged
    assert outcome.power["20% too small"] > 0.98
    assert {} == {name: errors for name, errors in off.items() if not abs(errors) < LIMIT}
    assert together_test(sound, prior) > LEVEL
    for by in (0.2, 0.1, -0.25):
        assert together_test(sound, prior, partial(narrowed, by=by)) < LEVEL, by
    assert together_test(sound, prior, shifted) < LEVEL


# Defects that are planted in the likelihood or the prior


def test_white_noise_model_fails_the_bands() -> None:
    """It takes the discrepancy of the same records for sensor noise, as eight of them show."""
    common = experiment(problem(fixed=("lag", "beta")))
    right = common.posterior
    names = (*right.single_record.actuator.parameters, "sensor_sd")
    white = replace(
        right,
        datasets=(replace(right.single_record, noise=WhiteNoise()),),
        prior=JointPrior(p for p in right.prior.parameters if p.name in names),
        joint=None,
    )
    outcome = made(replace(common, posterior=white, source=right), 8)
    off = errors_off(outcome)
    for kind in ("parameter", "displacement"):
        assert off[f"{kind} 95"] < -LIMIT
    assert not judged(outcome).passed


@dataclass(frozen=True)
class Swapped(Posterior):
    """A posterior whose model has the sign of γ, against β, the wrong way round."""

    def log_likelihood(
        self, theta: FloatArray, displacement: FloatArray | None = None
    ) -> FloatArray:
        """Log likelihood of the model with the wrong sign."""
        return super().log_likelihood(self._swapped(theta), displacement)

    def simulate(
        self,
        theta: FloatArray,
        rows: IntArray | slice = slice(None),  # as the posterior has it
        record: str | None = None,
    ) -> FloatArray:
        """Displacement of the model with the wrong sign."""
        return super().simulate(self._swapped(theta), rows, record)

    def _swapped(self, theta: FloatArray) -> FloatArray:
        signs = np.ones(theta.shape[1])
        signs[self.prior.names.index("gamma")] = -1
        swapped: FloatArray = theta * signs
        return swapped


def wrong_correlation() -> CalibrationSetup:
    common = experiment(problem(fixed=("alpha", "beta", "gamma", "lag")))
    right = common.posterior
    wrong = right.altered(noise=WrongCorrelation(right.single_record.actuator.interval, 3.0))
    return replace(common, posterior=wrong, source=right)


def swapped_sign() -> CalibrationSetup:
    common = experiment(problem(fixed=("d", "lag", "offset")))
    right = common.posterior
    parts = {name: getattr(right, name) for name in right.__dataclass_fields__}
    return replace(common, posterior=Swapped(**parts), source=right)


def forgotten_prior() -> CalibrationSetup:
    """Simulate with the config's correlation time, and fit with a prior of ten times that."""
    fixed = ("alpha", "beta", "gamma", "lag")
    wide = '{ distribution = "lognormal", median = 3.0, sigma = 1.0 }'
    common = experiment(problem(fixed=fixed))
    forgetful = experiment(problem(fixed=fixed, discrepancy_time=wide))
    return replace(forgetful, source=common.posterior)


@pytest.mark.parametrize(
    "defect",
    [swapped_sign, forgotten_prior, pytest.param(wrong_correlation, marks=pytest.mark.slow)],
)
def test_defect_of_likelihood_or_prior_is_found(defect: Callable[[], CalibrationSetup]) -> None:
    outcome = judged(made(replace(defect(), held_out={}), FEW))
    assert not outcome.passed
    assert any("ranks" in text for text in outcome.failures), outcome.failures
