"""Pictures of a finished run: bands along loops and time, parameters, chains and coverage.

:func:`draw_all` draws what there is to see of a :class:`~bwbayes.results.result.Result`, and
:func:`save` writes it as PNG. A run that has not converged shows its chains and nothing else. This
package alone knows matplotlib, Pillow and corner; it opens no window and touches no global figure.
They are loaded when something is drawn: whoever leaves that to another process need not wait.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from bwbayes.app.figures.style import STYLE
from bwbayes.results.bands import Bands
from bwbayes.results.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Drawing",
    "Drawings",
    "draw_all",
    "draw_alone",
    "drawings",
    "picture_of",
    "prepare",
    "save",
    "save_one",
    "save_pictures",
]

# What draws a figure, and such by the figure's name.
type Drawing = Callable[[], "Figure"]
type Drawings = dict[str, Drawing]


def draw_all(result: Result) -> dict[str, Figure]:
    """Draw a run's figures, by name, in the order in which one looks at them.

    ``loop``, ``agreement`` (of several records), ``loops``, ``steps``, ``bands_NAME`` for each of
    the result's bands, ``coverage``,
    ``innovations`` and ``spectrum`` (of several records ``innovations_NAME`` and so on),
    ``corner``, ``trace`` and ``ranks``. Without convergence only the last two; without bands or a
    measurement to hold them against, what needs them is left out.
    """
    with _styled():
        return {name: draw() for name, draw in drawings(result).items()}


def drawings(result: Result) -> Drawings:
    """Return, by name, what draws each figure of a result, as far as that is known by now."""
    return _of_predictions(result) | _of_draws(result)


def _drawing(module: str, name: str, *shown: Any) -> Drawing:
    return partial(_draw, module, name, *shown)


def _draw(module: str, name: str, *shown: Any) -> Figure:
    """Draw with a function of one of this package's modules."""
    figure: Figure = getattr(import_module(f"{__name__}.{module}"), name)(*shown)
    return figure


def _styled() -> AbstractContextManager[None]:
    """Return the context in which all is drawn."""
    import matplotlib as mpl  # noqa: PLC0415

    return mpl.rc_context(STYLE)


def _of_predictions(result: Result) -> Drawings:
    """Return, by name, what draws each figure of predictions; nothing without convergence."""
    every: Drawings = {}
    if not result.outcome.converged:
        return every
    # A step has no loop.
    looped = [bands for bands in result.bands if bands.name not in result.steps]
    if looped:
        every["loop"] = _drawing("loop", "draw_loop", looped)
    if result.agreement:
        every["agreement"] = _drawing("agreement", "draw_agreement", result.agreement)
    if result.loops is not None:
        every["loops"] = _drawing("loops", "draw_loops", result.loops)
    if result.steps:
        every["steps"] = _drawing("steps", "draw_steps", result.steps)
    every |= {
        f"bands_{bands.name}": _drawing("series", "draw_bands", bands) for bands in result.bands
    }
    if result.scores:
        every["coverage"] = _drawing("coverage", "draw_coverage", result.bands, result.scores)
    several = len(result.innovations) > 1
    return every | {
        f"{kind}_{name}" if several else kind: _drawing(kind, f"draw_{kind}", one)
        for kind in ("innovations", "spectrum")
        for name, one in result.innovations.items()
    }


def _of_draws(result: Result) -> Drawings:
    """Return, by name, what draws each figure of the draws, which are known before predictions."""
    every: Drawings = {}
    if result.outcome.converged:
        every["corner"] = _drawing("chain", "draw_corner", result)
    every["trace"] = _drawing("chain", "draw_trace", result)
    every["ranks"] = _drawing("chain", "draw_ranks", result)
    return every


def prepare() -> None:
    """Load what is slow to load, before there is anything to draw."""
    import corner  # noqa: F401, PLC0415
    from matplotlib.backends import backend_agg  # noqa: F401, PLC0415

    from bwbayes.app.figures import chain, interactive  # noqa: F401, PLC0415


def picture_of(draw: Drawing) -> bytes:
    """Draw a figure and return it as PNG."""
    with _styled():
        return _png(draw())


def save(figures: Mapping[str, Figure], folder: Path) -> dict[str, bytes]:
    """Write each figure to ``folder/NAME.png`` and return the files' bytes by name.

    The folder is made if need be; what a file name may not hold is percent-encoded.
    """
    with _styled():
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
    with _styled():
        return _draw("series", "draw_bands", bands)


def save_one(figure: Figure, path: Path) -> None:
    """Write one figure as PNG."""
    with _styled():
        path.write_bytes(_png(figure))


def _png(figure: Figure) -> bytes:
    """Return a figure as PNG, laid out and drawn once: ``savefig`` does either twice.

    Of its thousands of colours, nearly all from smooth edges, it keeps those that come nearest to
    all: nobody sees the difference, and the file has a third of the size.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from PIL import Image  # noqa: PLC0415

    figure.set_dpi(STYLE["savefig.dpi"])
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    drawn = Image.fromarray(pixels).convert("RGB")
    few = drawn.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    buffer = BytesIO()
    few.save(buffer, "png")
    return buffer.getvalue()
