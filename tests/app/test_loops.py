"""Measured loops and steps come into summary, report and picture, once a run has converged."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
import pytest

from bwbayes.model.actuator import Actuator
from bwbayes.model.creep import Creep
from bwbayes.prediction.loops import MEASURES, Loops, measure_loops
from bwbayes.prediction.steps import STEP_MEASURES, Step, StepResponse, measure_step
from bwbayes.report.result import Result, summary
from tests.app import example
from tests.app.test_report import rows
from tests.inference.problems import decaying_sine, posterior_of


@pytest.fixture(scope="module")
def measured() -> Loops:
    voltage = decaying_sine(200) + 130.0  # does not go through zero
    actuator = Actuator("lag", "first", 0.01)
    of = posterior_of(voltage, 0.6 * voltage, actuator, "discrepancy", {}, from_rest=True)
    return measure_loops(of, of.prior.draw(np.random.default_rng(1), 30))


def with_loops(measured: Loops, *, converged: bool = True) -> Result:
    return dataclasses.replace(example.run(converged), loops=measured)


def test_table_is_the_summarys(measured: Loops) -> None:
    run = with_loops(measured)
    kept: Any = summary(run)["loops"]
    table = rows(example.page(run), "loops")
    for name, (title, unit) in MEASURES.items():
        *texts, shown_unit = table[title]
        assert unit.replace("um", "µm") == shown_unit
        for loop, cells in (("major", texts[:2]), ("minor", texts[2:])):
            one = kept[loop][name]
            if one is None:
                assert ["–"] * 2 == cells
                continue
            shown = [float(text) for cell in cells for text in re.split(" ± | to ", cell)]
            expected = [one[key] for key in ("mean", "sd", "lower_95", "upper_95")]
            assert expected == pytest.approx(shown, abs=0.0503 * one["sd"], rel=0)
    assert kept["major"]["opening_um"] is None


def test_without_convergence_no_loop_is_shown(measured: Loops) -> None:
    run = with_loops(measured, converged=False)
    assert summary(run)["loops"] is None
    assert 'id="loops"' not in example.page(run, pictures={"loops": b""})
    assert "loops" not in example.figures(run)


@pytest.fixture(scope="module")
def steps() -> dict[str, StepResponse]:
    voltage = decaying_sine(200)
    outcome = {}
    for name, creep in (("one", None), ("two", Creep((0.1, 1.0)))):
        actuator = Actuator("lag", "first", 0.01, creep=creep)
        of = posterior_of(voltage, 0.6 * voltage, actuator, "discrepancy", {}, from_rest=True)
        draws = of.prior.draw(np.random.default_rng(1), 20)
        outcome[name] = measure_step(of, draws, Step(50.0, 5.0))
    return outcome


def test_table_of_steps_is_the_summarys(steps: dict[str, StepResponse]) -> None:
    run = dataclasses.replace(example.run(), steps=steps)
    kept: Any = summary(run)["step_responses"]
    table = rows(example.page(run), "steps")
    for name, (title, _) in STEP_MEASURES.items():
        *texts, _ = table[title]
        for step, cells in (("one", texts[:2]), ("two", texts[2:])):
            one = kept[step][name]
            if one is None:
                assert ["–"] * 2 == cells
            else:
                mean = float(cells[0].split(" ± ")[0])
                assert one["mean"] == pytest.approx(mean, abs=0.0503 * one["sd"])
    assert kept["one"]["creep_percent"] is None


def test_without_convergence_no_step_is_shown(steps: dict[str, StepResponse]) -> None:
    run = dataclasses.replace(example.run(converged=False), steps=steps)
    assert summary(run)["step_responses"] is None
    assert 'id="steps"' not in example.page(run, pictures={"steps": b""})
    assert "steps" not in example.figures(run)
