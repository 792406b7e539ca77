"""Measured loops and steps come into summary, report and picture, once a run has converged."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
import pytest

from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.creep import Creep
from bwbayes.prediction.loops import MEASURES, measure_loops
from bwbayes.prediction.steps import STEP_MEASURES, Step, measure_step
from bwbayes.report.result import summary
from tests.app import example
from tests.app.test_report import rows
from tests.inference.problems import decaying_sine, posterior_of


def posterior(creep: Creep | None = None, middle: float = 0.0) -> Posterior:
    voltage = decaying_sine(200) + middle
    actuator = Actuator("lag", "first", 0.01, creep=creep)
    return posterior_of(voltage, 0.6 * voltage, actuator, "discrepancy", {}, from_rest=True)


@pytest.fixture(scope="module")
def measured() -> dict[str, Any]:
    """Return loops, away from zero volt, and steps without and with creep."""
    off, steps = posterior(middle=130.0), {}
    for name, creep in (("one", None), ("two", Creep((0.1, 1.0)))):
        of = posterior(creep)
        draws = of.prior.draw(np.random.default_rng(1), 20)
        steps[name] = measure_step(of, draws, Step(50.0, 5.0))
    loops = measure_loops(off, off.prior.draw(np.random.default_rng(1), 30))
    return {"loops": loops, "steps": steps}


@pytest.mark.parametrize(
    ("table", "key", "columns", "measures"),
    [
        ("loops", "loops", ("major", "minor"), MEASURES),
        ("steps", "step_responses", ("one", "two"), STEP_MEASURES),
    ],
)
def test_the_table_is_the_summarys(
    measured: dict[str, Any],
    table: str,
    key: str,
    columns: tuple[str, str],
    measures: dict[str, tuple[str, str]],
) -> None:
    run = dataclasses.replace(example.run(), **measured)
    numbers: Any = summary(run)[key]
    shown = rows(example.page(run), table)
    for name, (title, unit) in measures.items():
        *texts, shown_unit = shown[title]
        assert unit.replace("um", "µm") == shown_unit
        for column, cells in zip(columns, (texts[:2], texts[2:]), strict=True):
            estimate = numbers[column][name]
            if estimate is None:
                assert ["–"] * 2 == cells
                continue
            said = [float(text) for cell in cells for text in re.split(" ± | to ", cell)]
            expected = [estimate[key] for key in ("mean", "sd", "lower_95", "upper_95")]
            assert expected == pytest.approx(said, abs=0.0503 * estimate["sd"], rel=0)


def test_what_a_loop_or_step_has_not_is_not_there(measured: dict[str, Any]) -> None:
    numbers: Any = summary(dataclasses.replace(example.run(), **measured))
    assert numbers["loops"]["major"]["opening_um"] is None  # it does not go through zero
    assert numbers["step_responses"]["one"]["creep_percent"] is None
