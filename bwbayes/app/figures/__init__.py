"""Pictures of a finished run: bands along loops and time, parameters, chains and coverage.

:func:`draw_all` draws what there is to see of a :class:`~bwbayes.results.result.Result`, and
:func:`save` writes it as PNG. A run that has not converged shows its chains and nothing else. This
package alone knows matplotlib, Pillow and corner; it opens no window and touches no global figure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from io import BytesIO
from pathlib import Path
from urllib.parse import quote

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

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

__all__ = [
    "Drawing",
    "Drawings",
    "draw_all",
    "draw_alone",
    "drawings",
    "picture_of",
    "save",
    "save_one",
    "save_pictures",
]

# What draws a figure, and such by the figure's name.
type Drawing = Callable[[], Figure]
type Drawings = dict[str, Drawing]


def draw_all(result: Result) -> dict[str, Figure]:
    """Draw a run's figures, by name, in the order in which one looks at them.

    ``loop``, ``agreement`` (of several records), ``loops``, ``steps``, ``bands_NAME`` for each of
    the result's bands, ``coverage``,
    ``innovations`` (of several records ``innovations_NAME``), ``corner``, ``trace`` and ``ranks``.
    Without convergence only the last two; without bands or a measurement to hold them against,
    what needs them is left out.
    """
    with mpl.rc_context(STYLE):
        return {name: draw() for name, draw in drawings(result).items()}


def drawings(result: Result) -> Drawings:
    """Return, by name, what draws each figure of a result, as far as that is known by now."""
    return _of_predictions(result) | _of_draws(result)


def _of_predictions(result: Result) -> Drawings:
    """Return, by name, what draws each figure of predictions; nothing without convergence."""
    every: Drawings = {}
    if not result.outcome.converged:
        return every
    # A step has no loop.
    looped = [bands for bands in result.bands if bands.name not in result.steps]
    if looped:
        every["loop"] = partial(draw_loop, looped)
    if result.agreement:
        every["agreement"] = partial(draw_agreement, result.agreement)
    if result.loops is not None:
        every["loops"] = partial(draw_loops, result.loops)
    if result.steps:
        every["steps"] = partial(draw_steps, result.steps)
    every |= {f"bands_{bands.name}": partial(draw_bands, bands) for bands in result.bands}
    if result.scores:
        every["coverage"] = partial(draw_coverage, result.bands, result.scores)
    several = len(result.innovations) > 1
    return every | {
        f"innovations_{name}" if several else "innovations": partial(draw_innovations, one)
        for name, one in result.innovations.items()
    }


def _of_draws(result: Result) -> Drawings:
    """Return, by name, what draws each figure of the draws, which are known before predictions."""
    every: Drawings = {}
    if result.outcome.converged:
        every["corner"] = partial(draw_corner, result)
    every["trace"] = partial(draw_trace, result)
    every["ranks"] = partial(draw_ranks, result)
    return every


def picture_of(draw: Drawing) -> bytes:
    """Draw a figure and return it as PNG."""
    with mpl.rc_context(STYLE):
        return _png(draw())


def save(figures: Mapping[str, Figure], folder: Path) -> dict[str, bytes]:
    """Write each figure to ``folder/NAME.png`` and return the files' bytes by name.

    The folder is made if need be; what a file name may not hold is percent-encoded.
    """
    with mpl.rc_context(STYLE):
        drawn = {name: _png(figure) for name, figure in figures.items()}
    save_pictures(drawn, folder)
    return drawn


def save_pictures(drawn: Mapping[str, bytes], folder: Path) -> None:
    """Write pictures, PNG by name, as :func:`save` does."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in drawn.items():
        (folder / f"{quote(name, safe=' ,;()+')}.png").write_bytes(picture)


def draw_alone(bands: Bands) -> Figure:
    """Draw the bands of one prediction."""
    with mpl.rc_context(STYLE):
        return draw_bands(bands)


def save_one(figure: Figure, path: Path) -> None:
    """Write one figure as PNG."""
    with mpl.rc_context(STYLE):
        path.write_bytes(_png(figure))


def _png(figure: Figure) -> bytes:
    """Return a figure as PNG, laid out and drawn once: ``savefig`` does either twice.

    Of its thousands of colours, nearly all from smooth edges, it keeps those that come nearest to
    all: nobody sees the difference, and the file has a third of the size.
    """
    figure.set_dpi(mpl.rcParams["savefig.dpi"])
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    drawn = Image.fromarray(pixels).convert("RGB")
    few = drawn.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    buffer = BytesIO()
    few.save(buffer, "png")
    return buffer.getvalue()
