"""`bwbayes compensate` and `fit.compensate`: a command with its promised error, or one line."""

import json
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.control.references import build_reference
from bwbayes.errors import InputError
from tests.app.conftest import Type

SINE = {"amplitude": 1.0, "frequency": 1.0}


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


@pytest.mark.parametrize(
    ("reference", "options", "line"),
    [
        ("triangel", {}, "'triangel' is neither a shape nor a file; did you mean triangle?"),
        ("nowhere.csv", {}, "nowhere.csv: does not exist; check the path"),
        ("sine", {"amplitude": 1.0}, "sine: has no frequency; give it, in Hz"),
        ("sine", {"amplitude": "much", "frequency": 1.0}, "sine: amplitude 'much'; must be a num"),
        (None, {}, "reference: NoneType is none; give one of sine, triangle"),
        ([0.0, 1.0] * 10, {"amplitude": 1.0}, "displacements take no amplitude; leave it out, or"),
        (build_reference("sine", 0.02, 1.0, 1.0), {"smoothed": 0.1}, "already takes no smoothed"),
        (build_reference("sine", 0.02, 40.0, 10.0), {"slew": 500.0}, "faster than the amplifier's"),
        ([0.0, *[900.0] * 49], {}, "on it is beyond the amplifier's"),
        ("sine", {"amplitud": 1.0}, "compensate: amplitud is unknown; did you mean amplitude?"),
        (
            "sine",
            {**SINE, "command": "best"},
            "command: 'best' is unknown; known are mean, expected",
        ),
    ],
)
def test_what_is_no_reference_is_one_line(
    fit: bw.Run, reference: Any, options: dict[str, Any], line: str
) -> None:
    with pytest.raises(InputError, match=re.escape(line)) as refused:
        fit.compensate(reference, from_rest=True, voltage=(-100.0, 100.0), **options)
    assert "\n" not in str(refused.value)


@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_a_command_after_any_drive_says_what_a_demagnetized_start_would_change(fit: bw.Run) -> None:
    values = 20 * np.sin(np.linspace(0, 6, 200)) ** 2
    waited, rested = (fit.compensate(values, from_rest=declared) for declared in (False, True))
    errors = [float(np.mean(made.compensated.largest)) for made in (waited, rested)]
    assert errors[1] < 0.4 * errors[0]
    (said,) = [remark for remark in waited.remarks if "--from-rest" in remark]
    assert f"the largest error is {errors[0]:.3g} um in the mean, but" in said
    assert not any("--from-rest" in remark for remark in rested.remarks)
