"""Where ensembles, replicates and records are worked on: here, in processes, or on a cluster.

The executors are those of ``concurrent.futures`` and of ``distributed``. On a dask cluster a call
whose worker dies is made again elsewhere, and because every call is a pure function the result has
the same bits; if the scheduler itself is gone, what is on disk can be resumed anywhere. Matrix
products here are small and the ensembles already share the cores, so the linear algebra library is
kept to one thread: more would only wait for each other, and could change the last bits.

The figures of a page are drawn in a process beside this one, if possible. That process compiles
what every likelihood needs while this one loads what samples, and compiles what simulates while
this one compiles the rest of the likelihood; it loads what draws after that, or before if all is
compiled. It begins with each picture as soon as what it shows is known: the draws before
predictions are made, the bands before they are judged. The pictures are the same as drawn in one
process.
"""

from __future__ import annotations

import atexit
import gc
import logging
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import cloudpickle
from threadpoolctl import threadpool_limits

from bwbayes.errors import InputError, InputWarning
from bwbayes.inference import Engine, resolve_engine
from bwbayes.watching import Watch, unwatched, watched

if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior
    from bwbayes.report.result import PagePlots, Result

# Values of `--executor`; a cluster also goes by its address, dask://HOST:PORT.
KINDS = ("local", "threads", "processes", "dask")

# Seconds to wait for a scheduler, and for its first worker.
PATIENCE = 20.0


@contextmanager
def open_executor(
    workers: int | None = None, engine: Engine = "numpy", executor: str | Executor | None = None
) -> Iterator[Executor]:
    """Give an executor with that many workers, by default one a core.

    Parameters
    ----------
    workers
        How many.
    engine
        Compiled code runs in threads of this process, side by side. Several workers with NumPy,
        which does not, are processes; a single one is this process itself.
    executor
        "local", which is that; "threads" or "processes" whatever the engine; "dask", processes
        of this machine under a scheduler; "dask://HOST:PORT", the workers of a scheduler that runs
        already; or any executor with the methods of ``concurrent.futures``, or a
        ``distributed.Client``, which stay open.

    Raises InputError: another word, or a cluster that does not answer.
    """
    if executor is not None and not isinstance(executor, str):
        # Calls go to others than threads by value.
        if hasattr(executor, "get_executor"):
            yield _on_client(executor)
        elif isinstance(executor, ThreadPoolExecutor | ByValue):
            yield executor
        elif callable(getattr(executor, "submit", None)):
            yield ByValue(executor)
        else:
            raise InputError(
                f"executor: {type(executor).__name__} has no submit; give an executor of "
                "concurrent.futures, or one of " + ", ".join(KINDS)
            )
        return
    count = workers or os.cpu_count() or 1
    kind, address = _kind_of(executor)
    if kind == "local":
        kind = "processes" if engine == "numpy" and count > 1 else "threads"
    if kind == "dask":
        with _cluster(address, workers) as pool:
            yield pool
    elif kind == "processes":
        with processes(count) as pool:
            if pool is not None:
                yield pool
                return
        # The result is the same on any number of workers.
        warnings.warn(
            "no worker process starts, so that this one computes alone; put a script's calls "
            'under `if __name__ == "__main__":`, and see that /dev/shm is writable',
            InputWarning,
            stacklevel=2,
        )
        kind, count = "threads", 1
    if kind == "threads":
        threads = ThreadPoolExecutor(count)
        try:
            yield threads
        finally:
            threads.shutdown(cancel_futures=True)


def require_executor(executor: str | None) -> None:
    """Refuse what :func:`open_executor` refuses of a word, before anything is done for it.

    Raises InputError: another word, no ``distributed``, or a cluster that does not answer.
    """
    kind, address = _kind_of(executor)
    if address:
        with _cluster(address, None):
            pass
    elif kind == "dask":
        _dask()


def _kind_of(executor: str | None) -> tuple[str, str]:
    """Return which of `KINDS` an executor is, and the address of its scheduler, if it has one."""
    kind, _, address = (executor or "local").partition("://")
    if kind not in KINDS or (address and kind != "dask"):
        kinds = ", ".join(KINDS)
        raise InputError(
            f"executor: {executor!r} is unknown; write one of {kinds}, dask://HOST:PORT"
        )
    return kind, address


@contextmanager
def processes(count: int, method: Literal["spawn", "fork"] = "spawn") -> Iterator[ByValue | None]:
    """Give an executor with processes, which end at once if whoever has it is interrupted.

    None where no process starts: without semaphores, or from a script without a main guard.

    "spawn" starts Python in each; "fork" copies this process as it is, at once and with all that it
    has loaded, which only a process without other threads may do.
    """
    # A worker that still loads its parent's script, which has no main guard and calls this again.
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        os._exit(1)
    try:
        pool = ProcessPoolExecutor(count, multiprocessing.get_context(method), _settle)
    except (ImportError, NotImplementedError, OSError):
        yield None
        return
    try:
        with warnings.catch_warnings():
            # Python warns of any thread; those of the linear algebra library stop for a fork.
            warnings.filterwarnings("ignore", ".*multi-threaded", DeprecationWarning)
            started = _starts(pool, count)
        yield ByValue(pool) if started else None
    except BaseException:
        # An interrupted caller does not wait for results that nobody will read.
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


class ByValue(Executor):
    """Sends by value what pickle does not send: priors and bounds that parts declare in a line.

    ``workers`` is how many calls a cluster makes at the same time.
    """

    def __init__(self, pool: Any, workers: int | None = None) -> None:
        self.pool, self.workers = pool, workers

    def submit[**P, T](self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Send a call by value."""
        sent: Future[T] = self.pool.submit(_invoke, cloudpickle.dumps(partial(fn, *args, **kwargs)))
        return sent


def _invoke(call: bytes) -> Any:
    """Make a call, with one thread for linear algebra as everywhere."""
    with one_thread():
        return pickle.loads(call)()


def one_thread() -> AbstractContextManager[object]:
    """Keep this process's linear algebra to one thread, as a context."""
    limited: AbstractContextManager[object] = threadpool_limits(1, user_api="blas")
    return limited


def _starts(pool: Executor, count: int) -> bool:
    """Start workers that ignore the signals that stop a run: its own process handles those.

    Returns whether one has started.

    Without that, Ctrl-C would kill the workers first, or while they start make each complain.
    """
    stopping = {signal.SIGINT, signal.SIGTERM}
    blocks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, stopping) if blocks else set()
    try:
        # Each starts a worker, which inherits what is blocked.
        first, *_ = [pool.submit(os.getpid) for _ in range(count)]
    except (BrokenExecutor, OSError):
        return False
    finally:
        if blocks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        first.result()
    except BrokenExecutor:
        return False
    return True


def _settle() -> None:
    """Prepare a worker process: one thread, ignoring Ctrl-C, ended with its parent."""
    # The limit is set to libraries that are there, and this one has not been needed yet.
    import scipy.linalg  # noqa: F401, PLC0415

    one_thread()
    # All that is left ends with the process: to look through it once more takes seconds.
    atexit.register(gc.freeze)
    # The Ctrl-C that asks a run to stop in order must not kill its workers first.
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def leave_with_parent() -> None:
        if (parent := multiprocessing.parent_process()) is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=leave_with_parent, daemon=True).start()


def _on_client(client: Any) -> ByValue:
    """Return an executor on the workers of a ``distributed.Client``, which stays open."""
    workers = max(sum(client.nthreads().values()), 1)
    return ByValue(client.get_executor(pure=False), workers)


@contextmanager
def _cluster(address: str, workers: int | None) -> Iterator[ByValue]:
    """Give an executor on the cluster at HOST:PORT; without one, on processes of this machine.

    Raises
    ------
    InputError
        No ``distributed``, no scheduler, no worker, or one with another bwbayes.
    BrokenExecutor
        The scheduler is gone, or workers die under one call.
    """
    dask, distributed = _dask()
    # One line tells the user the problem; these logs are for those who run the cluster.
    for name in ("distributed", "distributed.client", "distributed.nanny", "distributed.core"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    scheduler: Any = f"tcp://{address}"
    settings = {
        "distributed.comm.timeouts.connect": PATIENCE,
        # A posterior is, with every call.
        "distributed.admin.large-graph-warning-threshold": "1GB",
    }
    with dask.config.set(settings):
        try:
            if not address:
                scheduler = distributed.LocalCluster(
                    n_workers=workers or dask.system.CPU_COUNT,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                )
            client = distributed.Client(scheduler, timeout=PATIENCE)
        except (OSError, TimeoutError, ValueError):
            raise InputError(
                f"executor dask://{address}: no scheduler there; start one with `dask scheduler`"
            ) from None
        try:
            _require_workers(client, address)
            yield _on_client(client)
        except CancelledError:
            raise BrokenExecutor("the scheduler is gone; resume") from None
        except distributed.scheduler.KilledWorker:
            raise BrokenExecutor("several workers died during one call; free memory") from None
        finally:
            client.close(timeout=PATIENCE)
            if not address:
                scheduler.close(timeout=PATIENCE)


def _dask() -> tuple[Any, Any]:
    """Return dask and distributed, which only those who ask for them have."""
    try:
        return import_module("dask"), import_module("distributed")
    except ImportError:
        raise InputError(
            "executor dask: distributed is not installed; install bwbayes[dask]"
        ) from None


def _require_workers(client: Any, address: str) -> None:
    """Wait for a worker, and refuse those that would compute something else."""
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
        versions: dict[str, str] = client.run(_version)
    except TimeoutError:
        raise InputError(
            f"executor dask://{address}: the scheduler has no worker; start some with "
            f"`dask worker {address} --nthreads 1`"
        ) from None
    for name, text in versions.items():
        if text != _version():
            raise InputError(
                f"executor dask://{address}: the worker {name} has {text or 'no bwbayes'}, "
                f"here is {_version()}; install the same"
            )


def _version() -> str:
    return " ".join(f"{name} {version(name)}" for name in ("bwbayes", "numpy", "scipy", "emcee"))


# The name under which plots to zoom and hover are drawn; no picture is called so.
PLOTS = ""


class FigureWorker:
    """Draws in another process what is known already, and at the end in this one what is left."""

    def __init__(self, pool: Executor | None = None) -> None:
        self.pool = pool
        self.submitted: dict[str, Future[Any]] = {}
        if pool is not None:
            pool.submit(_begin)

    def warm_up(self, posterior: Posterior) -> None:
        """Let the other process compile what this one needs later, and load what draws."""
        if self.pool is None:
            return
        if posterior.engine == "numba":
            from bwbayes.inference.compiled import warm_up  # noqa: PLC0415

            self.pool.submit(warm_up, posterior)
        self.pool.submit(_load)

    def draw(self, result: Result) -> None:
        """Begin with all that can be seen of a result, but for what was begun before."""
        if self.pool is None:
            return
        for name, work in _works(result).items():
            if name not in self.submitted:
                self.submitted[name] = self.pool.submit(work)

    def collect(
        self, result: Result, folder: Path, watch: Watch = unwatched
    ) -> tuple[dict[str, bytes], PagePlots]:
        """Wait until all is drawn; write pictures, PNG by name, to a folder; return all.

        ``watch`` is called with the share that is drawn.
        """
        from bwbayes.report.figures import save_pictures  # noqa: PLC0415
        from bwbayes.report.result import NO_PLOTS  # noqa: PLC0415

        self.draw(result)
        works = _works(result)
        # From the last to the first: whatever is not begun by then is drawn here.
        drawn: dict[str, Any] = {}
        for name in watched([*reversed(works)], watch):
            if name in self.submitted and not self.submitted[name].cancel():
                with suppress(BrokenProcessPool):  # nothing is lost that this process cannot draw
                    drawn[name] = self.submitted[name].result()
            if name not in drawn:
                drawn[name] = works[name]()
        images = {name: drawn[name] for name in works}
        plots = images.pop(PLOTS, NO_PLOTS)
        save_pictures(images, folder)
        return images, plots


def _begin() -> None:
    """Compile what every likelihood needs; if that is there, load what draws."""
    if resolve_engine() == "numba":
        from bwbayes.inference.compiled.kernels import compile_common  # noqa: PLC0415

        if not compile_common():
            return
    _load()


def _load() -> None:
    """Load what draws, and what its work is made of."""
    if "bwbayes.report.figures.interactive" in sys.modules:
        return  # at the beginning
    from bwbayes.report import result  # noqa: F401, PLC0415
    from bwbayes.report.figures import prepare  # noqa: PLC0415

    prepare()


def _works(result: Result) -> dict[str, Callable[[], Any]]:
    """Return what draws each picture of a result and, once its bands are known, the plots."""
    from bwbayes.report.figures import (  # noqa: PLC0415
        picture_of,
        pictures,
        plots_of,
    )

    works: dict[str, Callable[[], Any]] = {}
    if result.predictions:
        works[PLOTS] = partial(plots_of, result)
    for name, picture in pictures(result).items():
        works[name] = partial(picture_of, picture.draw, result.quantities)
    return works


@contextmanager
def open_figure_worker(workers: int | None) -> Iterator[FigureWorker]:
    """Give who draws, in a process of its own if several workers may work."""
    if 1 in (workers, os.cpu_count()):
        yield FigureWorker()
        return
    # A process may be copied while it runs.
    copied = sys.platform == "linux" and threading.active_count() == 1
    with processes(1, "fork" if copied else "spawn") as pool:
        yield FigureWorker(pool)
