"""The page over all records of a campaign: how each ended, its parameters, and their population."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bwbayes.app.figures.style import unit_text
from bwbayes.app.report.page import picture, template
from bwbayes.app.report.words import digits
from bwbayes.app.running.campaign_result import CampaignResult, Row
from bwbayes.arrays import FloatArray
from bwbayes.population.population import Spread

__all__ = ["render"]

CAPTIONS = {
    "parameters": (
        "Parameters side by side",
        "Median and 95 % interval of every record that has converged: grey, by itself; blue, with "
        "the population for a prior; red, if it lies off the population that all others show. "
        "Line and band: the population's middle, and where 95 % of specimens not measured yet lie.",
    ),
}


def render(name: str, campaign: CampaignResult, pictures: Mapping[str, bytes]) -> str:
    """Return the page of a campaign of that name, with PNG files by the name of their figure."""
    told = campaign.population
    units: dict[str, str] = {}
    for row in campaign.rows:
        units |= {key: str(one["unit"]) for key, one in row.parameters.items()}
    return template("campaign.html.j2").render(
        name=name,
        counts=campaign.counts,
        total=len(campaign.rows),
        well=campaign.exit_status == 0,
        outliers=[
            (record, ", ".join(parameters)) for record, parameters in campaign.outliers.items()
        ],
        units=[(key, unit_text(unit)) for key, unit in units.items()],
        rows=[_row(row, list(units)) for row in campaign.rows],
        short=[row for row in campaign.rows if row.reason],
        untold=campaign.untold,
        population=[] if told is None else [_spread(one) for one in told.parameters.values()],
        pictures=[picture(png, key, *CAPTIONS[key]) for key, png in pictures.items()],
    )


def _row(row: Row, names: list[str]) -> dict[str, Any]:
    texts = []
    for name in names:
        one = row.parameters.get(name)
        texts.append(_interval(one["lower_95"], one["upper_95"]) if one else "")
    return {"name": row.name, "status": row.status, "texts": texts}


def _spread(one: Spread) -> dict[str, Any]:
    low, high = np.quantile(one.new, [0.025, 0.975])
    taken = sum(among.normal for among in one.specimens.values())
    return {
        "name": one.name,
        "unit": unit_text(one.unit),
        "mean": _estimate(one.mean),
        "spread": _estimate(one.spread, percent=one.logarithmic),
        "new": _interval(float(low), float(high)),
        "shapes": f"{one.pareto_k:.2f}",
        "normal": f"{taken} of {len(one.specimens)}",
    }


def _estimate(draws: FloatArray, *, percent: bool = False) -> str:
    """Write a median and a 95 % interval; a relative spread in percent."""
    low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975]) * (100 if percent else 1)
    unit = " %" if percent else ""
    return f"{middle:.3g}{unit} ({_interval(float(low), float(high))})"


def _interval(low: float, high: float) -> str:
    return f"{digits(low, high - low)} to {digits(high, high - low)}"
