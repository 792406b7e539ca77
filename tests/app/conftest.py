"""What the tests of the app share: the small run, and a copy of it to change."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import bwbayes as bw
from bwbayes.app.running.folder import RunFolder
from tests.app import small


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the finished small run; it is for reading."""
    return small.finished(tmp_path_factory)


@pytest.fixture(scope="session")
def fit(run: Path) -> bw.Fit:
    """Return the small run in Python."""
    return bw.open_run(run)


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> RunFolder:
    """Return a copy of the finished run, to be changed."""
    shutil.copytree(run, tmp_path / "copy")
    return RunFolder.open(tmp_path / "copy")


@pytest.fixture
def _without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the time that pictures take, where they are not what is tested."""
    monkeypatch.setattr("bwbayes.app.running.figure_worker.drawings", lambda _: {})
