"""A run that has not converged keeps its draws, and speaks of no interval."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from bwbayes.app import run as module
from bwbayes.app.cli import _finish
from bwbayes.app.config import load
from bwbayes.app.folder import RunFolder
from bwbayes.app.predict import predict
from bwbayes.app.run import carry_on
from bwbayes.inference.chainfile import ChainFile
from bwbayes.results.prediction import Start
from tests.app import small


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small.finished(tmp_path_factory)


@pytest.fixture(scope="module")
def cut_short(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, int]:
    """Return a run that used up its budget, and the exit status of its command."""
    path = tmp_path_factory.mktemp("short") / "small"
    made = small.begun(path, ("block = 25", "block = 25\nsteps = 25"))
    return made, _finish(made.path, 1, quiet=True)


def test_run_without_convergence_speaks_of_no_interval(
    cut_short: tuple[RunFolder, int],
) -> None:
    made, status = cut_short
    assert 4 == status
    found = small.numbers(made.path)
    assert (False, None, None) == (found["converged"], found["parameters"], found["validation"])
    assert found["stop_reason"].startswith("budget of 25 steps used up: ")
    bands = made.path / "bands.csv"
    assert not bands.exists() or not bands.read_text().strip()
    page = (made.path / "report.html").read_text(encoding="utf-8")
    assert "95 %" not in re.sub(r"<style.*?</style>|src=\"data:[^\"]*\"", "", page, flags=re.S)
    assert not list((made.path / "figures").glob("bands*"))
    assert not list((made.path / "figures").glob("co*"))  # corner, coverage


def test_run_without_convergence_keeps_its_draws(cut_short: tuple[RunFolder, int]) -> None:
    made, _ = cut_short
    assert 25 == ChainFile.read(made.chain).steps("sampling")


def test_line_on_the_screen_says_what_to_do(
    cut_short: tuple[RunFolder, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(cut_short[0].path, tmp_path / "a")
    assert 4 == _finish(tmp_path / "a", 1, quiet=True)
    printed = capsys.readouterr()
    assert "" == printed.out
    assert 1 == printed.err.count("\n")
    assert printed.err.startswith("NOT CONVERGED: budget of 25 steps used up: ")
    assert f"`bwbayes resume {tmp_path / 'a'} --steps N`" in printed.err


def test_prediction_from_it_is_refused(cut_short: tuple[RunFolder, int], tmp_path: Path) -> None:
    made, _ = cut_short
    out = tmp_path / "bands.csv"
    start = Start(from_rest=True)
    assert 4 == predict(made.path, None, "step10", start, out, small.quiet())
    assert not out.exists()


def test_larger_budget_converges_to_what_it_would_have_been(
    run: Path,
    cut_short: tuple[RunFolder, int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "draw_all", lambda _: {})
    shutil.copytree(cut_short[0].path, tmp_path / "small")
    made = RunFolder.open(tmp_path / "small")
    result = carry_on(made, small.quiet(), workers=1, steps=20_000)
    assert result.outcome.converged
    assert 20_000 == load(made.config).sampling.steps
    small.assert_same_end(run, made.path)
