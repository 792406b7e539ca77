"""A record before any fit: along time, as a loop, and the spectrum of its drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.record import Record
from bwbayes.report.figures.style import COLORS, LEAD_IN_COLOR, MEASURED_COLOR, zigzag

__all__ = ["record_drawings"]

SPECTRUM_POINTS = 1500


def record_drawings(
    record: Record, training: Sequence[slice] = (), findings: Sequence[Finding] = ()
) -> dict[str, Callable[[], Figure]]:
    """Return what draws a record's figures, by name: ``time``, ``loop`` and ``drive``.

    Parameters
    ----------
    record
        The record, with or without a displacement.
    training
        The windows that are fitted; what lies outside is shown in gray.
    findings
        What is wrong; where it is only a part of the record, the part is marked.
    """
    drawings: dict[str, Callable[[], Figure]] = {
        "time": partial(_draw_time, record, training, findings)
    }
    if record.displacement is not None:
        drawings["loop"] = partial(_draw_loop, record)
    return drawings | {"drive": partial(_draw_drive, record)}


def _draw_time(record: Record, training: Sequence[slice], findings: Sequence[Finding]) -> Figure:
    read = record.displacement is not None
    figure = Figure(figsize=(11, 5.6 if read else 3.2), layout="constrained")
    panels = figure.subplots(1 + read, 1, sharex=True, squeeze=False)[:, 0]
    panels[0].plot(*zigzag(record.time, record.voltage), color=COLORS[0], lw=0.9)
    panels[0].set_ylabel("voltage (V)")
    if record.displacement is not None:
        rows = np.flatnonzero(record.has_reading)
        time, values = record.time[rows], record.displacement[rows]
        # More readings are shown as a line.
        if rows.size < 2000:
            panels[1].plot(time, values, ".", color=MEASURED_COLOR, ms=2.5, mew=0)
        else:
            panels[1].plot(*zigzag(time, _with_gaps(record, rows)), color=MEASURED_COLOR, lw=0.7)
        panels[1].set_ylabel("displacement (µm)")
    for panel in panels:
        _mark(panel, record, training, findings)
    panels[-1].set_xlabel("time (s)")
    handles, labels = panels[-1].get_legend_handles_labels()
    if labels:
        figure.legend(handles, labels, loc="outside upper center", ncols=4)
    return figure


def _with_gaps(record: Record, rows: np.ndarray[tuple[int], np.dtype[np.int64]]) -> FloatArray:
    """Return the readings, nan at the first one behind a gap that is longer than usual."""
    assert record.displacement is not None
    values = record.displacement[rows].copy()
    steps = np.diff(rows, prepend=rows[0])
    values[steps > 3 * np.median(steps)] = np.nan
    return values


def _mark(
    panel: Axes, record: Record, training: Sequence[slice], findings: Sequence[Finding]
) -> None:
    """Show what is not fitted, and the parts of the record with which something is wrong."""
    end = record.start + record.duration
    label = "not fitted"
    at = record.start
    edges = [
        (record.time[window.start], record.start + window.stop * record.interval)
        for window in training
    ]
    for start, stop in [*edges, *([(end, end)] if edges else [])]:
        if start - at > record.interval / 2:
            panel.axvspan(at, start, color=LEAD_IN_COLOR, alpha=0.25, lw=0, label=label)
            label = "_nolegend_"
        at = max(at, stop)
    kinds: dict[str, str] = {}
    for finding in findings:
        if finding.stop - finding.start < 0.98 * record.duration:
            color = kinds.setdefault(finding.kind, COLORS[1 + len(kinds) % (len(COLORS) - 2)])
            panel.axvspan(
                finding.start, finding.stop, color=color, alpha=0.3, lw=1, label=finding.kind
            )


def _draw_loop(record: Record) -> Figure:
    assert record.displacement is not None
    rows = np.flatnonzero(record.has_reading)
    rows = rows[:: -(-rows.size // 20_000)]
    figure = Figure(figsize=(6.4, 5.2), layout="constrained")
    panel = figure.subplots()
    dots = panel.scatter(
        record.voltage[rows],
        record.displacement[rows],
        c=record.time[rows],
        s=2.0,
        lw=0,
        cmap="viridis",
        rasterized=True,
    )
    figure.colorbar(dots, label="time (s)")
    panel.set_xlabel("voltage (V)")
    panel.set_ylabel("displacement (µm)")
    return figure


def _draw_drive(record: Record) -> Figure:
    """Draw the spectrum of the voltage, above its mean, from one period a record on."""
    frequency, power = scipy.signal.periodogram(
        record.voltage, 1 / record.interval, "hann", scaling="spectrum"
    )
    amplitude = np.sqrt(2 * power[1:])
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    panel = figure.subplots()
    panel.loglog(*_thinned(frequency[1:], amplitude), color=COLORS[0], lw=0.9)
    top = float(amplitude.max())
    # Six decades below the peak.
    panel.set_ylim(max(top * 10.0**-6, float(amplitude.min()) / 2, 1e-12), 3 * top)
    panel.set_xlabel("frequency (Hz)")
    panel.set_ylabel("amplitude of the voltage (V)")
    return figure


def _thinned(frequency: FloatArray, amplitude: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Keep the largest amplitude of each of some stretches that look alike on a log axis."""
    if frequency.size <= SPECTRUM_POINTS:
        return frequency, amplitude
    first = np.unique(np.geomspace(1, frequency.size, SPECTRUM_POINTS).astype(np.int64)) - 1
    return frequency[first], np.maximum.reduceat(amplitude, first)
