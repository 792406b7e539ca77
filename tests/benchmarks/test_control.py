"""The table of what a controller's step costs has a row for every actuator."""

from __future__ import annotations

import pytest

from tests.benchmarks import control
from tests.benchmarks.cases import Effort
from tests.control import cases
from tests.programs import needs


def test_every_actuator_has_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    needs("cc")
    monkeypatch.setattr(control, "SAMPLES", 100)
    table = control.controller(Effort(rounds=1, longest=100, steps=1, everything=False))
    assert list(cases.ACTUATORS) == [row["model"] for row in table.rows]
    for row in table.rows:
        times = row["forward, ns"], row["inverse, ns"], row["state, bytes"]
        assert all(isinstance(one, float | int) and one > 0 for one in times)
