"""Many calls side by side, with a line of progress: replicates of a calibration, records."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor

from rich.console import Console

from bwbayes.app.running.progress import CountProgress
from bwbayes.app.running.workers import executor, side_by_side
from bwbayes.calibration.replicates import as_done

__all__ = ["batch"]


def batch[T](
    call: Callable[..., T],
    arguments: Sequence[tuple[object, ...]],
    label: Callable[[T], str],
    *,
    console: Console,
    kind: str,
    done: int,
    short: Mapping[str, int],
    workers: int | None,
    backend: str | Executor | None,
) -> Iterator[T]:
    """Call a function with each of the arguments, and yield each result as soon as it is there.

    ``label`` says what a result is short of, if anything; ``done`` and ``short`` count those of
    this ``kind`` that were there before. They go into processes, also with the compiled engine:
    most of their time goes into Python.
    """
    if not arguments:
        return
    count = min(workers or os.cpu_count() or 1, len(arguments))
    with (
        executor(count, backend=backend) as pool,
        CountProgress(console, kind, done, len(arguments), short) as progress,
    ):
        together = side_by_side(pool, workers, len(arguments))
        for result in as_done(pool, together, call, arguments):
            yield result
            progress(label(result))
