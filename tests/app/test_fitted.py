"""From arrays to bands in five lines, and every object shows little of itself at a prompt."""

import re
import shutil
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

import bwbayes as bw
from bwbayes.app.commands.cli import cli
from bwbayes.app.config.config import StandConfig, load, parse
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.campaign import Row
from bwbayes.app.running import run
from bwbayes.app.running.folder import CampaignFolder, RunFolder
from bwbayes.control.loop import Stand
from bwbayes.control.tracking import Tracking, track
from bwbayes.diagnosis.rivals import DriveLock, Rival
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.model.inputs import Limits
from bwbayes.population.population import population
from bwbayes.record import Record, read_record
from bwbayes.report.report import digits
from bwbayes.report.result import write_bands
from bwbayes.shown import LONGEST, MOST_LINES, brief, rounded
from tests.app import small
from tests.control import cases
from tests.population.test_population import drawn


@pytest.fixture(scope="module")
def folder(run: Path) -> Path:
    return run


@pytest.fixture(scope="module")
def record(folder: Path) -> Record:
    return read_record(folder / "records/record.h5")


@pytest.fixture(scope="module")
def opened(folder: Path) -> Run:
    return bw.open_run(folder)


@pytest.fixture(scope="module")
def keys(folder: Path, opened: Run) -> dict[str, Any]:
    return {
        "name": "small",
        "seed": 3,
        "train": (0, 5),
        "parameters": {"initial": {"fixed": 0.0}, "gamma": {"fixed": 0.0172}},
        "ess": 200,
        "block": 25,
        "walkers": 18,
        "validation": {
            "held-out": (5, 6),
            "sine": {"record": read_record(folder / "records/sine.h5"), "from_rest": True},
        },
        "truth": opened.config.truth,
        "workers": 1,
        "progress": False,
    }


@pytest.fixture(scope="module")
def fit(record: Record, keys: dict[str, Any]) -> Run:
    arrays = record.voltage, record.displacement
    made = bw.Record.from_arrays(*arrays, interval=record.interval, voltage_is="command")
    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
        small.without_explanations(patch)
        warnings.simplefilter("error")
        return bw.fit(replace(made, origin=record.origin, truth=record.truth), **keys)


def stopped(folder: Path, steps: int = 25) -> Run:
    made = bw.open_run(folder)
    outcome = replace(made.outcome, converged=False, stop_reason=f"step limit {steps} reached")
    return made.with_cache(outcome=outcome, kept={})


def test_draws_and_summary_are_labeled_and_agree(fit: Run) -> None:
    assert ("chain", "draw") == tuple(fit.draws.sizes)
    table = fit.summary
    assert set(fit.draws.data_vars) == set(table.index)
    for name, row in table.iterrows():
        assert row["mean"] == pytest.approx(float(fit.draws[name].mean()))
        assert row["sd"] == pytest.approx(float(fit.draws[name].std()), rel=1e-3)
        assert row["unit"] == fit.draws[name].attrs["units"]
    assert set(fit.posterior.children) >= {"posterior", "sample_stats", "log_likelihood"}


def test_residuals_are_the_readings_less_the_bands_mean(fit: Run) -> None:
    record = fit.study.record
    assert record.displacement is not None
    residuals = fit.residuals
    assert (record.samples,) == residuals.shape
    for name, window in (("training", slice(0, 250)), ("held-out", slice(250, 300))):
        expected = record.displacement[window] - fit.bands[name].mean
        np.testing.assert_array_equal(expected, residuals.values[window])
    np.testing.assert_array_equal(record.time, residuals.time)


def test_a_terminal_sees_a_table_and_a_notebook_html(fit: Run) -> None:
    said, page = str(fit), fit._repr_html_()
    for name, row in fit.summary.iterrows():
        for text in (str(name), digits(row["mean"], row["sd"]), digits(row["sd"], row["sd"])):
            assert text in said
            assert text in page
    assert said.startswith("small: converged, ")
    assert said.startswith(repr(fit).splitlines()[0])
    assert page.count("<table>") == 3
    assert '<th scope="col">Mean</th>' in page


@pytest.mark.parametrize("passed", [True, False, None])
def test_the_heading_says_for_which_drives_validation_passed(
    opened: Run, passed: bool | None
) -> None:
    heading = opened.with_cache(standing=ValidationSummary(passed)).heading
    drives = f" for drives like the training record's ({opened.facts['drive']})"
    assert heading.endswith(f"validation passed{drives}") == bool(passed)
    assert (drives in heading) == bool(passed)


def test_the_notebooks_html_shows_names_as_they_are(opened: Run) -> None:
    config = opened.config.model_copy(update={"name": "<b>x</b>"})
    shown = opened.with_cache(config=config, result=opened.result)
    assert "&lt;b&gt;x" in shown._repr_html_()


def test_every_figure_is_one_of_matplotlib(opened: Run) -> None:
    names = "loop loops bands coverage innovations spectrum corner trace ranks record"
    for name in names.split():
        assert getattr(opened.plot, name)().axes, name
    fit = opened
    with pytest.raises(bw.InputError, match=r"plot: no 'heldout' here; did you mean held-out\?"):
        fit.plot.bands("heldout")


@pytest.mark.usefixtures("_without_pictures")
def test_saved_it_is_the_command_lines_run_bit_by_bit(
    folder: Path, fit: Run, tmp_path: Path
) -> None:
    path = fit.save(tmp_path / "copy")
    small.assert_same_end(folder, path)
    # The record was an array, and not the stand's signal: the stand is not mentioned.
    theirs_config = load(folder / "config.toml").model_copy(update={"stand": StandConfig()})
    assert theirs_config == load(path / "config.toml")
    ours = {one.relative_to(path).as_posix() for one in path.rglob("*") if one.is_file()}
    theirs = {one.relative_to(folder).as_posix() for one in folder.rglob("*") if one.is_file()}
    # Predictions of the shared folder may have needed rivals since.
    later = {name for name in theirs if name.startswith("figures/") or name == "rivals.npz"}
    assert ours - {"rivals.npz"} == theirs - later
    with pytest.raises(bw.InputError, match=r"copy: exists"):
        fit.save(path)
    again = bw.open_run(path)
    assert again.summary.equals(fit.summary)
    assert again.draws.equals(fit.draws)
    assert (again.seconds, again.remarks) == (fit.seconds, fit.remarks)
    assert repr(again) == repr(fit)


@pytest.mark.usefixtures("_without_pictures")
@pytest.mark.parametrize(
    ("words", "options"),
    [
        ((), {}),
        (("--after", "--lead-in", "1"), {"after": True, "lead_in": 1.0}),
        (("--same-offset", "--window", "1", "2"), {"estimate_offset": False, "window": (1.0, 2.0)}),
    ],
)
def test_a_prediction_is_the_command_lines(
    folder: Path, opened: Run, tmp_path: Path, words: tuple[str, ...], options: dict[str, Any]
) -> None:
    copy, out = tmp_path / "sine.h5", tmp_path / "theirs.csv"
    shutil.copyfile(folder / "records/sine.h5", copy)
    small.typed(cli, "predict", folder, "--record", copy, "--from-rest", "--out", out, *words)
    write_bands(tmp_path / "ours.csv", [opened.predict(copy, from_rest=True, **options)])
    assert out.read_bytes() == (tmp_path / "ours.csv").read_bytes()


@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_a_record_that_may_start_from_rest_says_what_that_would_change(fit: Run) -> None:
    """A record declared so, one that starts elsewhere or whose readings tell its state, is none."""
    sine = 60 * np.sin(np.linspace(0, 12, 200))
    for voltage, declared, expected in (
        (sine, False, True),
        (sine, True, False),
        (sine + 40, False, False),
    ):
        planned = Record.from_arrays(voltage, interval=0.02)
        followed = fit.predict(planned, from_rest=True).mean
        measured = Record.from_arrays(voltage, followed, interval=0.02)
        for record in (planned, measured):
            remarks = fit.predict(record, from_rest=declared).remarks
            told = any("--from-rest declares" in remark for remark in remarks)
            assert told is (expected and record is planned)


@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
@pytest.mark.parametrize(("held", "said"), [(True, True), (False, False)])
def test_a_lead_in_that_is_only_a_hold_is_said_to_tell_little(
    opened: Run, held: bool, said: bool
) -> None:
    """With the length of one that moves; nothing where the state is known."""
    first = opened.study.record
    assert first.displacement is not None
    hold = round(1.0 / first.interval)
    voltage, readings = (
        np.concatenate([np.full(hold, values[40]), values[40:]])
        for values in (first.path.voltage, first.displacement)
    )
    record = bw.Record.from_arrays(voltage, readings, interval=first.interval)
    lead_in = 0.8 if held else 2.0
    remarks = opened.predict(record, lead_in=lead_in).remarks
    told = [remark for remark in remarks if "is only a hold" in remark]
    assert said == bool(told)
    if told:
        longer = float(told[0].partition("take --lead-in ")[2])
        assert 1.0 < longer < 3.0
    rested = opened.predict(record, lead_in=lead_in, from_rest=True).remarks
    assert not [remark for remark in rested if "is only a hold" in remark]


def test_without_convergence_every_interval_is_refused_in_one_line(folder: Path) -> None:
    made = stopped(folder)
    line = "not converged: step limit 25 reached; intervals are withheld; resume with"
    for ask in (
        lambda: made.summary,
        lambda: made.bands,
        lambda: made.residuals,
        lambda: made.loops,
        lambda: made.predict(made.study.record),
        lambda: made.compensate("sine", amplitude=20, frequency=1),
        lambda: made.design("d"),
        lambda: made.export("out"),
        made.track,
        made.plot.loop,
        made.plot.corner,
    ):
        with pytest.raises(bw.NotConvergedError, match=line):
            ask()
    assert made.passed is None
    assert made.validation == {}
    # The draws and the chain's figures stay.
    assert made.draws["d"].size
    assert made.draws.attrs["converged"] == 0
    assert made.plot.trace().axes
    for text in (repr(made), made._repr_html_()):
        assert "NOT CONVERGED: step limit 25 reached; intervals are withheld" in text
        assert "95%" not in text


@pytest.mark.usefixtures("_without_explanations")
def test_a_fit_that_ran_out_of_steps_goes_on_and_leaves_nothing(
    record: Record,
    keys: dict[str, Any],
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.warns(bw.InputWarning, match="NOT CONVERGED: step limit 25") as caught:
        made = bw.fit(record, **keys | {"steps": 25})
    assert {__file__} == {warning.filename for warning in caught}
    assert not made.converged
    again = made.resume(steps=20_000, workers=1, progress=False)
    assert again.config.sampling.steps == 20_000
    assert again.draws.equals(bw.open_run(folder).draws)
    assert list(tmp_path.iterdir())
    del made, again
    assert [] == list(tmp_path.iterdir())


def test_remarks_of_the_record_are_warnings(
    record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("bwbayes.app.running.run.resume", none)
    assert record.displacement is not None
    spoilt = record.displacement.copy()
    spoilt[120] += 60.0
    with (
        pytest.raises(KeyboardInterrupt),
        pytest.warns(bw.InputWarning, match="record: spikes: 1 isolated outlier") as caught,
    ):
        bw.fit(replace(record, displacement=spoilt))
    assert {__file__} == {warning.filename for warning in caught}


def test_bands_that_do_not_hold_are_a_warning(folder: Path, opened: Run) -> None:
    other = read_record(folder / "records/sine.h5")
    assert other.displacement is not None
    turned = replace(other, displacement=-other.displacement)
    with pytest.warns(
        bw.InputWarning, match=r"VALIDATION FAILED: sine \(separate record\): the readings fall"
    ) as caught:
        bands = opened.predict(turned, from_rest=True, name="sine")
    assert {__file__} == {warning.filename for warning in caught}
    assert bands.passed is False
    assert "VALIDATION FAILED" in repr(bands)


def test_what_is_no_record_is_not_predicted(opened: Run) -> None:
    array: Any = np.zeros(20)
    with pytest.raises(bw.InputError, match="ndarray is no record; give a file, or "):
        opened.predict(array)


@pytest.fixture
def _no_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "resume", None)


@pytest.mark.usefixtures("_no_run")
@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ({"dynamcs": "lag"}, "fit: dynamcs: unknown key; did you mean dynamics?"),
        ({"model": {}}, "fit: model: unknown key; give the keys of [model] themselves"),
        ({"parameters": {"d": {"fixd": 1.0}}}, "fit: parameters.d.fixd: unknown key; did you mean"),
        ({"train": "all"}, "fit: record.train: input should be a valid list"),
        ({"dynamics": "leg"}, "dynamics: 'leg' is unknown; did you mean lag?"),
        ({"validation": {"a": {"windw": (0, 1)}}}, "fit: validation.a.windw: unknown key; did you"),
        ({"validation": {"a": {"record": 3}}}, "fit: a: int is not a record"),
        ({"validation": {"a": "none.csv"}}, "none.csv: does not exist; check the path"),
    ],
)
def test_a_key_that_is_wrong_is_one_line(record: Record, wrong: dict[str, Any], line: str) -> None:
    with pytest.raises(bw.InputError) as error:
        bw.fit(record, **wrong)
    assert line in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.usefixtures("_without_explanations", "_without_pictures")
def test_a_config_is_fitted_as_the_command_does(run: Path, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(small.TEXT)
    bw.fit(tmp_path / "small.toml", folder=tmp_path / "a", progress=False)
    small.assert_same_end(run, tmp_path / "a")
    with pytest.raises(bw.InputError, match="fit: ess: say it in the config, or give a record"):
        bw.fit(tmp_path / "small.toml", ess=100)


@pytest.mark.usefixtures("_no_run")
def test_what_is_no_record_is_one_line(record: Record) -> None:
    with pytest.raises(bw.InputError, match=r"ndarray is not a record; make one with Record"):
        bw.fit(record.voltage)  # type: ignore[arg-type]
    with pytest.raises(bw.InputError, match="fit: record: has no displacement"):
        bw.fit(replace(record, displacement=None, truth=None))


def test_rivals_are_fitted_once_and_kept_with_the_run(
    copy: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rivals(p_value: float, **keys: Any) -> tuple[Rival, ...] | None:
        """Return those of a run; other ``keys`` are of its [model]."""
        lock, run = DriveLock(0.5, p_value), bw.open_run(copy.path)
        model = run.config.model.model_copy(update=keys)
        config = run.config.model_copy(update={"model": model})
        locked = run.with_cache(config=config, drive_locks={"record": lock})
        return locked.widening_rivals("record")

    copy.rivals.unlink(missing_ok=True)
    assert rivals(1.0) is None
    assert not copy.rivals.exists()
    (tied,) = rivals(1.0, tied=[{"stages": ["sensor-lag"]}]) or ()
    assert "sensor-lag" in tied.spec.chain
    fitted = rivals(0.0)
    # Fitting again would raise.
    monkeypatch.setattr("bwbayes.diagnosis.rivals.fit_rivals", None)
    kept = rivals(0.0)
    assert fitted
    assert kept
    for before, after in zip(fitted, kept, strict=True):
        assert before.spec == after.spec
        np.testing.assert_array_equal(before.coordinates, after.coordinates)


# Objects show little at a prompt, ``dir`` public names alone, and docstrings no inner modules


@pytest.fixture(scope="module")
def objects(opened: bw.Run, tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    folder, rng = tmp_path_factory.mktemp("shown"), np.random.default_rng(1)
    time = np.arange(300) / 50
    voltage = 60 * np.sin(2 * np.pi * time) * (1 - time / 20)
    stand = bw.VirtualTestStand(sample_rate=50.0)
    record = stand.run(voltage, rng)
    rows = tuple(Row(f"r{i}", f"r{i}.csv", "refused", "because " * 40, {}) for i in range(200))
    many = population(drawn(rng).specimens, rng)
    return [
        opened,
        record,
        stand,
        bw.Record.from_arrays(np.sin(np.arange(1000)), interval=1e-3),
        bw.signal("identification"),
        bw.InputError("a"),
        bw.InputWarning("a"),
        bw.NotConvergedError("a"),
        *bw.inspect(bw.Record(voltage, -voltage, interval=0.02)),
        opened.predict(record, lead_in=0.2),
        *opened.predictions,
        bw.Campaign(CampaignFolder(folder), rows, many),
        opened.compensate("sine", amplitude=20, frequency=1, from_rest=True),
        opened.export(folder / "export"),
        followed(rng),
        *opened.design("d", candidates={"fast": voltage, "slow": 0.5 * voltage}),
        bw.compare(opened, opened, future=False, workers=1),
        parse('[record]\nfile = "a.csv"\n', "a"),
    ]


def followed(generator: np.random.Generator) -> Tracking:
    """Return what ``fit.track`` does, of three draws: the margins of a thousand take a minute."""
    actuator = cases.actuator("bouc-wen, second-order", "zero")
    noise = cases.noise_of(3, 0.5, 1.5, 0.5)
    theta, stand = cases.theta(actuator, 3), Stand(Limits(*cases.SPAN))
    return track(actuator, theta, noise, stand, generator, frequencies=(5.0,))


@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_every_object_shows_itself_in_a_dozen_lines(objects: list[Any]) -> None:
    public = {getattr(bw, name) for name in bw.__all__ if isinstance(getattr(bw, name), type)}
    assert not {one.__name__ for one in public - {*map(type, objects)}}
    for thing in objects:
        text = repr(thing)
        assert text.count("\n") < MOST_LINES, type(thing)
        assert len(text) <= LONGEST, type(thing)


@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_what_is_printed_is_still_whole(objects: list[Any]) -> None:
    fit = objects[0]
    assert len(str(fit).splitlines()) > MOST_LINES
    assert str(fit).startswith("small: converged, ")
    first, last = repr(fit).splitlines()[0], repr(fit).splitlines()[-1]
    assert str(fit).startswith(first)
    assert re.fullmatch(r"\.\.\. \d+ more lines: print it to see them", last)


@dataclass(frozen=True)
class Anything:
    """With fields of any kind."""

    __repr__ = brief

    one: Any
    another: Any


VALUES = st.recursive(
    st.none() | st.text() | st.floats() | st.integers() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.tuples(inner, inner),
)


@given(VALUES, VALUES)
def test_anything_is_shown_shortly(one: Any, another: Any) -> None:
    for thing in (Anything(one, another), Anything(Anything(one, another), [one] * 50)):
        assert repr(thing).count("\n") < MOST_LINES
        assert len(repr(thing)) <= LONGEST


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (13612.0, 3, "13,600"),
        (670.4, 2, "670"),
        (41.26, 3, "41.3"),
        (0.0012, 2, "0.0012"),
        (2.5e7, 3, "2.5e+07"),
        (99_990.0, 2, "100,000"),
    ],
)
def test_a_number_has_no_exponent_below_a_million(value: float, digits: int, text: str) -> None:
    assert rounded(value, digits) == text


def test_dir_has_public_names_alone() -> None:
    assert sorted(bw.__all__) == dir(bw)
