"""`bwbayes track` and `fit.track`: numbers, a table and a picture that agree, or one line."""

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

import bwbayes as bw
from bwbayes.control.loop import CONTROLLERS
from bwbayes.errors import InputError
from tests.app.conftest import Type


def test_numbers_table_and_picture_agree(
    bwbayes: Type, run: Path, fit: bw.Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    tracking, asked = fit.track(frequencies=(5.0,), draws=5), dict[str, Any]()

    def track(_: bw.Run, **options: Any) -> Any:
        asked.update(options)
        return tracking

    monkeypatch.setattr("bwbayes.app.jobs.control.track", track)
    shutil.copytree(run, tmp_path / "run")
    command = "track", "run", "--frequency", "5", "--draws", "5"
    said, folder = bwbayes(*command), tmp_path / "run/track"
    assert (0, "") == (said.status, said.err)
    assert ((5.0,), 5) == (asked["frequencies"], asked["draws"])
    for kind in ("json", "csv", "html"):
        assert f"wrote run/track/track.{kind}\n" in said.out
    numbers = json.loads((folder / "track.json").read_text())
    with (folder / "track.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert 4 * len(CONTROLLERS) == len(rows)
    for row, known in zip(rows, numbers["table"], strict=True):
        assert (row["signal"], row["controller"]) == (known["signal"], known["controller"])
        assert float(row["rms_um"]) == pytest.approx(known["rms_um"])
        assert 0 <= known["rms_um_low"] <= known["rms_um_high"] <= known["largest_um_high"]
    assert (5, True) == (numbers["draws"], numbers["robustness"]["stable"])
    assert (folder / "track.png").read_bytes().startswith(b"\x89PNG")
    page = (folder / "track.html").read_text(encoding="utf-8")
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    assert f"{numbers['table'][0]['rms_um']:.2f}</td>" in page
    least = min(best["share"] for best in numbers["best_share"])
    share = "all" if least == 1 else f"at least {100 * least:.0f}% of the"
    assert f"in {share} draws, on every signal" in page
    assert numbers["table"] == tracking.numbers()["table"]
    assert 4 == len(fit.plot.tracking(tracking).axes)
    assert 200 < tracking.margins.gain.size <= 1000
    bwbayes(*command).assert_refused("track.json: exists; choose another name, or give")


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"delay": -1}, "delay: -1 samples; give 0 to 100"),
        ({"draws": 1}, "draws: 1 is too few"),
        ({"gain_margin": 0.5}, "gain margin: 0.5; give a factor above 1"),
        ({"phase_margin": 120.0}, "phase margin: 120 degrees; give one between 0 and 90"),
        ({"rate": -1.0}, "rate: -1 Hz; give a number above 0"),
        ({"voltage": (1.0, 0.0)}, "give two voltages, the lower one first"),
        ({"frequencies": (400.0,)}, "frequencies: 400 Hz; at this rate give some from"),
        ({"amplitude": 1e4}, "amplitude: 10000 um; give one above 0 and within"),
    ],
)
def test_options_that_make_no_sense_are_one_line(
    fit: bw.Run, options: dict[str, Any], line: str
) -> None:
    with pytest.raises(InputError, match=line) as error:
        fit.track(**options)
    assert "\n" not in str(error.value)
