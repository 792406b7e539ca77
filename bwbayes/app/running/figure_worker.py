"""Draw a run's pictures, if possible in a process beside this one, which predicts and writes.

There each picture is begun as soon as what it shows is known: the draws before predictions are
made, the bands before they are judged. The pictures are the same as drawn in one process.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path

from bwbayes.app.running.workers import processes
from bwbayes.report.figures import picture_of, prepare, save_pictures
from bwbayes.report.figures.pictures import pictures
from bwbayes.report.report import Picture
from bwbayes.report.result import Result


class Artist:
    """Draws in another process what is known already; without one all at the end, in this one."""

    def __init__(self, pool: Executor | None = None) -> None:
        self.pool = pool
        self.begun: dict[str, Future[bytes]] = {}
        if pool is not None:
            pool.submit(prepare)

    def draw(self, result: Result) -> None:
        """Begin with all that can be seen of a result, but for what was begun before."""
        if self.pool is None:
            return
        for name, picture in pictures(result).items():
            if name not in self.begun:
                self.begun[name] = self.pool.submit(picture_of, picture.draw)

    def pictures(self, result: Result, folder: Path) -> dict[str, bytes]:
        """Wait until all are drawn, write them to the folder, and return PNG by name."""
        self.draw(result)
        images = {name: self._drawn(name, shown) for name, shown in pictures(result).items()}
        save_pictures(images, folder)
        return images

    def _drawn(self, name: str, picture: Picture) -> bytes:
        if name in self.begun:
            with suppress(BrokenProcessPool):  # nothing is lost that this process cannot draw
                return self.begun[name].result()
        return picture_of(picture.draw)


@contextmanager
def artist_of(workers: int | None, *, apart: bool) -> Iterator[Artist]:
    """Give who draws, in a process ``apart`` if that is asked for and several workers may work."""
    if not apart or 1 in (workers, os.cpu_count()):
        yield Artist()
        return
    # What is loaded here need not be loaded there, where a process may be copied while it runs.
    copied = sys.platform == "linux" and threading.active_count() == 1
    with processes(1, "fork" if copied else "spawn") as pool:
        yield Artist(pool)
