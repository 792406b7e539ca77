"""A record without a config gets one, and a file beside a run is read as the run's record was."""

import json
import re
import shlex
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given

import bwbayes as bw
from bwbayes.app.commands import cli
from bwbayes.app.config.config import RecordConfig, dump, load, parse
from bwbayes.app.config.proposal import ConfigProposal, draft_config
from bwbayes.app.fit.fitted import Run
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.study.about import findings_of
from bwbayes.app.study.from_config import open_like, record_naming
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.record import Record, read_record, write_record
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.formats import read_named, read_source
from bwbayes.record.io.series import Source
from bwbayes.record.teststand import VirtualTestStand
from bwbayes.record.waveforms import Waveform, sine
from tests.app import small
from tests.app.conftest import Type

pytestmark = pytest.mark.usefixtures("_without_pictures")

OWN = "time_s,voltage_V,displacement_um"


@pytest.fixture(scope="module")
def record() -> Record:
    """Return a decaying sine of six seconds at 100 Hz."""
    waveform = Waveform(sine(100.0, 1.0), 6.0, decay=0.1, decay_from=1.0)
    return VirtualTestStand("process", 100.0).run(waveform, np.random.default_rng(1))


Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path, record: Record) -> Write:
    """Return a function that writes a CSV of the record's columns, changed and scaled."""

    def written(
        header: str = OWN,
        factors: tuple[float, float, float] = (1.0, 1.0, 1.0),
        change: Callable[[FloatArray], object] = lambda _: None,
        rows: slice | np.ndarray = slice(None),
        rest: int = 0,
    ) -> Path:
        assert record.displacement is not None
        displacement = record.displacement.copy()
        change(displacement)
        columns = np.stack([record.time, record.voltage, displacement], axis=1) * factors
        columns = np.pad(columns, ((rest, 0), (0, 0)), mode="edge")
        columns[:, 0] = factors[0] * record.interval * np.arange(len(columns))
        lines = [",".join(f"{value:.9g}" for value in row) for row in columns[rows]]
        path = tmp_path / "mine.csv"
        path.write_text("\n".join([header, *lines]) + "\n")
        return path

    return written


def command(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli.cli, [str(one) for one in arguments], standalone_mode=False)


def proposed(path: Path, **units: str) -> ConfigProposal:
    return draft_config(path, path.parent, Naming(units=units))


def test_the_comments_say_what_the_record_shows_and_what_it_cannot_tell(write: Write) -> None:
    text = proposed(write()).text
    assert text.startswith("# mine.csv: 600 samples every 0.01 s from 0 s on\n# voltage -")
    assert "# No issues found." in text
    assert "# from_rest = true  # starts at 0 V, moving; say so if" in text
    assert '# voltage_is = "command"' in text
    resting = write(rest=240)
    assert "# from_rest = true  # starts at 0 V, at rest for 2.4" in proposed(resting).text
    text = proposed(write(rows=slice(20, None))).text
    assert re.search(
        r"# from_rest = false  # starts at 9\d\.\d V, moving; the initial state is", text
    )


@pytest.mark.parametrize("begin", [0.3, 0.6, 0.72, 0.95])
@pytest.mark.parametrize("takes", [0.0, 0.05, 0.5])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_the_only_motion_of_a_step_or_ramp_is_fitted(
    tmp_path: Path, begin: float, takes: float, noise: float
) -> None:
    """Nothing of a step is held out; whatever is held out, the other readings move by half."""
    rng, time = np.random.default_rng(4), np.arange(800) / 800
    ramp = np.clip((time - begin * (1 - takes)) / max(takes, 1e-6), 0.0, 1.0)
    voltage = 80 * ramp + noise * rng.standard_normal(time.size)
    readings = 0.5 * voltage + 0.02 * rng.standard_normal(time.size)
    columns = np.stack([time, voltage, readings], axis=1)
    path = tmp_path / "step.csv"
    np.savetxt(path, columns, "%.6g", ",", header=OWN, comments="")
    proposal = proposed(path)
    if not takes:
        assert not proposal.config.validation
        assert "# Too little of the record, or of its motion, can be left out" in proposal.text
    train = proposal.config.records["record"].train
    assert train is not None
    inside = [voltage[(a <= time) & (time < b)] for a, b in train]
    assert sum(np.ptp(window) for window in inside) > 40


def _turned(displacement: FloatArray) -> None:
    displacement *= -1


@pytest.mark.parametrize("rows", [np.arange(30, 440, 41), np.array([100, 365, 555])])
def test_outliers_are_set_aside_where_fitted_and_left_out_where_held_out(
    write: Write, rows: np.ndarray
) -> None:
    def spoil(displacement: FloatArray) -> None:
        displacement[rows] += 60.0

    path = write(change=spoil)
    proposal = proposed(path)
    assert proposal.config.model.outliers
    assert f"# spikes: {rows.size} isolated outliers" in proposal.text
    held = proposal.config.records["record"].exclude or []
    assert 0 < len(held) < rows.size
    problem = resolve_config(proposal.config, path.parent)
    aside = rows.size - len(held)
    said = f"{aside} reading{'s' * (aside > 1)} set aside"
    assert any(remark.startswith(said) for remark in problem.record_remarks), problem.record_remarks
    assert rows.tolist() == np.flatnonzero(~problem.study.record.has_reading).tolist()


@pytest.mark.parametrize(
    ("written", "line"),
    [
        (
            {"change": _turned},
            "reversed sign: the displacement falls by .* --unit displacement=-um`",
        ),
        ({"rows": np.r_[0:200, 280:600]}, r"csv:202: time_s: gap of 0.81 s .*; give the voltage"),
        ({"header": "time_s,voltage_V,pos"}, "which unit has 'pos' .* --unit displacement=um"),
        ({"header": "time_s,a_V,b_V"}, "which column is the voltage"),
        ({"header": "time_s,voltage_V,displacement_in"}, "which unit has 'displacement_in'"),
    ],
    ids=["sign", "gap", "no unit", "two voltages", "odd unit"],
)
def test_what_makes_a_fit_pointless_is_one_line(
    write: Write, written: dict[str, object], line: str
) -> None:
    path = write(**written)
    done = command("run", path)
    assert isinstance(done.exception, InputError)
    assert re.search(line, str(done.exception)), str(done.exception)
    assert "" == done.output
    assert ["mine.csv"] == [one.name for one in path.parent.iterdir()]


def test_the_command_that_writes_the_config_has_the_options_that_were_given(write: Write) -> None:
    path = write(header="time_s,voltage_V,pos 1", change=_turned)
    given = "--column", "displacement=pos 1", "--unit", "displacement=0.5 um"
    error = str(command("run", path, *given).exception)
    (typed,) = re.findall("write a config with `bwbayes (.*)` and run that", error)
    assert ["init", str(path), *given] == shlex.split(typed)
    assert 0 == command(*shlex.split(typed)).return_value
    assert path.with_suffix(".toml").exists()


@pytest.mark.filterwarnings("ignore:.*1 line above the header:bwbayes.errors.InputWarning")
def test_the_config_names_the_table_that_was_chosen(bwbayes: Type, write: Write) -> None:
    path = write()
    alone = read_record(path)
    turned = write(change=_turned).read_text()
    path.write_text(f"first\n{turned}\nsecond\n{write().read_text()}")
    for name in ("init", "run", "check"):
        said = bwbayes(name, path)
        said.assert_refused("2 tables with numbers: 1 'first' (", ", 2 'second' (", "`--table 1`")
    assert 0 == bwbayes("init", path, "--table", "second").status
    record = load(path.with_suffix(".toml")).records["record"]
    assert "second" == record.table
    assert record.file is not None
    read = read_record(path.with_name(record.file), table=record.table)
    np.testing.assert_array_equal(read.displacement, alone.displacement)
    said = bwbayes("check", path.with_suffix(".toml"), "--table", "1")
    said.assert_refused("--table and --displacement are for a record")


@pytest.mark.parametrize("factors", [(1.0, 1e3, 1.0), (1.0, 1e-4, 1.0), (1.0, 1.0, 1e4)])
def test_units_that_are_stated_are_doubted_and_not_refused(
    write: Write, factors: tuple[float, float, float]
) -> None:
    proposal = proposed(write(factors=factors))
    (finding,) = proposal.findings
    assert "unlikely units" == finding.kind
    assert re.match(
        r"voltages of up to \S+ V move the displacement by \S+ um, \S+ um per volt$", finding.text
    )
    assert proposal.blocking_issue is None


def test_a_reversed_sign_is_turned_by_its_unit(
    write: Write, record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    small.without_explanations(monkeypatch)
    path = write(change=_turned)
    done = command("check", path, "--out", path.parent / "page")
    assert 0 == done.return_value
    assert "reversed sign: the displacement falls" in done.output
    assert (path.parent / "page/check.html").exists()
    assert 0 == command("init", path, "--unit", "displacement=-um").return_value
    problem = resolve_config(load(path.with_suffix(".toml")), path.parent)
    assert problem.study.record.displacement is not None
    np.testing.assert_allclose(problem.study.record.displacement, record.displacement, atol=1e-6)  # type: ignore[arg-type]
    assert () == findings_of(problem.study)["record"]


def test_init_writes_the_config_beside_the_record_and_replaces_none(write: Write) -> None:
    path = write()
    done = command("init", path)
    assert 0 == done.return_value
    assert done.output.startswith("wrote ")
    assert "starts at 0 V, moving: its initial state is estimated; if it was" in done.output
    assert path.with_suffix(".toml").read_text() == proposed(path).text
    again = command("init", path)
    assert isinstance(again.exception, InputError)
    assert "mine.toml: exists; edit it, or choose another name with --out" in str(again.exception)
    (path.parent / "configs").mkdir()
    elsewhere = path.parent / "configs/a.toml"
    assert 0 == command("init", path, "--out", elsewhere).return_value
    assert "../mine.csv" == load(elsewhere).records["record"].file
    assert 600 == resolve_config(load(elsewhere), elsewhere.parent).study.record.samples
    for unit in ("displacement", "length=nm", "displacement=furlong", "time=-s"):
        assert isinstance(command("init", path, "--unit", unit).exception, InputError)


def test_the_shorter_side_of_a_jump_is_neither_fitted_nor_held_out(write: Write) -> None:
    def jump(displacement: FloatArray) -> None:
        displacement[400:] += 10.0

    path = write(change=jump)
    proposal = proposed(path)
    time = proposal.record.time[400]
    assert f"at {proposal.record.clock(time)} s" in proposal.text
    windows = [*(proposal.config.records["record"].train or ())]
    windows += proposal.config.validation["held_out"].window or ()
    assert max(stop for _, stop in windows) <= time + 1e-9
    assert () == findings_of(resolve_config(proposal.config, path.parent).study)["record"]


def test_readings_that_are_clipped_are_missing(write: Write) -> None:
    def clip(displacement: FloatArray) -> None:
        low, high = np.min(displacement), np.max(displacement)
        np.clip(displacement, 0.8 * low, 0.8 * high, out=displacement)

    path = write(change=clip)
    proposal = draft_config(path, path.parent, Naming())
    (source,) = proposal.config.records.values()
    assert proposal.record.displacement is not None
    limits = np.min(proposal.record.displacement), np.max(proposal.record.displacement)
    assert limits == pytest.approx(source.missing)
    again = f'{proposal.text}\n[validation.again]\nfile = "{path.name}"\n'
    problem = resolve_config(parse(again, str(path)), path.parent)
    assert () == findings_of(problem.study)["record"]
    another = problem.study.validations["again"].record
    assert another is not None
    for record in (problem.study.record, another):
        assert record.displacement is not None
        assert limits[0] < np.nanmin(record.displacement) < np.nanmax(record.displacement)
        assert np.nanmax(record.displacement) < limits[1]
    assert source.missing == problem.config.records["record"].missing


# A file beside a run is read as the run's record was, if it has the same columns


QUANTITIES = ("time", "voltage", "displacement")
# Names that people give columns; none of them can be taken for a displacement.
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
    """The config's numbers and units do not matter; nor do they in a run that noted nothing."""
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
    # Only the statements on the file itself count.
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
