"""``bwbayes design``: candidates in, a ranking and the best signal's file out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.commands import cli
from bwbayes.app.fit.fitted import converged
from bwbayes.app.jobs.design import design
from bwbayes.comparison.designed import Design, Promise
from bwbayes.diagnosis.standing import Standing
from bwbayes.model.inverse.limits import Limits
from bwbayes.record import read_record
from bwbayes.report.page import render

CANDIDATES = """\
[steady]
amplitude = 100.0
frequency = 1.0
duration = 3.0

[fading]
amplitude = 100.0
frequency = 1.0
duration = 3.0
decay = 0.3

[tiny]
amplitude = 1.0
frequency = 1.0
duration = 3.0
"""


def command(arguments: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr("sys.argv", ["bwbayes", "design", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_the_best_of_a_file_is_written_for_the_generator(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "some.toml").write_text(CANDIDATES, encoding="utf-8")
    arguments = [str(run), "--parameter", "alpha", "--candidates", str(tmp_path / "some.toml")]
    assert command([*arguments, "--out", str(tmp_path / "out")], monkeypatch) == 0
    assert "fading" in capsys.readouterr().out
    said = json.loads((tmp_path / "out/design.json").read_text())
    assert [one["name"] for one in said["candidates"]] == ["fading", "steady", "tiny"]
    best = read_record(tmp_path / "out/best.csv", need_displacement=False)
    assert best.displacement is None
    assert best.interval == pytest.approx(0.02)
    time = best.time
    expected = 100 * np.sin(2 * np.pi * time) * np.maximum(1 - 0.3 * time, 0)
    np.testing.assert_allclose(best.voltage, expected, atol=1e-4)
    page = (tmp_path / "out/design.html").read_text(encoding="utf-8")
    for one in said["candidates"]:
        assert f">{one['name']}<" in page
        assert f"{one['left']:.1%}" in page
    assert {"best.png", "promises.png"} <= {path.name for path in (tmp_path / "out").iterdir()}
    # Once more it is not replaced.
    assert command([*arguments, "--out", str(tmp_path / "out")], monkeypatch) == 2
    assert "best.csv: exists" in capsys.readouterr().err


def test_the_preset_keeps_to_the_amplifiers_limits(run: Path) -> None:
    made = design(
        converged(run),
        Path("verification"),
        voltage=(0.0, 150.0),
        current=2e-3,
        capacitance=5e-6,
    )
    assert not any(one.refused for one in made if "sine" in one.name)
    best = made.signals[made.best.name]
    assert best.min() >= -1e-6
    assert best.max() <= 150 + 1e-6
    assert np.max(np.abs(np.diff(best))) / made.interval <= 400 * (1 + 1e-6)
    lefts = [one.left for one in made if not one.refused]
    assert lefts == sorted(lefts)
    assert 0 < lefts[0] < 1


def test_a_page_names_what_cannot_be_told_apart_and_what_is_refused() -> None:
    """Two standard errors of the difference; refused signals have a reason, and no promise."""
    wave = 100 * np.sin(np.arange(200) / 10)
    made = [
        Promise("a", 0.50, 0.01),
        Promise("b", 0.52, 0.01),
        Promise("c", 0.60, 0.01),
        Promise("d", np.nan, np.nan, "is too fast"),
    ]
    limits = Limits(-100, 100, 50.0)
    waves = dict.fromkeys("abcd", wave)
    ranking = Design("run", None, "x", limits, waves, 0.01, Standing(), made)
    assert ["b"] == ranking.alike
    page = render(ranking.report(), {})
    assert "not to be told apart from it: b" in page
    assert "<li>d is too fast</li>" in page
    assert "width left of the band along x after one more record of it: 50.0% ± 1.0%" in page
    assert "at most 50 V/s" in page


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "give either a parameter or a drive"),
        (["--parameter", "alpha", "--drive", "verification"], "give either"),
        (["--parameter", "alpa"], "did you mean alpha?"),
        (["--parameter", "alpha", "--candidates", "none.toml"], "none.toml: No such file"),
        (["--parameter", "alpha", "--candidates", "empty.toml"], "has no candidate"),
        (["--parameter", "alpha", "--candidates", "odd.toml"], "odd.toml: one"),
        (["--parameter", "alpha", "--voltage", "5", "5"], "no voltage from 5 to 5 V"),
        (["--parameter", "alpha", "--current", "1"], "together, or neither"),
        (["--parameter", "alpha", "--voltage", "-1", "1", "--candidates", "far.toml"], "can make"),
    ],
)
def test_what_cannot_be_ranked_is_one_line_and_status_2(
    run: Path,
    arguments: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty.toml").write_text("", encoding="utf-8")
    Path("odd.toml").write_text("[one]\namplitude = -3\n", encoding="utf-8")
    Path("far.toml").write_text(CANDIDATES.replace("1.0\nf", "9.0\nf"), encoding="utf-8")
    assert command([str(run), "--out", "out", *arguments], monkeypatch) == 2
    printed = capsys.readouterr().err
    assert said in printed
    assert printed.count("\n") == 1
