"""The figures of a fit, each by a function of its own: ``fit.plot.loop()``.

They are those of the report. Each function returns a matplotlib figure, which a notebook shows and
``figure.savefig("loop.png")`` writes. Without convergence there are the record and the chain's
figures alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from bwbayes.control.loop import CONTROLLERS
from bwbayes.control.tracking import Tracking
from bwbayes.diagnosis.innovations import Innovations
from bwbayes.errors import InputError, suggestion
from bwbayes.report.figures import drawn
from bwbayes.report.figures.control import draw_tracking
from bwbayes.report.figures.pictures import draw_kind
from bwbayes.report.figures.record import record_drawings
from bwbayes.report.report import Figure

if TYPE_CHECKING:
    from bwbayes.app.fit.fitted import Fit


class Plots:
    """The figures of a fit.

    Those that speak of an interval raise a :class:`~bwbayes.errors.NotConvergedError` without
    convergence. Of several records each shows the one of the ``name``, by default the first.
    """

    def __init__(self, fit: Fit) -> None:
        self._fit = fit

    def record(self, kind: str = "time", name: str | None = None) -> Figure:
        """Draw a training record: along "time", as a "loop", or its "drive"'s spectrum."""
        problem = self._fit.problem
        name, record = _named(problem.records, name)
        training = problem.posterior.alone(name).only.training
        drawings = record_drawings(record, training, problem.findings[name])
        return drawn(_named(drawings, kind)[1])

    def loop(self, *names: str) -> Figure:
        """Draw displacement against voltage with its bands, and its tip enlarged.

        By default for all that was predicted with the fit, or for the bands of these names.
        """
        bands = self._fit.bands
        return drawn(draw_kind, "loop", [_named(bands, name)[1] for name in names or bands])

    def loops(self) -> Figure:
        """Draw the major and a minor loop and the initial curve, measured."""
        return drawn(draw_kind, "loops", self._fit.loops)

    def bands(self, name: str | None = None) -> Figure:
        """Draw the bands of one window or record along time, by default the first fitted one."""
        return drawn(draw_kind, "bands", _named(self._fit.bands, name)[1])

    def coverage(self) -> Figure:
        """Draw how much the bands cover against what they promise, and the readings' PIT."""
        return drawn(draw_kind, "coverage", [*self._fit.bands.values()], self._fit.result.scores)

    def innovations(self, name: str | None = None) -> Figure:
        """Draw whether innovations, what each reading adds, are white, normal, of one size."""
        return drawn(draw_kind, "innovations", self._whitened(name))

    def spectrum(self, name: str | None = None) -> Figure:
        """Draw the residual's spectrum beside the noise model's."""
        return drawn(draw_kind, "spectrum", self._whitened(name))

    def corner(self) -> Figure:
        """Draw each parameter of the posterior, and each pair of them."""
        self._fit.require_converged()
        return drawn(draw_kind, "corner", self._fit.result)

    def trace(self) -> Figure:
        """Draw each ensemble's mean and spread, step by step."""
        return drawn(draw_kind, "trace", self._fit.result)

    def ranks(self) -> Figure:
        """Draw how the ranks of each ensemble's draws are spread."""
        return drawn(draw_kind, "ranks", self._fit.result)

    def tracking(self, tracked: Tracking) -> Figure:
        """Draw what ``fit.track()`` returns: error against frequency, for each controller."""
        return drawn(draw_tracking, tracked.to_pandas(), CONTROLLERS)

    def _whitened(self, name: str | None) -> Innovations:
        self._fit.require_converged()
        return _named(self._fit.result.innovations, name)[1]


def _named[T](items: Mapping[str, T], name: str | None) -> tuple[str, T]:
    """Return what is called so, and its name; without one the first."""
    name = next(iter(items)) if name is None else name
    if name not in items:
        raise InputError(f"plot: no {name!r} here; {suggestion(name, items)}")
    return name, items[name]
