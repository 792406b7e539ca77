"""What was measured of the model: its slow loops and its responses to steps, with their bands."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from bwbayes.prediction.loops import Loops
from bwbayes.prediction.steps import CREEP_FROM, StepResponse
from bwbayes.report.figures import style

BAND = "95 % parameters"


def draw_loops(loops: Loops) -> Figure:
    """Draw displacement against voltage, and on the right less the major loop's straight line.

    On the scale of the whole loop its band is a line's width; less the line it can be seen.
    """
    figure, ((whole, tilted),) = style.new_figure(11, 4.8, 1, 2)
    major, minor = loops.major, loops.minor
    branches = (
        ("major loop", 0, "-", major.voltage, major.rising),
        ("_nolegend_", 0, "-", major.voltage, major.falling),
        ("minor loop", 1, "-", minor.voltage, minor.rising),
        ("_nolegend_", 1, "-", minor.voltage, minor.falling),
        ("initial curve", 2, "--", loops.initial_voltage, loops.initial),
    )
    ends = major.falling.mean[0], major.rising.mean[-1]
    line = np.polyfit(major.voltage[[0, -1]], ends, 1)
    for panel, subtracted in ((whole, 0 * line), (tilted, line)):
        for label, color, dashes, voltage, curve in branches:
            mean, *edges = (
                values - np.polyval(subtracted, voltage)
                for values in (curve.mean, curve.lower, curve.upper)
            )
            style.draw_band(panel, voltage, mean, edges, label, style.COLORS[color], dashes)
        panel.set_xlabel("voltage (V)")
    whole.set(ylabel="displacement (µm)", title="driven slowly, without offset")
    tilted.set(ylabel="displacement − straight line (µm)")
    tilted.set(title="less the line between the major loop's turns")
    style.share_legend(figure, band=BAND)
    return figure


def draw_steps(responses: Mapping[str, StepResponse]) -> Figure:
    """Draw the displacement since each step, and beside it the creep, if there is any."""
    creeps = any(response.crept is not None for response in responses.values())
    figure, (panels,) = style.new_figure(11 if creeps else 6.4, 4.8, 1, 1 + creeps)
    first = np.inf
    for number, (name, response) in enumerate(responses.items()):
        color = style.COLORS[number % len(style.COLORS)]
        label = style.plain(f"{name}, {response.step.height:g} V")
        # The rise is drawn from this part of its final value on.
        started = np.abs(response.response.mean) > 1e-3 * abs(float(response.response.mean[-1]))
        # Without dynamics there is no rise to be seen.
        start = CREEP_FROM / 10 if started[0] else float(response.time[int(np.argmax(started))])
        first = min(first, start)
        for panel, curve in zip(panels, (response.response, response.crept), strict=False):
            if curve is not None:
                edges = curve.lower, curve.upper
                style.draw_band(panel, response.time, curve.mean, edges, label, color)
    last = max(response.step.held for response in responses.values())
    for panel in panels:
        panel.set(xscale="log", xlabel="time since the step (s)", xlim=(CREEP_FROM, last))
    panels[0].set(xlim=(first, last), ylabel="displacement (µm)", title="rise")
    if creeps:
        panels[1].set(ylabel="growth since 0.1 s (µm)", title="creep")
    style.share_legend(figure, band=BAND)
    return figure
