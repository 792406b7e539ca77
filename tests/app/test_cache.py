"""What a run worked out is read from its folder, and anything else is worked out again."""

import shutil
import subprocess
import sys
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
from bwbayes.app.fit.fitted import STAGES
from bwbayes.app.running.fingerprint import load, save
from bwbayes.sampling import sampler


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


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_is_the_same_computed_alone_read_or_after_the_others(
    run: Path, tmp_path: Path, name: str
) -> None:
    alone = getattr(bw.open_run(run).with_cache(kept={}), name)
    kept = bw.open_run(run).kept[name]
    assert content(alone, tmp_path / "alone.npz") == content(kept, tmp_path / "kept.npz")


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
    assert {"bands": 1.0} == load(path, "now")
    assert load(path, "then") is None
    text = '{"state": "now", "values": {"class": "' + kind + '", "fields": []}}'
    content = BytesIO()
    np.savez(content, text=np.array(text))
    path.write_bytes(content.getvalue())
    assert load(path, "now") is None
    path.write_bytes(sha256(content.getvalue()).digest() + content.getvalue())
    with pytest.raises(ValueError, match=f"{kind} is no"):
        load(path, "now")


@given(cut=st.floats(0, 1, exclude_max=True), data=st.data())
def test_a_damaged_file_is_none(cut: float, data: st.DataObject) -> None:
    """Cut off anywhere, or with another byte in any place, it is not read."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "result.npz"
        save(path, "now", {"bands": np.arange(5.0)})
        whole = path.read_bytes()
        path.write_bytes(whole[: int(cut * len(whole))])
        assert load(path, "now") is None
        place = data.draw(st.integers(0, len(whole) - 1))
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        assert load(path, "now") is None
        path.write_bytes(whole)
        assert load(path, "now")["bands"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]  # type: ignore[index]
