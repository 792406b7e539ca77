"""``bwbayes compare`` and ``bwbayes design``: the same numbers, one page, refusals in a line."""

import csv
import json
import re
import warnings
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.app.config.keywords import config_of
from bwbayes.app.fit.fitted import Run
from bwbayes.app.study.resolve import resolve_config
from bwbayes.errors import InputError, InputWarning
from bwbayes.model.operators.bouc_wen import hysteresis
from bwbayes.record import Record, read_record
from bwbayes.sampling.chain import ChainFile
from tests.app import small
from tests.app.conftest import Type
from tests.app.steps import Steps

pytestmark = pytest.mark.usefixtures("_without_pictures")

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

KEYS: dict[str, Any] = {
    "dynamics": "none",
    "noise": "white",
    "stages": [],
    "from_rest": True,
    "ess": 200,
    "train": (0, 4),
    "validation": {"later": (4, 6)},
}


def measured(alpha: float = 0.36) -> Record:
    """Return a record of 300 readings of a Bouc-Wen actuator, from rest."""
    time = np.arange(300) / 50
    voltage = 100 * np.sin(2 * np.pi * 0.8 * time) * (1 - 0.1 * time)
    displacement = 0.7 * voltage - hysteresis(voltage, alpha=alpha, beta=0.0272, gamma=0.0172)[0]
    displacement = displacement + 0.3 * np.random.default_rng(1).normal(size=time.size)
    return Record.from_arrays(voltage, displacement, interval=0.02)


@pytest.fixture(scope="module")
def fits() -> tuple[Run, Run]:
    """Return fits of Bouc-Wen and of a straight line, whose bands do not hold."""
    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
        small.without_explanations(patch)
        warnings.simplefilter("ignore", InputWarning)
        bouc_wen, linear = (
            bw.fit(measured(), hysteresis=name, name=name, progress=False, workers=1, **KEYS)
            for name in ("bouc-wen", "linear")
        )
    return bouc_wen, linear


def test_fits_are_compared_and_saved(fits: tuple[Run, Run], tmp_path: Path) -> None:
    bouc_wen, linear = fits
    comparison = linear.compare(bouc_wen, future=False, workers=1)
    assert comparison.recommended == "bouc-wen"
    assert comparison.tied == ()
    assert "bouc-wen is recommended" in repr(comparison)
    frame = comparison.to_pandas()
    assert list(frame.index) == ["bouc-wen", "linear"]
    assert frame.loc["bouc-wen", "held_out_nrmse"] == pytest.approx(
        bouc_wen.bands["later"].scores.nrmse  # type: ignore[union-attr]
    )
    folder = tmp_path / "out"
    again = bw.compare(*fits, future=False, workers=1, folder=folder)
    assert again.to_pandas().equals(frame)
    numbers = json.loads((folder / "comparison.json").read_text())
    assert numbers["recommended"] == "bouc-wen"
    assert numbers["models"]["linear"]["difference"]["value"] < 0
    with (folder / "comparison.csv").open(encoding="utf-8") as file:
        assert [row["name"] for row in csv.DictReader(file)] == ["bouc-wen", "linear"]
    page = (folder / "comparison.html").read_text(encoding="utf-8")
    for line in (*comparison.lines, *comparison.caveats):
        assert escape(line) in page
    assert f"{numbers['models']['bouc-wen']['log_evidence']:.2f}" in page
    with pytest.raises(InputError, match=r"comparison\.json: exists"):
        comparison.save(folder)
    same = bw.compare(bouc_wen, bouc_wen, future=False, workers=1)
    assert ["bouc-wen 1", "bouc-wen 2"] == list(same.to_pandas().index)


def test_a_comparison_tells_what_share_of_its_steps_is_done(
    fits: tuple[Run, Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = Steps.of_commands(monkeypatch)
    fits[0].compare(fits[1], workers=1, folder=tmp_path / "out", progress=False)
    parts = ("predictions", "earlier training", "later training", "later", "evidence")
    judged = [f"{name}: {part}" for name in ("bouc-wen", "linear") for part in parts]
    judged.insert(-1, "linear: training and later")
    steps.require(*judged, "figures")


def test_what_cannot_be_compared_is_one_line(fits: tuple[Run, Run]) -> None:
    record = measured()
    for given, options, line in (
        ([fits[0]], {}, "compare: one fit alone; give two or more, or a record"),
        (fits, {"models": "linear"}, "compare: models: fits are compared as they are; leave it"),
        (fits, {"train": (0, 1)}, "compare: train: fits are compared as they are; leave it out"),
        ([fits[0], record], {}, "compare: Record: is neither a fit nor the folder of a run"),
        ([fits[0], "nowhere"], {}, "nowhere: no run here; start one with"),
        ([record], {"models": "liner"}, "models: 'liner' is unknown; did you mean linear?"),
        ([record], {"models": []}, "models: names no model"),
        ([record], {"trian": (0, 1)}, "compare: trian: unknown key; did you mean train?"),
        ([], {}, "compare: record: list is not a record"),
    ):
        with pytest.raises(InputError, match=re.escape(line)):
            bw.compare(*given, **options)


@pytest.mark.parametrize(
    ("record", "keys", "line"),
    [
        (measured(0.35), {}, "different records, or in different units"),
        (measured(), {"train": (0, 3)}, "fitted to different windows"),
        (measured(), {"hold": "corners"}, "one alone reaches the corners between its samples"),
        (measured(), {"validation": {}}, r"differ in what is held out \(later\)"),
    ],
)
def test_other_readings_are_refused(
    fits: tuple[Run, Run], record: Record, keys: dict[str, Any], line: str
) -> None:
    config, records = config_of(record, KEYS | keys)
    other = fits[1].with_cache(study=resolve_config(config, Path(), records).study)
    with pytest.raises(InputError, match=line):
        fits[0].compare(other)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["a"], "a: does not exist; check the path"),
        (["b.toml"], "b.toml: No such file or directory; check the config's path"),
        ([".", "."], "the same run is there twice"),
    ],
)
def test_a_wrong_command_is_one_line(bwbayes: Type, arguments: list[str], text: str) -> None:
    bwbayes("compare", *arguments).assert_refused(text)


@pytest.mark.usefixtures("_without_explanations")
@pytest.mark.parametrize("noise", ["white", pytest.param("auto", marks=pytest.mark.slow)])
def test_a_config_is_run_with_each_model_and_gone_on_with(
    bwbayes: Type, tmp_path: Path, noise: str
) -> None:
    config = CONFIG.replace("white", noise)
    (tmp_path / "c.toml").write_text(config, encoding="utf-8")
    bw.write_record(measured(), tmp_path / "record.csv")
    options = "--models", "linear; bouc-wen", "--no-future", "--workers", "1", "--out", "out"
    said = bwbayes("compare", "c.toml", *options)
    assert 0 == said.status
    assert "bouc-wen is recommended" in said.out
    # gamma is stated, and the linear model has none, which is far behind.
    assert "only screened" in said.out
    assert (tmp_path / "out/linear/chain").is_dir()
    assert not (tmp_path / "out/linear/summary.json").exists()
    before = ChainFile.read(tmp_path / "out/bouc-wen/chain").coordinates("sampling")
    bwbayes("compare", "c.toml", *options).assert_refused("comparison.json: exists")
    (tmp_path / "out/comparison.json").unlink()
    assert 0 == bwbayes("compare", "c.toml", *options).status
    after = ChainFile.read(tmp_path / "out/bouc-wen/chain").coordinates("sampling")
    np.testing.assert_array_equal(before, after)
    # A corrected reading leaves the config as it is: the runs are of another record all the same.
    record = measured()
    assert record.displacement is not None
    corrected = record.displacement + np.where(np.arange(record.samples) == 60, 1.0, 0.0)
    bw.write_record(replace(record, displacement=corrected), tmp_path / "record.csv")
    (tmp_path / "out/comparison.json").unlink()
    bwbayes("compare", "c.toml", *options).assert_refused("out/linear: holds another run")
    bw.write_record(record, tmp_path / "record.csv")
    (tmp_path / "c.toml").write_text(config.replace("seed = 3", "seed = 4"), encoding="utf-8")
    said = bwbayes("compare", "c.toml", *options)
    assert 2 == said.status
    assert "holds another run" in said.err


# ``bwbayes design``: candidates in, a ranking and the best signal's file out


SIGNAL = "[{}]\namplitude = {}\nfrequency = 1.0\nduration = 3.0\ndecay = {}\n"
CANDIDATES = "".join(
    SIGNAL.format(*values)
    for values in (("steady", 100.0, 0.0), ("fading", 100.0, 0.3), ("tiny", 1.0, 0.0))
)


def test_the_best_of_a_file_is_written_for_the_generator(
    bwbayes: Type, run: Path, tmp_path: Path
) -> None:
    (tmp_path / "some.toml").write_text(CANDIDATES, encoding="utf-8")
    command = "design", run, "--parameter", "alpha", "--candidates", "some.toml", "--out", "out"
    said = bwbayes(*command)
    assert 0 == said.status
    assert "fading" in said.out
    numbers = json.loads((tmp_path / "out/design.json").read_text())
    assert ["fading", "steady", "tiny"] == [score["name"] for score in numbers["candidates"]]
    best = read_record(tmp_path / "out/best.csv", need_displacement=False)
    assert best.displacement is None
    assert best.interval == pytest.approx(0.02)
    expected = 100 * np.sin(2 * np.pi * best.time) * np.maximum(1 - 0.3 * best.time, 0)
    np.testing.assert_allclose(best.voltage, expected, atol=1e-4)
    page = (tmp_path / "out/design.html").read_text(encoding="utf-8")
    for score in numbers["candidates"]:
        assert f">{score['name']}<" in page
        assert f"{score['sd_ratio']:.1%}" in page
    assert {"best.png", "promises.png"} <= {path.name for path in (tmp_path / "out").iterdir()}
    # Once more nothing is replaced.
    bwbayes(*command).assert_refused("design.json: exists")
    (tmp_path / "out/design.json").unlink()
    bwbayes(*command).assert_refused("best.csv: exists")


def test_the_preset_keeps_to_the_amplifiers_limits(fit: bw.Run) -> None:
    limits = {"voltage": (0.0, 150.0), "current": 2e-3, "capacitance": 5e-6}
    ranking = fit.design(Path("verification"), **limits)  # type: ignore[arg-type]
    assert not any(score.refused for score in ranking if "sine" in score.name)
    best = ranking.signals[ranking.best.name]
    assert best.min() >= -1e-6
    assert best.max() <= 150 + 1e-6
    assert np.max(np.abs(np.diff(best))) / ranking.interval <= 400 * (1 + 1e-6)
    lefts = [score.sd_ratio for score in ranking if not score.refused]
    assert lefts == sorted(lefts)
    assert 0 < lefts[0] < 1


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ("--drive verification", "give either"),
        ("--validate", "give either"),
        ("--candidates none.toml", "none.toml: No such file"),
        ("--candidates empty.toml", "has no candidate"),
        ("--candidates odd.toml", "odd.toml: one"),
        ("--voltage 5 5", "no voltage from 5 to 5 V"),
        ("--current 1", "together, or neither"),
        ("--voltage -1 1 --candidates far.toml", "can make"),
    ],
)
def test_what_cannot_be_ranked_is_one_line(
    bwbayes: Type, run: Path, tmp_path: Path, options: str, text: str
) -> None:
    (tmp_path / "empty.toml").write_text("", encoding="utf-8")
    (tmp_path / "odd.toml").write_text("[one]\namplitude = -3\n", encoding="utf-8")
    (tmp_path / "far.toml").write_text(SIGNAL.format("far", 9.0, 0.0), encoding="utf-8")
    bwbayes("design", run, "--parameter", "alpha", *options.split()).assert_refused(text)
    assert not (run / "design").exists()


def test_validate_finds_a_record_to_validate_on_and_one_to_train_on(
    bwbayes: Type, run: Path, tmp_path: Path
) -> None:
    said = bwbayes("design", run, "--validate", "--out", "out")
    assert said.status == 0
    numbers = json.loads((tmp_path / "out/design.json").read_text())
    assert f"Validate on: {numbers['validate']}" in said.out
    assert f"Train on: {numbers['train']}" in said.out
    trained = read_record(run / "records/record.h5")
    fastest = np.max(np.abs(np.diff(trained.voltage))) / trained.interval
    for name in ("validate", "train"):
        record = read_record(tmp_path / f"out/{name}.csv", need_displacement=False)
        assert record.duration <= trained.duration
        assert trained.voltage.min() - 1e-3 <= record.voltage.min()
        assert record.voltage.max() <= trained.voltage.max() + 1e-3
        assert np.max(np.abs(np.diff(record.voltage))) / record.interval <= 1.01 * fastest
        assert (tmp_path / f"out/{name}.png").exists()
    scores = [score for score in numbers["candidates"] if not score["refused"]]
    furthest = max(scores, key=lambda score: score["difference_um"])
    assert furthest["name"] == numbers["validate"]
    assert scores[0]["name"] == numbers["train"]
    assert min(score["sd_ratio"] for score in scores) == scores[0]["sd_ratio"]
