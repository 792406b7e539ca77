"""Draw a run's pictures in a process beside this one, while this one predicts and writes.

The figures of the draws are drawn while predictions are made, those of the predictions while the
draws and bands are written. The pictures are the same as drawn in one process.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

from bwbayes.app.figures import Drawings, of_draws, of_predictions, pictures, save_pictures
from bwbayes.app.running.workers import executor
from bwbayes.results.result import Result

__all__ = ["Beside", "beside"]


class Beside:
    """Draws in another process what is known already."""

    def __init__(self, pool: Executor) -> None:
        self.pool = pool
        self.early: Future[dict[str, bytes]] | None = None
        pool.submit(_prepare)

    def begin(self, result: Result) -> None:
        """Begin with the figures of the draws; predictions may be missing yet."""
        self.early = self.pool.submit(_drawn, of_draws, result)

    def pictures(self, result: Result, folder: Path) -> Callable[[], dict[str, bytes]]:
        """Go on with the figures of predictions.

        What it returns waits until all are drawn, writes them to the folder, and returns PNG by
        name.
        """
        early = self.early or self.pool.submit(_drawn, of_draws, result)
        late = self.pool.submit(_drawn, of_predictions, result)

        def drawn() -> dict[str, bytes]:
            try:
                every = late.result() | early.result()
            except BrokenProcessPool:  # nothing is lost that this process cannot draw
                every = pictures(of_predictions(result) | of_draws(result))
            save_pictures(every, folder)
            return every

        return drawn


@contextmanager
def beside(workers: int | None, *, asked: bool) -> Iterator[Beside | None]:
    """Give what draws beside, if that is ``asked`` for and more than one worker may work."""
    if not asked or 1 in (workers, os.cpu_count()):
        yield None
        return
    with executor(1, how="processes") as pool:
        yield Beside(pool)


def _prepare() -> None:
    """Load what is slow to load, before there is anything to draw."""
    import corner  # noqa: F401, PLC0415


def _drawn(which: Callable[[Result], Drawings], result: Result) -> dict[str, bytes]:
    return pictures(which(result))
