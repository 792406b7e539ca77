"""The hysteresis loop: displacement against voltage, with its bands, whole and at its tip."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from bwbayes.arrays import FloatArray
from bwbayes.prediction.bands import Bands, Kind
from bwbayes.report.figures import style

__all__ = ["LOOP_KINDS", "draw_loop", "path", "polygons"]

LOOP_KINDS: tuple[Kind, ...] = ("sensor", "parameter")


def draw_loop(predictions: Sequence[Bands]) -> Figure:
    """Draw displacement against voltage, one column for each of the bands.

    Above the whole loop, below its tip at the largest voltage, where a band that is thin on the
    loop's scale can be seen.
    """
    columns = len(predictions)
    figure, axes = style.new_figure(max(3.6 * columns, 6.0), 7.2, 2, columns)
    for (full, tip), bands in zip(axes.T, predictions, strict=True):
        _draw(full, bands, ",")
        _draw(tip, bands, ".")
        _zoom(full, tip, bands)
        full.set_title(style.plain(style.title(bands)))
        tip.set_title("tip at the largest voltage")
    for panel in axes[:, 0]:
        panel.set_ylabel("displacement (µm)")
    style.share_legend(figure)
    return figure


def _draw(panel: Axes, bands: Bands, dot: str) -> None:
    for segment in map(path, style.segments(bands)):
        for kind in LOOP_KINDS:
            # Opaque: what overlaps where the path turns must not look like a denser band.
            look: style.Look = {
                "facecolor": style.BAND_COLORS[kind],
                "edgecolor": style.BAND_COLORS[kind],
            }
            corners = list(polygons(segment, kind))
            panel.add_collection(
                PolyCollection(corners, lw=0.4, label=style.BAND_NAMES[kind], **look)
            )
        panel.plot(segment.voltage, segment.mean, color=style.MEAN_COLOR, lw=0.7, label="mean")
    if bands.measured is not None:
        panel.plot([], [], ".", color=style.MEASURED_COLOR, label="measured")
        # Few readings have large and dark dots.
        size, alpha, marker = (3.0, 0.7, ".") if bands.measured.size <= 5000 else (2.0, 0.25, dot)
        dots: style.Look = {"ls": "", "ms": size, "mew": 0.0, "zorder": 1.5, "alpha": alpha}
        panel.plot(bands.voltage, bands.measured, marker=marker, color=style.MEASURED_COLOR, **dots)
    panel.autoscale_view()
    panel.set_xlabel("voltage (V)")


def path(bands: Bands, density: int = 300) -> Bands:
    """Return the samples of a window that are drawn: one for each small step along the loop.

    A fast signal keeps its samples, a slow one loses those that fall on the same spot: there are
    ``density`` points in a unit of length, the ranges of voltage and displacement being one each.
    """
    steps = [np.diff(x) / max(float(np.ptp(x)), 1e-300) for x in (bands.voltage, bands.mean)]
    length = np.append(0.0, np.cumsum(np.hypot(*steps)))
    rows = np.unique(np.floor(density * length), return_index=True)[1]
    return style.choose(bands, np.union1d(rows, [bands.voltage.size - 1]))


def polygons(bands: Bands, kind: Kind) -> Iterator[FloatArray]:
    """Yield the corners (corners, 2) of a 95 % band along a path, from each turn to the next."""
    voltage, lower, upper = bands.voltage, bands.lower[kind, 95], bands.upper[kind, 95]
    rising = np.diff(voltage) > 0
    turns = np.flatnonzero(rising[1:] != rising[:-1]) + 1
    for start, stop in itertools.pairwise([0, *turns.tolist(), voltage.size - 1]):
        there = np.arange(start, stop + 1)
        back = there[::-1]
        edges = np.append(lower[there], upper[back])
        yield np.stack([voltage[np.append(there, back)], edges], 1)


def _zoom(full: Axes, tip: Axes, bands: Bands) -> None:
    """Cut the tip's panel to the tip and mark it on the whole loop.

    It is as high as four sensor bands, or half the loop if that is less, and a tenth of it lies
    beyond the tip.
    """
    inside = slice(None) if bands.inside is None else bands.inside
    voltage = bands.voltage[inside]
    lower, upper = bands.lower["sensor", 95][inside], bands.upper["sensor", 95][inside]
    at = int(np.argmax(voltage))
    whole = float(np.max(upper) - np.min(lower))
    height = min(4.0 * float(np.mean(upper - lower)), whole / 2)
    width = (float(np.ptp(voltage)) or 1.0) * height / whole
    left, bottom = float(voltage[at]) - 0.9 * width, float(upper[at]) - 0.9 * height
    tip.set(xlim=(left, left + width), ylim=(bottom, bottom + height))
    outline: style.Look = {"edgecolor": style.ZOOM_COLOR, "alpha": 1.0, "linewidth": 1.5}
    full.indicate_inset((left, bottom, width, height), **outline)
