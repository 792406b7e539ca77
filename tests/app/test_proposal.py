"""From a CSV at once: a record without a config gets one, or one clear line."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from bwbayes.app.commands import cli
from bwbayes.app.config.config import load, parse
from bwbayes.app.config.proposal import ConfigProposal, draft_config
from bwbayes.app.study.about import findings_of
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.record import Record, read_record
from bwbayes.record.io.columns import Naming
from bwbayes.record.teststand import VirtualTestStand
from bwbayes.record.waveforms import Decay, Sine, Waveform
from tests.app import small
from tests.app.conftest import Type

pytestmark = pytest.mark.usefixtures("_without_pictures")

OWN = "time_s,voltage_V,displacement_um"


@pytest.fixture(scope="module")
def record() -> Record:
    """Return a decaying sine of six seconds at 100 Hz."""
    waveform = Waveform(Sine(100.0, 1.0), 6.0, 0.0, Decay(1.0, 0.1))
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
    """Of a step nothing is held out; whatever is held out, the other readings move by half."""
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
