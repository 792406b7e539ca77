"""What all pictures share: their look, the words on their axes, and how long series are thinned.

The colors are Okabe and Ito's, which color-blind readers can tell apart; bands differ by
lightness besides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.parameters import Parameter
from bwbayes.prediction.bands import Bands, Kind, titled
from bwbayes.report.words import label_with_unit

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "BAND_COLORS",
    "BAND_NAMES",
    "COLORS",
    "EDGE_COLOR",
    "LEAD_IN_COLOR",
    "MEAN_COLOR",
    "MEASURED_COLOR",
    "STYLE",
    "TRUTH_COLOR",
    "ZOOM_COLOR",
    "axis_label",
    "envelope",
    "hide_unused",
    "plain",
    "share_legend",
    "starts",
    "time_label",
    "title",
    "with_gaps",
    "zigzag",
]

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

MEAN_COLOR = "#D55E00"
MEASURED_COLOR = "#222222"
TRUTH_COLOR = "#E69F00"
LEAD_IN_COLOR = "#999999"
ZOOM_COLOR = "#CC79A7"

# From the widest band, drawn first, to the narrowest.
BAND_COLORS: Mapping[Kind, str] = {
    "sensor": "#DCEAF4",
    "displacement": "#ACD0E8",
    "parameter": "#6FAAD6",
}
EDGE_COLOR = "#12344D"
BAND_NAMES: Mapping[Kind, str] = {
    "sensor": "95 % sensor reading",
    "displacement": "95 % displacement",
    "parameter": "95 % parameters alone",
}


def plain(text: str) -> str:
    """Return a text that matplotlib will not read as mathematics."""
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


def title(bands: Bands) -> str:
    """Return the bands' name, and what they are of."""
    return titled(bands.name, training=bands.training, separate=bands.separate)


def time_label(offset: float) -> str:
    """Return the label of a time axis; ``offset`` is what the file's own clock adds to it, s."""
    return f"time after {offset:.15g} s (s)" if offset else "time (s)"


def with_gaps(bands: Bands) -> Bands:
    """Return bands of several windows with nan between them, where lines are to end."""
    inside = bands.inside
    if inside is None:
        return bands

    def cut(values: FloatArray) -> FloatArray:
        return np.where(inside, values, np.nan)

    return replace(
        bands,
        voltage=cut(bands.voltage),
        mean=cut(bands.mean),
        lower={key: cut(edge) for key, edge in bands.lower.items()},
        upper={key: cut(edge) for key, edge in bands.upper.items()},
    )


def starts(samples: int, count: int) -> IntArray:
    """Return the first samples of at most ``count`` stretches of nearly equal length."""
    return np.linspace(0, samples, min(samples, count), endpoint=False).astype(np.int64)


def envelope(
    time: FloatArray, lower: FloatArray, upper: FloatArray, count: int = 1500
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Thin a band to ``count`` stretches, each with its least and largest edge.

    Every excursion stays visible, which it would not if samples were left out; a stretch of nothing
    but nan stays a gap.
    """
    first = starts(time.size, count)
    return time[first], np.fmin.reduceat(lower, first), np.fmax.reduceat(upper, first)


def zigzag(
    time: FloatArray, values: FloatArray, count: int = 1500
) -> tuple[FloatArray, FloatArray]:
    """Thin a line to the least and the largest value of ``count`` stretches."""
    if time.size <= 2 * count:
        return time, values
    at, low, high = envelope(time, values, values, count)
    return np.repeat(at, 2), np.stack([low, high], axis=1).ravel()


def hide_unused(axes: np.ndarray[Any, Any], used: int, xlabel: str) -> list[Axes]:
    """Return the first ``used`` panels of a grid, the lowest of each column with the x label."""
    panels: list[Axes] = list(axes.flat)
    for i, panel in enumerate(panels):
        panel.set_visible(i < used)
        if i < used <= i + axes.shape[1]:
            panel.set_xlabel(xlabel)
    return panels[:used]


def share_legend(figure: Figure, ncols: int = 8) -> None:
    """Put one legend of all panels above them, where it hides no curve."""
    handles: dict[str, Artist] = {}
    for panel in figure.axes:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(list(handles.values()), list(handles), loc="outside upper center", ncols=ncols)
