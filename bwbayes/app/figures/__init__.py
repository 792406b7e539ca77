"""Pictures of a finished run: bands along loops and time, parameters, chains and coverage.

:func:`draw_all` draws what there is to see of a :class:`~bwbayes.results.result.Result`, and
:func:`save` writes it as PNG. A run that has not converged shows its chains and nothing else. This
package alone knows matplotlib and corner; it opens no window and touches no global figure.
"""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from urllib.parse import quote

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bwbayes.app.figures.agreement import draw_agreement
from bwbayes.app.figures.chain import draw_corner, draw_ranks, draw_trace
from bwbayes.app.figures.coverage import draw_coverage
from bwbayes.app.figures.innovations import draw_innovations
from bwbayes.app.figures.loop import draw_loop
from bwbayes.app.figures.loops import draw_loops
from bwbayes.app.figures.series import draw_bands
from bwbayes.app.figures.steps import draw_steps
from bwbayes.app.figures.style import STYLE
from bwbayes.results.bands import Bands
from bwbayes.results.result import Result

__all__ = ["draw_all", "draw_alone", "save", "save_one"]


def draw_all(result: Result) -> dict[str, Figure]:
    """Draw a run's figures, by name, in the order in which one looks at them.

    ``loop``, ``agreement`` (of several records), ``loops``, ``steps``, ``bands_NAME`` for each of
    the result's bands, ``coverage``,
    ``innovations`` (of several records ``innovations_NAME``), ``corner``, ``trace`` and ``ranks``.
    Without convergence only the last two; without bands or a measurement to hold them against,
    what needs them is left out.
    """
    figures: dict[str, Figure] = {}
    with mpl.rc_context(STYLE):
        if result.outcome.converged:
            # A step has no loop.
            looped = [bands for bands in result.bands if bands.name not in result.steps]
            if looped:
                figures["loop"] = draw_loop(looped)
            if result.agreement:
                figures["agreement"] = draw_agreement(result.agreement)
            if result.loops is not None:
                figures["loops"] = draw_loops(result.loops)
            if result.steps:
                figures["steps"] = draw_steps(result.steps)
            figures |= {f"bands_{bands.name}": draw_bands(bands) for bands in result.bands}
            if result.scores:
                figures["coverage"] = draw_coverage(result.bands, result.scores)
            for name, innovations in result.innovations.items():
                several = len(result.innovations) > 1
                figures[f"innovations_{name}" if several else "innovations"] = draw_innovations(
                    innovations
                )
            figures["corner"] = draw_corner(result)
        figures["trace"] = draw_trace(result)
        figures["ranks"] = draw_ranks(result)
    return figures


def save(figures: Mapping[str, Figure], folder: Path) -> dict[str, bytes]:
    """Write each figure to ``folder/NAME.png`` and return the files' bytes by name.

    The folder is made if need be; what a file name may not hold is percent-encoded.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures: dict[str, bytes] = {}
    with mpl.rc_context(STYLE):
        for name, figure in figures.items():
            pictures[name] = _png(figure)
            (folder / f"{quote(name, safe=' ,;()+')}.png").write_bytes(pictures[name])
    return pictures


def draw_alone(bands: Bands) -> Figure:
    """Draw the bands of one prediction."""
    with mpl.rc_context(STYLE):
        return draw_bands(bands)


def save_one(figure: Figure, path: Path) -> None:
    """Write one figure as PNG."""
    with mpl.rc_context(STYLE):
        path.write_bytes(_png(figure))


def _png(figure: Figure) -> bytes:
    """Return a figure as PNG, laid out and drawn once: ``savefig`` does either twice."""
    figure.set_dpi(mpl.rcParams["savefig.dpi"])
    buffer = BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)  # type: ignore[no-untyped-call]
    return buffer.getvalue()
