"""A run's folder comes to be whole or not at all, has one writer, and is never lost by mistake."""

import os
import resource
import signal
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import pytest

from bwbayes.app.config.config import load
from bwbayes.app.fit.fitted import Run
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.study.resolve import resolve_config
from bwbayes.errors import InputError
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
    # Not below pytest's own folder, which others may not even enter.
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
