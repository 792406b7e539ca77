"""Commands, exports and closed loops of a fit: their files agree, and what is wrong is one line."""

import csv
import json
import re
import shutil
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.control.exported import FILES
from bwbayes.control.loop import CONTROLLERS
from bwbayes.control.references import build_reference
from bwbayes.errors import InputError
from bwbayes.report.result import render
from tests.app.conftest import Type

SINE = {"reference": "sine", "amplitude": 1.0, "frequency": 1.0}
SLOW, FAST = (build_reference("sine", 0.02, *shape) for shape in ((1.0, 1.0), (40.0, 10.0)))


@pytest.mark.filterwarnings(
    "ignore:the reference is smoothed", "ignore:between samples", "ignore:voltage and last reversal"
)
def test_files_say_the_same_and_the_command_is_a_record(fit: bw.Run, tmp_path: Path) -> None:
    made = fit.compensate(build_reference("sine", 0.02, 30.0, 0.5), from_rest=True, limit=5.0)
    files = made.save(tmp_path / "new")
    names = ["command.csv", *(f"compensation.{kind}" for kind in ("json", "csv", "html"))]
    assert names == [path.name for path in files]
    record = bw.read_record(files[0], need_displacement=False)
    np.testing.assert_allclose(record.voltage, made.voltage)
    assert (made.reference.interval, "command") == (record.interval, record.voltage_is)
    numbers = json.loads(files[1].read_text())
    assert made.summary == numbers
    low, high = (f"{limit:.4g}" for limit in numbers["limits_V"])
    assert f"amplifier {low} to {high} V, at any speed" in record.origin
    assert numbers["compensated"]["rms_um"]["mean"] < numbers["uncompensated"]["rms_um"]["mean"]
    table = np.genfromtxt(files[2], delimiter=",", names=True)
    np.testing.assert_allclose(table["reference_um"], made.asked, atol=1e-6)
    error = made.compensated.bands.upper["displacement", 95] - made.asked
    np.testing.assert_allclose(table["error_upper_95_um"], error, atol=1e-6)
    page = files[3].read_text(encoding="utf-8")
    assert f"{numbers['compensated']['rms_um']['mean']:.3g} µm" in page
    assert 3 == page.count("<img ")
    with pytest.raises(InputError, match="exists"):
        made.save(tmp_path / "new")
    assert made.save(tmp_path / "new", overwrite=True) == files


@pytest.mark.filterwarnings("ignore:between samples", "ignore:voltage and last reversal")
def test_a_file_and_an_array_give_one_command(fit: bw.Run, tmp_path: Path) -> None:
    """Units of a file's columns are converted; the same seed gives the same bits."""
    values = 20 * np.sin(np.linspace(0, 6, 200)) ** 2
    path = tmp_path / "asked.csv"
    rows = [f"{0.02 * i:.9g},{float(1e3 * value)!r}" for i, value in enumerate(values)]
    path.write_text("\n".join(["time_s,displacement_nm", *rows, ""]), encoding="utf-8")
    by_file, by_array, again = (
        fit.compensate(reference, from_rest=True) for reference in (path, values, values)
    )
    np.testing.assert_allclose(by_file.asked, values, rtol=1e-12)
    np.testing.assert_allclose(by_file.voltage, by_array.voltage, atol=1e-9)
    assert "rms error" in repr(by_array)
    assert len(by_array.to_pandas()) == 200
    assert len(by_array.plot().axes) == 3
    np.testing.assert_array_equal(by_array.compensated.rms, again.compensated.rms)


@pytest.mark.usefixtures("_without_pictures")
def test_a_shape_is_that_of_the_command_line(
    bwbayes: Type, run: Path, fit: bw.Run, tmp_path: Path
) -> None:
    shape = "triangle", "--amplitude", 30, "--frequency", 1, "--periods", 2
    said = bwbayes("compensate", run, *shape, "--from-rest", "--limit", 5, "--out", "out")
    assert 0 == said.status
    numbers = json.loads((tmp_path / "out/compensation.json").read_text())
    options: dict[str, Any] = {"amplitude": 30, "frequency": np.int64(1), "periods": 2}
    with pytest.warns(bw.InputWarning) as warned:
        made = fit.compensate("triangle", **options, from_rest=True, limit=5)
    assert numbers == made.summary
    assert numbers["remarks"] == [str(warning.message) for warning in warned]
    assert Path(__file__).name == Path(warned[0].filename).name
    assert "triangle" == made.reference.name
    same = build_reference("triangle", 0.02, 30.0, 1.0, periods=2)
    np.testing.assert_array_equal(made.asked, same.given)
    with pytest.warns(bw.InputWarning):
        assert numbers == fit.compensate(same, from_rest=True, limit=5).summary


@pytest.mark.usefixtures("_without_pictures")
@pytest.mark.parametrize(("limit", "status", "kept"), [(1e-3, 3, False), (1e3, 0, True)])
def test_a_limit_that_is_not_kept_is_no_success(
    bwbayes: Type, run: Path, fit: bw.Run, limit: float, status: int, kept: bool
) -> None:
    shape = "triangle", "--amplitude", 30, "--frequency", 1, "--from-rest"
    said = bwbayes("compensate", run, *shape, "--limit", limit, "--out", f"out{limit}")
    assert said.status == status
    assert ("NOT KEPT" in said.out) is not kept
    assert (f"the limit of {limit:g} um is kept with a probability of 0.00" in said.out) is not kept
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        made = fit.compensate("triangle", amplitude=30, frequency=1, from_rest=True, limit=limit)
    assert any("is kept with a probability" in str(one.message) for one in warned) is not kept
    assert made.summary["limit_kept"] is kept


@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_a_command_after_any_drive_says_what_a_demagnetized_start_would_change(fit: bw.Run) -> None:
    values = 20 * np.sin(np.linspace(0, 6, 200)) ** 2
    waited, rested = (fit.compensate(values, from_rest=declared) for declared in (False, True))
    errors = [float(np.mean(made.compensated.largest)) for made in (waited, rested)]
    assert errors[1] < 0.4 * errors[0]
    (said,) = [remark for remark in waited.remarks if "--from-rest" in remark]
    assert f"the largest error is {errors[0]:.3g} um in the mean, but" in said
    assert not any("--from-rest" in remark for remark in rested.remarks)


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


@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
@pytest.mark.parametrize("verb", ["compensate", "export", "track"])
def test_voltages_beyond_those_fitted_have_to_be_allowed(verb: str, fit: bw.Run) -> None:
    shape = ["sine"] if verb == "compensate" else []
    options: dict[str, Any] = {"amplitude": 5.0, "frequency": 1.0} if shape else {}
    options |= {"frequencies": (5.0,), "draws": 2} if verb == "track" else {}
    job = partial(getattr(fit, verb), *shape, **options)
    with pytest.raises(InputError, match=r"-150 to 150 V goes beyond .*--beyond-training"):
        job(voltage=(-150.0, 150.0))
    amplifier = {"slew": 1e4, "current": 2e-3, "capacitance": 1e-6}
    made = job(voltage=(-150.0, 150.0), beyond_training=True, **amplifier)
    numbers = made.summary if verb == "compensate" else made.numbers()
    limits = numbers["reference"] if verb == "track" else numbers
    assert limits["limits_V"] == [-150.0, 150.0]
    assert (1e4, 2e-3) == (limits["slew_V_per_s"], limits["current_A"])
    said = "-150 to 150 V, up to 2000 V/s, 0.002 A into 1e-06 F"
    assert said in render(made.report(), {})


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
    assert f"{numbers['table'][0]['rms_um']:.3g}</td>" in page
    least = min(best["share"] for best in numbers["best_share"])
    share = "all" if least == 1 else f"at least {100 * least:.0f}% of the"
    assert f"in {share} draws, on every signal" in page
    assert numbers["table"] == tracking.numbers()["table"]
    assert 4 == len(fit.plot.tracking(tracking).axes)
    assert 200 < tracking.margins.gain.size <= 1000
    bwbayes(*command).assert_refused("track.json: exists; choose another name, or give")


@pytest.mark.parametrize(
    ("verb", "options", "line"),
    [
        ("compensate", {"reference": "triangel"}, "nor a file; did you mean triangle?"),
        ("compensate", {"reference": "nowhere.csv"}, "nowhere.csv: does not exist; check the path"),
        ("compensate", {"reference": "sine", "amplitude": 1.0}, "sine: has no frequency; give it"),
        ("compensate", SINE | {"amplitude": "much"}, "sine: amplitude 'much'; must be a num"),
        ("compensate", {"reference": None}, "NoneType is none; give one of sine, triangle"),
        ("compensate", {"reference": [0.0, 1.0] * 10, "amplitude": 1.0}, "take no amplitude"),
        ("compensate", {"reference": SLOW, "smoothed": 0.1}, "made already takes no smoothed"),
        ("compensate", {"reference": FAST, "slew": 500.0}, "it is faster than the amplifier's"),
        ("compensate", {"reference": [0.0, *[900.0] * 49]}, "on it is beyond the amplifier's"),
        ("compensate", SINE | {"amplitud": 1.0}, "amplitud is unknown; did you mean amplitude?"),
        ("compensate", SINE | {"command": "best"}, "'best' is unknown; known are mean, expected"),
        ("export", {"voltage": (np.nan, 5.0)}, "give two voltages, the lower one first"),
        ("export", {"rate": np.nan}, "rate: nan Hz; give a number above 0"),
        ("export", {"rate": 1e9}, "rate: 1e+09 Hz; give a number above 0 and up to 1e+07"),
        ("track", {"delay": -1}, "delay: -1 samples; give 0 to 100"),
        ("track", {"draws": 1}, "draws: 1 is too few"),
        ("track", {"gain_margin": 0.5}, "gain margin: 0.5; give a factor above 1"),
        ("track", {"phase_margin": 120.0}, "phase margin: 120 degrees; give one between 0 and 90"),
        ("track", {"rate": -1.0}, "rate: -1 Hz; give a number above 0"),
        ("track", {"voltage": (1.0, 0.0)}, "give two voltages, the lower one first"),
        ("track", {"frequencies": (400.0,)}, "frequencies: 400 Hz; at this rate give some from"),
        ("track", {"amplitude": 1e4}, "amplitude: 10000 um; give one above 0 and within"),
    ],
)
def test_what_makes_no_sense_is_one_line(
    fit: bw.Run, tmp_path: Path, verb: str, options: dict[str, Any], line: str
) -> None:
    beside: dict[str, Any] = {"from_rest": True, "voltage": (-100.0, 100.0)}
    if verb != "compensate":
        beside = {"folder": tmp_path / "out"} if verb == "export" else {}
    with pytest.raises(InputError, match=re.escape(line)) as refused:
        getattr(fit, verb)(**beside | options)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "out").exists()
