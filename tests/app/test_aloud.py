"""Python users are warned of what the command line prints."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app import aloud, problem
from bwbayes.app.folder import RunFolder
from bwbayes.app.problem import Problem
from bwbayes.app.run import finished
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputWarning
from bwbayes.inference.sampling import draws
from bwbayes.results.prediction import Start
from tests.app import small


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, FloatArray]:
    path = small.finished(tmp_path_factory)
    made, chain, _ = finished(RunFolder(path))
    flat = draws(made.posterior, chain).reshape(-1, len(made.posterior.names))
    return made, flat[:: len(flat) // 200]


def test_remarks_of_a_problem_are_warnings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = problem.resolve(small.config(), tmp_path)
    monkeypatch.setattr(problem, "resolve", lambda *_: replace(made, remarks=("one", "two")))
    with pytest.warns(InputWarning) as caught:
        assert ("one", "two") == aloud.resolve(small.config(), tmp_path).remarks
    assert ["one", "two"] == [str(warning.message) for warning in caught]
    assert {__file__} == {warning.filename for warning in caught}


def test_bands_that_hold_are_silent(fit: tuple[Problem, FloatArray]) -> None:
    made, flat = fit
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        windows = {"training": made.posterior.training[0]}
        generator = np.random.default_rng(1)
        (bands,) = aloud.predict_windows(made.posterior, flat, made.record, windows, generator)
    assert bands.training


def test_bands_that_do_not_hold_are_a_warning(fit: tuple[Problem, FloatArray]) -> None:
    made, flat = fit
    other = made.validations["sine"]
    assert other.record is not None
    assert other.record.displacement is not None
    turned = replace(other.record, displacement=-other.record.displacement)
    generator = np.random.default_rng(1)
    with pytest.warns(InputWarning, match="sine, not fitted: does not hold: .*against the voltage"):
        aloud.predict_record(made.posterior, flat, turned, other.start, generator, "sine")


def test_a_drive_beyond_what_was_fitted_is_a_warning(fit: tuple[Problem, FloatArray]) -> None:
    made, flat = fit
    plan = replace(made.record, voltage=5 * made.record.voltage, displacement=None, truth=None)
    generator = np.random.default_rng(1)
    with pytest.warns(
        InputWarning, match="plan: the voltage (goes from|moves at) .* are an extrapolation"
    ):
        aloud.predict_record(made.posterior, flat, plan, Start(True), generator, "plan")
