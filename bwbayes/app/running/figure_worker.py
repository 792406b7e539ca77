"""Draw what a page shows, if possible in a process beside this one, which predicts and writes.

That process compiles what every likelihood needs while this one loads what samples, and compiles
what simulates while this one compiles the rest of the likelihood; it loads what draws after that,
or before if all is compiled. It begins with each picture as soon as what it shows is known: the
draws before predictions are made, the bands before they are judged. The pictures are the same as
drawn in one process.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bwbayes.app.running.workers import processes
from bwbayes.inference.engine import resolve_engine
from bwbayes.watching import Watch, unwatched, watched

# All else is loaded where it is used: a worker starts before anything is loaded.
if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior
    from bwbayes.report.outputs import PagePlots
    from bwbayes.report.result import Result

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
        from bwbayes.report.outputs import NO_PLOTS  # noqa: PLC0415

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
