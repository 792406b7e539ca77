"""Step responses over the log of the time: the rise, and the creep that follows it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from bwbayes.prediction.steps import CREEP_FROM, StepResponse
from bwbayes.report.figures.style import COLORS, plain, share_legend

__all__ = ["draw_steps"]

BAND_ALPHA = 0.3


def draw_steps(responses: Mapping[str, StepResponse]) -> Figure:
    """Draw the displacement since each step, and beside it the creep, if there is any."""
    creeps = any(response.crept is not None for response in responses.values())
    figure = Figure(figsize=(11 if creeps else 6.4, 4.8), layout="constrained")
    panels = figure.subplots(1, 1 + creeps, squeeze=False)[0]
    first = np.inf
    for number, (name, response) in enumerate(responses.items()):
        color, label = COLORS[number % len(COLORS)], plain(f"{name}, {response.step.height:g} V")
        # The rise is drawn from this part of its final value on.
        started = np.abs(response.response.mean) > 1e-3 * abs(float(response.response.mean[-1]))
        # Without dynamics there is no rise to be seen.
        start = CREEP_FROM / 10 if started[0] else float(response.time[int(np.argmax(started))])
        first = min(first, start)
        for panel, curve in zip(panels, (response.response, response.crept), strict=False):
            if curve is not None:
                panel.fill_between(
                    response.time, curve.lower, curve.upper, fc=color, alpha=BAND_ALPHA, lw=0
                )
                panel.plot(response.time, curve.mean, color=color, label=label)
    for panel in panels:
        panel.set_xscale("log")
        panel.set_xlabel("time since the step (s)")
    last = max(response.step.held for response in responses.values())
    panels[0].set_xlim(first, last)
    panels[0].set_ylabel("displacement (µm)")
    panels[0].set_title("rise")
    if creeps:
        panels[1].set_xlim(CREEP_FROM, last)
        panels[1].set_ylabel("growth since 0.1 s (µm)")
        panels[1].set_title("creep")
    panels[0].fill_between([], [], fc="#888888", alpha=BAND_ALPHA, lw=0, label="95 % parameters")
    share_legend(figure)
    return figure
