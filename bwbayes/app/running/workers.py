"""Where ensembles, replicates and records are worked on: here, in processes, or on a cluster.

Matrix products here are small and the ensembles already share the cores, so the linear algebra
library is kept to one thread: more would only wait for each other, and could change the last bits.
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
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Any, Literal

import cloudpickle
from threadpoolctl import threadpool_limits

from bwbayes.errors import InputError
from bwbayes.inference.engine import Engine

__all__ = ["KINDS", "Processes", "ended", "executor", "one_thread", "side_by_side"]


# What `--executor` may say; a cluster goes by its address besides, dask://HOST:PORT.
KINDS = ("local", "threads", "processes", "dask")

# Times that a call is made before it is taken for what ends its processes.
TRIES = 3


@contextmanager
def executor(
    workers: int | None = None, engine: Engine = "numpy", how: str | Executor | None = None
) -> Iterator[Executor]:
    """Give an executor with that many workers, by default one a core.

    Parameters
    ----------
    workers
        How many.
    engine
        Compiled code runs in threads of this process, side by side. Several workers with NumPy,
        which does not, are processes; a single one is this process itself.
    how
        "local", which is that; "threads" or "processes" whatever the engine; "dask", processes
        of this machine under a scheduler; "dask://HOST:PORT", the workers of a scheduler that runs
        already; or any executor with the methods of ``concurrent.futures``, or a
        ``distributed.Client``, which stay open.

    Raises
    ------
    InputError
        Another word, or a cluster that does not answer.
    """
    if how is not None and not isinstance(how, str):
        yield _given(how)
        return
    kind = how or "local"
    if kind == "dask" or kind.startswith("dask://"):
        # Here, because few have dask, and it takes a second to load.
        from bwbayes.app.running.cluster import cluster  # noqa: PLC0415

        with cluster(kind.removeprefix("dask").removeprefix("://") or None, workers) as pool:
            yield pool
        return
    if kind not in KINDS:
        known = ", ".join(KINDS)
        raise InputError(f"executor: {kind!r} is unknown; write one of {known}, dask://HOST:PORT")
    count = workers or os.cpu_count() or 1
    if kind == "local":
        kind = "processes" if count > 1 and engine == "numpy" else "threads"
        count = count if engine == "numba" or kind == "processes" else 1
    with ended(Processes(count) if kind == "processes" else ThreadPoolExecutor(count)) as own:
        yield own


@contextmanager
def ended(own: Executor) -> Iterator[Executor]:
    """Give an executor, and end it when all is done, or at once if that is interrupted."""
    try:
        yield own
    except BaseException:
        # Whoever is interrupted does not wait for the end of what nobody will read.
        if isinstance(own, Processes):
            own.kill()
        raise
    finally:
        own.shutdown(wait=True, cancel_futures=True)


def side_by_side(pool: Executor, workers: int | None, most: int) -> int:
    """Return how many calls are to be under way: those of a cluster, two for each worker."""
    known = getattr(pool, "workers", None)
    count = 2 * known if isinstance(known, int) else workers or os.cpu_count() or 1
    return max(min(count, most), 1)


def _given(how: Any) -> Executor:
    """Return an executor that somebody made; calls go to others than threads by value."""
    if isinstance(how, ThreadPoolExecutor | _ByValue | Processes):
        return how
    if type(how).__module__.partition(".")[0] == "distributed" and hasattr(how, "scheduler"):
        from bwbayes.app.running.cluster import Cluster  # noqa: PLC0415

        return Cluster(how)
    if hasattr(how, "workers") and isinstance(how, Executor):
        return how
    if not callable(getattr(how, "submit", None)):
        raise InputError(
            f"executor: {type(how).__name__} has no submit; give an executor of "
            "concurrent.futures, or one of " + ", ".join(KINDS)
        )
    return _ByValue(how)


class _ByValue(Executor):
    """Sends by value what pickle does not send: priors and bounds that parts declare in a line."""

    def __init__(self, pool: Any) -> None:
        self.pool = pool

    def submit[**P, T](self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Send a call by value."""
        sent: Future[T] = self.pool.submit(_called, cloudpickle.dumps(partial(fn, *args, **kwargs)))
        return sent


class Processes(Executor):
    """Processes that are replaced when they die, and what they were at is done again.

    Every call here is a pure function, or goes on from where it stands on disk, so a second time
    gives the same. A call under which processes died ``TRIES`` times is given up.

    Parameters
    ----------
    count
        How many.
    method
        "spawn" starts Python in each; "fork" copies this process as it is, at once and with all
        that it has loaded, which only a process without other threads may do. Those that replace
        others are spawned.
    """

    def __init__(self, count: int, method: Literal["spawn", "fork"] = "spawn") -> None:
        self.count = count
        self.lock = threading.Lock()
        self.closed = False
        # Pools that broke are kept: Python's end of one waits for ever for its own lock if the last
        # reference to it goes meanwhile.
        self.broken: list[ProcessPoolExecutor] = []
        self.pool = self._started(method)

    @property
    def processes(self) -> list[int]:
        """The ids of the processes."""
        return [*(self.pool._processes or {})]

    def submit[**P, T](self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Send a call by value."""
        future: Future[T] = Future()
        self._send(future, cloudpickle.dumps(partial(fn, *args, **kwargs)), 1)
        return future

    def kill(self) -> None:
        """End the processes at once; what they have on disk stays whole."""
        with self.lock:
            self.closed = True
        for process in [*(self.pool._processes or {}).values()]:
            process.kill()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes when they have done what they are at."""
        with self.lock:
            self.closed = True
        self.pool.shutdown(wait=wait, cancel_futures=cancel_futures)

    def _started(self, method: str) -> ProcessPoolExecutor:
        context = multiprocessing.get_context(method)
        pool = ProcessPoolExecutor(self.count, mp_context=context, initializer=_settle)
        with warnings.catch_warnings():
            # Python warns of any thread; those of the linear algebra library stop for a fork.
            warnings.filterwarnings("ignore", ".*multi-threaded", DeprecationWarning)
            _start(pool, self.count)
        return pool

    def _replace(self, broken: ProcessPoolExecutor) -> None:
        """Start processes in place of those, if nobody has."""
        if self.pool is broken:
            self.broken.append(broken)
            self.pool = self._started("spawn")

    def _send(self, future: Future[Any], call: bytes, tried: int) -> None:
        """Make a call, once more if its process dies."""
        with self.lock:
            pool = self.pool
            try:
                made = pool.submit(_called, call)
            except BrokenProcessPool:
                if self.closed:
                    raise
                self._replace(pool)
                pool = self.pool
                made = pool.submit(_called, call)
        made.add_done_callback(partial(self._done, future, call, tried, pool))

    def _done(
        self,
        future: Future[Any],
        call: bytes,
        tried: int,
        pool: ProcessPoolExecutor,
        made: Future[Any],
    ) -> None:
        if made.cancelled():
            future.cancel()
            return
        error = made.exception()
        if isinstance(error, BrokenProcessPool) and tried < TRIES and not self.closed:
            try:
                with self.lock:
                    self._replace(pool)
                self._send(future, call, tried + 1)
            except RuntimeError as broken:  # shut down meanwhile
                future.set_exception(broken)
        elif not future.set_running_or_notify_cancel():
            pass
        elif error is not None:
            future.set_exception(error)
        else:
            future.set_result(made.result())


def _called(call: bytes) -> Any:
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
