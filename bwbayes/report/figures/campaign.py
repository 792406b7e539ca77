"""All records of a campaign side by side: each parameter's intervals, and their population."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bwbayes.arrays import FloatArray
from bwbayes.report.figures import style
from bwbayes.report.words import label_with_unit


def draw_parameters(
    records: Mapping[str, Mapping[str, Mapping[str, Any]]], new: Mapping[str, FloatArray]
) -> Figure:
    """Draw a panel for each parameter: the records' 95 % intervals in the order of their names.

    ``records`` are the records' estimates by parameter, as ``campaign.json`` has them, ``new`` the
    draws of a specimen not measured yet. Gray alone and blue with the population for a prior, the
    population's median and where 95 % of specimens not measured yet lie. Outliers are red.
    """
    units = {
        name: estimate["unit"]
        for estimates in records.values()
        for name, estimate in estimates.items()
    }
    figure, panels = style.panel_grid(len(units), 3, 2.6, "record")
    for panel, (name, unit) in zip(panels, units.items(), strict=True):
        if name in new:
            low, median, high = np.quantile(new[name], [0.025, 0.5, 0.975])
            panel.axhspan(low, high, color=style.BAND_COLORS["sensor"], zorder=0)
            panel.axhline(median, color=style.COLORS[0], lw=0.8, zorder=1)
        for x, estimates in enumerate(records.values(), start=1):
            estimate = estimates.get(name)
            if estimate is None:
                continue
            edges = estimate["lower_95"], estimate["upper_95"]
            panel.vlines(x, *edges, color=style.Color.LEAD_IN, lw=0.8)
            if "shrunk_median" in estimate:
                color = style.COLORS[1] if estimate["outlier"] else style.COLORS[0]
                edges = estimate["shrunk_lower_95"], estimate["shrunk_upper_95"]
                panel.vlines(x + 0.25, *edges, color=color, lw=1.4)
                panel.plot(x + 0.25, estimate["shrunk_median"], "o", color=color, ms=2.5)
            else:
                panel.plot(x, estimate["median"], ".", color=style.Color.LEAD_IN, ms=3)
        label = style.plain(label_with_unit(name, unit))
        panel.set(ylabel=label, xlim=(0, len(records) + 1))
        # The names of more records would overlap.
        if len(records) <= 24:
            names = [style.plain(record) for record in records]
            panel.set_xticks(range(1, len(records) + 1), names, rotation=90, fontsize=7)
    return figure
