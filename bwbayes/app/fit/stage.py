"""Stages of a run: what is computed of it once, and kept."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial, wraps
from typing import TYPE_CHECKING, Any

from bwbayes.watching import Watch

if TYPE_CHECKING:
    from bwbayes.app.fit.fitted import Run


class RunStage[T](cached_property[T]):
    """A stage of a run, from the function that computes it, of the run and a watch.

    A result that an earlier process has kept is not computed again. Asking for a stage without
    convergence raises a NotConvergedError, unless the stage is there ``always``.
    """

    def __init__(self, compute: Callable[[Any, Watch], T], *, always: bool = False) -> None:
        self.compute, self.always = compute, always

        @wraps(compute)
        def stage(run: Run) -> Any:
            if not always:
                run.require_converged()
            name = compute.__name__
            if name in run.kept:
                return run.kept[name]
            return self.compute(run, partial(run.watch, name.replace("_", " ")))

        super().__init__(stage)


def always[T](compute: Callable[[Any, Watch], T]) -> RunStage[T]:
    """Make a stage that is there without convergence, too."""
    return RunStage(compute, always=True)
