"""Draw a run's pictures in a process beside this one, while this one predicts and writes.

Each picture is begun as soon as what it shows is known: the draws before predictions are made, the
bands before they are judged. The pictures are the same as drawn in one process.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

from bwbayes.app.running.workers import processes
from bwbayes.report.figures import Drawing, drawings, picture_of, prepare, save_pictures
from bwbayes.report.page import PagePlots
from bwbayes.report.result import Result

__all__ = ["Beside", "beside"]


class Beside:
    """Draws in another process what is known already."""

    def __init__(self, pool: Executor) -> None:
        self.pool = pool
        self.pictured: dict[str, Future[bytes]] = {}
        self.plotted: Future[PagePlots] | None = None
        pool.submit(prepare)

    def draw(self, result: Result) -> None:
        """Begin with all that can be seen of a result, but for what was begun before."""
        for name, draw in drawings(result).items():
            if name not in self.pictured:
                self.pictured[name] = self.pool.submit(picture_of, draw)
        if self.plotted is None and result.bands:
            self.plotted = self.pool.submit(_plots_of, result)

    def pictures(self, result: Result, folder: Path) -> dict[str, bytes]:
        """Wait until all are drawn, write them to the folder, and return PNG by name."""
        self.draw(result)
        images = {name: self._picture(name, draw) for name, draw in drawings(result).items()}
        save_pictures(images, folder)
        return images

    def plots(self, result: Result) -> PagePlots:
        """Wait until the plots to zoom and hover are made, and return them."""
        try:
            return _plots_of(result) if self.plotted is None else self.plotted.result()
        except BrokenProcessPool:
            return _plots_of(result)

    def _picture(self, name: str, draw: Drawing) -> bytes:
        try:
            return self.pictured[name].result()
        except BrokenProcessPool:  # nothing is lost that this process cannot draw
            return picture_of(draw)


@contextmanager
def beside(workers: int | None, *, enabled: bool) -> Iterator[Beside | None]:
    """Give what draws beside, if that is ``enabled`` and more than one worker may work."""
    if not enabled or 1 in (workers, os.cpu_count()):
        yield None
        return
    # What is loaded here need not be loaded there, where a process may be copied while it runs.
    copied = sys.platform == "linux" and threading.active_count() == 1
    with processes(1, "fork" if copied else "spawn") as pool:
        yield Beside(pool)


def _plots_of(result: Result) -> PagePlots:
    from bwbayes.report.figures import interactive  # noqa: PLC0415  # only here it needs bokeh

    return interactive.made(result)
