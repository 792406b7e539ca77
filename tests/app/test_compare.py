"""``bwbayes compare`` and ``fit.compare``: the same numbers, one page, and refusals in a line."""

from __future__ import annotations

import csv
import json
import re
import warnings
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.app.commands import cli
from bwbayes.app.commands.studies import compare as compare_command
from bwbayes.app.fit.fitted import Fit
from bwbayes.errors import InputError, InputWarning
from bwbayes.model.operators.bouc_wen import hysteresis
from bwbayes.record import Record
from bwbayes.sampling.storage import ChainFile

CONFIG = """\
seed = 3
[record]
file = "record.csv"
from_rest = true
train = [[0.0, 4.0]]
[model]
dynamics = "none"
noise = "white"
[parameters]
gamma = { fixed = 0.0172 }
[sampling]
ess = 200
[validation.later]
window = [4.0, 6.0]
"""


def measured(alpha: float = 0.36) -> Record:
    """Return a record of 300 readings of a Bouc-Wen actuator, from rest."""
    time = np.arange(300) / 50
    voltage = 100 * np.sin(2 * np.pi * 0.8 * time) * (1 - 0.1 * time)
    displacement = 0.7 * voltage - hysteresis(voltage, alpha=alpha, beta=0.0272, gamma=0.0172)[0]
    displacement = displacement + 0.3 * np.random.default_rng(1).normal(size=time.size)
    return Record.from_arrays(voltage, displacement, interval=0.02)


def fitted(record: Record, hysteresis: str, **keys: Any) -> Fit:
    keys = {"train": (0, 4), "validation": {"later": (4, 6)}} | keys
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # bands of a wrong model do not hold
        return bw.fit(
            record,
            hysteresis=hysteresis,
            name=hysteresis,
            dynamics="none",
            noise="white",
            from_rest=True,
            ess=200,
            progress=False,
            workers=1,
            **keys,
        )


@pytest.fixture(scope="module")
def fits() -> tuple[Fit, Fit]:
    record = measured()
    return fitted(record, "bouc-wen"), fitted(record, "linear")


def run(arguments: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr("sys.argv", ["bwbayes", "compare", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_fits_are_compared_and_saved(fits: tuple[Fit, Fit], tmp_path: Path) -> None:
    one, other = fits
    made = other.compare(one, future=False, workers=1)
    assert made.recommended == "bouc-wen"
    assert made.tied == ()
    assert "bouc-wen is recommended" in repr(made)
    frame = made.to_pandas()
    assert list(frame.index) == ["bouc-wen", "linear"]
    assert frame.loc["bouc-wen", "held_out_nrmse"] == pytest.approx(
        one.bands["later"].scores.nrmse  # type: ignore[union-attr]
    )
    folder = made.save(tmp_path / "out")
    said = json.loads((folder / "comparison.json").read_text())
    assert said["recommended"] == "bouc-wen"
    assert said["models"]["linear"]["difference"]["value"] < 0
    with (folder / "comparison.csv").open(encoding="utf-8") as file:
        assert [row["name"] for row in csv.DictReader(file)] == ["bouc-wen", "linear"]
    page = (folder / "comparison.html").read_text(encoding="utf-8")
    for line in (*made.lines, *made.caveats):
        assert escape(line) in page
    evidence = said["models"]["bouc-wen"]["log_evidence"]
    assert f"{evidence:.2f}" in page


KEYS: dict[str, Any] = {
    "dynamics": "none",
    "noise": "white",
    "from_rest": True,
    "ess": 200,
    "seed": 3,
    "train": (0, 4),
    "validation": {"later": (4, 6)},
    "parameters": {"gamma": {"fixed": 0.0172}},
}


@pytest.mark.slow
def test_models_of_a_record_are_compared(tmp_path: Path) -> None:
    """Named in one text or in a list, with nothing left or a folder, and its runs: the same."""
    record = measured()
    few: dict[str, Any] = {"future": False, "screen": False, "workers": 1, "progress": False}
    made = bw.compare(record, models="linear; bouc-wen", **few, **KEYS)
    assert ("bouc-wen", ["bouc-wen", "linear"]) == (
        made.recommended,
        sorted(made.to_pandas().index),
    )
    kept = bw.compare(
        record, models=["linear", "bouc-wen"], folder=tmp_path / "kept", **few, **KEYS
    )
    assert made.to_pandas().equals(kept.to_pandas())
    numbers = json.loads((tmp_path / "kept/comparison.json").read_text())
    assert numbers["recommended"] == "bouc-wen"
    with pytest.raises(InputError, match=r"comparison\.json: exists"):
        bw.compare(record, folder=tmp_path / "kept", **few, **KEYS)
    folders = [tmp_path / "kept" / name for name in ("linear", "bouc-wen")]
    # The recommended one is finished.
    assert [False, True] == [(folder / "report.html").is_file() for folder in folders]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # its bands do not hold
        bw.resume(folders[0], progress=False)
    again = bw.compare(*folders, future=False, workers=1)
    assert "failed" == again["linear"].standing.status  # type: ignore[union-attr]
    assert (
        made.to_pandas()
        .drop(columns="validation")
        .equals(again.to_pandas().drop(columns="validation"))
    )
    mixed = bw.compare([str(folders[0]), bw.open_run(folders[1])], future=False, workers=1)
    assert again.to_pandas().equals(mixed.to_pandas())


def test_fits_are_compared_at_the_top(fits: tuple[Fit, Fit], tmp_path: Path) -> None:
    made = bw.compare(*fits, future=False, workers=1, folder=tmp_path / "out")
    assert made.to_pandas().equals(fits[0].compare(fits[1], future=False, workers=1).to_pandas())
    assert (tmp_path / "out/comparison.html").is_file()
    same = bw.compare(fits[0], fits[0], future=False, workers=1)
    assert ["bouc-wen 1", "bouc-wen 2"] == list(same.to_pandas().index)


def test_what_cannot_be_compared_is_one_line(fits: tuple[Fit, Fit]) -> None:
    record = measured()
    for given, options, line in (
        ([fits[0]], {}, "compare: one fit alone; give two or more, or a record"),
        (fits, {"models": "linear"}, "compare: models: fits are compared as they are; leave it"),
        (fits, {"train": (0, 1)}, "compare: train: fits are compared as they are; leave it out"),
        ([fits[0], record], {}, "compare: Record: is neither a fit nor the folder of a run"),
        ([fits[0], "nowhere"], {}, "compare: nowhere: is neither a fit nor the folder of a run"),
        ([record], {"models": "liner"}, "models: 'liner' is unknown; did you mean linear?"),
        ([record], {"models": []}, "models: names no model"),
        ([record], {"trian": (0, 1)}, "compare: trian: unknown key; did you mean train?"),
        ([], {}, "compare: record: list is not a record"),
    ):
        with pytest.raises(InputError, match=re.escape(line)):
            bw.compare(*given, **options)


def test_a_fit_says_what_to_measure_next(fits: tuple[Fit, Fit]) -> None:
    fit, linear = fits
    time = np.arange(150) / 50
    wave = np.sin(2 * np.pi * time)
    signals = {"steady": 80 * wave, "fading": 80 * wave * (1 - 0.3 * time), "far": 300 * wave}
    best, second, last = fit.design("beta", candidates=signals)
    assert (best.name, second.name) == ("fading", "steady")
    assert last.refused.startswith("needs ")
    # Its bands do not hold, which is said.
    with pytest.warns(InputWarning, match="VALIDATION FAILED: later"):
        assert linear.design(50 * wave, voltage=(-100, 100))[0].left < 1
    with (
        pytest.warns(InputWarning, match="VALIDATION FAILED: later"),
        pytest.raises(InputError, match="is not a free parameter"),
    ):
        linear.design("beta")


def test_other_records_windows_and_held_out_parts_are_refused(
    fits: tuple[Fit, Fit], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    one, _ = fits
    with pytest.raises(InputError, match="different records, or in different units"):
        one.compare(fitted(measured(0.35), "linear"))
    record = one.problem.record
    other = fitted(record, "linear", train=(0, 3))
    with pytest.raises(InputError, match="fitted to different windows"):
        one.compare(other)
    other = fitted(record, "linear", validation={})
    with pytest.raises(InputError, match=r"differ in what is held out \(later\)"):
        one.compare(other)
    # As a command: one line, and status 2.
    paths = [str(one.save(tmp_path / "a")), str(other.save(tmp_path / "b"))]
    assert run(paths, monkeypatch) == 2


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["a"], "give two runs or more, or a CONFIG"),
        (["b.toml"], "b.toml: No such file or directory; check the config's path"),
        (["a", "b", "--models", "linear"], "goes with one CONFIG"),
        (["a", "a"], "the same run is there twice"),
        (["a", "b"], "a: no run here"),
        (["{config}", "--models", "liner"], "did you mean linear"),
        (["{config}", "--models", "linear; linear"], "is there twice"),
    ],
)
def test_what_cannot_be_compared_is_one_line_and_status_2(
    arguments: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.toml").write_text(CONFIG, encoding="utf-8")
    assert run([one.format(config="c.toml") for one in arguments], monkeypatch) == 2
    printed = capsys.readouterr().err
    assert said in printed
    assert printed.count("\n") == 1


def test_a_config_alone_is_run_with_the_usual_models(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """At least six, with and without hysteresis; the help names each."""
    (tmp_path / "c.toml").write_text(CONFIG, encoding="utf-8")
    asked: list[dict[str, Any]] = []

    def noted(*given: Any, **_: Any) -> Any:
        asked.append(given[2])
        raise InputError("that is enough")

    monkeypatch.setattr("bwbayes.app.jobs.compare.compare_models", noted)
    assert run([str(tmp_path / "c.toml")], monkeypatch) == 2
    (models,) = asked
    assert len(models) >= 6
    assert {"linear", "bouc-wen"} <= {one.hysteresis for one in models.values()}
    said = next(str(vars(o)["help"]) for o in compare_command.params if o.name == "models")
    assert all(name in said for name in models)


def test_a_config_is_run_with_each_model_and_gone_on_with(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.toml").write_text(CONFIG, encoding="utf-8")
    record = measured()
    assert record.displacement is not None
    rows = np.column_stack([record.time, record.voltage, record.displacement])
    np.savetxt(
        "record.csv", rows, delimiter=",", header="time_s,voltage_V,displacement_um", comments=""
    )
    models = ["--models", "linear; bouc-wen", "--no-future", "--workers", "1"]
    arguments = ["c.toml", *models, "--out", "out"]
    assert run(arguments, monkeypatch) == 0
    shown = capsys.readouterr().out
    assert re.search(r"bouc-wen is recommended", shown)
    # gamma is stated, and the linear model has none, which is far behind.
    assert "only screened" in shown
    assert (tmp_path / "out/linear/chain").is_dir()
    assert not (tmp_path / "out/linear/summary.json").exists()
    before = ChainFile.read(tmp_path / "out/bouc-wen/chain").coordinates("sampling")
    assert run(arguments, monkeypatch) == 2
    assert "comparison.json: exists" in capsys.readouterr().err
    (tmp_path / "out/comparison.json").unlink()
    assert run(arguments, monkeypatch) == 0
    after = ChainFile.read(tmp_path / "out/bouc-wen/chain").coordinates("sampling")
    np.testing.assert_array_equal(before, after)
    (tmp_path / "c.toml").write_text(CONFIG.replace("seed = 3", "seed = 4"), encoding="utf-8")
    (tmp_path / "out/comparison.json").unlink()
    assert run(arguments, monkeypatch) == 2
    assert "holds another run" in capsys.readouterr().err
