"""Executors, here and on a cluster: the same bits, whoever dies on the way."""

import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from bwbayes.app.running import workers as workers_module
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.app.running.workers import one_thread, open_executor, side_by_side
from bwbayes.errors import InputError
from bwbayes.inference import Engine, map_estimate as pointfit
from bwbayes.sampling.chain import Chain, draws
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.sampler import init_chain, sample
from tests.app import small
from tests.app.conftest import Type
from tests.inference.problems import short_posterior, truth

distributed = pytest.importorskip("distributed", reason="bwbayes[dask] is not installed")

# dask's own processes and sockets end when the interpreter gets to it.
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

PLAN = SamplingPlan(
    ess=50, walkers=24, block=10, min_pilot_steps=20, max_pilot_steps=20, max_steps=40
)
PATIENCE = 120.0


def posterior() -> Any:
    return short_posterior(samples=40)


def chain() -> Chain:
    one = posterior()
    point = pointfit.fit(one, np.random.default_rng(1))
    return init_chain(one, point, PLAN, np.random.default_rng(2))


def sampled(pool: Executor, watcher: Callable[..., None] = lambda *_: None) -> Any:
    one, begun = posterior(), chain()
    sample(one, PLAN, begun, pool, watcher)
    return draws(one, begun)


@pytest.fixture(scope="module")
def here() -> Any:
    with open_executor(1) as pool:
        return sampled(pool)


@contextmanager
def scheduler(workers: int) -> Iterator[tuple[str, Any, list[Any]]]:
    """Run a real scheduler and so many workers, each a process; give its address and them all."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}

    def started(*arguments: str) -> Any:
        return subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    host, port = address.split(":")
    main = started("scheduler", "--host", host, "--port", port, "--no-dashboard")
    each = [
        started("worker", f"tcp://{address}", "--nthreads", "1", "--no-nanny", "--no-dashboard")
        for _ in range(workers)
    ]
    try:
        yield address, main, each
    finally:
        for process in (*each, main):
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def cluster() -> Iterator[tuple[str, Any, list[Any]]]:
    with scheduler(2) as running:
        yield running


def test_a_cluster_gives_the_same_bits(here: Any, cluster: tuple[str, Any, list[Any]]) -> None:
    with open_executor(executor=f"dask://{cluster[0]}") as pool:
        np.testing.assert_array_equal(here, sampled(pool))
        pool.submit(pow, 2, 2).result(PATIENCE)
        assert side_by_side(pool, None, 10) in (2, 4)  # of one worker or of both
        assert 1 == side_by_side(pool, None, 1)


def test_a_client_that_somebody_made_is_an_executor_and_stays_open(
    cluster: tuple[str, Any, list[Any]],
) -> None:
    client = distributed.Client(f"tcp://{cluster[0]}")
    try:
        with open_executor(executor=client) as pool:
            assert [4] == [pool.submit(pow, 2, 2).result()]
            error = pool.submit(int, "x").exception()
            assert isinstance(error, ValueError)
        assert "running" == client.status
    finally:
        client.close()


def test_a_worker_killed_within_a_block_costs_no_bit(
    here: Any, cluster: tuple[str, Any, list[Any]]
) -> None:
    """After the first block; the scheduler gives what it was at to the other."""
    _, _, workers = cluster
    killed: list[int] = []

    def watcher(*_: object) -> None:
        if not killed:
            killed.append(workers[0].pid)
            workers[0].kill()

    with open_executor(executor=f"dask://{cluster[0]}") as pool:
        np.testing.assert_array_equal(here, sampled(pool, watcher))
    assert killed


@pytest.mark.slow
def test_with_the_scheduler_lost_a_run_is_resumed_here(tmp_path: Path) -> None:
    expected = resume(small.begun(tmp_path / "here"), small.quiet(), workers=1, files=False)
    folder = small.begun(tmp_path / "there")
    with scheduler(1) as (address, main, _):
        threading.Thread(target=_kill_at_first_block, args=(folder, main), daemon=True).start()
        with pytest.raises(BrokenExecutor, match="the scheduler is gone"):
            resume(folder, small.quiet(), executor=f"dask://{address}", files=False)
    resumed = resume(RunFolder.open(folder.path), small.quiet(), workers=1, files=False)
    np.testing.assert_array_equal(expected.result.draws, resumed.result.draws)


def _kill_at_first_block(folder: RunFolder, process: Any) -> None:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and not (folder.chain / "pilot-0000.npz").exists():
        time.sleep(0.01)
    process.kill()


def test_what_takes_no_calls_is_no_executor() -> None:
    with pytest.raises(InputError, match="object has no submit"):
        open_executor(executor=object()).__enter__()  # type: ignore[arg-type]


def test_a_run_refuses_an_executor_before_its_map_estimate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = small.begun(tmp_path / "run")
    before = folder.config.read_bytes()
    monkeypatch.setattr("bwbayes.app.running.run.choose_model", None)
    with pytest.raises(InputError, match="'slurm' is unknown"):
        resume(folder, small.quiet(), executor="slurm", ess=50.0)
    assert before == folder.config.read_bytes()


@pytest.mark.parametrize("command", ["run", "resume", "compare", "campaign", "calibrate"])
@pytest.mark.parametrize(
    ("executor", "said"),
    [
        ("slurm", "executor: 'slurm' is unknown; write one of local"),
        ("dask", "distributed is not installed; install bwbayes[dask]"),
        ("dask://127.0.0.1:9", "no scheduler there; start one with `dask scheduler`"),
    ],
)
def test_every_command_refuses_an_executor_first_of_all(
    bwbayes: Type, monkeypatch: pytest.MonkeyPatch, command: str, executor: str, said: str
) -> None:
    monkeypatch.setattr(workers_module, "PATIENCE", 0.2)
    if executor == "dask":
        monkeypatch.setitem(sys.modules, "distributed", None)
    bwbayes(command, "nothing", "--executor", executor).assert_refused(said)


class Foreign(Executor):
    """An executor of somebody else, that sends what pickle sends."""

    def __init__(self) -> None:
        self.pool = ThreadPoolExecutor(2)
        self.sent = 0

    def submit(self, fn: Any, /, *args: Any, **_: Any) -> Future[Any]:
        """Send a call."""
        self.sent += 1
        return self.pool.submit(pickle.loads(pickle.dumps(fn)), *pickle.loads(pickle.dumps(args)))


def test_any_executor_with_a_submit_gives_the_same_bits(here: Any) -> None:
    foreign = Foreign()
    with open_executor(executor=foreign) as pool:
        np.testing.assert_array_equal(here, sampled(pool))
    assert foreign.sent > 8


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_dies_ends_the_work_at_once() -> None:
    with open_executor(1, executor="processes") as pool, pytest.raises(BrokenProcessPool):
        pool.submit(die).result(PATIENCE)


def linear_algebra_threads() -> set[int]:
    np.linalg.solve(np.eye(2), np.eye(2))
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.mark.parametrize(("workers", "engine"), [(1, "numpy"), (2, "numba")])
def test_workers_get_the_whole_model_and_use_one_thread_each(workers: int, engine: Engine) -> None:
    model = replace(posterior(), engine=engine)
    theta = truth(model)
    with one_thread(), open_executor(workers, engine) as pool:
        threads = [pool.submit(linear_algebra_threads) for _ in range(2 * workers)]
        assert [{1}] * len(threads) == [future.result() for future in threads]
        density = pool.submit(model.log_likelihood, theta).result()
    np.testing.assert_array_equal(model.log_likelihood(theta), density)
