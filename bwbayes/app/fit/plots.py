"""The figures of a fit, each by a function of its own: ``fit.plot.loop()``.

They are those of the report. Each function returns a matplotlib figure, which a notebook shows and
``figure.savefig("loop.png")`` writes. Without convergence there are the record and the chain's
figures alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from bwbayes.app.problem.problem import Problem
from bwbayes.control.loop import CONTROLLERS
from bwbayes.control.tracking import Tracking
from bwbayes.errors import InputError, suggestion
from bwbayes.prediction.bands import Bands
from bwbayes.report.figures import drawn
from bwbayes.report.figures.chain import draw_corner, draw_ranks, draw_trace
from bwbayes.report.figures.control import draw_tracking
from bwbayes.report.figures.coverage import draw_coverage
from bwbayes.report.figures.loop import draw_loop
from bwbayes.report.figures.measured import draw_loops
from bwbayes.report.figures.record import record_drawings
from bwbayes.report.figures.residuals import draw_innovations, draw_spectrum
from bwbayes.report.figures.series import draw_bands
from bwbayes.report.report import Figure
from bwbayes.report.result import Result
from bwbayes.shown import brief

__all__ = ["Plots"]


@dataclass(frozen=True)
class Plots:
    """The figures of a fit.

    ``converged`` returns the result, or raises a
    :class:`~bwbayes.errors.NotConvergedError` where nothing may be said of an interval.
    """

    __repr__ = brief

    problem: Problem
    result: Result
    converged: Callable[[], Result]

    def record(self, kind: str = "time", name: str | None = None) -> Figure:
        """Draw a training record: along "time", as a "loop", or its "drive"'s spectrum.

        Of several records the one of this name, by default the first.
        """
        problem, name = self.problem, self._record(name)
        training = problem.posterior.alone(name).only.training
        drawings = record_drawings(problem.records[name], training, problem.findings[name])
        return drawn(_named(drawings, kind))

    def loop(self, *names: str) -> Figure:
        """Draw displacement against voltage with its bands, and its tip enlarged.

        By default for all that was predicted with the fit, or for the bands of these names.
        """
        return drawn(draw_loop, [self._bands(name) for name in names] or self.converged().bands)

    def loops(self) -> Figure:
        """Draw the major and a minor loop and the initial curve, measured."""
        return drawn(draw_loops, self.converged().loops)

    def bands(self, name: str | None = None) -> Figure:
        """Draw the bands of one window or record along time, by default the first fitted one."""
        return drawn(draw_bands, self._bands(name or self.converged().bands[0].name))

    def coverage(self) -> Figure:
        """Draw how much the bands cover against what they promise, and the readings' PIT."""
        result = self.converged()
        return drawn(draw_coverage, result.bands, result.scores)

    def innovations(self, name: str | None = None) -> Figure:
        """Draw whether innovations, what each reading adds, are white, normal, of one size.

        Of several records in the one of this name, by default the first.
        """
        return drawn(draw_innovations, self.converged().innovations[self._record(name)])

    def spectrum(self, name: str | None = None) -> Figure:
        """Draw the residual's spectrum beside the noise model's.

        Of several records in the one of this name, by default the first.
        """
        return drawn(draw_spectrum, self.converged().innovations[self._record(name)])

    def corner(self) -> Figure:
        """Draw each parameter of the posterior, and each pair of them."""
        return drawn(draw_corner, self.converged())

    def trace(self) -> Figure:
        """Draw each ensemble's mean and spread, step by step."""
        return drawn(draw_trace, self.result)

    def ranks(self) -> Figure:
        """Draw how the ranks of each ensemble's draws are spread."""
        return drawn(draw_ranks, self.result)

    def tracking(self, tracked: Tracking) -> Figure:
        """Draw what ``fit.track()`` returns: error against frequency, for each controller."""
        return drawn(draw_tracking, tracked.to_pandas(), CONTROLLERS)

    def _record(self, name: str | None) -> str:
        """Return the name of a training record, by default of the first."""
        if name is not None:
            _named(self.problem.records, name)
        return name or next(iter(self.problem.records))

    def _bands(self, name: str) -> Bands:
        by_name = {bands.name: bands for bands in self.converged().bands}
        return _named(by_name, name)


def _named[T](items: Mapping[str, T], name: str) -> T:
    if name not in items:
        raise InputError(f"plot: no {name!r} here; {suggestion(name, items)}")
    return items[name]
