"""Pictures: of a run's loops, bands along time, parameters, chains and coverage, and of products.

:func:`pictures` lists the pictures of a run, and :func:`picture_of` draws one as PNG. This package
alone uses matplotlib, Bokeh, Pillow and corner; it opens no window and touches no global figure.
The libraries are loaded when something is drawn, so that a process that leaves drawing to another
one need not wait.
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

from bwbayes.quantities import DEFAULT, Quantities
from bwbayes.report.figures.style import STYLE
from bwbayes.report.report import Picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bwbayes.report.result import PagePlots, Result

__all__ = [
    "PICTURES",
    "Pictures",
    "draw_kind",
    "draw_styled",
    "picture_of",
    "pictures",
    "plots_of",
    "prepare",
    "save_pictures",
]


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

    from bwbayes.report.figures import fit, interactive  # noqa: F401, PLC0415

    fit.pair_contours()


def plots_of(result: Result) -> PagePlots:
    """Return a run's interactive plots, and the scripts that draw them, if there are any."""
    from bwbayes.report.figures import interactive  # noqa: PLC0415
    from bwbayes.report.result import NO_PLOTS, PagePlots  # noqa: PLC0415

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


type Pictures = dict[str, Picture]


def pictures(result: Result) -> Pictures:
    """Return the pictures of a run by name, those whose content is known so far.

    The names are ``loop``, ``agreement`` (of several records), ``loops``, ``steps``, ``bands_NAME``
    for each of the result's bands, ``coverage``, ``innovations`` and ``spectrum`` (for several
    records ``innovations_NAME`` and so on), ``corner``, ``trace`` and ``ranks``. Without
    convergence there are only the last two; without bands or readings, pictures that need them are
    left out.
    """
    shown: dict[str, tuple[Any, ...]] = {}
    if result.outcome.converged:
        shown = {
            "loop": (result.looped,),
            "agreement": (result.consistency,),
            "loops": (result.loops,),
            "steps": (result.step_responses,),
            **{f"bands_{bands.name}": (bands,) for bands in result.predictions},
            "coverage": ([b for b in result.predictions if b.scores is not None],),
        }
        several = len(result.innovations) > 1
        for name, innovations in result.innovations.items():
            shown[f"innovations_{name}" if several else "innovations"] = (innovations,)
        for name, innovations in result.innovations.items():
            # Compute the densities here, so that a drawing process need not load their modules.
            residual = innovations.residual_density()
            noise = innovations.noise_density(residual[0])
            shown[f"spectrum_{name}" if several else "spectrum"] = residual, noise
        shown["corner"] = (result,)
    shown |= {"trace": (result,), "ranks": (result,)}
    pictures_by_name: Pictures = {}
    for name, content in shown.items():
        kind, _, record = name.partition("_")
        _, title, caption, alt = PICTURES[kind]
        if record:
            title, alt = f"{title}: {record}", f"{alt} ({record})"
        if content[0]:
            pictures_by_name[name] = Picture(
                name, title, caption, partial(draw_kind, kind, *content), alt
            )
    return pictures_by_name


def draw_kind(kind: str, *shown: Any) -> Figure:
    """Draw a kind of picture with the function of its module, which is slow to load."""
    module = import_module(f"bwbayes.report.figures.{PICTURES[kind][0]}")
    figure: Figure = getattr(module, f"draw_{kind}")(*shown)
    return figure


# Module that draws a picture, its title, its caption and its alternative text, by the first word of
# the picture's name.
PICTURES = {
    "loop": (
        "series",
        "Hysteresis loop",
        "Displacement against voltage. New readings lie in the sensor band, the model in the "
        "parameter band.",
        "Displacement against voltage: readings, their mean, and the 95% bands around it",
    ),
    "loops": (
        "fit",
        "Major loop, minor loop and initial curve",
        "The model driven slowly, without dynamics, creep and offset. Left: displacement against "
        "voltage. Right: the same minus the straight line between the major loop's turning "
        "points, where the 95% bands of the parameters can be seen.",
        "Displacement against voltage of major loop, minor loop and initial curve, with bands",
    ),
    "agreement": (
        "fit",
        "Consistency of the records",
        "What each record's readings are off the joint fit, and off a fit of that record alone. "
        "The chi-square compares where both fits have the shared parameters with how far apart "
        "chance may put them.",
        "Residuals of each record in the joint fit and in a fit of its own, against time",
    ),
    "steps": (
        "fit",
        "Step responses",
        "Displacement after a voltage step from zero, over the logarithm of time; on the right its "
        "growth from 0.1 s on. The step is ideal, whatever the amplifier did. Bands: 95%, of the "
        "parameters.",
        "Displacement since a step, against the logarithm of time, with its band",
    ),
    "bands": (
        "series",
        "Over time",
        "Voltage, displacement, and readings minus mean. Of all readings, 95% should lie inside "
        "the sensor band; those of a lead-in, if any, served to estimate the sensor's offset and "
        "are not judged. In the plot, the dots of a long record are the extremes of each short "
        "stretch: more of them lie outside than of all readings.",
        "Voltage, displacement with its 95% bands, and readings minus mean, against time",
    ),
    "coverage": (
        "fit",
        "Coverage and PIT",
        "Left: measured against nominal coverage of the bands; whiskers are one "
        "block-bootstrap standard error. It does not include that a record has one offset, and a "
        "posterior one estimate of the discrepancy: one record may be covered more or less than "
        "many are on average, and its PIT may lean. Right: how often readings fall at each "
        "predicted probability. Flat: calibrated. Hump: bands too wide. U-shape: too narrow. "
        "Slope: bias.",
        "Measured against nominal coverage of the bands, and a histogram of the readings' PIT",
    ),
    "innovations": (
        "fit",
        "Innovations",
        "One-step prediction errors, standardized: each fitted reading's residual minus what those "
        "before it predict. For a correct model they are independent standard normal, of one size "
        "from the start on and at any input voltage. Whiskers: 95% intervals of chance.",
        "Autocorrelation, normal quantiles, course in time and size by drive of the innovations",
    ),
    "spectrum": (
        "fit",
        "Spectrum of the residuals",
        "Amplitude spectral density of the residuals, and that of the noise model at the most "
        "probable draw. A peak above it is an oscillation that the noise model does not describe.",
        "Amplitude density of the residuals and of the noise model against frequency",
    ),
    "corner": (
        "fit",
        "Posterior",
        "Each parameter, and each pair of parameters; contours hold 50 and 90% of the draws. "
        "Crossing lines, if any, are the true values.",
        "Histogram of each parameter and contours of each pair of parameters",
    ),
    "trace": (
        "fit",
        "Trace",
        "Each ensemble's mean over its walkers, step by step, and the spread of its walkers. "
        "Ensembles should lie on top of each other and not drift.",
        "Each parameter's mean and spread in each ensemble, step by step",
    ),
    "ranks": (
        "fit",
        "Ranks",
        "How the ranks of each ensemble's draws among all draws are spread. Each line should stay "
        "near one, mostly inside the gray stripe that independent draws would fill.",
        "Histograms of each parameter's ranks, one line for each ensemble",
    ),
}
