"""Fixtures of the app's tests: the small run, and a copy of it to change."""

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

import bwbayes as bw
from bwbayes.app.commands import cli
from bwbayes.app.running.folder import RunFolder
from tests.app import small


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the finished small run; it is for reading."""
    return small.finished(tmp_path_factory)


@pytest.fixture(scope="session")
def fit(run: Path) -> bw.Run:
    return bw.open_run(run)


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> RunFolder:
    shutil.copytree(run, tmp_path / "copy")
    return RunFolder.open(tmp_path / "copy")


@pytest.fixture
def _without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    small.without_pictures(monkeypatch)


@pytest.fixture
def _without_explanations(monkeypatch: pytest.MonkeyPatch) -> None:
    small.without_explanations(monkeypatch)


@dataclass(frozen=True)
class Said:
    """A command's output and its exit status."""

    status: int
    out: str
    err: str

    def assert_refused(self, *texts: str) -> None:
        """Require status 2 and one line that has these texts."""
        assert (2, "") == (self.status, self.out)
        assert re.fullmatch(r"bwbayes: [^\n]+\n", self.err), self.err
        for text in texts:
            assert text in self.err


Type = Callable[..., Said]


@pytest.fixture
def bwbayes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Type:
    """Return a function that runs a command line in an empty folder, in this process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    monkeypatch.setenv("COLUMNS", "200")

    def typed(*arguments: object) -> Said:
        monkeypatch.setattr("sys.argv", ["bwbayes", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            cli.main()
        printed = capsys.readouterr()
        assert isinstance(end.value.code, int)
        return Said(end.value.code, printed.out, printed.err)

    return typed
