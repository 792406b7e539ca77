"""A file beside a run is read as the run's record was, if it has the same columns."""

import json
import tempfile
import warnings
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

import bwbayes as bw
from bwbayes.app.config.config import dump, load, parse
from bwbayes.app.config.settings import RecordConfig
from bwbayes.app.fit.fitted import Run
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.study.from_config import open_like, record_naming
from bwbayes.app.study.resolve import resolve_config
from bwbayes.record import Record, read_record, write_record
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.formats import read_named, read_source
from bwbayes.record.io.series import Source
from tests.app.conftest import Type

pytestmark = pytest.mark.usefixtures("_without_pictures")

QUANTITIES = ("time", "voltage", "displacement")
# What people call columns; none of them can be taken for a displacement.
NAMES = ["a", "b", "U2", "ch 3", "ch 4", "t", "T1", "time_s", "voltage_mV"]
SAMPLES = 12


def written(path: Path, names: list[str], quantities: list[str], scale: float) -> None:
    """Write a file with a column for each of the quantities; others are noise."""
    steps = np.arange(SAMPLES)
    series = {"time": steps, "voltage": np.sin(steps), "displacement": scale * np.cos(steps)}
    columns = [series.get(quantity, 7.0 + 0.1 * steps**2) for quantity in quantities]
    np.savetxt(path, np.transpose(columns), delimiter=",", header=",".join(names), comments="")


@st.composite
def kinds(draw: st.DrawFn) -> tuple[list[str], list[str], RecordConfig]:
    """Draw a header, the quantities below it, and what a config says of them."""
    quantities = draw(st.permutations([*QUANTITIES, *draw(st.lists(st.just(""), max_size=2))]))
    count = len(quantities)
    names = draw(st.lists(st.sampled_from(NAMES), min_size=count, max_size=count, unique=True))
    by_number = draw(st.booleans())
    where = {q: quantities.index(q) for q in QUANTITIES}
    columns: dict[str, str | int] = {q: i + 1 if by_number else names[i] for q, i in where.items()}
    keys: dict[str, Any] = {
        "units": {
            "time": "ms",
            "voltage": "V",
            "displacement": draw(st.sampled_from(["nm", "-um"])),
        },
        "voltage_is": draw(st.sampled_from([None, "command"])),
    }
    if draw(st.booleans()):
        del columns["time"]
        keys["fs"] = 50.0
    return names, quantities, RecordConfig(file="first.csv", columns=columns, **keys)


def readable(path: Path, **options: Any) -> Record:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", bw.InputWarning)  # ignored columns
        return read_record(path, need_displacement=False, **options)


def read_like(path: Path, noted: dict[str, Any] | None, **reading: Any) -> Record:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", bw.InputWarning)
        return read_named(*open_like(path, noted, reading), need_displacement=False)


def read_as(source: RecordConfig, folder: Path) -> Record:
    """Read a config's record."""
    assert source.file is not None
    stated = source.columns, source.units, source.fs
    return readable(folder / source.file, columns=stated[0], units=stated[1], fs=stated[2])


@given(kinds(), st.booleans())
def test_a_second_file_of_the_same_columns_is_read_as_the_first(
    kind: tuple[list[str], list[str], RecordConfig], planned: bool
) -> None:
    """Also a planned voltage, whose file lacks what was measured."""
    names, quantities, source = kind
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        written(folder / "first.csv", names, quantities, 1.0)
        noted = record_naming(source, read_as(source, folder))
        kept = [i for i, q in enumerate(quantities) if q in ("time", "voltage") or not planned]
        second = folder / "second.csv"
        written(second, [names[i] for i in kept], [quantities[i] for i in kept], 3.0)
        record = read_like(second, noted)
        whole = folder / "whole.csv"
        written(whole, names, quantities, 3.0)
        expected = readable(
            whole,
            columns=source.columns,
            units=source.units,
            fs=source.fs,
            voltage_is=source.voltage_is,
        )
    np.testing.assert_array_equal(expected.voltage, record.voltage)
    assert (expected.interval, expected.voltage_is) == (record.interval, record.voltage_is)
    if planned:
        assert record.displacement is None
    else:
        np.testing.assert_array_equal(expected.displacement, record.displacement)


@given(kinds())
def test_a_file_of_other_columns_is_read_by_itself(
    kind: tuple[list[str], list[str], RecordConfig],
) -> None:
    """Whatever numbers and units the config gave; as is one of a run that noted nothing."""
    names, quantities, source = kind
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        written(folder / "first.csv", names, quantities, 1.0)
        second = folder / "second.csv"
        written(second, ["time_s", "voltage_V", "displacement_um"], [*QUANTITIES], 3.0)
        record = read_as(source, folder)
        for noted in (record_naming(source, record), None):
            assert open_like(second, noted)[1:] == (Naming(), None)
        assert record_naming(RecordConfig(file="first.csv"), record) is None


def test_a_run_keeps_how_its_record_was_read(tmp_path: Path) -> None:
    written(tmp_path / "first.csv", ["a", "b", "c"], [*QUANTITIES], 1.0)
    text = """\
[record]
file = "first.csv"
columns = { time = "a", voltage = "2", displacement = "c" }
units = { time = "ms", voltage = "V", displacement = "nm" }
[model]
noise = "white"
"""
    folder = RunFolder.create(tmp_path / "run", resolve_config(parse(text, "text"), tmp_path))
    problem = Run(folder)
    assert {
        "columns": {"time": "a", "voltage": "b", "displacement": "c"},
        "units": {"time": "ms", "voltage": "V", "displacement": "nm"},
        "all_columns": ["a", "b", "c"],
    } == problem.config.records["record"].read_as
    assert problem.config == resolve_config(problem.config, folder.path).config


def test_voltage_and_displacement_in_files_of_their_own_become_a_run(
    bwbayes: Type, tmp_path: Path
) -> None:
    """Its folder opens without them; a planned voltage alone is read as the first was."""
    time = 0.01 * np.arange(300)
    voltage = 50 + 40 * np.sin(6 * time)
    np.savetxt(tmp_path / "u.txt", voltage)
    np.savetxt(tmp_path / "x.txt", 0.7 * voltage + 0.1 * np.cos(9 * np.arange(300)))
    files = ["--voltage", tmp_path / "u.txt", "--displacement", tmp_path / "x.txt"]
    options = ["--unit", "voltage=V", "--unit", "displacement=um", "--fs", "100"]
    bwbayes("init", *files).assert_refused("--displacement", "--unit displacement=um --fs")
    config = tmp_path / "a.toml"
    assert bwbayes("init", *files, *options, "--out", config).status == 0
    folder = RunFolder.create(tmp_path / "run", resolve_config(load(config), tmp_path))
    for name in "ux":
        (tmp_path / f"{name}.txt").rename(tmp_path / f"{name}2.txt")
    problem = Run(folder)
    np.testing.assert_allclose(problem.study.records["record"].voltage, voltage)
    noted = problem.config.records["record"].read_as
    plan = read_like(tmp_path / "u2.txt", noted)
    measured = read_like(tmp_path / "u2.txt", noted, displacement_file=tmp_path / "x2.txt")
    assert (plan.readings, measured.readings) == (0, 300)
    assert (plan.interval, measured.interval) == (0.01, 0.01)


@pytest.fixture
def renamed(copy: RunFolder, tmp_path: Path) -> Path:
    config = load(copy.config)
    noted = {
        "columns": {"time": "a", "voltage": "b", "displacement": "c"},
        "units": {"time": "s", "voltage": "V", "displacement": "nm"},
        "voltage_is": "command",
        "all_columns": ["a", "b", "c"],
    }
    record = config.records["record"].model_copy(update={"read_as": noted})
    copy.config.write_text(dump(config.model_copy(update={"record": record})))
    other = read_record(copy.path / "records/sine.h5")
    assert other.displacement is not None
    columns = [other.time, other.voltage, 1000 * other.displacement]
    np.savetxt(
        tmp_path / "next.csv", np.transpose(columns), delimiter=",", header="a,b,c", comments=""
    )
    write_record(other, tmp_path / "same.csv")
    return tmp_path / "next.csv"


def test_predict_reads_a_second_file_once(
    copy: RunFolder, renamed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = list[Path]()

    def read(path: Path, table: int | str | None = None) -> Source:
        opened.append(path)
        return read_source(path, table)

    for module in ("bwbayes.record.io.formats", "bwbayes.app.study.from_config"):
        monkeypatch.setattr(f"{module}.read_source", read)
    fit = bw.open_run(copy.path)
    _ = fit.study  # reads the files of the run itself
    opened.clear()
    fit.predict(renamed)
    assert [renamed] == opened


def test_predict_validates_on_a_second_file_of_the_same_kind(
    bwbayes: Type, copy: RunFolder, renamed: Path
) -> None:
    for name in ("next", "same"):
        said = bwbayes("predict", copy.path, "--record", renamed.with_name(f"{name}.csv"))
        assert (0, "") == (said.status, said.err)
    first, second = (
        json.loads((copy.path / f"predictions/{name}.json").read_text())["scores"]
        for name in ("next", "same")
    )
    assert first["max_error_um"] == pytest.approx(second["max_error_um"], rel=1e-6)
    # What is said of the file itself counts alone.
    own = "--column", "time=a", "--column", "voltage=b", "--column", "displacement=c"
    said = bwbayes("predict", copy.path, "--record", renamed, *own, "--out", "own.csv")
    said.assert_refused("which unit has", "--unit displacement=um")
    # One of several tables is read alike.
    two = renamed.with_name("two.csv")
    two.write_text(2 * f"title\n{renamed.read_text()}\n")
    said = bwbayes("predict", copy.path, "--record", two)
    said.assert_refused("2 tables with numbers", "`--table 1`")
    with pytest.warns(bw.InputWarning, match="above the header"):
        said = bwbayes("predict", copy.path, "--record", two, "--table", "2")
    assert 0 == said.status
    second = json.loads((copy.path / "predictions/two.json").read_text())["scores"]
    assert second["max_error_um"] == pytest.approx(first["max_error_um"], rel=1e-9)


def test_predict_says_that_a_record_without_a_displacement_validates_nothing(
    bwbayes: Type, copy: RunFolder, tmp_path: Path
) -> None:
    """As where nobody can tell which column it is; a signal has none."""
    other = read_record(copy.path / "records/sine.h5")
    columns = [other.time, other.voltage, 2 * other.voltage]
    header = {"delimiter": ",", "header": "time_s,voltage_V,C", "comments": ""}
    np.savetxt(tmp_path / "next.csv", np.transpose(columns), **header)
    with pytest.warns(bw.InputWarning, match="ignored columns: C"):
        said = bwbayes("predict", copy.path, "--record", "next.csv")
    assert 0 == said.status
    assert "note: next.csv: has no displacement that is recognized, so the bands" in said.out
    signal = bwbayes("predict", copy.path, "--signal", "step50", "--from-rest")
    assert "not validated" not in signal.out


def test_compensate_and_design_read_a_file_alike(
    bwbayes: Type, copy: RunFolder, renamed: Path
) -> None:
    times = np.arange(50) / 50
    rows = np.stack([times, 20_000 * np.sin(np.pi * times) ** 2], axis=1)
    reference = renamed.with_name("path.csv")
    np.savetxt(reference, rows, delimiter=",", header="a,c", comments="")
    fit = bw.open_run(copy.path)
    with (
        pytest.warns(bw.InputWarning, match="between samples"),
        pytest.warns(bw.InputWarning, match="untested on these loops"),
    ):
        compensation = fit.compensate(reference, from_rest=True)
    assert np.max(
        np.asarray(compensation.reference.displacement, dtype=np.float64)
    ) == pytest.approx(20.0, rel=0.01)
    said = bwbayes("design", copy.path, "--drive", renamed)
    assert 0 == said.status, said.err


@pytest.mark.usefixtures("copy")
@pytest.mark.parametrize(
    ("command", "flag", "other"),
    [
        ("compensate", "--reference", ("sine", "--amplitude", "9", "--frequency", "1")),
        ("design", "--drive", ("--parameter", "beta")),
    ],
)
def test_a_reference_or_drive_is_told_its_columns_and_units_as_a_record_is(
    bwbayes: Type, tmp_path: Path, command: str, flag: str, other: tuple[str, ...]
) -> None:
    time = np.arange(200) / 50
    columns = np.stack([time, 30 * np.sin(4 * time), 15 * np.sin(4 * time)], axis=1)
    above = ["p,q,r", "1,1,1", "2,1,1", "3,1,1", "4,1,1", ""]
    for folder, header, factor in (
        ("plain", ["time_s,voltage_V,displacement_um"], 1.0),
        ("odd", [*above, "a,b,c"], 1e3),
    ):
        (tmp_path / folder).mkdir()
        rows = [",".join(f"{factor * value:.9f}" for value in row) for row in columns]
        (tmp_path / folder / "drive.csv").write_text("\n".join([*header, *rows, ""]))
    naming = ["--table", "2"]
    asked = bwbayes(command, "copy", flag, "odd/drive.csv", *naming)
    asked.assert_refused(f"copy and correct: bwbayes {command} copy {flag} odd/drive.csv --table 2")
    for named in ("time=a", "voltage=b", "displacement=c"):
        naming += ["--column", named]
    for unit in ("time=ms", "voltage=mV", "displacement=nm"):
        naming += ["--unit", unit]
    plain = bwbayes(command, "copy", flag, "plain/drive.csv", "--out", "plain")
    odd = bwbayes(command, "copy", flag, "odd/drive.csv", *naming, "--out", "odd")
    assert 2 != plain.status == odd.status
    assert plain.out == odd.out.replace("odd/", "plain/")
    bwbayes(command, "copy", *other, *naming).assert_refused(f"give {flag}, or remove them")
