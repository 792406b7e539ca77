"""A record before any fit: along time, as a loop, and the spectrum of its drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bwbayes.diagnosis.finding import Finding
from bwbayes.record import Record
from bwbayes.report.figures import style
from bwbayes.report.report import Picture


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
