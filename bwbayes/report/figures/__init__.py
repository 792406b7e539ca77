"""Pictures: of a run's loops, bands along time, parameters, chains and coverage, and of products.

:func:`drawings` says what there is to see of a :class:`~bwbayes.report.result.Result`, and
:func:`picture_of` draws it as PNG. This package alone knows matplotlib, Pillow and corner; it opens
no window and touches no global figure. They are loaded when something is drawn: whoever leaves that
to another process need not wait.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from bwbayes.report.figures.style import STYLE
from bwbayes.report.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Drawing",
    "Drawings",
    "drawings",
    "drawn",
    "picture_of",
    "prepare",
    "save_pictures",
]

# What draws a figure, and such by the figure's name.
type Drawing = Callable[[], "Figure"]
type Drawings = dict[str, Drawing]


def drawings(result: Result) -> Drawings:
    """Return, by name, what draws each figure of a run, as far as that is known by now.

    In the order in which one looks at them: ``loop``, ``agreement`` (of several records),
    ``loops``, ``steps``, ``bands_NAME`` for each of the result's bands, ``coverage``,
    ``innovations`` and ``spectrum`` (of several records ``innovations_NAME`` and so on),
    ``corner``, ``trace`` and ``ranks``. Without convergence only the last two; without bands or a
    measurement to hold them against, what needs them is left out.
    """
    return _of_predictions(result) | _of_draws(result)


def _draw(module: str, name: str, *shown: Any) -> Figure:
    """Draw with a function of one of this package's modules."""
    figure: Figure = getattr(import_module(f"{__name__}.{module}"), name)(*shown)
    return figure


def drawn(draw: Callable[..., Figure], *shown: Any) -> Figure:
    """Draw a figure with the look that all have."""
    import matplotlib as mpl  # noqa: PLC0415

    with mpl.rc_context(STYLE):
        return draw(*shown)


def _of_predictions(result: Result) -> Drawings:
    """Return, by name, what draws each figure of predictions; nothing without convergence."""
    named: Drawings = {}
    if not result.outcome.converged:
        return named
    # A step has no loop.
    looped = [bands for bands in result.bands if bands.name not in result.steps]
    if looped:
        named["loop"] = partial(_draw, "loop", "draw_loop", looped)
    if result.agreement:
        named["agreement"] = partial(_draw, "agreement", "draw_agreement", result.agreement)
    if result.loops is not None:
        named["loops"] = partial(_draw, "loops", "draw_loops", result.loops)
    if result.steps:
        named["steps"] = partial(_draw, "steps", "draw_steps", result.steps)
    named |= {
        f"bands_{bands.name}": partial(_draw, "series", "draw_bands", bands)
        for bands in result.bands
    }
    if result.scores:
        named["coverage"] = partial(_draw, "coverage", "draw_coverage", result.bands, result.scores)
    several = len(result.innovations) > 1
    return named | {
        f"{kind}_{name}" if several else kind: partial(_draw, kind, f"draw_{kind}", innovations)
        for kind in ("innovations", "spectrum")
        for name, innovations in result.innovations.items()
    }


def _of_draws(result: Result) -> Drawings:
    """Return, by name, what draws each figure of the draws, which are known before predictions."""
    named: Drawings = {}
    if result.outcome.converged:
        named["corner"] = partial(_draw, "chain", "draw_corner", result)
    named["trace"] = partial(_draw, "chain", "draw_trace", result)
    named["ranks"] = partial(_draw, "chain", "draw_ranks", result)
    return named


def prepare() -> None:
    """Load what is slow to load, before there is anything to draw."""
    import corner  # noqa: F401, PLC0415
    from matplotlib.backends import backend_agg  # noqa: F401, PLC0415

    from bwbayes.report.figures import chain, interactive  # noqa: F401, PLC0415


def picture_of(draw: Drawing) -> bytes:
    """Draw a figure and return it as PNG."""
    import matplotlib as mpl  # noqa: PLC0415

    with mpl.rc_context(STYLE):
        return _png(draw())


def save_pictures(pictures: Mapping[str, bytes], folder: Path) -> None:
    """Write pictures, PNG by name, to ``folder/NAME.png``.

    The folder is made if need be; what a file name may not hold is percent-encoded.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in pictures.items():
        (folder / f"{quote(name, safe=' ,;()+')}.png").write_bytes(picture)


def _png(figure: Figure) -> bytes:
    """Return a figure as PNG, laid out and drawn once: ``savefig`` does either twice.

    Of its thousands of colors, nearly all from smooth edges, it keeps those that come nearest to
    all: nobody sees the difference, and the file has a third of the size.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from PIL import Image  # noqa: PLC0415

    figure.set_dpi(STYLE["savefig.dpi"])
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    drawn = Image.fromarray(pixels).convert("RGB")
    quantized = drawn.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    buffer = BytesIO()
    quantized.save(buffer, "png")
    return buffer.getvalue()
