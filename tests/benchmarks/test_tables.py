"""Every table of the command is filled, on a record short enough for tests."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from bwbayes.inference.posterior import Posterior
from tests.benchmarks import likelihood, timing
from tests.benchmarks.__main__ import TARGETS, main
from tests.benchmarks.cases import Effort
from tests.benchmarks.startup import STARTS, started
from tests.benchmarks.tables import Table, written
from tests.inference.problems import short_posterior

ONCE = Effort(rounds=1, longest=1000, steps=1, everything=False)


@pytest.mark.parametrize(
    ("measure", "rows"),
    [
        (likelihood.batches, 6),
        (likelihood.models, 6),
        (likelihood.lengths, 1),
        (likelihood.hysteresis_alone, 1),
        (likelihood.threads, 1),
    ],
)
def test_tables_of_the_likelihood_are_filled(
    measure: Callable[[Posterior, Effort], Table], rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timing, "TURN", 0.0)
    fixed = {"initial": 0.0, "mass": 0.00134, "stiffness": 4.1e5}
    table = measure(short_posterior(samples=100, dynamics="second-order", fixed=fixed), ONCE)
    assert rows == len(table.rows)
    for row in table.rows:
        assert all(cell > 0 for cell in row.values() if isinstance(cell, int | float))


def test_figures_can_be_read_again(tmp_path: Path) -> None:
    table = Table("steps", "Steps", "note", [{"move": "a", "s": 0.5, "other": None}])
    written([table], {"cores": 2}, tmp_path / "benchmarks.json")
    read = json.loads((tmp_path / "benchmarks.json").read_text(encoding="utf-8"))
    assert 2 == read["cores"]
    assert [{"move": "a", "s": 0.5, "other": None}] == read["steps"]["rows"]


@pytest.mark.slow
def test_the_quick_command_says_what_became_of_each_target(tmp_path: Path) -> None:
    out = tmp_path / "benchmarks.json"
    done = CliRunner().invoke(main, ["--quick", "--out", str(out)], catch_exceptions=False)
    assert 0 == done.exit_code
    rows = json.loads(out.read_text(encoding="utf-8"))["targets"]["rows"]
    assert [name for name, _, _ in TARGETS] == [row["target"] for row in rows]


def test_every_start_ends_well() -> None:
    for arguments in STARTS.values():
        started(arguments)()
