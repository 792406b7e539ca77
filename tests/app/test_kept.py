"""A run's folder keeps what was worked out, and knows what it belongs to; else it is refused."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

import bwbayes as bw
from bwbayes.app.commands.cli import cli
from bwbayes.app.config.config import Config, dump, load, parse
from bwbayes.app.fit.fitted import STAGES, open_finished
from bwbayes.app.running import fingerprint as fingerprint_module
from bwbayes.app.running.fingerprint import require_own, save, versions
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import redraw, resume
from bwbayes.app.study.about import version_remarks
from bwbayes.app.study.resolve import resolve_config
from bwbayes.errors import InputError
from bwbayes.sampling import sampler
from bwbayes.sampling.storage import ChainFile
from tests.app import small


def content(stage: Any, path: Path) -> bytes:
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
        stage = content(getattr(anew, name), tmp_path / "stage.npz")
        assert stage == content(kept[name], tmp_path / "kept.npz"), name


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
    content = BytesIO()
    np.savez(content, text=np.array(text))
    path.write_bytes(content.getvalue())
    assert fingerprint_module.load(path, "now") is None
    path.write_bytes(sha256(content.getvalue()).digest() + content.getvalue())
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
    np.savez(copy.chain / "start.npz", allow_pickle=False, **arrays | {"text": json.dumps(text)})
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
