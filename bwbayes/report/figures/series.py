"""Bands along time: voltage, displacement and residuals, whole and where the error is largest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bwbayes.arrays import FloatArray
from bwbayes.prediction.bands import Bands
from bwbayes.report.figures import style

__all__ = ["draw_bands"]

# A series with fewer samples than this shows dots and the truth, a longer one only pixels.
DOTS = 2000


def draw_bands(bands: Bands) -> Figure:
    """Draw voltage, displacement with its bands, and residuals with the bands around zero.

    The left column shows all samples, the right one a short segment around the largest error (or
    the largest displacement, if nothing was measured), where the bands can be told apart.
    """
    figure, axes = style.new_figure(
        11, 7.4, 3, 2, sharex="col", width_ratios=(2, 1), height_ratios=(1, 2, 2)
    )
    zoom = _around_largest_error(bands)
    for column, shown in zip(axes.T, (bands, bands.within([zoom])), strict=True):
        _draw_column(column, shown)
    for panel in axes[:, 0]:
        _mark(panel, bands, zoom)
    axes[2, 1].xaxis.set_major_locator(MaxNLocator(5))
    is_measured = bands.measured is not None
    axes[0, 0].set(ylabel="voltage (V)", title=style.plain(style.title(bands)))
    axes[1, 0].set_ylabel("displacement (µm)")
    axes[2, 0].set_ylabel("measured − mean (µm)" if is_measured else "band − mean (µm)")
    axes[0, 1].set_title(f"at the largest {'error' if is_measured else 'displacement'}")
    style.share_legend(figure, ncols=4)
    return figure


def _draw_column(column: Sequence[Axes], bands: Bands) -> None:
    voltage, displacement, residual = column
    residual.axhline(0.0, color=style.MEAN_COLOR, lw=1.0, label="mean")
    residual.set_xlabel(style.time_label(bands.time_offset))
    for segment in style.segments(bands):
        time = segment.time
        voltage.plot(*style.zigzag(time, segment.voltage), color=style.MEASURED_COLOR, lw=0.8)
        style.draw_ribbons(displacement, segment)
        style.draw_ribbons(residual, segment, segment.mean)
        displacement.plot(*style.zigzag(time, segment.mean), color=style.MEAN_COLOR, lw=0.8)
        if segment.truth is not None and bands.time.size < DOTS:
            true = style.zigzag(time, segment.truth - segment.mean)
            label = "true displacement, without noise"
            residual.plot(*true, color=style.TRUTH_COLOR, zorder=2.1, label=label)
    if bands.measured is not None:
        _draw_readings(displacement, bands.time, bands.measured)
        _draw_readings(residual, bands.time, bands.measured - bands.mean)
        residual.plot([], [], ".", color=style.MEASURED_COLOR, label="measured")


def _draw_readings(panel: Axes, time: FloatArray, readings: FloatArray) -> None:
    """Draw every reading: an envelope of noise would hide how few lie outside the band."""
    if time.size < DOTS:
        dots: style.Look = {"marker": ".", "ms": 2.5, "mew": 0, "alpha": 0.7}
    else:
        dots = {"marker": ",", "alpha": min(1.0, 15_000 / time.size)}
    panel.plot(time, readings, ls="", color=style.MEASURED_COLOR, **dots)


def _around_largest_error(bands: Bands, height: float = 8.0, least: int = 40) -> slice:
    """Return the judged samples about the largest error, within their window.

    As many as show at most ``height`` sensor bands of displacement, and a tenth of all samples, but
    at least ``least`` to either side.
    """
    judged = slice(min(bands.scored_from, bands.time.size - 1), None)
    error = np.abs(bands.mean if bands.measured is None else bands.measured - bands.mean)
    error = np.nan_to_num(error if bands.inside is None else np.where(bands.inside, error, 0.0))
    at = judged.start + int(np.argmax(error[judged]))
    window = next(window for window in bands.windows if at < window.stop)
    width = float(np.mean((bands.upper["sensor", 95] - bands.lower["sensor", 95])[window]))
    samples = np.arange(window.start, window.stop)
    is_distant = np.abs(bands.mean[window] - bands.mean[at]) > height * width / 2
    reach = min([bands.time.size // 20, *np.abs(samples[is_distant] - at)])
    reach = max(reach, least)
    return slice(max(at - reach, window.start), min(at + reach + 1, window.stop))


def _mark(panel: Axes, bands: Bands, zoom: slice) -> None:
    """Show where the zoom is, and which samples are not judged."""
    start, stop = bands.time[zoom][[0, -1]]
    zoomed: style.Look = {"color": style.ZOOM_COLOR, "alpha": 0.5, "zorder": 0.5}
    panel.axvspan(start, stop, lw=1, label="shown on the right", **zoomed)
    if bands.scored_from:
        lead_in = bands.time[[0, min(bands.scored_from, bands.time.size - 1)]]
        label = "lead-in, not judged"
        panel.axvspan(*lead_in, fc=style.LEAD_IN_COLOR, alpha=0.35, lw=0, label=label)
