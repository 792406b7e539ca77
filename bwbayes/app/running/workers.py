"""Where ensembles, replicates and records are worked on: here, in processes, or on a cluster.

The executors are those of ``concurrent.futures`` and of ``distributed``. Matrix products here are
small and the ensembles already share the cores, so the linear algebra library is kept to one
thread: more would only wait for each other, and could change the last bits.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Any, Literal

import cloudpickle
from threadpoolctl import threadpool_limits

from bwbayes.errors import InputError
from bwbayes.inference.engine import Engine

__all__ = ["KINDS", "ByValue", "executor", "one_thread", "processes", "side_by_side"]


# What `--executor` may say; a cluster goes by its address besides, dask://HOST:PORT.
KINDS = ("local", "threads", "processes", "dask")


@contextmanager
def executor(
    workers: int | None = None, engine: Engine = "numpy", backend: str | Executor | None = None
) -> Iterator[Executor]:
    """Give an executor with that many workers, by default one a core.

    Parameters
    ----------
    workers
        How many.
    engine
        Compiled code runs in threads of this process, side by side. Several workers with NumPy,
        which does not, are processes; a single one is this process itself.
    backend
        "local", which is that; "threads" or "processes" whatever the engine; "dask", processes
        of this machine under a scheduler; "dask://HOST:PORT", the workers of a scheduler that runs
        already; or any executor with the methods of ``concurrent.futures``, or a
        ``distributed.Client``, which stay open.

    Raises
    ------
    InputError
        Another word, or a cluster that does not answer.
    """
    if backend is not None and not isinstance(backend, str):
        yield _given(backend)
        return
    count = workers or os.cpu_count() or 1
    kind, _, address = (backend or "local").partition("://")
    if kind not in KINDS or (address and kind != "dask"):
        kinds = ", ".join(KINDS)
        raise InputError(
            f"executor: {backend!r} is unknown; write one of {kinds}, dask://HOST:PORT"
        )
    if kind == "local":
        kind = "processes" if engine == "numpy" and count > 1 else "threads"
    if kind == "dask":
        # Here, because few have dask, and it takes a second to load.
        from bwbayes.app.running.cluster import cluster  # noqa: PLC0415

        with cluster(address, workers) as pool:
            yield pool
    elif kind == "processes":
        with processes(count) as pool:
            yield pool
    else:
        threads = ThreadPoolExecutor(count)
        try:
            yield threads
        finally:
            threads.shutdown(cancel_futures=True)


@contextmanager
def processes(count: int, method: Literal["spawn", "fork"] = "spawn") -> Iterator[ByValue]:
    """Give an executor with processes, which end at once if whoever has it is interrupted.

    "spawn" starts Python in each; "fork" copies this process as it is, at once and with all that it
    has loaded, which only a process without other threads may do.
    """
    pool = ProcessPoolExecutor(count, multiprocessing.get_context(method), _settle)
    try:
        with warnings.catch_warnings():
            # Python warns of any thread; those of the linear algebra library stop for a fork.
            warnings.filterwarnings("ignore", ".*multi-threaded", DeprecationWarning)
            _start(pool, count)
        yield ByValue(pool)
    except BaseException:
        # Whoever is interrupted does not wait for the end of what nobody will read.
        for process in [*(pool._processes or {}).values()]:
            process.kill()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def side_by_side(pool: Executor, workers: int | None, calls: int) -> int:
    """Return how many calls are to be under way: those of a cluster, two for each worker."""
    workers_there = getattr(pool, "workers", None)
    count = 2 * workers_there if isinstance(workers_there, int) else workers or os.cpu_count() or 1
    return max(min(count, calls), 1)


def _given(backend: Any) -> Executor:
    """Return an executor that somebody made; calls go to others than threads by value."""
    if isinstance(backend, ThreadPoolExecutor | ByValue):
        return backend
    if hasattr(backend, "get_executor"):
        from bwbayes.app.running.cluster import on_client  # noqa: PLC0415

        return on_client(backend)
    if not callable(getattr(backend, "submit", None)):
        raise InputError(
            f"executor: {type(backend).__name__} has no submit; give an executor of "
            "concurrent.futures, or one of " + ", ".join(KINDS)
        )
    return ByValue(backend)


class ByValue(Executor):
    """Sends by value what pickle does not send: priors and bounds that parts declare in a line.

    ``workers`` is how many calls a cluster makes at the same time.
    """

    def __init__(self, pool: Any, workers: int | None = None) -> None:
        self.pool, self.workers = pool, workers

    def submit[**P, T](self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Send a call by value."""
        sent: Future[T] = self.pool.submit(_called, cloudpickle.dumps(partial(fn, *args, **kwargs)))
        return sent


def _called(call: bytes) -> Any:
    """Make a call, with one thread for linear algebra as everywhere."""
    with one_thread():
        return pickle.loads(call)()


def one_thread() -> AbstractContextManager[object]:
    """Keep this process's linear algebra to one thread, as a context."""
    limited: AbstractContextManager[object] = threadpool_limits(1, user_api="blas")
    return limited


def _start(pool: Executor, count: int) -> None:
    """Start workers that ignore the signals that stop a run: its own process handles those.

    Without that, Ctrl-C would kill the workers first, or while they start make each complain.
    """
    if not hasattr(signal, "pthread_sigmask"):
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        for _ in range(count):  # each starts a worker, which inherits what is blocked
            pool.submit(os.getpid)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _settle() -> None:
    """Prepare a worker process: one thread, ignoring Ctrl-C, ended with its parent."""
    # The limit is set to libraries that are there, and this one has not been needed yet.
    import scipy.linalg  # noqa: F401, PLC0415

    one_thread()
    # The Ctrl-C that asks a run to stop in order must not kill its workers first.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
