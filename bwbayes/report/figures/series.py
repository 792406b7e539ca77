"""Figures of series: bands and records before any fit, along time and as hysteresis loops."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.prediction.bands import Bands, Kind
from bwbayes.record import Record
from bwbayes.report.figures import style
from bwbayes.report.report import Picture

# Number of samples below which a series shows dots and the truth.
DOTS = 2000


def draw_bands(bands: Bands) -> Figure:
    """Draw voltage, displacement with its bands, and residuals with the bands around zero.

    The left column shows all samples, the right one a short segment around the largest error (or
    the largest displacement, if nothing was measured), where the bands can be told apart.
    """
    figure, axes = style.new_figure(
        11, 7.4, 3, 2, 0.15, sharex="col", width_ratios=(2, 1), height_ratios=(1, 2, 2)
    )
    zoom = _around_largest_error(bands)
    for column, shown in zip(axes.T, (bands, bands.within([zoom])), strict=True):
        _draw_column(column, shown)
    for panel in axes[:, 0]:
        zoomed: style.Look = {"color": style.Color.ZOOM, "alpha": 0.5, "zorder": 0.5}
        start, stop = bands.time[zoom][[0, -1]]
        panel.axvspan(start, stop, lw=1, label="shown on the right", **zoomed)
        if bands.scored_from:
            lead_in = bands.time[[0, min(bands.scored_from, bands.time.size - 1)]]
            label = "lead-in, not judged"
            panel.axvspan(*lead_in, fc=style.Color.LEAD_IN, alpha=0.35, lw=0, label=label)
    axes[2, 1].xaxis.set_major_locator(MaxNLocator(5))
    is_measured = bands.measured is not None
    axes[0, 0].set(ylabel="voltage (V)", title=style.plain(bands.title))
    axes[1, 0].set_ylabel("displacement (µm)")
    axes[2, 0].set_ylabel("measured − mean (µm)" if is_measured else "band − mean (µm)")
    axes[0, 1].set_title(f"at the largest {'error' if is_measured else 'displacement'}")
    style.share_legend(figure, ncols=4)
    return figure


def _draw_column(column: Sequence[Axes], bands: Bands) -> None:
    voltage, displacement, residual = column
    residual.axhline(0.0, color=style.Color.MEAN, lw=1.0, label="mean")
    residual.set_xlabel(style.time_label(bands.time_offset))
    for segment in style.segments(bands):
        time = segment.time
        voltage.plot(*style.zigzag(time, segment.voltage), color=style.Color.MEASURED, lw=0.8)
        style.draw_ribbons(displacement, segment)
        style.draw_ribbons(residual, segment, segment.mean)
        displacement.plot(*style.zigzag(time, segment.mean), color=style.Color.MEAN, lw=0.8)
        if segment.model_error_sd:
            narrow = segment.without_rivals
            for edge in (narrow.lower["sensor", 95], narrow.upper["sensor", 95]):
                dashed: style.Look = {"color": style.Color.MEAN, "lw": 0.7, "ls": "--"}
                dashed["label"] = "sensor band without rivals"
                residual.plot(*style.zigzag(time, edge - segment.mean), **dashed)
        if segment.truth is not None and bands.time.size < DOTS:
            true = style.zigzag(time, segment.truth - segment.mean)
            label = "true displacement, without noise"
            residual.plot(*true, color=style.Color.TRUTH, zorder=2.1, label=label)
    if bands.measured is not None:
        _draw_readings(displacement, bands.time, bands.measured)
        _draw_readings(residual, bands.time, bands.measured - bands.mean)
        residual.plot([], [], ".", color=style.Color.MEASURED, label="measured")


def _draw_readings(panel: Axes, time: FloatArray, readings: FloatArray) -> None:
    """Draw every reading: an envelope of noise would hide how few lie outside the band."""
    if time.size < DOTS:
        dots: style.Look = {"marker": ".", "ms": 2.5, "mew": 0, "alpha": 0.7}
    else:
        dots = {"marker": ",", "alpha": min(1.0, 15_000 / time.size)}
    panel.plot(time, readings, ls="", color=style.Color.MEASURED, **dots)


def _around_largest_error(bands: Bands, height: float = 8.0, min_samples: int = 40) -> slice:
    """Return the scored samples around the largest error, within their window.

    They show at most ``height`` sensor bands of displacement, and a tenth of all samples, but at
    least ``min_samples`` samples to either side.
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
    reach = max(reach, min_samples)
    return slice(max(at - reach, window.start), min(at + reach + 1, window.stop))


LOOP_KINDS: tuple[Kind, ...] = ("sensor", "parameter")


def draw_loop(predictions: Sequence[Bands]) -> Figure:
    """Draw displacement against voltage, one column for each of the bands.

    The upper panel shows the whole loop, the lower one its tip at the largest voltage, where a band
    that is thin on the loop's scale can be seen.
    """
    columns = len(predictions)
    figure, axes = style.new_figure(max(3.6 * columns, 6.0), 7.2, 2, columns)
    for (full, tip), bands in zip(axes.T, predictions, strict=True):
        _draw(full, bands, ",")
        _draw(tip, bands, ".")
        # The tip's panel has the height of four sensor bands, or of half the loop if less, and a
        # tenth of it lies beyond the tip.
        inside = slice(None) if bands.inside is None else bands.inside
        voltage = bands.voltage[inside]
        lower, upper = bands.lower["sensor", 95][inside], bands.upper["sensor", 95][inside]
        at = int(np.argmax(voltage))
        height_of_band = float(np.max(upper) - np.min(lower))
        height = min(4.0 * float(np.mean(upper - lower)), height_of_band / 2)
        width = (float(np.ptp(voltage)) or 1.0) * height / height_of_band
        left, bottom = float(voltage[at]) - 0.9 * width, float(upper[at]) - 0.9 * height
        tip.set(xlim=(left, left + width), ylim=(bottom, bottom + height))
        outline: style.Look = {"edgecolor": style.Color.ZOOM, "alpha": 1.0, "linewidth": 1.5}
        full.indicate_inset((left, bottom, width, height), **outline)
        full.set_title(style.plain(bands.title))
        tip.set_title("tip at the largest voltage")
    for panel in axes[:, 0]:
        panel.set_ylabel("displacement (µm)")
    style.share_legend(figure)
    return figure


def _draw(panel: Axes, bands: Bands, dot: str) -> None:
    for segment in map(path, style.segments(bands)):
        for kind in LOOP_KINDS:
            # Bands are opaque: their overlap at a reversal must not look like a denser band.
            look: style.Look = {
                "facecolor": style.BAND_COLORS[kind],
                "edgecolor": style.BAND_COLORS[kind],
            }
            corners = list(polygons(segment, kind))
            panel.add_collection(
                PolyCollection(corners, lw=0.4, label=style.BAND_NAMES[kind], **look)
            )
        panel.plot(segment.voltage, segment.mean, color=style.Color.MEAN, lw=0.7, label="mean")
    if bands.measured is not None:
        panel.plot([], [], ".", color=style.Color.MEASURED, label="measured")
        # Draw few readings as large and dark dots.
        size, alpha, marker = (3.0, 0.7, ".") if bands.measured.size <= 5000 else (2.0, 0.25, dot)
        dots: style.Look = {"ls": "", "ms": size, "mew": 0.0, "zorder": 1.5, "alpha": alpha}
        panel.plot(bands.voltage, bands.measured, marker=marker, color=style.Color.MEASURED, **dots)
    panel.autoscale_view()
    panel.set_xlabel("voltage (V)")


def path(bands: Bands, density: int = 300) -> Bands:
    """Return the samples of a window to draw: one for each small step along the loop.

    A fast signal keeps its samples, a slow one loses those that fall on the same spot: there are
    ``density`` points in a unit of length, which is the range of voltage or displacement.
    """
    steps = [np.diff(x) / max(float(np.ptp(x)), 1e-300) for x in (bands.voltage, bands.mean)]
    length = np.append(0.0, np.cumsum(np.hypot(*steps)))
    rows = np.unique(np.floor(density * length), return_index=True)[1]
    return style.choose(bands, np.union1d(rows, [bands.voltage.size - 1]))


def polygons(bands: Bands, kind: Kind) -> Iterator[FloatArray]:
    """Yield the corners (corners, 2) of a 95% band along a path, between each two reversals."""
    voltage, lower, upper = bands.voltage, bands.lower[kind, 95], bands.upper[kind, 95]
    rising = np.diff(voltage) > 0
    turns = np.flatnonzero(rising[1:] != rising[:-1]) + 1
    for start, stop in itertools.pairwise([0, *turns.tolist(), voltage.size - 1]):
        indices = np.arange(start, stop + 1)
        back = indices[::-1]
        edges = np.append(lower[indices], upper[back])
        yield np.stack([voltage[np.append(indices, back)], edges], 1)


def record_pictures(
    record: Record, training: Sequence[slice], findings: Sequence[Finding], name: str = ""
) -> dict[str, Picture]:
    """Return the pictures of a record: ``time``, ``loop``, ``drive``; ``name`` is set for several.

    Readings outside of the ``training`` windows are shown in gray; a part of the record that has a
    finding is marked.
    """
    kinds: dict[str, tuple[str, str, Callable[[], Figure]]] = {
        "time": (
            "Along time",
            "Voltage and displacement. Gray: readings that are not fitted; colored: the parts of "
            "the record with which something is wrong.",
            partial(_draw_time, record, training, findings),
        ),
        "loop": (
            "Hysteresis loop",
            "Displacement against voltage, colored by time.",
            partial(_draw_loop, record),
        ),
        "drive": (
            "Spectrum of the drive",
            "Amplitude of the voltage at each frequency.",
            partial(_draw_drive, record),
        ),
    }
    return {
        kind: Picture(f"{kind}_{name}", f"{title}: {name}", caption, draw)
        if name
        else Picture(kind, title, caption, draw)
        for kind, (title, caption, draw) in kinds.items()
        if kind != "loop" or record.displacement is not None
    }


def _draw_time(record: Record, training: Sequence[slice], findings: Sequence[Finding]) -> Figure:
    read = record.displacement is not None
    figure, grid = style.new_figure(11, 5.6 if read else 3.2, 1 + read, gap=0.15, sharex=True)
    panels = grid[:, 0]
    panels[0].plot(*style.zigzag(record.time, record.voltage), color=style.COLORS[0], lw=0.9)
    panels[0].set_ylabel("voltage (V)")
    if record.displacement is not None:
        rows = np.flatnonzero(record.has_reading)
        time, values = record.time[rows], record.displacement[rows]
        if rows.size < 2000:
            panels[1].plot(time, values, ".", color=style.Color.MEASURED, ms=2.5, mew=0)
        else:
            # Show more readings as a line, which ends at a gap that is longer than usual.
            steps = np.diff(rows, prepend=rows[0])
            values = np.where(steps > 3 * np.median(steps), np.nan, values)
            panels[1].plot(*style.zigzag(time, values), color=style.Color.MEASURED, lw=0.7)
        panels[1].set_ylabel("displacement (µm)")
    for panel in panels:
        _mark(panel, record, training, findings)
    panels[-1].set_xlabel("time (s)")
    style.share_legend(figure, ncols=4)
    return figure


def _mark(
    panel: Axes, record: Record, training: Sequence[slice], findings: Sequence[Finding]
) -> None:
    """Mark the parts of the record that are not fitted, and those with a finding."""
    at, end = record.start, record.start + record.duration
    fitted = [
        (record.time[window.start], record.start + window.stop * record.interval)
        for window in training
    ]
    for start, stop in [*fitted, (end, end)] if fitted else []:
        if start - at > record.interval / 2:
            gray: style.Look = {"color": style.Color.LEAD_IN, "alpha": 0.25}
            panel.axvspan(at, start, lw=0, label="not fitted", **gray)
        at = max(at, stop)
    parts = [f for f in findings if f.stop - f.start < 0.98 * record.duration]
    kinds = list(dict.fromkeys(finding.kind for finding in parts))
    for finding in parts:
        color = style.COLORS[1 + kinds.index(finding.kind) % (len(style.COLORS) - 2)]
        span = finding.start, finding.stop
        panel.axvspan(*span, color=color, alpha=0.3, lw=1, label=finding.kind)


def _draw_loop(record: Record) -> Figure:
    assert record.displacement is not None
    rows = np.flatnonzero(record.has_reading)
    rows = rows[:: -(-rows.size // 20_000)]
    voltage, displacement = record.voltage[rows], record.displacement[rows]
    figure, ((panel,),) = style.new_figure(6.4, 5.2)
    look: style.Look = {"s": 2.0, "lw": 0, "cmap": "viridis", "rasterized": True}
    dots = panel.scatter(voltage, displacement, c=record.time[rows], **look)
    figure.set_layout_engine("constrained")
    figure.colorbar(dots, label="time (s)")
    panel.set(xlabel="voltage (V)", ylabel="displacement (µm)")
    return figure


def _draw_drive(record: Record, points: int = 1500) -> Figure:
    """Draw the spectrum of the voltage minus its mean, from one period in a record on."""
    frequency, power = scipy.signal.periodogram(
        record.voltage, 1 / record.interval, "hann", scaling="spectrum"
    )
    frequency, amplitude = frequency[1:], np.sqrt(2 * power[1:])
    top, bottom = float(amplitude.max()), float(amplitude.min())
    if frequency.size > points:
        # Take the largest value of each of some segments of equal width on a log axis.
        first = np.unique(np.geomspace(1, frequency.size, points).astype(np.int64)) - 1
        frequency, amplitude = frequency[first], np.maximum.reduceat(amplitude, first)
    figure, ((panel,),) = style.new_figure(6.4, 3.8)
    panel.loglog(frequency, amplitude, color=style.COLORS[0], lw=0.9)
    # Show six decades below the peak.
    panel.set_ylim(max(top * 10.0**-6, bottom / 2, 1e-12), 3 * top)
    panel.set(xlabel="frequency (Hz)", ylabel="amplitude of the voltage (V)")
    return figure
