"""Readings without noise, as a first try has them: a fit converges, and says what they lack."""

import warnings
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from tests.app import small

TIME = 0.005 * np.arange(400)
VOLTAGE = 60 * np.exp(-0.1 * TIME) * np.sin(2 * np.pi * TIME)
TRUTH = {"alpha": 0.35, "beta": 0.03, "gamma": 0.015}
EXACT = 0.7 * VOLTAGE - np.ravel(bw.hysteresis(VOLTAGE, **TRUTH))


def fitted(displacement: FloatArray, voltage: FloatArray = VOLTAGE) -> bw.Run:
    record = bw.Record.from_arrays(voltage, displacement, interval=0.005)
    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
        small.without_explanations(patch)
        warnings.simplefilter("ignore")
        keys: dict[str, Any] = {
            "dynamics": "none",
            "noise": "white",
            "search": "none",
            "ess": 200,
            "walkers": 20,
        }
        return bw.fit(record, progress=False, **keys)


def test_an_exact_record_gives_its_parameters() -> None:
    fit = fitted(EXACT)
    assert fit.converged
    assert fit.passed is not False, fit.standing.lines
    assert any("no noise" in note for note in fit.notes)
    means = dict(zip(fit.study.posterior.names, fit.flat_draws.mean(axis=0), strict=True))
    for name, value in {"d": 0.7, **TRUTH}.items():
        assert means[name] == pytest.approx(value, rel=1e-5)


def test_a_drive_that_jumps_gives_its_parameters() -> None:
    """Differences of its readings do not show that they have no noise."""
    voltage = np.repeat(np.random.default_rng(3).uniform(-60, 60, 100), 4)
    fit = fitted(0.7 * voltage - np.ravel(bw.hysteresis(voltage, **TRUTH)), voltage)
    assert fit.converged
    means = dict(zip(fit.study.posterior.names, fit.flat_draws.mean(axis=0), strict=True))
    for name, value in {"d": 0.7, **TRUTH}.items():
        assert means[name] == pytest.approx(value, rel=1e-5)


def test_two_levels_are_a_coarse_sensor() -> None:
    fit = fitted(np.where(EXACT > 0, 10.0, 0.0))
    assert fit.converged
    assert any("coarse resolution" in note for note in fit.notes)
    assert fit.passed is not False, fit.standing.lines


@pytest.mark.parametrize("level", [0.0, 3.7])
@pytest.mark.parametrize("column", ["voltage", "displacement"])
def test_a_constant_column_is_refused_in_a_line(column: str, level: float) -> None:
    columns = {"voltage": VOLTAGE, "displacement": EXACT, column: np.full(400, level)}
    with pytest.raises(InputError, match="constant") as refused:
        fitted(columns["displacement"], columns["voltage"])
    assert "\n" not in str(refused.value)
