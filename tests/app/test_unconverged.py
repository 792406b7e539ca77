"""A run that has not converged keeps its draws, and speaks of no interval."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.commands.shared import finish
from bwbayes.app.config.config import load
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.storage import ChainFile
from tests.app import small
from tests.app.conftest import Type


@pytest.fixture(scope="module")
def cut_short(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, int]:
    path = tmp_path_factory.mktemp("short") / "small"
    made = small.begun(path, ("block = 25", "block = 25\nsteps = 25"))
    with pytest.MonkeyPatch.context() as patch:
        small.without_explanations(patch)
        return made, finish(made.path, workers=1, quiet=True)


def test_run_without_convergence_speaks_of_no_interval(
    cut_short: tuple[RunFolder, int],
) -> None:
    made, status = cut_short
    assert 4 == status
    assert 25 == ChainFile.read(made.chain).steps("sampling")
    seen = small.numbers(made.path)
    assert (False, None, None) == (seen["converged"], seen["parameters"], seen["validation"])
    assert seen["stop_reason"].startswith("step limit 25 reached: ")
    bands = made.path / "bands.csv"
    assert not bands.exists() or not bands.read_text().strip()
    page = (made.path / "report.html").read_text(encoding="utf-8")
    assert "95%" not in re.sub(r"<style.*?</style>|=\"data:[^\"]*\"", "", page, flags=re.S)
    assert not list((made.path / "figures").glob("bands*"))
    assert not list((made.path / "figures").glob("co*"))  # corner, coverage


def test_one_that_is_interrupted_is_said_to_be_not_finished(
    cut_short: tuple[RunFolder, int], bwbayes: Type, tmp_path: Path
) -> None:
    path = tmp_path / "interrupted"
    shutil.copytree(cut_short[0].path, path)
    (path / "summary.json").unlink()
    said = bwbayes("predict", str(path), "--signal", "step50")
    said.assert_refused(f"is not finished; resume with `bwbayes resume {path}`")


def test_line_on_the_screen_says_what_to_do(
    cut_short: tuple[RunFolder, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(cut_short[0].path, tmp_path / "a")
    assert 4 == finish(tmp_path / "a", workers=1, quiet=True)
    printed = capsys.readouterr()
    assert "" == printed.out
    assert 1 == printed.err.count("\n")
    assert printed.err.startswith("NOT CONVERGED: step limit 25 reached: ")
    command = re.escape(f"`bwbayes resume {tmp_path / 'a'} --steps ") + r"(\d+)`"
    (steps,) = re.findall(command, printed.err)
    assert 2 * 25 <= int(steps) < 1000


@pytest.mark.parametrize(
    "command",
    [
        "predict RUN --signal step10 --from-rest",
        "compensate RUN sine --amplitude 20 --frequency 1",
        "design RUN --parameter d",
        "export RUN",
        "track RUN",
        "budget RUN",
        "certificate RUN",
    ],
)
def test_whatever_builds_on_it_is_refused_with_its_status(
    bwbayes: Type, cut_short: tuple[RunFolder, int], command: str, tmp_path: Path
) -> None:
    words = command.replace("RUN", str(cut_short[0].path)).split()
    said = bwbayes(*words, "--out", tmp_path / "out")
    assert (4, "") == (said.status, said.out)
    assert re.fullmatch(r"NOT CONVERGED: [^\n]*`bwbayes resume [^\n]*\n", said.err)
    assert not any(tmp_path.iterdir())


@pytest.mark.usefixtures("_without_pictures", "_without_explanations")
def test_larger_budget_converges_to_what_it_would_have_been(
    run: Path, cut_short: tuple[RunFolder, int], tmp_path: Path
) -> None:
    shutil.copytree(cut_short[0].path, tmp_path / "small")
    made = RunFolder.open(tmp_path / "small")
    result = resume(made, small.quiet(), workers=1, steps=20_000)
    assert result.outcome.converged
    assert 20_000 == load(made.config).sampling.steps
    small.assert_same_end(run, made.path)


def not_a_number(_: Posterior, theta: FloatArray) -> FloatArray:
    return np.full(len(theta), np.nan)


def test_likelihood_that_is_nan_everywhere_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = small.begun(tmp_path / "a")
    monkeypatch.setattr(Posterior, "log_likelihood", not_a_number)
    with pytest.raises(InputError, match="no draw has a finite posterior density"):
        finish(folder.path, workers=1, quiet=True)
    assert not folder.summary.exists()
