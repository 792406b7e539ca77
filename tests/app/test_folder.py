"""A run's folder is whole or not at all, has one writer, and keeps all that was worked out."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from hashlib import sha256
from io import BytesIO
from multiprocessing.synchronize import Event
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import xarray
from hypothesis import given, strategies as st

import bwbayes as bw
from bwbayes.app.commands.cli import cli
from bwbayes.app.config.config import Config, dump, load, parse
from bwbayes.app.fit.fitted import STAGES, Run, open_finished
from bwbayes.app.running import fingerprint as fingerprint_module
from bwbayes.app.running.fingerprint import require_own, save, versions
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import redraw, resume
from bwbayes.app.study.about import version_remarks
from bwbayes.app.study.resolve import resolve_config
from bwbayes.errors import InputError
from bwbayes.model.declaration import Distribution
from bwbayes.record import read_record
from bwbayes.sampling import sampler
from bwbayes.sampling.chain import ChainFile
from tests.app import small
from tests.forks import FORKS

NOBODY = 65534


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return resolve_config(small.config(), tmp_path_factory.mktemp("config"))


def content(path: Path) -> dict[str, bytes]:
    files = [file for file in path.rglob("*") if file.is_file() and file.name != ".lock"]
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def assert_refused(path: Path, problem: Run, *, overwrite: bool, why: str) -> None:
    with pytest.raises(InputError, match=why) as error:
        RunFolder.create(path, problem, overwrite)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(f"{path}: ")


def test_run_is_not_overwritten_unless_told(tmp_path: Path, problem: Run) -> None:
    path = tmp_path / "a"
    made = RunFolder.create(path, problem, overwrite=False)
    made.summary.write_bytes(b"{}")
    before = content(path)
    assert_refused(path, problem, overwrite=False, why=rf"`bwbayes\.resume\('{path}'\)`")
    assert before == content(path)
    RunFolder.create(path, problem, overwrite=True)
    assert not made.summary.exists()
    assert made.config.is_file()


def hold(path: Path, held: Event, enough: Event) -> None:
    with RunFolder(path).locked():
        held.set()
        enough.wait(60)


def test_second_writer_is_refused_while_the_first_one_lives(tmp_path: Path, problem: Run) -> None:
    made = RunFolder.create(tmp_path / "a", problem, overwrite=False)
    held, enough = FORKS.Event(), FORKS.Event()
    other = FORKS.Process(target=hold, args=(made.path, held, enough))
    other.start()
    try:
        assert held.wait(60)
        before = content(made.path)
        with pytest.raises(InputError, match="another process is writing"), made.locked():
            pass
        assert_refused(made.path, problem, overwrite=True, why="another process is writing")
        assert before == content(made.path)
    finally:
        other.kill()  # which gives the lock back
        other.join()
    with made.locked():
        pass


@contextmanager
def powerless() -> Iterator[None]:
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def read_only() -> Iterator[Path]:
    # It is not below pytest's own folder, which others may not even enter.
    with tempfile.TemporaryDirectory() as name:
        path = Path(name)
        yield path
        path.chmod(0o755)


def test_read_only_folder_is_refused(read_only: Path, problem: Run) -> None:
    made = RunFolder.create(read_only / "a", problem, overwrite=False)
    for path in (made.path, read_only):
        path.chmod(0o555)
    with powerless():
        assert_refused(read_only / "b", problem, overwrite=False, why="Permission denied")
        with pytest.raises(InputError, match="Permission denied; make the folder"), made.locked():
            pass
        assert_refused(made.path, problem, overwrite=True, why="Permission denied")
    made.path.chmod(0o755)
    assert made.config.is_file()


def create_with_room_for(path: Path, size: int, told: Any) -> None:
    """Make a run's folder where no file may be larger, and tell the error."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
    try:
        small.begun(path)
    except InputError as error:
        told.put(str(error))


@pytest.mark.parametrize("size", [0, 500, 5_000])
def test_full_disk_leaves_no_folder(tmp_path: Path, size: int) -> None:
    told = FORKS.Queue()
    path = tmp_path / "a"
    process = FORKS.Process(target=create_with_room_for, args=(path, size, told))
    process.start()
    text = told.get(timeout=60)
    process.join()
    assert 0 == process.exitcode
    assert "\n" not in text
    assert "File too large" in text
    assert not path.exists()


def test_new_folder_has_all_that_a_run_needs(tmp_path: Path, problem: Run) -> None:
    partial = tmp_path / "results/.a.partial/records/old.h5"
    partial.parent.mkdir(parents=True)
    partial.write_bytes(b"half a record")
    made = RunFolder.create(tmp_path / "results/a", problem, overwrite=False)
    assert {"config.toml", "records/record.h5", "records/sine.h5"} == set(content(made.path))
    assert [made.path] == list((tmp_path / "results").iterdir())
    assert problem.config == load(made.config)
    assert made == RunFolder.open(made.path)


@pytest.mark.parametrize("named", ["thesis.tex", "config.toml", "records/notes.txt"])
def test_what_is_no_runs_is_never_replaced(tmp_path: Path, problem: Run, named: str) -> None:
    path = tmp_path / "mine"
    (path / named).parent.mkdir(parents=True)
    (path / named).write_text("years of work")
    assert_refused(path, problem, overwrite=False, why="exists")
    for taken in (path, path / named):
        assert_refused(taken, problem, overwrite=True, why="is not a run's folder")
    assert_refused(path / named / "below", problem, overwrite=False, why="Not a directory")
    assert {named: b"years of work"} == content(path)
    (tmp_path / "empty").mkdir()
    assert_refused(tmp_path / "empty", problem, overwrite=False, why="exists")
    assert RunFolder.create(tmp_path / "empty", problem, overwrite=True).config.is_file()


def test_what_is_no_run_cannot_be_opened(tmp_path: Path) -> None:
    config = tmp_path / "config.toml"
    for path in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match=f"{path}: no run here; start one with"):
            RunFolder.open(path)
    config.write_text(small.TEXT)
    with pytest.raises(InputError, match="no run here; start one with"):
        RunFolder.open(tmp_path)
    with pytest.raises(InputError, match=r"config.toml: no run here, but a file; give the folder"):
        RunFolder.open(config)


# A run's folder keeps what was worked out, and knows what it belongs to; else it is refused


def stage_content(stage: Any, path: Path) -> bytes:
    """Return what a file of a stage holds: types, texts and arrays to the bit."""
    save(path, "now", {"stage": stage})
    return path.read_bytes()


def refuse(*_: object) -> None:
    raise AssertionError("worked out again")


@pytest.fixture
def _nothing_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    for stage in STAGES.values():
        monkeypatch.setattr(stage, "compute", refuse)
    monkeypatch.setattr(sampler, "sample", refuse)


@pytest.mark.usefixtures("_nothing_computed")
def test_an_opened_run_computes_nothing(run: Path) -> None:
    opened = bw.open_run(run)
    assert opened.converged
    assert opened.bands
    assert set(vars(opened.result)) > set(STAGES)
    assert "converged" in str(opened)


def test_a_stage_is_the_same_computed_before_the_others_or_after_them(
    run: Path, tmp_path: Path
) -> None:
    """From the last one on, each with what it needs alone; the run has computed them in turn."""
    anew, kept = bw.open_run(run).with_cache(kept={}), bw.open_run(run).kept
    for name in reversed(STAGES):
        stage = stage_content(getattr(anew, name), tmp_path / "stage.npz")
        assert stage == stage_content(kept[name], tmp_path / "kept.npz"), name


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_is_computed_once(run: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    fit, computed = bw.open_run(run).with_cache(kept={}), []
    for other, stage in STAGES.items():
        monkeypatch.setattr(stage, "compute", lambda *_, other=other: computed.append(other))
    assert getattr(fit, name) is getattr(fit, name)
    assert computed == [name]
    fit.compute()
    assert sorted(computed) == sorted(STAGES)


@pytest.mark.parametrize("name", STAGES)
def test_no_stage_speaks_of_an_interval_without_convergence(run: Path, name: str) -> None:
    fit = bw.open_run(run)
    fit = fit.with_cache(outcome=replace(fit.outcome, converged=False))
    if STAGES[name].always:
        assert not getattr(fit.with_cache(kept={}), name)
    else:
        with pytest.raises(bw.NotConvergedError, match="intervals are withheld"):
            getattr(fit, name)


def test_to_open_a_run_is_to_read_files(run: Path) -> None:
    """Half a second is what the libraries take that only its use needs."""
    code = f"import bwbayes, sys; bwbayes.open_run({str(run)!r}); print(*sys.modules)"
    opened = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    slow = {"arviz", "emcee", "h5py", "matplotlib", "numba", "pandas", "pydantic", "scipy.special"}
    assert not slow & set(opened.stdout.decode().split())


@pytest.mark.usefixtures("_nothing_computed")
@pytest.mark.parametrize("damage", ["missing", "config", "record"])
def test_what_is_missing_or_of_another_state_is_worked_out_again(
    run: Path, tmp_path: Path, damage: str
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    if damage == "missing":
        (folder / "result.npz").unlink()
    elif damage == "record":
        file = folder / "records/sine.h5"  # predicted, not fitted
        record = bw.read_record(file)
        assert record.displacement is not None
        bw.write_record(replace(record, displacement=record.displacement + 1.0), file)
    else:
        config = (folder / "config.toml").read_text(encoding="utf-8")
        (folder / "config.toml").write_text(f'name = "other"\n{config.partition(chr(10))[2]}')
    with pytest.raises(AssertionError, match="worked out again"):
        _ = bw.open_run(folder).result


@pytest.mark.parametrize("kind", ["os:system", "subprocess:Popen", "bwbayes.errors:InputError"])
def test_nothing_but_a_dataclass_of_the_package_comes_out_of_a_file(
    kind: str, tmp_path: Path
) -> None:
    path = tmp_path / "result.npz"
    save(path, "now", {"bands": 1.0})
    assert {"bands": 1.0} == fingerprint_module.load(path, "now")
    assert fingerprint_module.load(path, "then") is None
    text = '{"state": "now", "values": {"class": "' + kind + '", "fields": []}}'
    archive = BytesIO()
    np.savez(archive, text=np.array(text))
    path.write_bytes(archive.getvalue())
    assert fingerprint_module.load(path, "now") is None
    path.write_bytes(sha256(archive.getvalue()).digest() + archive.getvalue())
    with pytest.raises(ValueError, match=f"{kind} is no"):
        fingerprint_module.load(path, "now")


@given(cut=st.floats(0, 1, exclude_max=True), data=st.data())
def test_a_damaged_file_is_none(cut: float, data: st.DataObject) -> None:
    """Cut off anywhere, or with another byte in any place, it is not read."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "result.npz"
        save(path, "now", {"bands": np.arange(5.0)})
        whole = path.read_bytes()
        path.write_bytes(whole[: int(cut * len(whole))])
        assert fingerprint_module.load(path, "now") is None
        place = data.draw(st.integers(0, len(whole) - 1))
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        assert fingerprint_module.load(path, "now") is None
        path.write_bytes(whole)
        assert fingerprint_module.load(path, "now")["bands"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]  # type: ignore[index]


def require(run: Path, changed: Config) -> None:
    """Hold a config in the place of a run's own against the run's chain."""
    require_own(resolve_config(changed, run), Path("x"), ChainFile.read(run / "chain").attributes())


def with_d(config: Config, **changes: Any) -> Config:
    d = config.parameters["d"].model_copy(update=changes)
    return config.model_copy(update={"parameters": config.parameters | {"d": d}})


def resumed(folder: RunFolder) -> None:
    resume(folder, small.quiet(), workers=1)


def predicted(folder: RunFolder) -> None:
    small.typed(cli, "predict", folder.path, "--signal", "sine")


@pytest.mark.parametrize("use", [redraw, resumed, predicted])
def test_edited_prior_is_refused(copy: RunFolder, use: Callable[[RunFolder], object]) -> None:
    config = load(copy.config)
    prior = config.parameters["d"].prior
    assert prior is not None
    wider = with_d(config, prior=prior | {"sigma": 1.25 * float(prior["sigma"])})
    copy.config.write_text(dump(wider))
    with pytest.raises(InputError) as caught:
        use(copy)
    text = str(caught.value)
    assert "chain: parameters.d.prior was lognormal (" in text
    assert text.endswith("; undo the edit or start a new run")


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("[[0.0, 5.0]]", "[[0.0, 4.0]]", "record.train"),
        ("passive = true", "passive = false", "model.passive"),
        ('hold = "auto"', 'hold = "first"', "model.hold"),
        ("fixed = 0.0172", "fixed = 0.0173", "parameters.gamma.fixed"),
        ("seed = 3", "seed = 4", "seed"),
        ("block = 25", "block = 30", "sampling.block"),
    ],
)
def test_what_changes_the_posterior_is_named(run: Path, old: str, new: str, key: str) -> None:
    text = dump(load(run / "config.toml"))
    assert old in text
    with pytest.raises(InputError, match=f"x: {key} was .* when the chain was sampled, is "):
        require(run, parse(text.replace(old, new), ""))


def test_a_bound_and_all_else_that_differs_are_named(run: Path) -> None:
    config = load(run / "config.toml")
    held = {"seed": 5, "model": config.model.model_copy(update={"hold": "first"})}
    for changed, said in (
        (with_d(config, lower=0.5), r"parameters.d.lower was not set when .* is 0\.5; undo"),
        (config.model_copy(update=held), r"seed was 3 .*, is 5 \(also model.hold\); undo"),
    ):
        with pytest.raises(InputError, match=said):
            require(run, changed)


def test_what_leaves_the_posterior_may_change(run: Path) -> None:
    config = load(run / "config.toml")
    sampling = {"ess": 9.0, "steps": 7, "pilot_steps": 9, "engine": "auto"}
    changes = {
        "name": "other",
        "sampling": config.sampling.model_copy(update=sampling),
        "validation": {},
        "truth": {},
    }
    relabeled = with_d(config, label="D", description="gain")
    require(run, relabeled.model_copy(update=changes))


def test_chain_without_a_fingerprint_is_refused(copy: RunFolder) -> None:
    with np.load(copy.chain / "start.npz") as file:
        arrays = dict(file)
    text = json.loads(str(arrays["text"]))
    del text["attributes"]["posterior"]
    np.savez(copy.chain / "start.npz", **arrays | {"text": json.dumps(text)})
    for use in (redraw, resumed):
        with pytest.raises(InputError, match=r"does not say which priors .* start a new run"):
            use(copy)


def test_other_versions_are_said(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noted = json.dumps({"numpy": "1.0", "scipy": "1.1", "gone": "3"})
    now = {"numpy": "1.0", "scipy": "1.2", "new": "1"}
    expected = "the chain was begun with other versions: scipy 1.1, now 1.2"
    assert (expected,) == version_remarks(noted, now)
    assert () == version_remarks(noted, {"numpy": "1.0"})
    assert not any("other versions" in r for r in open_finished(RunFolder(run)).result.remarks)
    installed = versions("numpy")
    monkeypatch.setattr(fingerprint_module, "versions", lambda _: installed | {"numpy": "99"})
    remarks = open_finished(RunFolder(run)).result.remarks
    (remark,) = [text for text in remarks if "other versions" in text]
    assert remark.endswith(", now 99")


def test_a_studys_digest_is_that_of_its_posterior(run: Path) -> None:
    config = load(run / "config.toml")
    study = resolve_config(config, run).study
    prior = config.parameters["d"].prior
    assert prior is not None
    record = study.record
    assert record.displacement is not None
    moved = replace(record, displacement=record.displacement + 1e-9)
    same = (
        resolve_config(with_d(config, label="D", description="gain"), run).study,
        resolve_config(config.model_copy(update={"name": "other", "validation": {}}), run).study,
        replace(study, engine="numpy"),
    )
    others = (
        resolve_config(with_d(config, prior=prior | {"sigma": 0.7}), run).study,
        resolve_config(with_d(config, upper=9.0), run).study,
        study.with_model(replace(study.spec, noise="smooth")),
        replace(study, per_record=("offset",)),
        replace(study, records={"record": moved}),
        replace(study, from_rest=frozenset({"record"}) - study.from_rest),
        replace(study, training={"record": (slice(0, 200),)}),
    )
    made = [(other.sha256, other.keys) for other in (study, *same, *others)]
    assert all(each == made[0] for each in made[1 : 1 + len(same)])
    assert all(each not in made[:row] for row, each in enumerate(made) if row > len(same))


# A run leaves what it should, says nothing it cannot know, and does not depend on its pieces


def test_posterior_has_readings_log_likelihood_and_whether_it_has_converged(run: Path) -> None:
    """For each draw it is that of all readings; with the log prior it makes the log density."""
    record, posterior = (
        read_record(run / "records/record.h5"),
        Run(RunFolder(run)).study.posterior,
    )
    with xarray.open_datatree(run / "posterior.nc", engine="h5netcdf") as tree:
        assert 1 == tree.attrs["converged"] == tree["posterior"].attrs["converged"]
        for group, name in (("observed_data", "displacement"), ("constant_data", "voltage")):
            values = tree[group].to_dataset()[name]
            assert (("time",), "s") == (values.dims, values["time"].attrs["units"])
            np.testing.assert_array_equal(record.time, values["time"].values)
            np.testing.assert_array_equal(getattr(record, name), values.values)
        found = tree["log_likelihood"].to_dataset()["displacement"]
        drawn = tree["posterior"].to_dataset()
        free = np.array([[float(drawn[n][c, 3]) for n in posterior.names] for c in (0, 20, 71)])
        expected = posterior.log_likelihood(posterior.prior.theta(free))
        np.testing.assert_allclose(found.values[[0, 20, 71], 3], expected, rtol=0, atol=1e-6)
        assert found.shape == tree["sample_stats"].to_dataset()["lp"].shape


@pytest.mark.usefixtures("_without_pictures", "_without_explanations")
def test_larger_target_is_reached_with_the_same_draws_first(
    run: Path, copy: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where none are set aside: for a larger target that may pay where it did not before."""
    monkeypatch.setattr(sampler._Sampling, "_is_early", False)
    required = float(np.floor(small.lowest_ess(run)) + 1)
    assert resume(copy, small.quiet(), workers=1, ess=required).converged
    first, longer = ChainFile.read(run / "chain"), ChainFile.read(copy.chain)
    steps = first.steps("sampling")
    assert steps < longer.steps("sampling")
    np.testing.assert_array_equal(
        first.coordinates("sampling"), longer.coordinates("sampling")[:steps]
    )
    assert small.lowest_ess(copy.path) >= required


@pytest.mark.usefixtures("_without_pictures")
def test_what_is_finished_is_not_worked_out_again(
    copy: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers, before = copy.numbers(), copy.summary.stat().st_mtime_ns
    for stage in STAGES.values():
        monkeypatch.setattr(stage, "compute", None)
    fit = resume(copy, small.quiet(), workers=1)
    assert fit.converged
    assert copy.summary.stat().st_mtime_ns == before
    copy.summary.unlink()
    resume(copy, small.quiet(), workers=1)
    again = copy.numbers()
    assert {k: v for k, v in again.items() if k != "wall_s"} == {
        k: v for k, v in numbers.items() if k != "wall_s"
    }


def test_pictures_of_an_earlier_end_do_not_stay(copy: RunFolder) -> None:
    steps = ChainFile.read(copy.chain).steps("sampling")
    assert not resume(copy, small.quiet(), workers=1, ess=1e6, steps=steps).converged
    assert {"trace.png", "ranks.png"} == {p.name for p in (copy.path / "figures").iterdir()}
    assert small.numbers(copy.path)["validation"] is None
    assert not (copy.path / "bands.csv").exists()


def test_report_is_drawn_again_with_the_same_numbers(run: Path, copy: RunFolder) -> None:
    for name in ("report.html", "bands.csv", "posterior.nc"):
        (copy.path / name).unlink()
    shutil.rmtree(copy.path / "figures")
    redraw(copy)
    assert json.loads((run / "summary.json").read_text()) == json.loads(copy.summary.read_text())
    small.assert_same_end(run, copy.path)
    assert (copy.path / "report.html").stat().st_size > 100_000
    names = {path.name for path in (run / "figures").iterdir()}
    assert names == {path.name for path in (copy.path / "figures").iterdir()}


def test_a_prior_that_the_record_contradicts_is_a_remark(run: Path) -> None:
    folder = RunFolder(run)
    fit = open_finished(folder)
    outcome = replace(fit.outcome, converged=False)  # no bands are needed
    fit = fit.with_cache(outcome=outcome, kept={})
    assert () == fit.remarks
    nanometres = Distribution("lognormal", {"median": 1e-3, "sigma": 0.6})
    study = replace(fit.study)
    vars(study)["defaults"] = {**fit.study.defaults, "d": nanometres}
    (remark,) = open_finished(folder).with_cache(study=study, outcome=outcome, kept={}).remarks
    assert "Fix: check its unit" in remark


def test_another_engine_is_refused_unless_asked_for(copy: RunFolder) -> None:
    text = copy.config.read_text().replace('engine = "numba"', 'engine = "numpy"')
    copy.config.write_text(text)
    before = ChainFile.read(copy.chain).steps("sampling")
    with pytest.raises(InputError, match=r'sampled with the numba engine, not numpy.*`engine="num'):
        resume(copy, small.quiet(), workers=1)
    assert before == ChainFile.read(copy.chain).steps("sampling")


# A run's files are for everybody: they open with common tools where bwbayes is not installed

# Commands of a colleague who has arviz, xarray, pandas and corner, and no bwbayes.
SCRIPT = """
import json, sys
from pathlib import Path

sys.modules["bwbayes"] = None  # nothing may import it

import arviz as az
import corner
import matplotlib
import numpy as np
import pandas as pd
import xarray as xr

matplotlib.use("agg")
summary = json.loads(Path("summary.json").read_text(encoding="utf-8"))
means = {name: row["mean"] for name, row in summary["parameters"].items()}
tree = az.from_netcdf("posterior.nc")
assert set(means) == set(tree["posterior"].data_vars)
assert tree.attrs["converged"] == 1
statistics, draws = az.summary(tree, round_to="none"), az.extract(tree)
posterior = xr.open_dataset("posterior.nc", group="posterior", engine="h5netcdf")
for name, mean in means.items():
    assert np.isclose(statistics.loc[name, "mean"], mean, rtol=1e-6)
    assert np.isclose(posterior[name].mean(), mean, rtol=1e-6)
assert [posterior[name].attrs["units"] for name in ("d", "offset")] == ["um/V", "um"]
readings = xr.open_datatree("posterior.nc", engine="h5netcdf")["observed_data/displacement"]
assert readings.notnull().sum() == 300
figure = corner.corner(np.stack([draws[name].values for name in means], axis=1), labels=[*means])
assert len(figure.axes) == len(means) ** 2
blocks = [np.load(path) for path in sorted(Path("chain").glob("sampling-0*.npz"))]
chain = np.concatenate([block["log_density"] for block in blocks])  # (steps, ensembles, walkers)
assert chain.shape == (summary["steps"], 4, 18)
coordinates = np.concatenate([block["coordinates"] for block in blocks])
assert coordinates.shape == (*chain.shape, len(means))
assert json.loads(str(np.load("chain/start.npz")["text"]))["attributes"]["seed"] == 3
bands = pd.read_csv("bands.csv")
assert set(bands["set"]) == {"training", "held-out", "sine"}
assert [*bands][:5] == ["set", "time_s", "voltage_V", "displacement_um", "mean_um"]
inside = bands.displacement_um.between(bands.sensor_lower_95_um, bands.sensor_upper_95_um)
assert 0.85 < inside.mean()
"""


def test_files_open_with_arviz_xarray_pandas_corner_and_numpy(run: Path) -> None:
    """``-I`` keeps the checkout out of the script's path as well."""
    done = subprocess.run(
        [sys.executable, "-I", "-c", SCRIPT], cwd=run, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
