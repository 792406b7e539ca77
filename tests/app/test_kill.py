"""A run may be killed at any moment: it goes on to the same bits, and leaves no process behind.

The commands run in processes from a fork server, which has all imported already. They do what a
person's do, but for pictures and explanations, which are spared. The slow test of random kills
makes 200 of them, or as many as the environment variable KILLS says.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.commands.cli import main
from bwbayes.app.fit import fitted
from bwbayes.app.running import run as run_module
from bwbayes.app.running.folder import RunFolder
from bwbayes.errors import InputError
from bwbayes.sampling.chain import PHASES, ChainFile, Phase
from tests.app import small
from tests.forks import FORKS
from tests.measured import keep

# Longer than anything here takes.
PATIENCE = 300.0

# Kills at random times of the slow test, ten a run.
KILLS = int(os.environ.get("KILLS", "200"))
RUNS = max(KILLS // 10, 1)

Moment = Callable[[Path], bool]


def follow(where: Path, arguments: list[str], last_step: str) -> None:
    """Do what the command line would, in a session of its own.

    Or die where a step of the run would begin.
    """
    os.setsid()
    os.chdir(where)
    # Python prepares a process that a terminal starts for this, and a fork server's for none.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, name in ((1, "out"), (2, "err")):
        with (where / name).open("w") as file:
            os.dup2(file.fileno(), number)
    patched = pytest.MonkeyPatch()
    small.without_pictures(patched)
    small.without_explanations(patched)
    if last_step:
        patched.setattr(run_module, last_step, die)
    sys.argv = ["bwbayes", *arguments]
    main()


def die(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@contextmanager
def started(where: Path, *arguments: str, last_step: str = "") -> Iterator[ForkServerProcess]:
    """Start a command as the first process of a session of its own."""
    process = FORKS.Process(target=follow, args=(where, list(arguments), last_step))
    process.start()
    assert process.pid is not None
    try:
        yield process
    finally:
        process.kill()
        process.join()
        assert_alone(process.pid)


def finished(where: Path, *arguments: str) -> tuple[int | None, str, str]:
    with started(where, *arguments) as process:
        process.join(PATIENCE)
        return process.exitcode, (where / "out").read_text(), (where / "err").read_text()


def session(leader: int) -> list[str]:
    result = subprocess.run(
        ["ps", "-o", "stat=,args=", "--sid", str(leader)],
        capture_output=True,
        text=True,
        check=False,
    )
    return [row for row in result.stdout.splitlines() if not row.startswith("Z")]


def assert_alone(leader: int) -> None:
    end = time.monotonic() + PATIENCE
    while session(leader) and time.monotonic() < end:
        time.sleep(0.05)
    assert [] == session(leader)


def wait(process: ForkServerProcess, moment: Moment, folder: Path) -> None:
    end = time.monotonic() + PATIENCE
    while process.is_alive() and not moment(folder):
        assert time.monotonic() < end
        time.sleep(0.01)


def blocks(phase: Phase, count: int) -> Moment:
    """Return the moment when so many blocks of a phase are in the file."""

    def reached(folder: Path) -> bool:
        path = folder / "chain"
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
    "pilot": blocks("pilot", 1),
    "tuning": blocks("tuning", 1),
    "sampling": blocks("sampling", 3),
    "final outputs": lambda _: False,  # where it dies by itself: these are too quick to wait for
}


def test_killed_at_every_stage_it_resumes_to_the_same_bits(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "results/small"
    (tmp_path / "small.toml").write_text(small.TEXT)
    reached = []
    for name, moment in MOMENTS.items():
        new = not folder.exists()
        command = ("run", "small.toml") if new else ("resume", "results/small")
        workers = "2" if name == "sampling" else "1"
        (folder / ".lock").unlink(missing_ok=True)
        step = "render" if name == "final outputs" else ""
        every = (*command, "--quiet", "--workers", workers)
        with started(tmp_path, *every, last_step=step) as process:
            wait(process, moment, folder)
            process.kill()
            process.join()
            reached.append((name, process.exitcode))
        assert not (folder / "summary.json").exists()
    assert [(name, -signal.SIGKILL) for name in MOMENTS] == reached
    last = ("resume", "results/small", "--quiet", "--workers", "1")
    assert (0, "", "") == finished(tmp_path, *last)
    small.assert_same_end(run, folder)


# Where a request to stop would be lost: in what C calls, such as what loads a compiled function,
# and in a library that, while it is loaded, takes whatever happens for something that is missing.
LOSES_IT = {
    "callback": "ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), signal.{name}))()",
    "import": "import loses_it",
}
LIBRARY = """
import os, signal

try:
    os.kill(os.getpid(), signal.{name})
except BaseException:
    pass
"""
ASKED = """
import ctypes, os, signal, time
from bwbayes.app.commands import cli

def wait(*_, **__):
    {loses_it}
    time.sleep({seconds})

cli.cli.main = wait
cli.main()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("where", LOSES_IT)
def test_no_request_to_stop_is_lost(where: str, name: str, tmp_path: Path) -> None:
    (tmp_path / "loses_it.py").write_text(LIBRARY.format(name=name))
    code = ASKED.format(loses_it=LOSES_IT[where].format(name=name), seconds=PATIENCE)
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (130, "bwbayes: interrupted\n") == (done.returncode, done.stderr)


@pytest.mark.parametrize(
    ("asked", "everyone", "moment"),
    [
        (signal.SIGTERM, False, soon_after(appears(".lock"))),
        (signal.SIGINT, True, soon_after(appears("chain"))),
        (signal.SIGINT, True, blocks("pilot", 1)),
    ],
    ids=["terminate point fit", "Ctrl-C starting workers", "Ctrl-C pilot"],
)
def test_request_to_stop_ends_in_order(
    tmp_path: Path, asked: signal.Signals, everyone: bool, moment: Moment
) -> None:
    # Long enough that it has not ended by itself before it is asked to.
    (tmp_path / "small.toml").write_text(small.TEXT.replace("ess = 200", "ess = 20000"))
    folder = tmp_path / "a"
    command = ("run", "small.toml", "--out", "a", "--quiet", "--workers", "2")
    with started(tmp_path, *command) as process:
        wait(process, moment, folder)
        assert process.pid is not None
        if everyone:
            os.killpg(process.pid, asked)
        else:
            os.kill(process.pid, asked)
        process.join(PATIENCE)
        assert_alone(process.pid)
    assert 130 == process.exitcode
    assert "" == (tmp_path / "out").read_text()
    assert "interrupted; resume with `bwbayes resume a`\n" == (tmp_path / "err").read_text()
    assert not (folder / "summary.json").exists()
    with pytest.raises(InputError, match=r"no draws yet; resume with|chain does not exist"):
        fitted.open_finished(RunFolder(folder))


@pytest.mark.slow
def test_kills_at_random_end_in_the_same_bits(run: Path, tmp_path: Path) -> None:
    """Each run is killed some ten times, wherever it is then, on its way to its end."""
    (tmp_path / "small.toml").write_text(small.TEXT)
    begun = time.monotonic()
    whole = ("run", "small.toml", "--out", "whole", "--quiet", "--workers", "2")
    assert (0, "", "") == finished(tmp_path, *whole)
    length = time.monotonic() - begun
    small.assert_same_end(run, tmp_path / "whole")
    generator = np.random.default_rng(1)
    kills = 0
    for number in range(RUNS):
        shutil.rmtree(tmp_path / "a", ignore_errors=True)
        before = [0] * len(PHASES)
        while kills < KILLS * (number + 1) // RUNS:
            workers = str(generator.integers(1, 3))
            with started(tmp_path, *go_on(tmp_path), "--workers", workers) as process:
                process.join(generator.uniform(0, 3 * length * RUNS / KILLS))
                process.kill()
                process.join()
                assert process.exitcode in (0, -signal.SIGKILL)
                kills += process.exitcode == -signal.SIGKILL
            now = counted(tmp_path / "a/chain")
            assert all(n >= b for n, b in zip(now, before, strict=True))
            before = now
        assert (0, "", "") == finished(tmp_path, *go_on(tmp_path))
        small.assert_same_end(run, tmp_path / "a")
    keep("kills", {"kills": kills, "runs": RUNS})
    assert KILLS == kills


def go_on(where: Path) -> tuple[str, ...]:
    if (where / "a").exists():
        return ("resume", "a", "--quiet")
    return ("run", "small.toml", "--out", "a", "--quiet")


def counted(path: Path) -> list[int]:
    if not path.exists():
        return [0] * len(PHASES)
    chain = ChainFile.read(path)
    return [len(chain.history(phase)) for phase in PHASES]
