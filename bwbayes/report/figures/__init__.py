"""Pictures: of a run's loops, bands along time, parameters, chains and coverage, and of products.

:func:`~bwbayes.report.figures.pictures.pictures` lists the pictures of a run, and
:func:`picture_of` draws one as PNG. This package alone uses matplotlib, Bokeh, Pillow and corner;
it opens no window and touches no global figure. The libraries are loaded when something is drawn,
so that a process that leaves drawing to another one need not wait.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from bwbayes.quantities import DEFAULT, Quantities
from bwbayes.report.figures.style import STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bwbayes.report.outputs import PagePlots
    from bwbayes.report.result import Result

__all__ = ["draw_styled", "picture_of", "plots_of", "prepare", "save_pictures"]


def draw_styled(
    draw: Callable[..., Figure], *shown: Any, quantities: Quantities = DEFAULT
) -> Figure:
    """Draw a figure with the common style, and in the words of its quantities."""
    import matplotlib as mpl  # noqa: PLC0415
    from matplotlib.text import Text  # noqa: PLC0415

    with mpl.rc_context(STYLE):
        figure = draw(*shown)
        for text in figure.findobj(Text) if quantities != DEFAULT else ():
            assert isinstance(text, Text)
            text.set_text(quantities.say(text.get_text()))
        return figure


def prepare() -> None:
    """Load the slow libraries before there is anything to draw."""
    from matplotlib.backends import backend_agg  # noqa: F401, PLC0415

    from bwbayes.report.figures import chain, interactive  # noqa: F401, PLC0415

    chain.pair_contours()


def plots_of(result: Result) -> PagePlots:
    """Return a run's interactive plots, and the scripts that draw them, if there are any."""
    from bwbayes.report.figures import interactive  # noqa: PLC0415
    from bwbayes.report.outputs import NO_PLOTS, PagePlots  # noqa: PLC0415

    plots = interactive.draw(result) if result.outcome.converged else {}
    return PagePlots(plots, interactive.scripts()) if plots else NO_PLOTS


def picture_of(draw: Callable[[], Figure], quantities: Quantities = DEFAULT) -> bytes:
    """Draw a figure and return it as PNG, laid out and drawn once: ``savefig`` does either twice.

    The figure has thousands of colors, nearly all from smooth edges. The PNG keeps the palette that
    comes nearest to all: nobody sees the difference, and the file has a third of the size.
    """
    import matplotlib as mpl  # noqa: PLC0415
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from PIL import Image  # noqa: PLC0415

    with mpl.rc_context(STYLE):
        figure = draw_styled(draw, quantities=quantities)
        figure.set_dpi(STYLE["savefig.dpi"])
        canvas = FigureCanvasAgg(figure)
        canvas.draw()  # type: ignore[no-untyped-call]
        pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    image = Image.fromarray(pixels).convert("RGB")
    quantized = image.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    buffer = BytesIO()
    quantized.save(buffer, "png")
    return buffer.getvalue()


def save_pictures(pictures: Mapping[str, bytes], folder: Path) -> None:
    """Write pictures, PNG by name, to ``folder/NAME.png``.

    The folder is made if need be; characters that a file name may not hold are percent-encoded.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in pictures.items():
        (folder / f"{quote(name, safe=' ,;()+')}.png").write_bytes(picture)
