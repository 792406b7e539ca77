"""Where what a model misses follows the drive, rivals widen the bands of unlike drives alone."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bwbayes.app.config.config import parse
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.predict import Prediction, predict_after, predict_another
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.laplace import climb
from bwbayes.diagnosis.rivals import (
    DriveLock,
    Rival,
    compare,
    drive_features,
    drive_lock,
    drive_locks,
    families,
    fit_rivals,
    predictability,
)
from bwbayes.inference import map_estimate
from bwbayes.inference.noise import noise_model
from bwbayes.inference.study import generator
from bwbayes.model.spec import ModelSpec
from bwbayes.prediction.bands import KINDS, LEVELS
from bwbayes.record import Record
from bwbayes.record.io.formats import write_record
from tests.inference.problems import short_posterior, truth
from tests.prediction.runs import covered
from tests.stand import Stand, play

STAND = Stand(lag=0.005, discrepancy=0.0, sensor=0.05)
TIME = np.arange(600) / STAND.rate
DRIVES = {
    "record": 50 * (1 - np.cos(2 * np.pi * TIME)) * np.exp(-0.1 * TIME),
    "like": 50 * (1 - np.cos(2 * np.pi * TIME)) * np.exp(-0.1 * TIME),
    "unlike": 25 * (2 - np.cos(2 * np.pi * 0.9 * TIME) - np.cos(2 * np.pi * 0.23 * TIME)),
}
CONFIG = """
[record]
file = "record.h5"
from_rest = true
[model]
noise = "smooth"
[validation.like]
file = "like.h5"
[validation.unlike]
file = "unlike.h5"
"""


def measured(kind: str, voltage: FloatArray, rng: np.random.Generator) -> Record:
    """Measure a good actuator, or the same behind a mount with backlash."""
    record = replace(STAND, sensor=0.0).measure(voltage, rng)
    assert record.displacement is not None
    moved = record.displacement if kind == "good" else play(record.displacement, 1.0)
    return replace(record, displacement=moved + STAND.sensor * rng.standard_normal(moved.size))


def fitted(kind: str, folder: Path) -> Run:
    """Return a run whose draws (draws, free) are those of Laplace's approximation."""
    rng = np.random.default_rng(54)
    for name, voltage in DRIVES.items():
        write_record(measured(kind, voltage, rng), folder / f"{name}.h5")
    problem = resolve_config(parse(CONFIG, "config"), folder)
    posterior = problem.study.posterior
    fit = climb(posterior, map_estimate.local_minima(posterior, rng, 1))
    drawn = rng.multivariate_normal(fit.coordinates, fit.covariance, 300, method="eigh")
    free, density = posterior.prior.constrain(drawn)
    return problem.with_cache(flat_draws=free[np.isfinite(density)])


class Rivals:
    """The rivals of a problem's model, fitted once, if its error follows the drive."""

    def __init__(self, problem: Run) -> None:
        self.study = problem.study
        lock = drive_locks(self.study.posterior, problem.flat_draws, generator(1, "drive lock"))[
            "record"
        ]
        self.locked = lock.locked
        self.fitted: tuple[Rival, ...] | None = None

    def __call__(self, of: str, _: object) -> tuple[Rival, ...] | None:
        """Return them, or None."""
        if self.locked and self.fitted is None:
            self.fitted = fit_rivals(
                self.study.for_record(of), families(self.study.spec), generator(1, "rivals")
            )
        return self.fitted


def agreeing(*_: object) -> tuple[Rival, ...]:
    return ()


def predicted(problem: Run, name: str, rivals: Any) -> Prediction:
    run = problem.with_cache(widening_rivals=rivals)
    return predict_another(run, problem.study.validations[name], name)


def require_wider(wide: Prediction, narrow: Prediction) -> None:
    """Assert that displacement and sensor bands have the error in them, and nothing else."""
    assert wide.model_error_sd is not None
    assert wide.model_error_sd > 0
    assert [note for note in wide.remarks if "um wide instead of" in note] == [
        wide.model_error_note
    ]
    assert narrow.model_error_sd == 0.0
    assert not narrow.model_error_note
    for level in LEVELS:
        for edges in ("lower", "upper"):
            band = getattr(wide, edges)["parameter", level]
            assert np.array_equal(band, getattr(narrow, edges)["parameter", level])
    for kind in KINDS[1:]:
        added = wide.sd(kind) ** 2 - narrow.sd(kind) ** 2
        assert np.mean(added) == pytest.approx(wide.model_error_sd**2, rel=0.1)
    assert np.array_equal(wide.mean, narrow.mean)


def test_unlike_drives_of_a_wrong_model_have_wider_bands(tmp_path: Path) -> None:
    """Like drives have not; forecasts have; the parameters' bands stay, a note says both widths."""
    problem = fitted("backlash", tmp_path)
    rivals = Rivals(problem)
    assert predicted(problem, "like", rivals).model_error_sd is None
    assert rivals.fitted is None
    wide, narrow = (predicted(problem, "unlike", found) for found in (rivals, agreeing))
    require_wider(wide, narrow)
    assert covered(wide) > covered(narrow)
    # The report has both.
    assert wide.without_rivals.width() == pytest.approx(narrow.width(), rel=0.03)
    times = f"{wide.width() / wide.without_rivals.width():.2g}"
    assert f"bands widened {times} times on this one" in str(wide)
    assert "Without rivals" in str(wide)
    assert "Without rivals" not in str(narrow)
    for bands in (wide, narrow):
        drawn = bands.plot().axes[4].get_legend_handles_labels()[1]
        assert ("sensor band without rivals" in drawn) is (bands is wide)
    plan = problem.study.validations["unlike"].record
    assert plan is not None
    require_wider(
        *(
            predict_after(
                problem.with_cache(widening_rivals=found), plan.voltage, "later", "record"
            )
            for found in (rivals, agreeing)
        )
    )


def test_right_model_keeps_its_bands(tmp_path: Path) -> None:
    """No rival is fitted."""
    problem = fitted("good", tmp_path)
    rivals = Rivals(problem)
    for name in ("like", "unlike"):
        prediction = predicted(problem, name, rivals)
        assert prediction.model_error_sd is None
        assert not any("follows the drive" in remark for remark in prediction.remarks)
    assert rivals.fitted is None


@pytest.mark.parametrize(
    "spec",
    [
        ModelSpec(),
        ModelSpec.from_keys({"hysteresis": "duhem", "creep": True, "creep_growth": True}),
        ModelSpec().with_stages("quadratic", "cubic", "backlash"),
        ModelSpec().with_stages("plays", "cubic", "backlash", "saturation", "sensor-curve"),
    ],
)
def test_there_is_one_rival_of_each_family(spec: ModelSpec) -> None:
    """Other operators, each place of the nonlinearity, with creep and without; never the model."""
    rivals = list(families(spec))
    assert spec not in rivals
    assert len({*rivals}) == len(rivals) >= 5
    others = {"bouc-wen", "duhem", "plays"} - {spec.operator.name}
    assert {rival.operator.name for rival in rivals} >= others
    for name in ("creep", "saturation", "sensor-curve"):
        assert {name in rival.chain for rival in rivals} == {True, False}
    for rival in rivals:
        assert ("backlash" in rival.chain) is ("backlash" in spec.chain)
        assert "lag" in rival.chain


# A residual that follows the drive is told from one that does not.
# False alarms: at most 3% of residuals of white, rough and smooth noise (2% by the test's level;
# one of 120 fits of good actuators). Power: 95% of misfits as large as that noise, where the drive
# comes back to where it was; of a multisine, which hardly does in 12 s, of those twice as large by
# like states alone, and of those half as large as white noise by its other parts.


INTERVAL, ROWS = 0.02, np.arange(600)
LOCK_TIME = INTERVAL * ROWS
NOISES = {"white": [0.1], "discrepancy": [0.1, 0.2, 0.2], "smooth": [0.1, 0.2, 0.2, 0.6]}


def drive(kind: str, rng: np.random.Generator) -> FloatArray:
    """Return a voltage (samples,) of 12 s."""
    phases = rng.uniform(0, 2 * np.pi, 3)
    voltage: FloatArray = 100 * np.abs((0.9 * LOCK_TIME + phases[0]) % 2 - 1)
    if kind == "decaying sine":
        voltage = 50 + 45 * np.exp(-0.12 * LOCK_TIME) * np.sin(2 * np.pi * LOCK_TIME + phases[0])
    if kind == "multisine":
        tones = np.sin(2 * np.pi * np.outer([0.21, 0.53, 0.9], LOCK_TIME) + phases[:, np.newaxis])
        voltage = 50 + 15 * tones.sum(axis=0)
    return voltage


def misfit(voltage: FloatArray) -> FloatArray:
    """Return what plays add to a line of the voltage (samples,), of unit variance."""
    plays = [play(voltage - voltage[0], threshold) for threshold in (5.0, 15.0, 30.0)]
    followed = np.sum(plays, axis=0)
    line = np.polynomial.Polynomial.fit(voltage, followed, 1)
    rest: FloatArray = followed - line(voltage)
    return rest / np.std(rest)


def locked(noise: str, kind: str, number: int, size: float, *, own: bool = True) -> DriveLock:
    """Look at noise with a misfit of a size, in its sds, along its own drive or another one."""
    rng = np.random.default_rng((54, number))
    voltage = drive(kind, rng)
    followed = voltage if own else drive("multisine", rng)
    residual, *chance = drawn(noise)[[number, *range(100, 300)]]
    residual = residual + size * np.std(chance) * misfit(followed)
    return compare(residual, np.stack(chance), voltage, ROWS)


@cache
def drawn(noise: str) -> FloatArray:
    """Draw residuals (draws, samples) of a noise, um."""
    theta, rng = np.repeat([NOISES[noise]], 300, axis=0), np.random.default_rng(54)
    both = noise_model(noise, INTERVAL).draw_all(theta, ROWS.size, rng)
    total: FloatArray = both[0] + both[1]
    return total


@pytest.mark.parametrize("noise", NOISES)
def test_noise_does_not_follow_the_drive(noise: str) -> None:
    kinds = ("decaying sine", "triangle", "multisine")
    found = [locked(noise, kind, number, 0.0) for number in range(40) for kind in kinds]
    assert sum(lock.locked for lock in found) <= 0.03 * len(found)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("kind", ["decaying sine", "triangle", "multisine"])
def test_misfit_as_large_as_the_noise_is_seen(noise: str, kind: str) -> None:
    size = 2.0 if kind == "multisine" else 1.0
    found = [locked(noise, kind, number, size) for number in range(20)]
    assert sum(lock.locked for lock in found) >= 0.95 * len(found)


def test_misfit_of_another_drive_is_not_one_of_this() -> None:
    """The twin: as large, but along a drive that the actuator did not have, it is hardly seen."""
    found = [locked("smooth", "triangle", number, 1.0, own=False) for number in range(20)]
    assert sum(lock.locked for lock in found) <= 0.3 * len(found)


@pytest.mark.parametrize(("size", "seen"), [(0.0, (0.0, 0.03)), (0.5, (0.95, 1.0))])
def test_parts_of_a_record_tell_of_each_other(size: float, seen: tuple[float, float]) -> None:
    """An error that follows a multisine, half of white noise, is seen; the noise alone is not."""
    found = []
    for number in range(100):
        rng = np.random.default_rng((55, number))
        voltage = drive("multisine", rng)
        white = rng.standard_normal(voltage.size) + size * misfit(voltage)
        found.append(predictability(white, drive_features(voltage), rng) < 0.01)
    assert seen[0] <= np.mean(found) <= seen[1]


@pytest.mark.parametrize("planted", [False, True])
def test_posterior_of_a_record_is_looked_at(planted: bool) -> None:
    """With gaps between its readings; what is found is said in words."""
    posterior = short_posterior(samples=800)
    record, rng = posterior.single_record, np.random.default_rng(5)
    readings = record.displacement + 2.0 * planted * misfit(record.voltage)
    readings[100:160] = np.nan
    posterior = posterior.altered(displacement=readings)
    free = truth(posterior)[:, [posterior.prior.names.index(name) for name in posterior.names]]
    lock = drive_lock(posterior, free, rng)
    assert lock.locked is planted
    assert ["follows the drive" in str(finding) for finding in lock.findings] == [True] * planted
    # The fix is to measure a record that `design` finds.
    assert all("bwbayes design FOLDER --validate" in finding.fix for finding in lock.findings)
    assert lock.numbers["follows_the_drive"] is planted


def test_few_readings_and_readings_that_are_only_rounded_tell_nothing() -> None:
    posterior = short_posterior(samples=800)
    free = truth(posterior)[:, [posterior.prior.names.index(name) for name in posterior.names]]
    exact = posterior.simulate(truth(posterior))[0]
    for readings in (np.where(np.arange(800) < 30, exact, np.nan), np.round(exact)):
        altered = posterior.altered(displacement=readings)
        assert not drive_lock(altered, free, np.random.default_rng(1)).locked
