"""All records of a campaign side by side: each parameter's intervals, and their population."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bwbayes.report.figures import style

__all__ = ["Interval", "ParameterPanel", "draw_parameters"]


class Interval(NamedTuple):
    """A median and a 95 % interval; of an outlier or not."""

    lower: float
    median: float
    upper: float
    outlier: bool = False


class ParameterPanel(NamedTuple):
    """A parameter in all records, by their names.

    ``alone`` has the intervals of the records by themselves, ``shrunk`` with the population for a
    prior, ``specimen`` is where a specimen not measured yet lies, if there is a population.
    """

    label: str
    alone: Mapping[str, Interval]
    shrunk: Mapping[str, Interval]
    specimen: Interval | None


def draw_parameters(records: Sequence[str], parameters: Sequence[ParameterPanel]) -> Figure:
    """Draw a panel for each parameter: the records' 95 % intervals in the order of their names.

    Gray alone and blue with the population for a prior, the population's median and where 95 % of
    specimens not measured yet lie. Outliers are red.
    """
    figure, panels = style.panel_grid(len(parameters), 3, 2.6, "record")
    for panel, parameter in zip(panels, parameters, strict=True):
        _draw_parameter(panel, records, parameter)
        panel.set(ylabel=style.plain(parameter.label), xlim=(0, len(records) + 1))
        # The names of more records would overlap.
        if len(records) <= 24:
            names = [style.plain(name) for name in records]
            panel.set_xticks(range(1, len(records) + 1), names, rotation=90, fontsize=7)
    return figure


def _draw_parameter(panel: Axes, records: Sequence[str], parameter: ParameterPanel) -> None:
    if parameter.specimen is not None:
        low, median, high, _ = parameter.specimen
        panel.axhspan(low, high, color=style.BAND_COLORS["sensor"], zorder=0)
        panel.axhline(median, color=style.COLORS[0], lw=0.8, zorder=1)
    for x, name in enumerate(records, start=1):
        alone, shrunk = parameter.alone.get(name), parameter.shrunk.get(name)
        if alone is not None:
            panel.vlines(x, alone.lower, alone.upper, color=style.LEAD_IN_COLOR, lw=0.8)
        if shrunk is not None:
            color = style.COLORS[1] if shrunk.outlier else style.COLORS[0]
            panel.vlines(x + 0.25, shrunk.lower, shrunk.upper, color=color, lw=1.4)
            panel.plot(x + 0.25, shrunk.median, "o", color=color, ms=2.5)
        elif alone is not None:
            panel.plot(x, alone.median, ".", color=style.LEAD_IN_COLOR, ms=3)
