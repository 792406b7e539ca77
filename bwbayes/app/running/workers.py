"""Where the ensembles run: in processes of their own, or in this one.

Matrix products here are small and the ensembles already share the cores, so the linear algebra
library is kept to one thread: more would only wait for each other, and could change the last bits.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Any

import cloudpickle
from threadpoolctl import threadpool_limits

from bwbayes.inference.engine import Engine

__all__ = ["executor", "one_thread"]


@contextmanager
def executor(workers: int | None = None, engine: Engine = "numpy") -> Iterator[Executor]:
    """Give an executor with that many workers, by default one a core.

    Compiled code runs in threads of this process, side by side. Several workers with NumPy, which
    does not, are processes; a single one is this process itself.
    """
    count = workers or os.cpu_count() or 1
    pool: Executor = ThreadPoolExecutor(count if engine == "numba" else 1)
    if count > 1 and engine == "numpy":
        context = multiprocessing.get_context("spawn")
        pool = _Processes(count, mp_context=context, initializer=_settle)
        _start(pool, count)
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


class _Processes(ProcessPoolExecutor):
    """Processes that take what pickle does not: priors and bounds that parts declare in a line."""

    def submit[**P, T](self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Send a call by value."""
        return super().submit(_called, cloudpickle.dumps(partial(fn, *args, **kwargs)))


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
