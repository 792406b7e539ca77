"""`bwbayes compensate` and `fit.compensate`: a command with its promised error, or one line."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.app.commands.products import compensate as command
from bwbayes.app.fit.fitted import converged
from bwbayes.app.jobs.compensate import compensate
from bwbayes.control.references import shaped
from bwbayes.errors import InputError

VOLTAGE = (-100.0, 100.0)


def asked_file(folder: Path, values: Any, interval: float = 0.02) -> Path:
    path = folder / "asked.csv"
    time = interval * np.arange(len(values))
    rows = [f"{t:.9g},{x}" for t, x in zip(time, values, strict=True)]
    path.write_text("\n".join(["time_s,displacement_nm", *rows, ""]), encoding="utf-8")
    return path


def test_files_say_the_same_and_the_command_is_a_record(run: Path, tmp_path: Path) -> None:
    """What is written: a record that the package reads again, numbers, a table, a page."""
    made = compensate(converged(run), shaped("sine", 0.02, 30.0, 0.5), from_rest=True, limit=5.0)
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


@pytest.mark.filterwarnings("ignore:between samples")
def test_a_file_an_array_and_a_fit_give_one_command(run: Path, tmp_path: Path) -> None:
    """Units of a file's columns are converted; the same seed gives the same bits."""
    values = 20 * np.sin(np.linspace(0, 6, 200)) ** 2
    path = asked_file(tmp_path, [repr(float(1e3 * value)) for value in values])
    by_file = compensate(converged(run), path, from_rest=True)
    fit = bw.open_run(run)
    by_array = fit.compensate(values, from_rest=True)
    np.testing.assert_allclose(by_file.asked, values, rtol=1e-12)
    np.testing.assert_allclose(by_file.voltage, by_array.voltage, atol=1e-9)
    assert "rms error" in repr(by_array)
    assert len(by_array.to_pandas()) == 200
    assert len(by_array.plot().axes) == 3
    again = fit.compensate(values, from_rest=True)
    np.testing.assert_array_equal(by_array.compensated.rms, again.compensated.rms)


def test_a_shape_is_that_of_the_command_line(run: Path, tmp_path: Path) -> None:
    """By its name, with the same numbers; with options left out, the same defaults."""
    arguments = ["triangle", "--amplitude", "30", "--frequency", "1", "--periods", "2"]
    out = ["--from-rest", "--limit", "5", "--out", str(tmp_path)]
    assert 0 == command.main([str(run), *arguments, *out], standalone_mode=False)
    numbers = json.loads((tmp_path / "compensation.json").read_text())
    fit = bw.open_run(run)
    options: dict[str, Any] = {"amplitude": 30, "frequency": np.int64(1), "periods": 2}
    with pytest.warns(bw.InputWarning) as warned:
        made = fit.compensate("triangle", **options, from_rest=True, limit=5)
    assert numbers == made.summary
    assert numbers["remarks"] == [str(one.message) for one in warned]
    assert Path(__file__).name == Path(warned[0].filename).name
    assert "triangle" == made.reference.name
    shape = shaped("triangle", 0.02, 30.0, 1.0, periods=2)
    np.testing.assert_array_equal(made.asked, shape.given)
    again = compensate(converged(run), shape, from_rest=True, limit=5)
    assert numbers == again.summary
    assert numbers == compensate(converged(run), made.reference, from_rest=True, limit=5).summary


@pytest.mark.parametrize(
    ("reference", "options", "line"),
    [
        ("triangel", {}, "'triangel' is neither a shape nor a file; did you mean triangle?"),
        ("nowhere.csv", {}, "nowhere.csv: does not exist; check the path"),
        ("sine", {"amplitude": 1.0}, "sine: has no frequency; give it, in Hz"),
        ("sine", {"amplitude": "much", "frequency": 1.0}, "sine: amplitude 'much'; must be a num"),
        (None, {}, "reference: NoneType is none; give one of sine, triangle"),
        (["a"] * 20, {}, "reference: list is none; give one of sine"),
        ([0.0, 1.0] * 10, {"amplitude": 1.0}, "displacements take no amplitude; leave it out, or"),
        ("a.csv", {"interval": 1.0}, "a file takes no interval; leave it out, or give one of sine"),
        (shaped("sine", 0.02, 1.0, 1.0), {"smoothed": 0.1}, "made already takes no smoothed"),
        ("sine", {"amplitud": 1.0}, "compensate: amplitud is unknown; did you mean amplitude?"),
        (
            "sine",
            {"amplitude": 1.0, "frequency": 1.0, "command": "best"},
            "command: 'best' is unknown; known are mean, expected",
        ),
    ],
)
def test_what_is_no_reference_is_one_line(
    run: Path, reference: Any, options: dict[str, Any], line: str
) -> None:
    fit = bw.open_run(run)
    with pytest.raises(InputError, match=re.escape(line)) as refused:
        fit.compensate(reference, **options)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ([0.0, 1.0, 2.0], "give one row of 10 samples or more"),
        ([5000.0] * 50, "is 5 um all along"),
        (["nan", *range(49)], "not a number; give one at every sample"),
        ([0.0, *[9e5] * 49], r"needs .* V, and from .* s on it is beyond the amplifier's"),
        ([], "no columns of numbers in it"),
    ],
)
def test_references_that_cannot_be_used_are_one_line(
    run: Path, tmp_path: Path, values: list[Any], line: str
) -> None:
    path = asked_file(tmp_path, values)
    with pytest.raises(InputError, match=line) as refused:
        compensate(converged(run), path, from_rest=True, voltage=VOLTAGE)
    assert "\n" not in str(refused.value)


def test_what_is_too_fast_says_where_and_how_fast(run: Path) -> None:
    fast = shaped("sine", 0.02, 40.0, 10.0)
    with pytest.raises(InputError, match=r"V/s, and from .* it is faster than the amplifier's"):
        compensate(converged(run), fast, from_rest=True, voltage=VOLTAGE, slew=500.0)
