"""The measured loops: major loop, minor loop and initial curve, whole and less a straight line.

On the scale of the whole loop its band is a line's width; less the straight line between the major
loop's turns it can be seen.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bwbayes.prediction.loops import Loops
from bwbayes.report.figures.style import COLORS, share_legend

__all__ = ["draw_loops"]

BAND_ALPHA = 0.3


def draw_loops(loops: Loops) -> Figure:
    """Draw displacement against voltage, and on the right less the major loop's straight line."""
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    panels = figure.subplots(1, 2)
    major, minor = loops.major, loops.minor
    curves = (
        ("major loop", COLORS[0], "-", major.voltage, (major.rising, major.falling)),
        ("minor loop", COLORS[1], "-", minor.voltage, (minor.rising, minor.falling)),
        ("initial curve", COLORS[2], "--", loops.initial_voltage, (loops.initial,)),
    )
    ends = major.falling.mean[0], major.rising.mean[-1]
    line = np.polyfit(major.voltage[[0, -1]], ends, 1)
    for panel, subtracted in zip(panels, (0 * line, line), strict=True):
        for name, color, style, voltage, branches in curves:
            away = np.polyval(subtracted, voltage)
            for number, bands in enumerate(branches):
                label = "_nolegend_" if number else name
                lower, upper = bands.lower - away, bands.upper - away
                panel.fill_between(voltage, lower, upper, fc=color, alpha=BAND_ALPHA, lw=0)
                panel.plot(voltage, bands.mean - away, style, color=color, label=label)
        panel.set_xlabel("voltage (V)")
    panels[0].set_ylabel("displacement (µm)")
    panels[1].set_ylabel("displacement − straight line (µm)")
    panels[0].set_title("driven slowly, without offset")
    panels[1].set_title("less the line between the major loop's turns")
    panels[0].fill_between([], [], fc="#888888", alpha=BAND_ALPHA, lw=0, label="95 % parameters")
    share_legend(figure)
    return figure
