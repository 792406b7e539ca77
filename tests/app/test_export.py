"""`bwbayes export` and `fit.export`: the posterior's mean for a controller, or one line."""

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.control.exported import FILES
from bwbayes.errors import InputError
from tests.app.conftest import Type


def test_the_files_are_the_posteriors_mean(bwbayes: Type, run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    said = bwbayes("export", "run")
    wrote = "wrote run/export/model.json\nwrote run/export/actuator.c\n"
    assert (0, wrote, "") == (said.status, said.out, said.err)
    numbers = json.loads((tmp_path / "run/export/model.json").read_text())
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


def test_the_controllers_pace_is_an_option(fit: bw.Run, tmp_path: Path) -> None:
    exported = fit.export(tmp_path, voltage=(-20, 80), rate=1e4, hold="first")
    numbers, code = (tmp_path / name for name in FILES)
    assert code.read_text(encoding="ascii") == exported.c_code()
    assert (1e-4, "first", [-20, 80]) == tuple(
        json.loads(numbers.read_text())[name] for name in ("interval_s", "hold", "limits_V")
    )
    assert 1e-4 == exported.linear.dt
    with pytest.raises(InputError, match=r"model\.json: exists; choose another name, or give"):
        fit.export(tmp_path)
    fit.export(tmp_path, overwrite=True)
    assert 0.02 == json.loads(numbers.read_text())["interval_s"]
    with pytest.raises(InputError, match="choose another folder"):
        fit.export(code)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"voltage": (np.nan, 5.0)}, "give two voltages, the lower one first"),
        ({"rate": np.nan}, "rate: nan Hz; give a number above 0"),
        ({"rate": 1e9}, r"rate: 1e\+09 Hz; give a number above 0 and up to 1e\+07"),
    ],
)
def test_options_that_make_no_sense_are_one_line(
    fit: bw.Run, tmp_path: Path, options: dict[str, Any], line: str
) -> None:
    with pytest.raises(InputError, match=line):
        fit.export(tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
@pytest.mark.parametrize("verb", ["compensate", "export", "track"])
def test_voltages_beyond_those_fitted_have_to_be_allowed(verb: str, fit: bw.Run) -> None:
    shape = ["sine"] if verb == "compensate" else []
    options: dict[str, Any] = {"amplitude": 5.0, "frequency": 1.0} if shape else {}
    options |= {"frequencies": (1.0,), "draws": 2} if verb == "track" else {}
    job = partial(getattr(fit, verb), *shape, **options)
    with pytest.raises(InputError, match=r"-150 to 150 V goes beyond .*--beyond-training"):
        job(voltage=(-150.0, 150.0))
    made = job(voltage=(-150.0, 150.0), beyond_training=True)
    numbers = made.summary if verb == "compensate" else made.numbers()
    limits = numbers["reference"] if verb == "track" else numbers
    assert limits["limits_V"] == [-150.0, 150.0]
