"""What a run worked out is read from its folder, and anything else is worked out again."""

from __future__ import annotations

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
from hypothesis import given
from hypothesis import strategies as st

import bwbayes as bw
from bwbayes.app.running import assembling
from bwbayes.app.running.fingerprint import load, save
from bwbayes.sampling import sampler


def content(result: Any, path: Path) -> bytes:
    """Return what a file of a result's parts holds: types, texts and arrays to the bit."""
    names = ("bands", "scores", "verdicts", "loops", "innovations", "explanations", "learned")
    save(path, "now", {name: getattr(result, name) for name in names})
    return path.read_bytes()


def refuse(*_: object) -> None:
    raise AssertionError("worked out again")


def test_an_opened_run_works_nothing_out(
    run: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    expected = bw.open_run(run)
    worked_out = assembling.assemble(expected.problem, expected.chain, expected.outcome)
    monkeypatch.setattr(assembling, "assemble", refuse)
    monkeypatch.setattr(sampler, "sample", refuse)
    opened = bw.open_run(run)
    assert opened.converged
    first, second = (content(r, tmp_path / "result.npz") for r in (worked_out, opened.result))
    assert first == second
    assert opened.bands
    assert "converged" in str(opened)


def test_to_open_a_run_is_to_read_files(run: Path) -> None:
    """Half a second is what the libraries take that only its use needs."""
    code = f"import bwbayes, sys; bwbayes.open_run({str(run)!r}); print(*sys.modules)"
    opened = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    slow = {"arviz", "emcee", "h5py", "matplotlib", "numba", "pandas", "pydantic", "scipy.special"}
    assert not slow & set(opened.stdout.decode().split())


@pytest.mark.parametrize("damage", ["missing", "config", "record"])
def test_what_is_missing_or_of_another_state_is_worked_out_again(
    run: Path, tmp_path: Path, damage: str, monkeypatch: pytest.MonkeyPatch
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
    monkeypatch.setattr(assembling, "assemble", refuse)
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
