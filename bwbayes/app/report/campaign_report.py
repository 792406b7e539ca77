"""The page over all records of a campaign: how each ended, its parameters, and their population."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bwbayes.app.figures.style import unit_text
from bwbayes.app.report.page import Table, picture, template
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

NEW = "A specimen not measured yet, 95 %"


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
        records=_records(campaign.rows, units),
        short=Table(
            "short",
            "Records to look at",
            ("Record", "Status", "Why"),
            [(row.name, row.status, row.reason) for row in campaign.rows if row.reason],
        ),
        untold=campaign.untold,
        population=Table(
            "population",
            "Population",
            ("Parameter", "Unit", "Middle", "Spread", NEW, "Pareto k", "Taken for normal"),
            [] if told is None else [_spread(one) for one in told.parameters.values()],
        ),
        pictures=[picture(png, key, *CAPTIONS[key]) for key, png in pictures.items()],
    )


def _records(rows: Sequence[Row], units: Mapping[str, str]) -> Table:
    """Return the interval of each parameter of every record."""
    titles = [f"{name} ({unit_text(unit)})".replace(" ()", "") for name, unit in units.items()]
    texts = []
    for row in rows:
        known = [row.parameters.get(name) for name in units]
        intervals = [_interval(one["lower_95"], one["upper_95"]) if one else "" for one in known]
        texts.append((row.name, row.status, *intervals))
    return Table("records", "Records", ("Record", "Status", *titles), texts)


def _spread(one: Spread) -> tuple[str, ...]:
    low, high = np.quantile(one.new, [0.025, 0.975])
    taken = sum(among.normal for among in one.specimens.values())
    return (
        one.name,
        unit_text(one.unit),
        _estimate(one.mean),
        _estimate(one.spread, percent=one.logarithmic),
        _interval(float(low), float(high)),
        f"{one.pareto_k:.2f}",
        f"{taken} of {len(one.specimens)}",
    )


def _estimate(draws: FloatArray, *, percent: bool = False) -> str:
    """Write a median and a 95 % interval; a relative spread in percent."""
    low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975]) * (100 if percent else 1)
    unit = " %" if percent else ""
    return f"{middle:.3g}{unit} ({_interval(float(low), float(high))})"


def _interval(low: float, high: float) -> str:
    return f"{digits(low, high - low)} to {digits(high, high - low)}"
