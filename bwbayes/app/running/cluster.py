"""Work on a dask cluster, as any executor of ``concurrent.futures`` does it.

:class:`Cluster` wraps a client of ``distributed``. What all calls have in common, a posterior or a
calibration's experiment, goes to the scheduler once; each worker fetches it once, and gets it again
if it was lost with a worker. A call whose worker dies is made again elsewhere by the scheduler, and
because every call is a pure function the result has the same bits. If the scheduler itself is gone,
all that waits fails with one line, and what is on disk can be resumed anywhere.
"""

# mypy: allow-untyped-calls
# distributed says that it has types, but its functions have none.

from __future__ import annotations

import logging
import pickle
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent import futures
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from typing import Any

import cloudpickle
from threadpoolctl import threadpool_limits

from bwbayes.errors import InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.results.replicates import Experiment

__all__ = ["Cluster", "cluster"]

# What is sent once, and not with every call.
SHARED = (Posterior, Experiment)

# Seconds to wait for a scheduler, and for its first worker.
PATIENCE = 20.0

# Workers that may die under one call before it is given up.
DEATHS = 5


class Cluster(Executor):
    """An executor on the workers of a dask client.

    Parameters
    ----------
    client
        A ``distributed.Client``.
    """

    def __init__(self, client: Any) -> None:
        self.client = client
        self.lock = threading.Lock()
        self.sent: dict[int, tuple[object, Any]] = {}
        self.waiting: set[Future[Any]] = set()

    @property
    def workers(self) -> int:
        """Calls that can be made at the same time."""
        threads: dict[str, int] = self.client.nthreads()
        return max(sum(threads.values()), 1)

    def submit[**P, T](self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Make a call on a worker; a posterior or an experiment among its arguments is sent once.

        Raises
        ------
        BrokenExecutor
            The scheduler is gone.
        """
        future: Future[T] = Future()
        shared = [i for i, argument in enumerate(args) if isinstance(argument, SHARED)]
        others = [None if i in shared else argument for i, argument in enumerate(args)]
        call = cloudpickle.dumps((fn, others, kwargs))
        try:
            made = self.client.submit(
                _called,
                call,
                shared,
                [self._shared(args[i]) for i in shared],
                pure=False,
                key=None,
            )
        except Exception as error:
            raise self._gone(error) from None
        self.waiting.add(future)
        made.add_done_callback(partial(self._done, future))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Forget what was sent; the client stays open, and stays its owner's."""
        for future in [*self.waiting]:
            if cancel_futures:
                future.cancel()
        if wait:
            futures.wait([*self.waiting])
        self.sent.clear()

    def _shared(self, argument: object) -> Any:
        """Return the future of an argument that is sent once.

        It is the result of a call, which the scheduler can make again if a worker that had it dies.
        """
        with self.lock:
            if id(argument) not in self.sent:
                with warnings.catch_warnings():
                    # It is large on purpose, and this is the only time.
                    warnings.filterwarnings("ignore", message="Sending large graph")
                    content = cloudpickle.dumps(argument)
                    made = self.client.submit(pickle.loads, content, pure=False)
                # The argument is kept too, so that no other gets its id.
                self.sent[id(argument)] = argument, made
            return self.sent[id(argument)][1]

    def _done(self, future: Future[Any], made: Any) -> None:
        """Hand on what came of a call."""
        self.waiting.discard(future)
        if future.cancelled():
            return
        try:
            if made.status == "finished":
                _succeed(future, made.result(timeout=PATIENCE))
            elif made.status == "error":
                raised = made.exception(timeout=PATIENCE)
                if type(raised).__name__ == "KilledWorker":
                    why = f"{DEATHS} workers died during one call; free some memory"
                    raised = BrokenExecutor(why)
                _fail(future, raised)
            else:
                _fail(future, self._gone(None))
        except Exception as error:  # nobody sees what a callback raises, and the caller waits
            _fail(future, self._gone(error))

    def _gone(self, error: BaseException | None) -> BrokenExecutor:
        why = f": {error}" if error is not None and str(error) else ""
        return BrokenExecutor(f"the scheduler is gone or has lost what it was given{why}; resume")


def _succeed(future: Future[Any], result: object) -> None:
    if future.set_running_or_notify_cancel():
        future.set_result(result)


def _fail(future: Future[Any], error: BaseException) -> None:
    if future.set_running_or_notify_cancel():
        future.set_exception(error)


@contextmanager
def cluster(address: str | None, workers: int | None) -> Iterator[Cluster]:
    """Give an executor on the cluster at HOST:PORT; without one, on processes of this machine.

    Raises
    ------
    InputError
        ``distributed`` is not installed, or there is no scheduler, or it has no worker, or one with
        another bwbayes.
    """
    try:
        import dask  # noqa: PLC0415  # only those who ask for it have it
        import distributed  # noqa: PLC0415
    except ImportError:
        raise InputError(
            "executor dask: distributed is not installed; install bwbayes[dask]"
        ) from None
    # What a person has to know is said in one line; the rest is for those who run the cluster.
    for name in ("distributed", "distributed.client", "distributed.nanny", "distributed.core"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    settings = {
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.comm.timeouts.connect": PATIENCE,
        "distributed.worker.daemon": True,
    }
    with dask.config.set(settings):
        local = None
        try:
            if address is None:
                local = distributed.LocalCluster(
                    n_workers=workers or dask.system.CPU_COUNT,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                )
            client = distributed.Client(local or f"tcp://{address}", timeout=PATIENCE)
        except (OSError, TimeoutError, ValueError):
            raise InputError(
                f"executor dask://{address}: no scheduler there; start one with `dask scheduler`"
            ) from None
        try:
            _require_workers(client, address)
            yield Cluster(client)
        finally:
            client.close(timeout=PATIENCE)
            if local is not None:
                local.close(timeout=PATIENCE)


def _require_workers(client: Any, address: str | None) -> None:
    """Wait for a worker, and refuse those that would compute something else."""
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
        every: dict[str, str] = client.run(_version)
    except TimeoutError:
        raise InputError(
            f"executor dask://{address}: the scheduler has no worker; start some with "
            f"`dask worker {address} --nthreads 1`"
        ) from None
    own = _version()
    other = next(((name, text) for name, text in every.items() if text != own), None)
    if other is not None:
        raise InputError(
            f"executor dask://{address}: the worker {other[0]} has {other[1] or 'no bwbayes'}, "
            f"here is {own}; install the same"
        )


def _version() -> str:
    return " ".join(f"{name} {version(name)}" for name in ("bwbayes", "numpy", "scipy", "emcee"))


def _called(call: bytes, places: list[int], shared: list[object]) -> Any:
    """Make a call on a worker, with one thread for linear algebra as everywhere."""
    fn, arguments, named = pickle.loads(call)
    for place, argument in zip(places, shared, strict=True):
        arguments[place] = argument
    with threadpool_limits(1, user_api="blas"):
        return fn(*arguments, **named)
