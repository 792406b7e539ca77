"""Where what a model misses follows the drive, rivals widen the bands of unlike drives alone."""

from dataclasses import replace
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
from bwbayes.diagnosis.rivals import Rival, drive_locks, families, fit_rivals
from bwbayes.inference import map_estimate
from bwbayes.inference.study import generator
from bwbayes.model.spec import ModelSpec
from bwbayes.prediction.bands import KINDS, LEVELS
from bwbayes.record import Record
from bwbayes.record.io.formats import write_record
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
