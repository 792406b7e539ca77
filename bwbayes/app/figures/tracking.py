"""Tracking error against frequency, with and without a model, for each signal."""

from __future__ import annotations

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from bwbayes.app.figures.style import COLOURS, STYLE, hide_unused, share_legend
from bwbayes.control.tracking import CONTROLLERS, Tracking

__all__ = ["draw_tracking"]

BAND_ALPHA = 0.25


def draw_tracking(tracking: Tracking) -> Figure:
    """Draw the rms errors of the controllers: mean over the draws, and where 95 % of them lie."""
    with mpl.rc_context(STYLE):
        rows = (len(tracking.signals) + 1) // 2
        figure = Figure(figsize=(10, 3.4 * rows + 0.4), layout="constrained")
        axes = figure.subplots(rows, 2, squeeze=False, sharex=True, sharey=True)
        panels = hide_unused(axes, len(tracking.signals), "frequency (Hz)")
        table = tracking.to_pandas().groupby(["signal", "controller"])
        for panel, signal in zip(panels, tracking.signals, strict=True):
            for controller, colour in zip(CONTROLLERS, COLOURS, strict=False):
                part = table.get_group((signal, controller))
                band = part["rms_um_low"], part["rms_um_high"]
                panel.fill_between(part["frequency_Hz"], *band, fc=colour, alpha=BAND_ALPHA, lw=0)
                panel.plot(
                    part["frequency_Hz"], part["rms_um"], "o-", ms=3, color=colour, label=controller
                )
            panel.set_title(signal)
            panel.set_xscale("log")
            panel.set_yscale("log")
        for left in axes[:, 0]:
            left.set_ylabel("rms error (µm)")
        for panel in panels:
            panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            panel.xaxis.set_major_formatter(ScalarFormatter())
            panel.xaxis.set_minor_formatter(NullFormatter())
        share_legend(figure)
    return figure
