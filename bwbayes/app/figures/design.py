"""What to measure next, in pictures: how much each candidate would leave open, and the best one."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from bwbayes.app.figures.style import COLOURS, MEAN_COLOUR, STYLE, plain, zigzag
from bwbayes.comparison.design import Asked, Promise

__all__ = ["draw_design"]

ROW = 0.32  # of a candidate, inches
ERRORS = 2.0  # standard errors that a bar reaches to either side


def draw_design(asked: Asked, made: Sequence[Promise]) -> dict[str, Figure]:
    """Draw what candidates promise, and the best one's voltage: ``promises``, ``best``."""
    with mpl.rc_context(STYLE):
        return {"promises": _promises(asked, made), "best": _best(asked, made[0])}


def _promises(asked: Asked, made: Sequence[Promise]) -> Figure:
    """Draw a dot with its error for each candidate, the best above; nothing new at 100 %."""
    known = [one for one in made if not one.refused]
    figure = Figure(figsize=(7, 1.2 + ROW * len(known)), layout="constrained")
    panel = figure.subplots()
    rows = np.arange(len(known))
    left, error = (
        100 * np.array([getattr(one, key) for one in known]) for key in ("left", "error")
    )
    colours = [MEAN_COLOUR, *[COLOURS[0]] * (len(known) - 1)]
    panel.hlines(rows, left, 100, color="#bbbbbb", lw=1)
    panel.errorbar(left, rows, xerr=ERRORS * error, fmt="none", ecolor="#222222", capsize=5)
    panel.scatter(left, rows, color=colours, s=28, zorder=3)
    panel.axvline(100, color="#222222", lw=1, ls=":")
    panel.set_yticks(rows, [plain(one.name) for one in known])
    panel.invert_yaxis()
    panel.set_xlim(0, 104)
    panel.set_xlabel(plain(f"{asked.left} (%)"))
    return figure


def _best(asked: Asked, best: Promise) -> Figure:
    """Draw the voltage of the best candidate, between the amplifier's limits."""
    voltage = asked.signals[best.name]
    figure = Figure(figsize=(7, 2.8), layout="constrained")
    panel = figure.subplots()
    time = asked.interval * np.arange(voltage.size, dtype=np.float64)
    panel.plot(*zigzag(time, voltage), color=MEAN_COLOUR)
    for side in (asked.amplifier.low, asked.amplifier.high):
        panel.axhline(side, color="#222222", lw=1, ls=":")
    panel.set_title(plain(best.name))
    panel.set_xlabel("time (s)")
    panel.set_ylabel("voltage (V)")
    return figure
