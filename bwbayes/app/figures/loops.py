"""The measured loops: major loop, minor loop and initial curve, whole and less a straight line.

On the scale of the whole loop its band is a line's width; less the straight line between the major
loop's turns it can be seen.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bwbayes.app.figures.style import COLOURS
from bwbayes.results.loops import Loops

__all__ = ["draw_loops"]

BAND_ALPHA = 0.3


def draw_loops(loops: Loops) -> Figure:
    """Draw displacement against voltage, and on the right less the major loop's straight line."""
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    panels = figure.subplots(1, 2)
    major, minor = loops.major, loops.minor
    curves = (
        ("major loop", COLOURS[0], "-", major.voltage, (major.rising, major.falling)),
        ("minor loop", COLOURS[1], "-", minor.voltage, (minor.rising, minor.falling)),
        ("initial curve", COLOURS[2], "--", loops.initial_voltage, (loops.initial,)),
    )
    ends = major.falling.mean[0], major.rising.mean[-1]
    line = np.polyfit(major.voltage[[0, -1]], ends, 1)
    for panel, taken in zip(panels, (0 * line, line), strict=True):
        for name, colour, style, voltage, branches in curves:
            away = np.polyval(taken, voltage)
            for number, one in enumerate(branches):
                label = "_nolegend_" if number else name
                lower, upper = one.lower - away, one.upper - away
                panel.fill_between(voltage, lower, upper, fc=colour, alpha=BAND_ALPHA, lw=0)
                panel.plot(voltage, one.mean - away, style, color=colour, label=label)
        panel.set_xlabel("voltage (V)")
    panels[0].set_ylabel("displacement (µm)")
    panels[1].set_ylabel("displacement − straight line (µm)")
    panels[0].set_title("driven slowly, without offset")
    panels[1].set_title("less the line between the major loop's turns")
    handles, labels = panels[0].get_legend_handles_labels()
    handles.append(panels[0].fill_between([], [], fc="#888888", alpha=BAND_ALPHA, lw=0))
    figure.legend(
        handles, [*labels, "95 % parameters"], loc="outside upper center", ncols=len(handles)
    )
    return figure
