"""What a scheduler costs: calls that only wait, on a real scheduler, and what follows on paper.

``python -m tests.benchmarks.cluster`` starts a scheduler and two worker processes with four threads
each, and sends calls of a known length with a posterior and a block's state, as sampling does. They
only wait, so that eight of them fit on a small machine: what is measured is the scheduler, the
network and the pickling, which are what stops a thousand cores. With ``--replicates N`` it makes a
small calibration on one worker and on two besides.
"""

from __future__ import annotations

import sys
import tempfile
import time
from concurrent.futures import Executor
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from bwbayes.app.config.config import load
from bwbayes.app.jobs import calibrate
from bwbayes.app.running.cluster import Cluster
from bwbayes.app.running.workers import executor
from bwbayes.results.replicates import as_done
from tests.inference.problems import short_posterior
from tests.measured import keep

__all__ = ["main", "on_paper", "overhead", "scaling"]

WORKERS = (1, 2, 4, 8)

# Seconds of a call: a block of a short record, of the paper's record, a replicate.
LENGTHS = (0.02, 0.1, 1.0)

# Seconds that each measurement takes without any cost.
SHARE = 1.5

# Cores on paper, and seconds of a replicate: now, and as it is to become.
CORES = 1000
REPLICATES = (3.3, 0.8)


def waited(_: object, state: object, seconds: float) -> object:
    """Take a posterior and a block's state, wait, and give a state back."""
    time.sleep(seconds)
    return state


def overhead(pool: Executor, workers: int, seconds: float) -> float:
    """Return the wall time (s) of a call with so many under way, each on a worker of its own."""
    posterior, state = short_posterior(samples=300), np.zeros((24, 40))
    calls = max(round(SHARE / seconds) * workers, 2 * workers)
    begun = time.perf_counter()
    arguments = ((posterior, state, seconds) for _ in range(calls))
    for _ in as_done(pool, workers, waited, arguments):
        pass
    return (time.perf_counter() - begun) * workers / calls


def busiest(pool: Executor, calls: int = 400) -> float:
    """Return the CPU time (s) that a call costs scheduler and client, which are in this process.

    It is what bounds the calls of a second, and the same on a machine that is busy otherwise.
    """
    posterior, state = short_posterior(samples=300), np.zeros((24, 40))
    begun = time.process_time()
    for _ in as_done(pool, 64, waited, ((posterior, state, 0.0) for _ in range(calls))):
        pass
    return (time.process_time() - begun) / calls


def scaling() -> dict[str, Any]:
    """Measure with 1, 2, 4 and 8 waiting workers, threads of two processes."""
    import distributed  # noqa: PLC0415  # takes a second, and one benchmark needs it

    outcome: dict[str, Any] = {}
    with (
        distributed.LocalCluster(  # type: ignore[no-untyped-call]
            n_workers=2, threads_per_worker=WORKERS[-1] // 2, dashboard_address=None
        ) as local,
        distributed.Client(local) as client,  # type: ignore[no-untyped-call]
        Cluster(client) as pool,
    ):
        busiest(pool, 50)  # the first calls fetch the posterior
        outcome["call_ms"] = 1000 * busiest(pool)
        for workers, seconds in product(WORKERS, LENGTHS):
            each = overhead(pool, workers, seconds)
            outcome[f"{workers} workers, calls of {seconds:g} s"] = {
                "busy": seconds / each,
                "lost_ms": 1000 * (each - seconds),
            }
    return outcome


def on_paper(call: float) -> dict[str, float]:
    """Return what a thousand cores give if each call costs the scheduler so many seconds.

    It hands out 1/call calls a second, whatever there are of workers: replicates a minute are
    60 min(cores/seconds, 1/call).
    """
    return {
        f"replicates of {seconds:g} s a minute": 60 * min(CORES / seconds, 1 / call)
        for seconds in REPLICATES
    } | {f"cores kept busy by replicates of {s:g} s": min(CORES, s / call) for s in REPLICATES}


def replicated(count: int) -> dict[str, float]:
    """Return the seconds of a calibration of so many replicates on one worker and on two."""
    config = load(Path("runs/calibration.toml"))
    seconds = {}
    for workers in (1, 2):
        with tempfile.TemporaryDirectory() as folder, executor(workers, how="dask") as pool:
            made = calibrate.start(config, Path("runs"), Path(folder) / "a", count)
            pool.submit(waited, None, None, 0).result()
            begun = time.perf_counter()
            calibrate.carry_on(made, Console(quiet=True), how=pool)
            seconds[f"{workers} workers"] = time.perf_counter() - begun
    return seconds | {"speed_up": seconds["1 workers"] / seconds["2 workers"]}


def main(arguments: list[str]) -> None:
    """Measure, print and keep."""
    outcome = scaling()
    outcome["on_paper"] = on_paper(outcome["call_ms"] / 1000)
    if "--replicates" in arguments:
        count = int(arguments[arguments.index("--replicates") + 1])
        outcome[f"calibration of {count}"] = replicated(count)
    for name, value in outcome.items():
        sys.stdout.write(f"{name}: {value}\n")
    keep("cluster", outcome)


if __name__ == "__main__":
    main(sys.argv[1:])
