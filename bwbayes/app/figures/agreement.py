"""Each record's residuals in the joint fit and in one of its own, side by side along time."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.figure import Figure

from bwbayes.app.figures.style import COLOURS, MEAN_COLOUR
from bwbayes.results.agreement import Agreement

__all__ = ["draw_agreement"]

HEIGHT = 1.9  # of a record's panel, inches


def draw_agreement(every: Mapping[str, Agreement]) -> Figure:
    """Draw a panel for each record: what the joint fit misses, and what a fit of its own does."""
    figure = Figure(figsize=(11, 0.9 + HEIGHT * len(every)), layout="constrained")
    panels = figure.subplots(len(every), 1, squeeze=False)[:, 0]
    for panel, (name, one) in zip(panels, every.items(), strict=True):
        for values, colour, label in (
            (one.joint, COLOURS[0], f"joint fit: {one.joint_um:.3g} µm rms"),
            (one.own, COLOURS[1], f"own fit: {one.own_um:.3g} µm rms"),
        ):
            panel.plot(one.time, values, ".", color=colour, ms=2, mew=0, alpha=0.7, label=label)
        panel.axhline(0, color=MEAN_COLOUR, lw=0.8)
        verdict = "DOES NOT AGREE" if one.disagrees else "agrees"
        told = f"chi-square {one.distance:.3g} of {one.degrees:.3g}, p = {one.p_value:.2g}"
        panel.set_title(f"{name}: {verdict} with the others ({told})", fontsize=10)
        panel.set_ylabel("residual (µm)")
        panel.legend(loc="upper right", markerscale=4)
    panels[-1].set_xlabel("time (s)")
    return figure
