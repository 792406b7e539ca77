"""``bwbayes design``: candidates in, a ranking and the best signal's file out."""

import json
from pathlib import Path

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.record import read_record
from tests.app.conftest import Type

pytestmark = pytest.mark.usefixtures("_without_pictures")

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
