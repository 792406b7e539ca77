"""A command that compensates, in pictures: what is reached, its error, the loop before, after."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, Locator, LogLocator, MaxNLocator, NullFormatter

from bwbayes.app.figures.style import (
    BAND_COLOURS,
    COLOURS,
    MEAN_COLOUR,
    STYLE,
    envelope,
    plain,
    share_legend,
    zigzag,
)
from bwbayes.arrays import FloatArray
from bwbayes.control.predicted import Compensation, Played

__all__ = ["draw_compensation", "draw_compensations"]

LINEAR_COLOUR, ASKED_COLOUR = COLOURS[3], "#222222"

# Edges of a histogram's bins.
BINS = 61


def draw_compensations(made: Compensation) -> dict[str, Figure]:
    """Draw all figures of a compensation, by name: ``tracking``, ``error``, ``loops``."""
    with mpl.rc_context(STYLE):
        return {
            "tracking": _tracking(made),
            "error": _error(made),
            "loops": _loops(made),
        }


def draw_compensation(made: Compensation) -> Figure:
    """Draw what is asked for and what is predicted, and the error with its bands."""
    with mpl.rc_context(STYLE):
        return _tracking(made)


def _tracking(made: Compensation) -> Figure:
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    top, middle, below = figure.subplots(3, 1, sharex=True, height_ratios=(1, 2, 2))
    time = made.reference.time
    top.plot(*zigzag(time, made.linear.voltage), color=LINEAR_COLOUR, label="uncompensated")
    top.plot(*zigzag(time, made.voltage), color=MEAN_COLOUR, label="compensated")
    top.set_ylabel("voltage (V)")
    top.set_title(plain(f"command for {made.reference.name}"))
    _ribbon(middle, made, made.compensated, 0.0)
    middle.plot(*zigzag(time, made.linear.bands.mean), color=LINEAR_COLOUR, label="uncompensated")
    middle.plot(*zigzag(time, made.compensated.bands.mean), color=MEAN_COLOUR, label="compensated")
    middle.plot(*zigzag(time, made.asked), "--", color=ASKED_COLOUR, label="reference")
    middle.set_ylabel("displacement (µm)")
    _errors(below, made)
    below.set_xlabel("time (s)")
    share_legend(figure, ncols=5)
    return figure


def _error(made: Compensation) -> Figure:
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    along, spread = figure.subplots(1, 2, width_ratios=(2, 1))
    _errors(along, made, without=False)
    along.set_xlabel("time (s)")
    both = np.concatenate([made.linear.rms, made.compensated.rms])
    # Errors are mostly far from zero; where they are not, all of them may be zero, or alike.
    low = max(float(both.min()), 1e-9)
    bins = np.geomspace(low, max(float(both.max()), 1.1 * low), BINS)
    for played, colour, name in (
        (made.linear, LINEAR_COLOUR, "uncompensated"),
        (made.compensated, MEAN_COLOUR, "compensated"),
    ):
        spread.hist(played.rms, bins=bins, color=colour, alpha=0.6, label=name)
    spread.set_xlabel("rms of the error (µm)")
    spread.set_ylabel("draws")
    spread.set_xscale("log")
    spread.xaxis.set_major_locator(_few_ticks(bins[0], bins[-1]))
    spread.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    spread.xaxis.set_minor_formatter(NullFormatter())
    share_legend(figure)
    return figure


def _few_ticks(low: float, high: float) -> Locator:
    """Return what puts two to five ticks on a logarithmic axis; one decade may hold no power."""
    decades = np.log10(high / low)
    if decades < 1:
        return MaxNLocator(3)
    return LogLocator(numticks=5) if decades > 2 else LogLocator(subs=(1, 3))


def _loops(made: Compensation) -> Figure:
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    before, after = figure.subplots(1, 2, sharex=True, sharey=True)
    for panel, played, title in (
        (before, made.linear, "without compensation"),
        (after, made.compensated, "with compensation"),
    ):
        low, high = float(made.asked.min()), float(made.asked.max())
        panel.plot([low, high], [low, high], "--", color=ASKED_COLOUR, label="as asked for")
        panel.plot(made.asked, played.bands.mean, color=MEAN_COLOUR, label="predicted")
        panel.set_title(title)
        panel.set_xlabel("reference (µm)")
        panel.legend(fontsize=8)
    before.set_ylabel("displacement (µm)")
    return figure


def _errors(panel: Axes, made: Compensation, *, without: bool = True) -> None:
    time = made.reference.time
    _ribbon(panel, made, made.compensated, made.asked)
    if without:
        error = made.linear.bands.mean - made.asked
        panel.plot(*zigzag(time, error), color=LINEAR_COLOUR, label="uncompensated")
    error = made.compensated.bands.mean - made.asked
    panel.plot(*zigzag(time, error), color=MEAN_COLOUR, label="compensated")
    if made.limit is not None:
        for side in (-made.limit, made.limit):
            panel.axhline(side, color=ASKED_COLOUR, lw=0.8, ls=":")
    panel.set_ylabel("error (µm)")


def _ribbon(panel: Axes, made: Compensation, played: Played, about: float | FloatArray) -> None:
    """Draw the 95 % bands of displacement and parameters about something."""
    for kind in ("displacement", "parameter"):
        lower = played.bands.lower[kind, 95] - about
        upper = played.bands.upper[kind, 95] - about
        drawn = envelope(made.reference.time, lower, upper)
        name = {"displacement": "95 % displacement", "parameter": "95 % parameters alone"}[kind]
        panel.fill_between(*drawn, fc=BAND_COLOURS[kind], lw=0, label=name)
