"""A command that compensates, in pictures: what is reached, its error, the loop before, after."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, Locator, LogLocator, MaxNLocator, NullFormatter

from bwbayes.arrays import FloatArray
from bwbayes.prediction.bands import Bands, Kind
from bwbayes.report.figures.style import (
    BAND_COLORS,
    COLORS,
    MEAN_COLOR,
    envelope,
    plain,
    share_legend,
    zigzag,
)

__all__ = ["Command", "draw_error", "draw_loops", "draw_tracking"]

COLOR_OF = {"uncompensated": COLORS[3], "compensated": MEAN_COLOR}
REFERENCE_COLOR = "#222222"
BAND_OF: Mapping[Kind, str] = {
    "displacement": "95 % displacement",
    "parameter": "95 % parameters alone",
}


class Command(NamedTuple):
    """A command, its bands of the displacement, and its rms errors (draws,), um."""

    voltage: FloatArray
    bands: Bands
    rms: FloatArray


# By name: "uncompensated" and "compensated".
type Commands = Mapping[str, Command]


def draw_tracking(
    name: str, reference: FloatArray, commands: Commands, limit: float | None
) -> Figure:
    """Draw voltage, displacement and error along time, beside those without compensation.

    ``reference`` (samples,), um, is what was asked for; ``limit``, um, that of the error.
    """
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    top, center, below = figure.subplots(3, 1, sharex=True, height_ratios=(1, 2, 2))
    bands = commands["compensated"].bands
    time = _time(bands)
    _ribbon(center, bands, 0.0)
    for label, command in commands.items():
        color = COLOR_OF[label]
        top.plot(*zigzag(time, command.voltage), color=color, label=label)
        center.plot(*zigzag(time, command.bands.mean), color=color, label=label)
    top.set_ylabel("voltage (V)")
    top.set_title(plain(f"command for {name}"))
    center.plot(*zigzag(time, reference), "--", color=REFERENCE_COLOR, label="reference")
    center.set_ylabel("displacement (µm)")
    _errors(below, reference, commands, limit)
    share_legend(figure, ncols=5)
    return figure


def draw_error(reference: FloatArray, commands: Commands, limit: float | None) -> Figure:
    """Draw the error along time with its bands, and what its rms may be over the draws."""
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    along, spread = figure.subplots(1, 2, width_ratios=(2, 1))
    _errors(along, reference, {"compensated": commands["compensated"]}, limit)
    rms = np.concatenate([command.rms for command in commands.values()])
    # Errors are mostly far from zero; where they are not, all of them may be zero, or alike.
    low = max(float(rms.min()), 1e-9)
    bins = np.geomspace(low, max(float(rms.max()), 1.1 * low), 61)
    for label, command in commands.items():
        spread.hist(command.rms, bins=bins, color=COLOR_OF[label], alpha=0.6, label=label)
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


def draw_loops(reference: FloatArray, commands: Commands) -> Figure:
    """Draw the displacement against the reference, without and with compensation."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for panel, (label, command) in zip(panels, commands.items(), strict=True):
        ends = [float(reference.min()), float(reference.max())]
        panel.plot(ends, ends, "--", color=REFERENCE_COLOR, label="reference")
        panel.plot(reference, command.bands.mean, color=MEAN_COLOR, label="predicted")
        panel.set_title(label)
        panel.set_xlabel("reference (µm)")
        panel.legend(fontsize=8)
    panels[0].set_ylabel("displacement (µm)")
    return figure


def _errors(panel: Axes, reference: FloatArray, commands: Commands, limit: float | None) -> None:
    bands = commands["compensated"].bands
    _ribbon(panel, bands, reference)
    for label, command in commands.items():
        error = command.bands.mean - reference
        panel.plot(*zigzag(_time(bands), error), color=COLOR_OF[label], label=label)
    if limit is not None:
        for side in (-limit, limit):
            panel.axhline(side, color=REFERENCE_COLOR, lw=0.8, ls=":")
    panel.set_xlabel("time (s)")
    panel.set_ylabel("error (µm)")


def _ribbon(panel: Axes, bands: Bands, about: float | FloatArray) -> None:
    """Draw the 95 % bands of displacement and parameters about something."""
    for kind, label in BAND_OF.items():
        edges = (bands.lower[kind, 95] - about, bands.upper[kind, 95] - about)
        drawn = envelope(_time(bands), *edges)
        panel.fill_between(*drawn, fc=BAND_COLORS[kind], lw=0, label=label)


def _time(bands: Bands) -> FloatArray:
    """Return time from the command's begin, (samples,), s."""
    return bands.interval * np.arange(bands.mean.size, dtype=np.float64)
