"""What builds on a run says first how the run's validation came out, wherever it is read.

That nothing is said of a run that passed, each command's own tests say.
"""

import json
import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import bwbayes as bw
from bwbayes.app.commands.cli import cli
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.validation import BandValidation, ValidationSummary

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
    return BandValidation("held-out", training=False, passed=passed, reasons=(OFF,), cause=cause)


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
