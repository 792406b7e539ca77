"""A run may be killed at any moment: it goes on to the same bits, and leaves no process behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from bwbayes.errors import InputError
from bwbayes.inference.chain import PHASES, Phase
from bwbayes.inference.chainfile import ChainFile
from tests.app import small

# Longer than anything here takes.
PATIENCE = 120.0

Moment = Callable[[Path], bool]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small.finished(tmp_path_factory)


@contextmanager
def started(where: Path, arguments: list[str]) -> Iterator[subprocess.Popen[str]]:
    """Start a command as the first process of a session of its own."""
    process = subprocess.Popen(
        arguments,
        cwd=where,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()
        assert_alone(process.pid)


def session(leader: int) -> list[str]:
    """Return the processes of a session that live: command lines."""
    found = subprocess.run(
        ["ps", "-o", "stat=,args=", "--sid", str(leader)],
        capture_output=True,
        text=True,
        check=False,
    )
    return [row for row in found.stdout.splitlines() if not row.startswith("Z")]


def assert_alone(leader: int) -> None:
    """See that all processes of an ended session end too."""
    end = time.monotonic() + PATIENCE
    while session(leader) and time.monotonic() < end:
        time.sleep(0.05)
    assert [] == session(leader)


def wait(process: subprocess.Popen[str], moment: Moment, folder: Path) -> None:
    """Wait for a moment of a run, or for its end."""
    end = time.monotonic() + PATIENCE
    while process.poll() is None and not moment(folder):
        assert time.monotonic() < end
        time.sleep(0.01)


def blocks(phase: Phase, count: int) -> Moment:
    """Return the moment when so many blocks of a phase are in the file."""

    def reached(folder: Path) -> bool:
        path = folder / "chain.h5"
        try:
            return path.exists() and ChainFile.read(path).blocks(phase) >= count
        except InputError:  # replaced at this moment
            return False

    return reached


def appears(name: str) -> Moment:
    return lambda folder: (folder / name).exists()


def soon_after(moment: Moment) -> Moment:
    def reached(folder: Path) -> bool:
        if not moment(folder):
            return False
        time.sleep(0.3)
        return True

    return reached


# In the order in which a run comes by them: each is reached after going on from the one before.
MOMENTS: dict[str, Moment] = {
    "start": appears("config.toml"),
    "point fit": soon_after(appears(".lock")),
    "pilot": blocks("pilot", 3),
    "tuning": blocks("tuning", 2),
    "sampling": blocks("sampling", 3),
    "final outputs": appears("bands.csv"),
}


def test_killed_at_every_stage_it_resumes_to_the_same_bits(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "results/small"
    (tmp_path / "small.toml").write_text(small.TEXT)
    reached = []
    for name, moment in MOMENTS.items():
        new = not folder.exists()
        command = ["run", "small.toml"] if new else ["resume", "results/small"]
        workers = "2" if name == "sampling" else "1"
        (folder / ".lock").unlink(missing_ok=True)
        with started(tmp_path, small.command(*command, "--quiet", "--workers", workers)) as process:
            wait(process, moment, folder)
            if process.poll() is None:
                process.kill()
                process.wait()
            reached.append((name, process.returncode))
        assert not (folder / "summary.json").exists()
    assert [(name, -signal.SIGKILL) for name in MOMENTS] == reached
    last = small.command("resume", "results/small", "--quiet", "--workers", "1")
    done = subprocess.run(last, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (0, "", "") == (done.returncode, done.stdout, done.stderr)
    small.assert_same_end(run, folder)


@pytest.mark.parametrize(
    ("asked", "everyone", "moment"),
    [
        (signal.SIGTERM, False, soon_after(appears(".lock"))),
        (signal.SIGTERM, True, blocks("pilot", 1)),
        (signal.SIGINT, True, soon_after(appears("chain.h5"))),
        (signal.SIGINT, True, blocks("pilot", 1)),
    ],
    ids=["terminate point fit", "terminate pilot", "Ctrl-C starting workers", "Ctrl-C pilot"],
)
def test_request_to_stop_ends_in_order(
    tmp_path: Path, asked: signal.Signals, everyone: bool, moment: Moment
) -> None:
    """Ctrl-C reaches all processes of a terminal, the workers too."""
    (tmp_path / "small.toml").write_text(small.TEXT)
    folder = tmp_path / "a"
    command = small.command("run", "small.toml", "--out", "a", "--quiet", "--workers", "2")
    with started(tmp_path, command) as process:
        wait(process, moment, folder)
        if everyone:
            os.killpg(process.pid, asked)
        else:
            process.send_signal(asked)
        out, err = process.communicate(timeout=PATIENCE)
        assert_alone(process.pid)
    assert (130, "") == (process.returncode, out)
    assert "interrupted; go on with `bwbayes resume a`\n" == err
    assert not (folder / "summary.json").exists()


def test_second_command_for_the_same_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(small.TEXT)
    command = small.command("run", "small.toml", "--out", "a", "--quiet", "--workers", "1")
    with started(tmp_path, command) as process:
        wait(process, blocks("pilot", 1), tmp_path / "a")
        for other in (["resume", "a"], ["run", "small.toml", "--out", "a", "--overwrite"]):
            done = subprocess.run(
                small.command(*other, "--quiet"),
                cwd=tmp_path,
                capture_output=True,
                text=True,
                check=False,
            )
            assert (2, "") == (done.returncode, done.stdout)
            assert "bwbayes: a: another process is writing this run; wait for it to end\n" == (
                done.stderr
            )
        assert process.poll() is None


# Dies inside a write: half of the rows are in the file, the count is not.
MORTAL = """
import os, signal, sys
from bwbayes.app.cli import main
from bwbayes.inference import chainfile

left = int(sys.argv.pop(1))


def put(dataset, rows, values, original=chainfile._put):
    global left
    left -= 1
    if left:
        return original(dataset, rows, values)
    dataset.resize(rows.stop, axis=0)
    half = max((rows.stop - rows.start) // 2, 1)
    dataset[rows.start : rows.start + half] = values[:half]
    dataset.file.flush()
    os.kill(os.getpid(), signal.SIGKILL)


chainfile._put = put
main()
"""


@pytest.mark.slow
def test_twenty_kills_end_in_the_same_bits(run: Path, tmp_path: Path) -> None:
    """Ten at random times of new runs, five of them gone on with, five inside a write."""
    (tmp_path / "small.toml").write_text(small.TEXT)
    begun = time.monotonic()
    subprocess.run(
        small.command("run", "small.toml", "--out", "whole", "--quiet"), cwd=tmp_path, check=True
    )
    whole = time.monotonic() - begun
    small.assert_same_end(run, tmp_path / "whole")
    generator = np.random.default_rng(1)
    resume = small.command("resume", "a", "--quiet")
    for number in range(10):
        new = small.command("run", "small.toml", "--out", "a", "--quiet", "--overwrite")
        for command in (new, resume)[: 1 + number % 2]:
            with started(tmp_path, command) as process:
                time.sleep(generator.uniform(0, whole))
        finish(run, tmp_path)
    for count in (1, 6, 30, 50, 70):
        arguments = ["run", "small.toml", "--out", "a", "--quiet", "--overwrite", "--workers", "1"]
        with started(tmp_path, [sys.executable, "-c", MORTAL, str(count), *arguments]) as process:
            assert -signal.SIGKILL == process.wait(PATIENCE)
        finish(run, tmp_path)


def finish(run: Path, where: Path) -> None:
    """Go on with a killed run; or start it, if it was killed before it had its folder."""
    folder = where / "a"
    command = ["resume", "a"] if folder.exists() else ["run", "small.toml", "--out", "a"]
    if folder.exists() and (folder / "chain.h5").exists():
        assert set(PHASES) == set(ChainFile.read(folder / "chain.h5").proposals)
    done = subprocess.run(
        small.command(*command, "--quiet"), cwd=where, capture_output=True, text=True, check=False
    )
    assert (0, "", "") == (done.returncode, done.stdout, done.stderr)
    small.assert_same_end(run, folder)
