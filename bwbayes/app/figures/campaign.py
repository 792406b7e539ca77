"""All records of a campaign side by side: each parameter's intervals, and their population."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bwbayes.app.figures.style import BAND_COLOURS, COLOURS, STYLE, hide_unused, plain, unit_text
from bwbayes.app.running.campaign_result import CampaignResult
from bwbayes.population.population import Spread

__all__ = ["draw_campaign"]

COLUMNS = 3
# Records up to which each has its name below it.
NAMED = 24

OWN_COLOUR = "#999999"


def draw_campaign(campaign: CampaignResult) -> dict[str, Figure]:
    """Draw the figure ``parameters``, if any record has converged.

    A panel for each parameter: the records' 95 % intervals in the order of their names, grey alone
    and blue with the population for a prior, the population's median and where 95 % of specimens
    not measured yet lie. Outliers are red.
    """
    rows = [row for row in campaign.rows if row.parameters]
    if not rows:
        return {}
    units: dict[str, str] = {}
    for row in rows:
        units |= {name: one["unit"] for name, one in row.parameters.items()}
    with mpl.rc_context(STYLE):
        lines = -(-len(units) // COLUMNS)
        figure = Figure(figsize=(11, 2.6 * lines + 0.4), layout="constrained")
        grid = figure.subplots(lines, COLUMNS, squeeze=False)
        panels = hide_unused(grid, len(units), "record")
        places = {row.name: place for place, row in enumerate(rows, start=1)}
        for panel, (name, unit) in zip(panels, units.items(), strict=True):
            told = campaign.population.parameters.get(name) if campaign.population else None
            if told is not None:
                _draw_population(panel, told)
            for row in rows:
                if name in row.parameters:
                    _draw_record(panel, places[row.name], row.parameters[name], told, row.name)
            text = unit_text(unit)
            panel.set_ylabel(plain(f"{name} ({text})" if text else name))
            panel.set_xlim(0, len(rows) + 1)
            if len(rows) <= NAMED:
                names = [plain(row.name) for row in rows]
                panel.set_xticks(list(places.values()), names, rotation=90, fontsize=7)
    return {"parameters": figure}


def _draw_population(panel: Axes, told: Spread) -> None:
    low, middle, high = np.quantile(told.new, [0.025, 0.5, 0.975])
    panel.axhspan(low, high, color=BAND_COLOURS["sensor"], zorder=0)
    panel.axhline(float(middle), color=COLOURS[0], lw=0.8, zorder=1)


def _draw_record(
    panel: Axes, place: int, one: Mapping[str, Any], told: Spread | None, name: str
) -> None:
    panel.vlines(place, one["lower_95"], one["upper_95"], color=OWN_COLOUR, lw=0.8)
    among = told.specimens.get(name) if told is not None else None
    if among is None:
        panel.plot(place, one["median"], ".", color=OWN_COLOUR, ms=3)
        return
    colour = COLOURS[1] if among.outlier else COLOURS[0]
    panel.vlines(place + 0.25, among.lower, among.upper, color=colour, lw=1.4)
    panel.plot(place + 0.25, among.median, "o", color=colour, ms=2.5)
