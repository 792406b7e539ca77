"""Figures of planned signals: designs, commands and their errors, and closed loops."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import (
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    ScalarFormatter,
)

from bwbayes.arrays import FloatArray
from bwbayes.report.figures import style

COLOR_OF = {"uncompensated": style.COLORS[3], "compensated": style.Color.MEAN}


# Commands by name, "uncompensated" and "compensated": objects with ``voltage`` (samples,), V,
# ``bands`` of the displacement, and ``rms`` errors (draws,), um.
type Commands = Mapping[str, Any]


def draw_command(
    name: str, reference: FloatArray, commands: Commands, limit: float | None
) -> Figure:
    """Draw voltage, displacement and error along time, beside those without compensation.

    ``reference`` (samples,), um, is the desired displacement; ``limit``, um, that of the error.
    """
    figure, panels = style.new_figure(10, 6.5, 3, gap=0.15, sharex=True, height_ratios=(1, 2, 2))
    top, center, below = panels[:, 0]
    time = commands["compensated"].bands.time
    style.draw_ribbons(center, commands["compensated"].bands, kinds=("displacement", "parameter"))
    for label, command in commands.items():
        color = COLOR_OF[label]
        top.plot(*style.zigzag(time, command.voltage), color=color, label=label)
        center.plot(*style.zigzag(time, command.bands.mean), color=color, label=label)
    top.set(ylabel="voltage (V)", title=style.plain(f"command for {name}"))
    line = style.zigzag(time, reference)
    center.plot(*line, "--", color=style.Color.MEASURED, label="reference")
    center.set_ylabel("displacement (µm)")
    _draw_errors(below, reference, commands, limit)
    style.share_legend(figure, ncols=5)
    return figure


def draw_error(reference: FloatArray, commands: Commands, limit: float | None) -> Figure:
    """Draw the error along time with its bands, and the distribution of its rms over the draws."""
    figure, ((along, spread),) = style.new_figure(10, 3.6, 1, 2, width_ratios=(2, 1))
    _draw_errors(along, reference, {"compensated": commands["compensated"]}, limit)
    rms = np.concatenate([command.rms for command in commands.values()])
    # Errors are mostly far from zero; if they are not, all of them may be zero, or equal.
    low = max(float(rms.min()), 1e-9)
    bins = np.geomspace(low, max(float(rms.max()), 1.1 * low), 61)
    for label, command in commands.items():
        spread.hist(command.rms, bins=bins, color=COLOR_OF[label], alpha=0.6, label=label)
    spread.set(xlabel="rms of the error (µm)", ylabel="draws", xscale="log")
    # Two to five ticks; one decade may hold no power of ten.
    decades = float(np.log10(bins[-1] / bins[0]))
    powers = LogLocator(numticks=5) if decades > 2 else LogLocator(subs=(1, 3))
    spread.xaxis.set_major_locator(MaxNLocator(3) if decades < 1 else powers)
    spread.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    spread.xaxis.set_minor_formatter(NullFormatter())
    style.share_legend(figure)
    return figure


def draw_loops(reference: FloatArray, commands: Commands) -> Figure:
    """Draw the displacement against the reference, without and with compensation."""
    figure, (panels,) = style.new_figure(10, 4.6, 1, 2, sharex=True, sharey=True)
    ends = [float(reference.min()), float(reference.max())]
    for panel, (label, command) in zip(panels, commands.items(), strict=True):
        panel.plot(ends, ends, "--", color=style.Color.MEASURED, label="reference")
        panel.plot(reference, command.bands.mean, color=style.Color.MEAN, label="predicted")
        panel.set(title=label, xlabel="reference (µm)")
        panel.legend(fontsize=8)
    panels[0].set_ylabel("displacement (µm)")
    return figure


def _draw_errors(
    panel: Axes, reference: FloatArray, commands: Commands, limit: float | None
) -> None:
    bands = commands["compensated"].bands
    style.draw_ribbons(panel, bands, reference, ("displacement", "parameter"))
    for label, command in commands.items():
        error = style.zigzag(bands.time, command.bands.mean - reference)
        panel.plot(*error, color=COLOR_OF[label], label=label)
    for side in () if limit is None else (-limit, limit):
        panel.axhline(side, color=style.Color.MEASURED, lw=0.8, ls=":")
    panel.set(xlabel="time (s)", ylabel="error (µm)")


def draw_tracking(table: Any, controllers: Iterable[str]) -> Figure:
    """Draw the rms errors of the controllers: mean over the draws, and the range of 95% of them.

    The table is a pandas.DataFrame with a row for each signal, frequency and controller.
    """
    signals = list(dict.fromkeys(table["signal"]))
    labels = "frequency (Hz)", "rms error (µm)"
    share: style.Look = {"sharex": True, "sharey": True}
    figure, panels = style.panel_grid(len(signals), 2, 3.4, *labels, **share)
    curves = table.groupby(["signal", "controller"])
    for panel, signal in zip(panels, signals, strict=True):
        for controller, color in zip(controllers, style.COLORS, strict=False):
            curve = curves.get_group((signal, controller))
            edges = curve["rms_um_low"], curve["rms_um_high"]
            means = curve["frequency_Hz"], curve["rms_um"]
            style.draw_band(panel, *means, edges, controller, color, "o-")
        panel.set(title=signal, xscale="log", yscale="log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter(ScalarFormatter())
        panel.xaxis.set_minor_formatter(NullFormatter())
    style.share_legend(figure)
    return figure


def draw_promises(
    names: Sequence[str], remaining: FloatArray, error: FloatArray, label: str
) -> Figure:
    """Draw a dot with two standard errors for each candidate; one at 100% adds no information.

    ``remaining`` and ``error`` (candidates,) are parts, the best first.
    """
    figure, ((panel,),) = style.new_figure(7, 1.2 + 0.32 * len(names))
    rows, percent = np.arange(len(names)), 100 * remaining
    colors = [style.Color.MEAN, *[style.COLORS[0]] * (len(names) - 1)]
    panel.hlines(rows, percent, 100, color="#bbbbbb", lw=1)
    panel.errorbar(percent, rows, xerr=200 * error, fmt="none", ecolor="#222222", capsize=5)
    panel.scatter(percent, rows, color=colors, s=28, zorder=3)
    panel.axvline(100, color="#222222", lw=1, ls=":")
    panel.set_yticks(rows, [style.plain(name) for name in names])
    figure.set_layout_engine("constrained")
    panel.invert_yaxis()
    panel.set(xlim=(0, 104), xlabel=style.plain(f"{label} (%)"))
    return figure
