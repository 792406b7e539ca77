"""`bwbayes track` and `fit.track`: numbers, a table and a picture that agree, or one line."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.app.commands.products import track as command
from bwbayes.control.loop import CONTROLLERS
from bwbayes.errors import InputError

FEW = ("--frequency", "2", "--frequency", "5", "--draws", "5")


def test_numbers_table_and_picture_agree(
    run: Path, fit: bw.Fit, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(run, tmp_path / "run")
    assert 0 == command.main([str(tmp_path / "run"), *FEW], standalone_mode=False)
    folder, said = tmp_path / "run/track", capsys.readouterr()
    assert "" == said.err
    for kind in ("json", "csv", "html"):
        assert f"wrote {folder / f'track.{kind}'}\n" in said.out
    numbers = json.loads((folder / "track.json").read_text())
    with (folder / "track.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert 2 * 4 * len(CONTROLLERS) == len(rows)
    for row, known in zip(rows, numbers["table"], strict=True):
        assert (row["signal"], row["controller"]) == (known["signal"], known["controller"])
        assert float(row["rms_um"]) == pytest.approx(known["rms_um"])
        assert 0 <= known["rms_um_low"] <= known["rms_um_high"] <= known["largest_um_high"]
    assert (5, True) == (numbers["draws"], numbers["robustness"]["stable"])
    assert (folder / "track.png").read_bytes().startswith(b"\x89PNG")
    page = (folder / "track.html").read_text(encoding="utf-8")
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    assert f"{numbers['table'][0]['rms_um']:.2f}</td>" in page
    least = min(one["share"] for one in numbers["best_share"])
    share = "all" if least == 1 else f"at least {100 * least:.0f} % of the"
    assert f"in {share} draws, on every signal" in page
    # The same draws and noise in Python, and on the command line again.
    again = fit.track(frequencies=(2.0, 5.0), draws=5)
    assert numbers["table"] == again.numbers()["table"]
    assert 4 == len(fit.plot.tracking(again).axes)
    with pytest.raises(InputError, match=r"track\.json: exists; choose another name, or give"):
        command.main([str(tmp_path / "run"), *FEW], standalone_mode=False)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"delay": -1}, "delay: -1 samples; give 0 to 100"),
        ({"delay": 101}, "delay: 101 samples; give 0 to 100"),
        ({"draws": 1}, "draws: 1 say nothing"),
        ({"gain_margin": 0.5}, "gain margin: 0.5; give a factor above 1"),
        ({"phase_margin": 120.0}, "phase margin: 120 degrees; give one between 0 and 90"),
        ({"rate": -1.0}, "rate: -1 Hz; give a number above 0"),
        ({"voltage": (1.0, 0.0)}, "give two voltages, the lower one first"),
        ({"frequencies": (400.0,)}, "frequencies: 400 Hz; at this rate give some from"),
        ({"amplitude": 1e4}, "amplitude: 10000 um; give one above 0 and within"),
    ],
)
def test_options_that_make_no_sense_are_one_line(
    fit: bw.Fit, options: dict[str, Any], line: str
) -> None:
    with pytest.raises(InputError, match=line) as error:
        fit.track(**options)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_the_draws_that_are_simulated_are_some_of_those_that_must_be_stable(fit: bw.Fit) -> None:
    made = fit.track(frequencies=(5.0,), draws=4, rate=500.0, delay=2)
    assert (4, 4) == made.rms.shape[2:]
    assert 200 < made.margins.gain.size <= 1000
    assert (2e-3, 2) == (made.gains.interval, made.stand.delay)
    assert np.isfinite(made.rms).all()
