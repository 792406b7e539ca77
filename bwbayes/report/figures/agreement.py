"""Each record's residuals in the joint fit and in one of its own, side by side along time."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.figure import Figure

from bwbayes.diagnosis.consistency import Agreement
from bwbayes.report.figures.style import COLORS, MEAN_COLOR

__all__ = ["draw_agreement"]


def draw_agreement(agreements: Mapping[str, Agreement]) -> Figure:
    """Draw a panel for each record: what the joint fit misses, and what a fit of its own does."""
    # 1.9 inches for each record's panel.
    figure = Figure(figsize=(11, 0.9 + 1.9 * len(agreements)), layout="constrained")
    panels = figure.subplots(len(agreements), 1, squeeze=False)[:, 0]
    for panel, (name, agreement) in zip(panels, agreements.items(), strict=True):
        for values, color, label in (
            (agreement.joint, COLORS[0], f"joint fit: {agreement.joint_um:.3g} µm rms"),
            (agreement.own, COLORS[1], f"own fit: {agreement.own_um:.3g} µm rms"),
        ):
            panel.plot(
                agreement.time, values, ".", color=color, ms=2, mew=0, alpha=0.7, label=label
            )
        panel.axhline(0, color=MEAN_COLOR, lw=0.8)
        verdict = "DOES NOT AGREE" if agreement.disagrees else "agrees"
        distance = f"chi-square {agreement.distance:.3g} of {agreement.degrees:.3g}"
        panel.set_title(
            f"{name}: {verdict} with the others ({distance}, p = {agreement.p_value:.2g})",
            fontsize=10,
        )
        panel.set_ylabel("residual (µm)")
        panel.legend(loc="upper right", markerscale=4)
    panels[-1].set_xlabel("time (s)")
    return figure
