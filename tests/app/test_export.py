"""`bwbayes export` and `fit.export`: the posterior's mean for a controller, or one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.app.commands.products import export as command
from bwbayes.app.fit.fitted import converged
from bwbayes.app.jobs.export import FILES, export
from bwbayes.errors import InputError


def test_the_files_are_the_posteriors_mean(run: Path, tmp_path: Path) -> None:
    made = export(converged(run), tmp_path / "new" / "here")
    files = [tmp_path / "new" / "here" / name for name in FILES]
    numbers = json.loads(files[0].read_text())
    posterior = json.loads((run / "summary.json").read_text())["parameters"]
    for name, known in numbers["parameters"].items():
        if name in posterior:
            assert known["mean"] == pytest.approx(posterior[name]["mean"], rel=1e-12)
            assert known["sd"] == pytest.approx(posterior[name]["sd"], rel=1e-3)
        else:
            # Fixed, but for the rounding of a mean of equal numbers.
            assert known["sd"] == pytest.approx(0.0, abs=1e-12 * abs(known["mean"]))
    assert numbers["inverse"]
    assert (0.02, "zero") == (numbers["interval_s"], numbers["hold"])
    assert numbers["limits_V"] == pytest.approx([-100, 100], abs=1)
    assert files[1].read_text(encoding="ascii") == made.c_code()


def test_the_controllers_pace_is_an_option(run: Path, tmp_path: Path) -> None:
    fit = bw.open_run(run)
    made = fit.export(tmp_path, voltage=(-20, 80), rate=1e4, hold="first")
    numbers = json.loads((tmp_path / "model.json").read_text())
    assert (1e-4, "first", [-20, 80]) == tuple(
        numbers[name] for name in ("interval_s", "hold", "limits_V")
    )
    assert 1e-4 == made.linear.dt
    with pytest.raises(InputError, match=r"model\.json: exists; choose another name, or give"):
        fit.export(tmp_path)
    fit.export(tmp_path, overwrite=True)
    assert 0.02 == json.loads((tmp_path / "model.json").read_text())["interval_s"]


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"voltage": (5.0, -5.0)}, "give two voltages, the lower one first"),
        ({"voltage": (np.nan, 5.0)}, "give two voltages, the lower one first"),
        ({"rate": 0.0}, "rate: 0 Hz; give a number above 0"),
        ({"rate": np.nan}, "rate: nan Hz; give a number above 0"),
        ({"rate": 1e9}, r"rate: 1e\+09 Hz; give a number above 0 and up to 1e\+07"),
    ],
)
def test_options_that_make_no_sense_are_one_line(
    run: Path, tmp_path: Path, options: dict[str, Any], line: str
) -> None:
    with pytest.raises(InputError, match=line):
        export(converged(run), tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="choose another folder"):
        export(converged(run), tmp_path / "file")


def test_the_command_says_what_it_wrote(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(run, tmp_path / "run")
    arguments = [str(tmp_path / "run"), "--rate", "1000", "--hold", "zero"]
    assert 0 == command.main(arguments, standalone_mode=False)
    folder = tmp_path / "run/export"
    said = f"wrote {folder / 'model.json'}\nwrote {folder / 'actuator.c'}\n"
    assert said == capsys.readouterr().out
