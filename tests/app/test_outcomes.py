"""Messages of a run that has not converged, failed or is inconclusive, or has a correction.

Each product of a run says first how its validation came out, wherever it is read; that nothing is
said of a run that passed, each command's own tests say. Without convergence draws are kept, and
there is no interval. A run whose bands fail on held-out readings has a corrected band.
"""

import json
import re
import shutil
import warnings
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import bwbayes as bw
from bwbayes.app.commands.cli import cli, finish
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.validation import BandValidation, ValidationSummary
from bwbayes.errors import InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.chain import ChainFile
from tests.app import small
from tests.app.conftest import Type

pytestmark = pytest.mark.usefixtures("_without_pictures")


@pytest.fixture(scope="module")
def cut_short(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, int]:
    path = tmp_path_factory.mktemp("short") / "small"
    made = small.begun(path, ("block = 25", "block = 25\nsteps = 25"))
    with pytest.MonkeyPatch.context() as patch:
        small.without_explanations(patch)
        return made, finish(made.path, workers=1, quiet=True)


def test_run_without_convergence_speaks_of_no_interval(cut_short: tuple[RunFolder, int]) -> None:
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


def test_the_steps_that_are_advised_lead_to_convergence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each advice at least doubles what was sampled, also where the limit ends within a block."""
    small.without_explanations(monkeypatch)
    made = small.begun(tmp_path / "a", ("block = 25", "block = 25\nsteps = 4"))
    status, taken = finish(made.path, workers=1, quiet=True), [0]
    while status == 4:
        (steps,) = re.findall(r"--steps (\d+)`", capsys.readouterr().err)
        taken.append(ChainFile.read(made.chain).steps("sampling"))
        assert taken[-1] >= 2 * taken[-2]
        check = bw.open_run(made.path).outcome.check
        assert int(steps) >= max(2 * taken[-1], 50 * np.max(check.autocorrelation))
        assert int(steps) >= taken[-1] * 200 / check.lowest_ess
        status = finish(made.path, workers=1, quiet=True, steps=int(steps))
    assert (0, 0, 25) == (status, *taken[:2])
    assert len(taken) <= 4


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


OFF = "95% bands cover 55% of 50 readings"
STATUS = {False: 3, None: 5}
HEADLINE = {False: "VALIDATION FAILED", None: "Validation inconclusive"}
COMMANDS = {
    "compensate": ("sine", "--amplitude", "20", "--frequency", "1", "--from-rest"),
    "track": ("--frequency", "2", "--draws", "5"),
    "design": ("--parameter", "d"),
    "export": (),
    "predict": ("--signal", "step50", "--from-rest"),
}
IN_PYTHON: dict[str, Callable[[bw.Run, Path], Any]] = {
    "compensate": lambda fit, _: fit.compensate("sine", amplitude=20, frequency=1, from_rest=True),
    "design": lambda fit, _: fit.design("d"),
    "export": lambda fit, folder: fit.export(folder),
}


def verdict(passed: bool | None) -> BandValidation:
    cause = Finding("loop", "the operator", "try another") if passed is False else None
    return BandValidation("held-out (held out)", False, passed, (OFF,), cause)


@pytest.fixture(
    params=[
        pytest.param(False, id="failed"),
        pytest.param(None, id="inconclusive", marks=pytest.mark.slow),
    ]
)
def passed(request: pytest.FixtureRequest) -> bool | None:
    answer: bool | None = request.param
    return answer


@pytest.fixture
def judged(run: Path, tmp_path: Path, passed: bool | None) -> Path:
    folder = tmp_path / "judged"
    shutil.copytree(run, folder)
    numbers = json.loads((folder / "summary.json").read_text())
    numbers["validation"]["held-out"] |= verdict(passed).summary
    (folder / "summary.json").write_text(json.dumps(numbers))
    return folder


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n == "track")) for n in COMMANDS]
)
def test_each_command_says_it_first_and_ends_with_its_status(
    name: str, judged: Path, passed: bool | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    where = out / "bands.csv" if name == "predict" else out
    arguments = [name, str(judged), *COMMANDS[name], "--out", str(where)]
    assert cli.main(arguments, standalone_mode=False) == STATUS[passed]
    said = capsys.readouterr()
    # All but one show a report on the screen, and the verdict above it.
    first = (said.err if name == "export" else said.out).partition("\n")[0]
    assert first.startswith(f"{HEADLINE[passed]}: held-out")
    assert OFF in first
    (numbers,) = out.glob("*.json")
    key = "run_validation" if name == "predict" else "validation"
    known = json.loads(numbers.read_text())[key]
    assert known["status"] == ("inconclusive" if passed is None else "failed")
    assert [OFF in line for line in known["messages"]] == [True]
    for page in out.glob("*.html"):
        text = page.read_text(encoding="utf-8")
        kinds = re.findall(r'<section class="status (\w+)"', text)
        assert kinds[0] == {False: "bad", None: "note"}[passed]
        assert "good" not in kinds
        assert text.index(OFF) < text.index("<table")
    for code in out.glob("*.c"):
        comment = re.sub(r"\s*\n \* ", " ", code.read_text().partition("*/")[0])
        assert OFF in comment
    assert name in {"export", "predict"} or any(out.glob("*.html"))


@pytest.mark.parametrize("name", IN_PYTHON)
def test_python_warns_of_it(
    name: str, fit: bw.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    validation = fit.validation | {"held-out": verdict(False)}
    monkeypatch.setitem(fit.__dict__, "standing", ValidationSummary.of(validation.values()))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        made = IN_PYTHON[name](fit, tmp_path / "out")
    (told,) = (one for one in caught if OFF in str(one.message))
    assert str(told.message).startswith(HEADLINE[False])
    assert Path(told.filename) == Path(__file__)
    if name != "design":
        assert made.standing.passed is False
    if name == "compensate":
        assert repr(made).startswith(HEADLINE[False])


NARROW = (
    "gamma = { fixed = 0.0172 }",
    "gamma = { fixed = 0.0172 }\nsensor_sd = { fixed = 0.1 }\n"
    "[model]\nnoise = 'white'\nstages = []",
)
COLUMNS = ["corrected_lower_95_um", "corrected_upper_95_um"]


@pytest.fixture(scope="module")
def failed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = small.begun(tmp_path_factory.mktemp("failed") / "run", NARROW)
    with pytest.MonkeyPatch.context() as patch:
        small.without_explanations(patch)
        small.without_pictures(patch)
        resume(folder, small.quiet(), workers=1)
    return folder.path


def inside(table: pd.DataFrame, lower: str, upper: str) -> float:
    return float(np.mean(table["displacement_um"].between(table[lower], table[upper])))


def test_corrected_band_stands_beside_the_failed_one(failed: Path) -> None:
    fit = bw.open_run(failed)
    correction = fit.bands["held-out"].correction
    assert correction is not None
    assert correction.factor == pytest.approx(5, rel=0.5)
    assert correction.blocks >= 20
    numbers = json.loads((failed / "summary.json").read_text())["validation"]
    assert numbers["held-out"]["correction"] == asdict(correction)
    table = pd.read_csv(failed / "bands.csv").set_index("set")
    assert table.loc["training", COLUMNS].isna().all(axis=None)
    held_out = table.loc["held-out"]
    assert inside(held_out, "sensor_lower_95_um", "sensor_upper_95_um") < 0.6
    assert inside(held_out, *COLUMNS) >= 0.95
    np.testing.assert_allclose(
        held_out[COLUMNS[1]] - held_out["mean_um"],
        correction.factor * (held_out["sensor_upper_95_um"] - held_out["mean_um"]),
        rtol=1e-4,
    )
    page = (failed / "report.html").read_text(encoding="utf-8")
    assert f"held-out: {correction}" in page
    labels = [text.get_text() for text in fit.bands["held-out"].plot().legends[0].get_texts()]
    assert "95% sensor reading, corrected" in labels


def test_predictions_of_drives_alike_have_it_and_others_do_not(
    failed: Path, bwbayes: Type, tmp_path: Path
) -> None:
    record = bw.open_run(failed).study.record
    for name, times in (("alike", 1.0), ("further", 1.3)):
        pd.DataFrame({"time_s": record.time, "voltage_V": times * record.voltage}).to_csv(
            tmp_path / f"{name}.csv", index=False
        )
        out = tmp_path / f"out/{name}.csv"
        assert bwbayes("predict", failed, "--voltage", f"{name}.csv", "--out", out).status == 3
        numbers = json.loads(out.with_suffix(".json").read_text())
        is_alike = name == "alike"
        assert is_alike is (numbers["correction"] is not None)
        assert is_alike is (set(COLUMNS) <= set(pd.read_csv(out)))


def test_nothing_is_shown_of_a_run_that_passed(run: Path, fit: bw.Run) -> None:
    assert all(bands.correction is None for bands in fit.predictions)
    assert "corrected" not in (run / "report.html").read_text(encoding="utf-8")
    assert "correct" not in (run / "bands.csv").read_text().partition("\n")[0]
    assert '"correction"' not in (run / "summary.json").read_text()
