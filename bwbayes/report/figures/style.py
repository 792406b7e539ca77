"""Style of all figures: their look, their axis labels, and the thinning of long series.

The colors are Okabe and Ito's, which color-blind readers can tell apart; bands differ by
lightness besides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bwbayes.arrays import ArrayLike, FloatArray, IntArray
from bwbayes.inference.parameters import Parameter
from bwbayes.prediction.bands import Bands, Kind
from bwbayes.report.report import label_with_unit

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Look of an artist: keyword arguments of the function that draws it.
type Look = dict[str, Any]

STYLE: dict[Any, Any] = {
    "figure.dpi": 100,
    "savefig.dpi": 120,
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "mathtext.fontset": "dejavusans",
    "text.usetex": False,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-4, 6),
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#e8e8e8",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.0,
    "legend.frameon": False,
    "path.simplify": True,
}

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


class Color:
    """Colors by their meaning."""

    MEAN = "#D55E00"
    MEASURED = "#222222"
    TRUTH = "#E69F00"
    LEAD_IN = "#999999"
    EXPECTED = "#777777"
    CHANCE = "#dddddd"  # range of chance
    ZOOM = "#CC79A7"
    EDGE = "#12344D"  # of the sensor band
    CORRECTED = "#009E73"


# Colors of the bands, from the widest one, drawn first, to the narrowest.
BAND_COLORS: Mapping[Kind, str] = {
    "sensor": "#DCEAF4",
    "displacement": "#ACD0E8",
    "parameter": "#6FAAD6",
}
BAND_NAMES: Mapping[Kind, str] = {
    "sensor": "95% sensor reading",
    "displacement": "95% displacement",
    "parameter": "95% parameters alone",
}
CORRECTED = "95% sensor reading, corrected"


def plain(text: str) -> str:
    """Escape a text so that matplotlib does not read it as mathematics."""
    return text.replace("$", r"\$")


def axis_label(parameter: Parameter) -> str:
    """Return a parameter's symbol and unit for an axis; its name if mathtext cannot read that."""
    from matplotlib.mathtext import MathTextParser  # noqa: PLC0415  # pages need units alone

    symbol = f"${parameter.label}$"
    try:
        MathTextParser("path").parse(symbol)
    except (ValueError, RuntimeError):
        symbol = plain(parameter.name)
    return label_with_unit(symbol, plain(parameter.unit))


def time_label(offset: float) -> str:
    """Return the label of a time axis; ``offset``, s, is added to it by the file's own clock."""
    return f"time after {offset:.15g} s (s)" if offset else "time (s)"


def segments(bands: Bands) -> list[Bands]:
    """Return the bands of each window separately, so that no line or area joins two windows."""
    return [bands.within([window]) for window in bands.windows]


def choose(bands: Bands, rows: IntArray) -> Bands:
    """Return the bands at some of their samples."""
    changes = dict[str, Any]()
    for name in ("time", "voltage", "measured", "truth", "mean"):
        values = getattr(bands, name)
        changes[name] = None if values is None else values[rows]
    for side in ("lower", "upper"):
        changes[side] = {band: edge[rows] for band, edge in getattr(bands, side).items()}
    return replace(bands, **changes, inside=None)


def starts(samples: int, count: int) -> IntArray:
    """Return the first samples of at most ``count`` segments of nearly equal length."""
    return np.linspace(0, samples, min(samples, count), endpoint=False).astype(np.int64)


def envelope(
    time: FloatArray, lower: FloatArray, upper: FloatArray, count: int = 1500
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Thin a band to ``count`` segments, each with its least and largest edge.

    Every excursion stays visible, which it would not if samples were left out; a segment of nan
    alone stays a gap.
    """
    first = starts(time.size, count)
    return time[first], np.fmin.reduceat(lower, first), np.fmax.reduceat(upper, first)


def zigzag(
    time: FloatArray, values: FloatArray, count: int = 1500
) -> tuple[FloatArray, FloatArray]:
    """Thin a line to the least and the largest value of ``count`` segments."""
    if time.size <= 2 * count:
        return time, values
    at, low, high = envelope(time, values, values, count)
    return np.repeat(at, 2), np.stack([low, high], axis=1).ravel()


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, gap: float = 0.8, **options: Any
) -> tuple[Figure, Any]:
    """Return a figure, inches, and its panels (rows, columns); ``options`` are of ``subplots``.

    Margins are fixed, with ``gap`` inches between the rows: measuring all labels takes as long as
    drawing them. If labels may be long the figure's layout should be constrained.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  # pages need words alone

    figure = Figure(figsize=(width, height))
    panels = figure.subplots(rows, columns, squeeze=False, **options)
    left, right, bottom, top = 0.85, width - 0.15, 0.55, height - 0.3
    figure.subplots_adjust(left / width, bottom / height, right / width, top / height)
    # The space between panels is a part of the size of one.
    figure.subplots_adjust(
        wspace=0.8 * columns / (right - left - 0.8 * (columns - 1)),
        hspace=gap * rows / (top - bottom - gap * (rows - 1)),
    )
    return figure, panels


def panel_grid(
    count: int, columns: int, height: float, xlabel: str, ylabel: str = "", **options: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure with a grid of panels, each of a height in inches.

    The lowest panel of each column has the x label, the first of each row the y label.
    """
    rows = -(-count // columns)
    figure, grid = new_figure(11, height * rows + 0.6, rows, columns, 0.35, **options)
    panels: list[Axes] = list(grid.flat)
    for i, panel in enumerate(panels):
        panel.set_visible(i < count)
        is_lowest = i < count <= i + columns
        panel.set_xlabel(xlabel if is_lowest else "")
        panel.set_ylabel("" if i % columns else ylabel)
        if options.get("sharex"):
            panel.tick_params(labelbottom=is_lowest)
    return figure, panels[:count]


def draw_band(
    panel: Axes, x: ArrayLike, mean: Any, edges: Any, label: str, color: str, style: str = "-"
) -> None:
    """Draw a mean (points,) with its band, two ``edges`` (points,), in the same color."""
    panel.fill_between(x, *edges, fc=color, alpha=0.3, lw=0)
    panel.plot(x, mean, style, ms=3, color=color, label=label)


def draw_ribbons(
    panel: Axes,
    bands: Bands,
    about: float | FloatArray = 0.0,
    kinds: Sequence[Kind] = tuple(BAND_COLORS),
) -> None:
    """Draw 95% bands minus ``about`` along time, the widest first, the sensor's with an edge."""
    for kind in kinds:
        # Where the sensor's noise is small, its band would not be seen beside the displacement's.
        edge: Look = {"ec": Color.EDGE, "ls": "--"} if kind == "sensor" else {"lw": 0.0}
        drawn = envelope(bands.time, bands.lower[kind, 95] - about, bands.upper[kind, 95] - about)
        panel.fill_between(*drawn, fc=BAND_COLORS[kind], label=BAND_NAMES[kind], **edge)
    for edge_um in bands.corrected or ():
        panel.plot(*zigzag(bands.time, edge_um - about), color=Color.CORRECTED, label=CORRECTED)


def share_legend(figure: Figure, ncols: int = 8, band: str = "") -> None:
    """Put one legend of all panels above them; ``band`` names the area of :func:`draw_band`."""
    if band:
        figure.axes[0].fill_between([], [], fc="#888888", alpha=0.3, lw=0, label=band)
    handles: dict[str, Artist] = {}
    for panel in figure.axes:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        figure.legend(handles.values(), handles, loc="upper center", ncols=ncols)
        height = 0.2 * -(-len(handles) // ncols)
        figure.subplots_adjust(top=figure.subplotpars.top - height / figure.get_figheight())
