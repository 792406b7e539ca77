"""The figures of a fit, each by a function of its own: ``fit.plot.loop()``.

They are those of the report. Each function returns a matplotlib figure, which a notebook shows and
``figure.savefig("loop.png")`` writes. Without convergence there are the record and the chain's
figures alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from bwbayes.app.fit.fitted import Run
from bwbayes.app.study.about import findings_of
from bwbayes.control.loop import CONTROLLERS
from bwbayes.control.tracking import Tracking
from bwbayes.errors import InputError, suggestion
from bwbayes.report.figures import PICTURES, draw_kind, draw_styled, pictures
from bwbayes.report.figures.products import draw_tracking
from bwbayes.report.figures.series import record_pictures
from bwbayes.report.report import Figure


class Plots:
    """The figures of a fit.

    Besides those below the report's, by their kinds: ``loops()``, ``steps()``, ``bands()``,
    ``coverage()``, ``agreement()``, ``innovations()``, ``spectrum()``, ``corner()``, ``trace()``
    and ``ranks()``. Each shows the bands or the record of the ``name``, by default the first. Those
    that speak of an interval raise a :class:`~bwbayes.errors.NotConvergedError` without
    convergence.
    """

    def __init__(self, fit: Run) -> None:
        self._fit = fit

    def __getattr__(self, kind: str) -> Callable[..., Figure]:
        if kind not in PICTURES:
            raise AttributeError(f"{kind} is no figure of a fit")

        def draw(name: str | None = None) -> Figure:
            if kind not in ("trace", "ranks"):
                self._fit.require_converged()
            shown = {
                key.removeprefix(f"{kind}_"): picture
                for key, picture in pictures(self._fit.result).items()
                if key.partition("_")[0] == kind
            }
            return self._draw(_select(shown, name or next(iter(shown), kind))[1].draw)

        return draw

    def _draw(self, draw: Callable[..., Figure], *shown: Any) -> Figure:
        return draw_styled(draw, *shown, quantities=self._fit.quantities)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *PICTURES]

    def record(self, kind: str = "time", name: str | None = None) -> Figure:
        """Draw a training record: along "time", as a "loop", or its "drive"'s spectrum."""
        study = self._fit.study
        name, record = _select(study.records, name)
        shown = record_pictures(record, study.training[name], findings_of(study)[name])
        return self._draw(_select(shown, kind)[1].draw)

    def loop(self, *names: str) -> Figure:
        """Draw displacement against voltage with its bands, and its tip enlarged.

        By default for all that was predicted with the fit, or for the bands of these names.
        """
        bands = self._fit.bands
        return self._draw(draw_kind, "loop", [_select(bands, name)[1] for name in names or bands])

    def tracking(self, tracked: Tracking) -> Figure:
        """Draw what ``fit.track()`` returns: error against frequency, for each controller."""
        return self._draw(draw_tracking, tracked.to_pandas(), CONTROLLERS)


def _select[T](items: Mapping[str, T], name: str | None) -> tuple[str, T]:
    """Return what is called so, and its name; without one the first."""
    name = next(iter(items)) if name is None else name
    if name not in items:
        raise InputError(f"plot: no {name!r} here; {suggestion(name, items)}")
    return name, items[name]
