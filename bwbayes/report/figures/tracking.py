"""Tracking error against frequency, with and without a model, for each signal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from bwbayes.report.figures.style import COLORS, hide_unused, share_legend

__all__ = ["draw_tracking"]

BAND_ALPHA = 0.25


def draw_tracking(table: Any, controllers: Sequence[str]) -> Figure:
    """Draw the rms errors of the controllers: mean over the draws, and where 95 % of them lie.

    The table is a pandas.DataFrame with a row for each signal, frequency and controller.
    """
    signals = list(dict.fromkeys(table["signal"]))
    rows = (len(signals) + 1) // 2
    figure = Figure(figsize=(10, 3.4 * rows + 0.4), layout="constrained")
    axes = figure.subplots(rows, 2, squeeze=False, sharex=True, sharey=True)
    panels = hide_unused(axes, len(signals), "frequency (Hz)")
    curves = table.groupby(["signal", "controller"])
    for panel, signal in zip(panels, signals, strict=True):
        for controller, color in zip(controllers, COLORS, strict=False):
            curve = curves.get_group((signal, controller))
            frequency, band = curve["frequency_Hz"], (curve["rms_um_low"], curve["rms_um_high"])
            panel.fill_between(frequency, *band, fc=color, alpha=BAND_ALPHA, lw=0)
            panel.plot(frequency, curve["rms_um"], "o-", ms=3, color=color, label=controller)
        panel.set_title(signal)
        panel.set_xscale("log")
        panel.set_yscale("log")
    for panel in axes[:, 0]:
        panel.set_ylabel("rms error (µm)")
    for panel in panels:
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter(ScalarFormatter())
        panel.xaxis.set_minor_formatter(NullFormatter())
    share_legend(figure)
    return figure
