"""What to measure next, in pictures: how much each candidate would leave open, and the best one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from bwbayes.arrays import FloatArray
from bwbayes.report.figures import style

__all__ = ["draw_promises", "draw_signal"]


def draw_promises(
    names: Sequence[str], remaining: FloatArray, error: FloatArray, label: str
) -> Figure:
    """Draw a dot with two standard errors for each candidate; nothing new at 100 %.

    ``remaining`` and ``error`` (candidates,) are parts, the best first.
    """
    figure, ((panel,),) = style.new_figure(7, 1.2 + 0.32 * len(names))
    rows, percent = np.arange(len(names)), 100 * remaining
    colors = [style.MEAN_COLOR, *[style.COLORS[0]] * (len(names) - 1)]
    panel.hlines(rows, percent, 100, color="#bbbbbb", lw=1)
    panel.errorbar(percent, rows, xerr=200 * error, fmt="none", ecolor="#222222", capsize=5)
    panel.scatter(percent, rows, color=colors, s=28, zorder=3)
    panel.axvline(100, color="#222222", lw=1, ls=":")
    panel.set_yticks(rows, [style.plain(name) for name in names])
    panel.invert_yaxis()
    panel.set(xlim=(0, 104), xlabel=style.plain(f"{label} (%)"))
    return figure


def draw_signal(
    name: str, voltage: FloatArray, interval: float, limits: tuple[float, float]
) -> Figure:
    """Draw a voltage (samples,), V, every ``interval`` s, between the amplifier's limits."""
    figure, ((panel,),) = style.new_figure(7, 2.8)
    time = interval * np.arange(voltage.size, dtype=np.float64)
    panel.plot(*style.zigzag(time, voltage), color=style.MEAN_COLOR)
    for limit in limits:
        panel.axhline(limit, color="#222222", lw=1, ls=":")
    panel.set(title=style.plain(name), xlabel="time (s)", ylabel="voltage (V)")
    return figure
