"""Work on a dask cluster, by the executor that ``distributed`` has for its clients.

A call whose worker dies is made again elsewhere by the scheduler, and because every call is a pure
function the result has the same bits. If the scheduler itself is gone, what waits is cancelled, and
what is on disk can be resumed anywhere.
"""

# mypy: allow-untyped-calls
# distributed says that it has types, but its functions have none.

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, CancelledError
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

from bwbayes.app.running.workers import ByValue
from bwbayes.errors import InputError

__all__ = ["cluster", "on_client"]

# Seconds to wait for a scheduler, and for its first worker.
PATIENCE = 20.0


def on_client(client: Any) -> ByValue:
    """Return an executor on the workers of a ``distributed.Client``, which stays open."""
    workers = max(sum(client.nthreads().values()), 1)
    return ByValue(client.get_executor(pure=False), workers)


@contextmanager
def cluster(address: str, workers: int | None) -> Iterator[ByValue]:
    """Give an executor on the cluster at HOST:PORT; without one, on processes of this machine.

    Raises
    ------
    InputError
        ``distributed`` is not installed, or there is no scheduler, or it has no worker, or one with
        another bwbayes.
    BrokenExecutor
        The scheduler is gone, or workers die under one call.
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
            yield on_client(client)
        except CancelledError:
            raise BrokenExecutor("the scheduler is gone; resume") from None
        except distributed.scheduler.KilledWorker:
            raise BrokenExecutor("several workers died during one call; free memory") from None
        finally:
            client.close(timeout=PATIENCE)
            if not address:
                scheduler.close(timeout=PATIENCE)


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
