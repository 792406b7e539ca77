"""Bands along time: voltage, displacement and residuals, whole and where the error is largest."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bwbayes.arrays import FloatArray
from bwbayes.prediction.bands import Bands
from bwbayes.report.figures.style import (
    BAND_COLORS,
    BAND_NAMES,
    EDGE_COLOR,
    LEAD_IN_COLOR,
    MEAN_COLOR,
    MEASURED_COLOR,
    TRUTH_COLOR,
    ZOOM_COLOR,
    envelope,
    plain,
    share_legend,
    time_label,
    title,
    with_gaps,
    zigzag,
)

__all__ = ["draw_bands"]

# The zoom shows at most this many sensor bands of displacement, and a tenth of the samples, but at
# least so many to either side.
ZOOM_HEIGHT = 8.0
LEAST_ZOOM = 40

# A stretch with fewer samples than this shows dots and the truth, a longer one only pixels.
DOTS = 2000


def draw_bands(bands: Bands) -> Figure:
    """Draw voltage, displacement with its bands, and residuals with the bands around zero.

    The left column shows all samples, the right one a short stretch around the largest error (or
    the largest displacement, if nothing was measured), where the bands can be told apart.
    """
    bands = with_gaps(bands)
    figure = Figure(figsize=(11, 7.4), layout="constrained")
    axes = figure.subplots(3, 2, sharex="col", width_ratios=(2, 1), height_ratios=(1, 2, 2))
    short = _around_largest_error(bands)
    for column, window in zip(axes.T, (slice(None), short), strict=True):
        voltage = zigzag(bands.time[window], bands.voltage[window])
        column[0].plot(*voltage, color=MEASURED_COLOR, lw=0.8)
        _draw_displacement(column[1], bands, window)
        _draw_residual(column[2], bands, window)
        column[2].set_xlabel(time_label(bands.time_offset))
    axes[2, 1].xaxis.set_major_locator(MaxNLocator(5))
    for panel in axes[:, 0]:
        _mark(panel, bands, short)
    axes[0, 0].set_ylabel("voltage (V)")
    axes[1, 0].set_ylabel("displacement (µm)")
    label = "band − mean" if bands.measured is None else "measured − mean"
    axes[2, 0].set_ylabel(f"{label} (µm)")
    axes[0, 0].set_title(plain(title(bands)))
    where = "largest displacement" if bands.measured is None else "largest error"
    axes[0, 1].set_title(f"at the {where}")
    share_legend(figure, ncols=4)
    return figure


def _around_largest_error(bands: Bands) -> slice:
    """Return the judged samples around the largest error that fit into the zoom's height."""
    size = bands.time.size
    first = min(bands.scored_from, size - 1)
    error = bands.mean if bands.measured is None else bands.measured - bands.mean
    at = first + int(np.argmax(np.nan_to_num(np.abs(error[first:]))))  # a reading may be missing
    width = float(np.nanmean(bands.upper["sensor", 95] - bands.lower["sensor", 95]))
    reach = max(int(0.1 * size / 2), LEAST_ZOOM)
    near = bands.mean[max(at - reach, 0) : at + reach + 1]
    here = min(at, reach)
    distant = ~(np.abs(near - near[here]) <= ZOOM_HEIGHT * width / 2)  # so is another window
    away = np.abs(np.flatnonzero(distant) - here)
    reach = max(int(away.min()), LEAST_ZOOM) if away.size else reach
    return slice(max(at - reach, 0), min(at + reach + 1, size))


def _draw_displacement(panel: Axes, bands: Bands, window: slice) -> None:
    _draw_ribbons(panel, bands, window, np.zeros_like(bands.mean))
    panel.plot(*zigzag(bands.time[window], bands.mean[window]), color=MEAN_COLOR, lw=0.8)
    if bands.measured is not None:
        _draw_readings(panel, bands.time[window], bands.measured[window])


def _draw_residual(panel: Axes, bands: Bands, window: slice) -> None:
    _draw_ribbons(panel, bands, window, bands.mean)
    panel.axhline(0.0, color=MEAN_COLOR, lw=1.0, label="mean")
    if bands.measured is not None:
        _draw_readings(panel, bands.time[window], (bands.measured - bands.mean)[window])
        panel.plot([], [], ".", color=MEASURED_COLOR, label="measured")
    if bands.truth is not None and bands.time[window].size < DOTS:
        drawn = zigzag(bands.time[window], (bands.truth - bands.mean)[window])
        panel.plot(*drawn, color=TRUTH_COLOR, lw=1.0, label="true displacement, without noise")


def _draw_ribbons(panel: Axes, bands: Bands, window: slice, about: FloatArray) -> None:
    """Draw the three 95 % bands, the widest first."""
    for kind, color in BAND_COLORS.items():
        lower = (bands.lower[kind, 95] - about)[window]
        upper = (bands.upper[kind, 95] - about)[window]
        drawn = envelope(bands.time[window], lower, upper)
        # Where the sensor's noise is small, its band would not be seen beside the displacement's.
        edge, style = (1.0, "--") if kind == "sensor" else (0.0, "-")
        panel.fill_between(
            *drawn, fc=color, ec=EDGE_COLOR, lw=edge, ls=style, label=BAND_NAMES[kind]
        )


def _draw_readings(panel: Axes, time: FloatArray, readings: FloatArray) -> None:
    """Draw every reading: an envelope of noise would hide how few lie outside the band."""
    if time.size < DOTS:
        panel.plot(time, readings, ".", color=MEASURED_COLOR, ms=2.5, mew=0, alpha=0.7)
    else:
        panel.plot(time, readings, ",", color=MEASURED_COLOR, alpha=min(1.0, 15_000 / time.size))


def _mark(panel: Axes, bands: Bands, short: slice) -> None:
    """Show where the zoom is, and which samples are not judged."""
    span = bands.time[short]
    label = "shown on the right"
    panel.axvspan(span[0], span[-1], color=ZOOM_COLOR, alpha=0.5, lw=1, zorder=0.5, label=label)
    if bands.scored_from:
        last = bands.time[min(bands.scored_from, bands.time.size - 1)]
        panel.axvspan(
            bands.time[0], last, fc=LEAD_IN_COLOR, alpha=0.35, lw=0, label="lead-in, not judged"
        )
