"""What to measure next, in pictures: how much each candidate would leave open, and the best one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from bwbayes.arrays import FloatArray
from bwbayes.report.figures.style import COLORS, MEAN_COLOR, plain, zigzag

__all__ = ["draw_promises", "draw_signal"]


def draw_promises(
    names: Sequence[str], remaining: FloatArray, error: FloatArray, label: str
) -> Figure:
    """Draw a dot with its error for each candidate, the best above; nothing new at 100 %.

    ``remaining`` and ``error`` (candidates,) are parts, the best first.
    """
    # 0.32 inches for each candidate.
    figure = Figure(figsize=(7, 1.2 + 0.32 * len(names)), layout="constrained")
    panel = figure.subplots()
    rows = np.arange(len(names))
    colors = [MEAN_COLOR, *[COLORS[0]] * (len(names) - 1)]
    panel.hlines(rows, 100 * remaining, 100, color="#bbbbbb", lw=1)
    # A bar reaches two standard errors to either side.
    bars = 100 * 2.0 * error
    panel.errorbar(100 * remaining, rows, xerr=bars, fmt="none", ecolor="#222222", capsize=5)
    panel.scatter(100 * remaining, rows, color=colors, s=28, zorder=3)
    panel.axvline(100, color="#222222", lw=1, ls=":")
    panel.set_yticks(rows, [plain(name) for name in names])
    panel.invert_yaxis()
    panel.set_xlim(0, 104)
    panel.set_xlabel(plain(f"{label} (%)"))
    return figure


def draw_signal(
    name: str, voltage: FloatArray, interval: float, limits: tuple[float, float]
) -> Figure:
    """Draw a voltage (samples,), V, every ``interval`` s, between the amplifier's limits."""
    figure = Figure(figsize=(7, 2.8), layout="constrained")
    panel = figure.subplots()
    panel.plot(
        *zigzag(interval * np.arange(voltage.size, dtype=np.float64), voltage), color=MEAN_COLOR
    )
    for limit in limits:
        panel.axhline(limit, color="#222222", lw=1, ls=":")
    panel.set_title(plain(name))
    panel.set_xlabel("time (s)")
    panel.set_ylabel("voltage (V)")
    return figure
