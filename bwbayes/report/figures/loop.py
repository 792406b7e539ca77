"""The hysteresis loop: displacement against voltage, with its bands, whole and at its tip."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.prediction.bands import Bands, Kind
from bwbayes.report.figures.style import (
    BAND_COLORS,
    BAND_NAMES,
    MEAN_COLOR,
    MEASURED_COLOR,
    ZOOM_COLOR,
    plain,
    title,
)

__all__ = ["along", "draw_loop", "paths", "polygons"]

SHOWN: tuple[Kind, ...] = ("sensor", "parameter")


# The tip's panel is as high as this many sensor bands, or half the loop if that is less; a tenth of
# it lies beyond the tip.
TIP_HEIGHT = 4.0
BEYOND = 0.1

# Readings up to which their dots are large and dark.
FEW = 5000


def draw_loop(predictions: Sequence[Bands]) -> Figure:
    """Draw displacement against voltage, one column for each of the bands.

    Above the whole loop, below its tip at the largest voltage, where a band that is thin on the
    loop's scale can be seen.
    """
    columns = len(predictions)
    size = (max(3.6 * columns, 6.0), 7.2)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(2, columns, squeeze=False)
    for (full, tip), bands in zip(axes.T, predictions, strict=True):
        for panel, dot in ((full, ","), (tip, ".")):
            _draw(panel, bands, dot)
            panel.set_xlabel("voltage (V)")
        _zoom(full, tip, bands)
        full.set_title(plain(title(bands)))
        tip.set_title("tip at the largest voltage")
    for panel in axes[:, 0]:
        panel.set_ylabel("displacement (µm)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure


def _draw(panel: Axes, bands: Bands, dot: str) -> None:
    windows = paths(bands)
    for kind in SHOWN:
        panel.add_collection(_ribbon(bands, windows, kind))
    for number, path in enumerate(windows):
        label = "_nolegend_" if number else "mean"
        panel.plot(bands.voltage[path], bands.mean[path], color=MEAN_COLOR, lw=0.7, label=label)
    if bands.measured is not None:
        panel.plot([], [], ".", color=MEASURED_COLOR, label="measured")
        sparse = bands.measured.size <= FEW
        dots = panel.plot(
            bands.voltage, bands.measured, "." if sparse else dot, color=MEASURED_COLOR
        )
        size, alpha = (3.0, 0.7) if sparse else (2.0, 0.25)
        dots[0].set(markersize=size, markeredgewidth=0.0, zorder=1.5, alpha=alpha)
    panel.autoscale_view()


def paths(bands: Bands) -> list[IntArray]:
    """Return the samples to draw of each window."""
    return [
        window.start
        + along(bands.voltage[window], bands.mean[window])  # no path from one to the next
        for window in bands.windows
    ]


def along(voltage: FloatArray, displacement: FloatArray) -> IntArray:
    """Return the samples to draw: one for each small step along the loop.

    A fast signal keeps its samples, a slow one loses those that fall on the same spot.
    """
    steps = [np.diff(x) / max(float(np.ptp(x)), 1e-300) for x in (voltage, displacement)]
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*steps))])
    # Drawn points per unit of length, the ranges of voltage and displacement being one each.
    corners: IntArray = np.unique(np.floor(300 * length), return_index=True)[1]
    return np.union1d(corners, [voltage.size - 1])


def _ribbon(bands: Bands, windows: Sequence[IntArray], kind: Kind) -> PolyCollection:
    """Return a band along paths that may turn back: a polygon from each turn to the next.

    Opaque, because what overlaps where the path turns must not look like a denser band.
    """
    color = BAND_COLORS[kind]
    corners = list(polygons(bands, windows, kind))
    return PolyCollection(
        corners, facecolor=color, edgecolor=color, linewidth=0.4, label=BAND_NAMES[kind]
    )


def polygons(bands: Bands, windows: Sequence[IntArray], kind: Kind) -> Iterator[FloatArray]:
    """Yield the corners (corners, 2) of a 95 % band along paths, from each turn to the next."""
    for path in windows:
        for window in one_way(bands.voltage[path]):
            at = path[window]
            edges = np.append(bands.lower[kind, 95][at], bands.upper[kind, 95][at[::-1]])
            yield np.stack([bands.voltage[np.append(at, at[::-1])], edges], 1)


def one_way(voltage: FloatArray) -> list[slice]:
    """Return the stretches of a voltage from turn to turn, each with the samples at its ends."""
    rising = np.diff(voltage) > 0
    turns = np.flatnonzero(rising[1:] != rising[:-1]) + 1
    edges = [0, *turns.tolist(), voltage.size - 1]
    return [slice(first, last + 1) for first, last in itertools.pairwise(edges)]


def _zoom(full: Axes, tip: Axes, bands: Bands) -> None:
    """Cut the tip's panel to the tip and mark it on the whole loop."""
    inside = slice(None) if bands.inside is None else bands.inside
    voltage = bands.voltage[inside]
    lower, upper = bands.lower["sensor", 95][inside], bands.upper["sensor", 95][inside]
    at = int(np.argmax(voltage))
    height = float(np.max(upper) - np.min(lower))
    upright = min(TIP_HEIGHT * float(np.mean(upper - lower)), height / 2)
    across = (float(np.ptp(voltage)) or 1.0) * upright / height
    side = float(voltage[at]) - (1 - BEYOND) * across
    top = float(upper[at]) + BEYOND * upright
    tip.set_xlim(side, side + across)
    tip.set_ylim(top - upright, top)
    full.indicate_inset(
        (side, top - upright, across, upright),
        edgecolor=ZOOM_COLOR,
        alpha=1.0,
        linewidth=1.5,
    )
