"""The page over all records of a campaign: how each ended, its parameters, and their population."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bwbayes.app.figures.style import unit_text
from bwbayes.app.report.page import Table, picture, template
from bwbayes.app.report.words import KINDS, digits, mark
from bwbayes.app.running.campaign_result import CampaignResult
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


NOTE = (
    "Medians, and 95 % intervals. A parameter above zero has a population that is normal in the "
    "logarithm: its middle is the median, its spread relative, in percent. Each parameter by "
    "itself. The records' own posteriors were reweighted; where Pareto k is above 0.7, or few "
    "draws count, a record's likelihood was taken for normal."
)


def render(name: str, campaign: CampaignResult, pictures: Mapping[str, bytes]) -> str:
    """Return the page of a campaign of that name, with PNG files by the name of their figure."""
    told = campaign.population
    ended = [KINDS.get(status, "bad") for status, count in campaign.counts.items() if count]
    return template("campaign.html.j2").render(
        name=name,
        counts=campaign.counts,
        total=len(campaign.rows),
        kind=min(ended, key=["bad", "note", "good"].index, default="good"),
        outliers=[
            (record, ", ".join(parameters)) for record, parameters in campaign.outliers.items()
        ],
        records=_records(campaign),
        short=Table(
            "short",
            "Records to look at",
            ("Record", "Status", "Why"),
            [(row.name, mark(row.status), row.reason) for row in campaign.rows if row.reason],
        ),
        untold=campaign.untold,
        population=_population([] if told is None else [*told.parameters.values()]),
        pictures=[picture(png, key, *CAPTIONS[key]) for key, png in pictures.items()],
    )


def _records(campaign: CampaignResult) -> Table:
    """Return a row for each record: its parameters by themselves."""
    units: dict[str, str] = {}
    for row in campaign.rows:
        units |= {key: unit_text(str(one["unit"])) for key, one in row.parameters.items()}
    rows, numbers = [], []
    for row in campaign.rows:
        texts = []
        flat: dict[str, object] = {"record": row.name, "status": row.status}
        for name in units:
            one = row.parameters.get(name)
            texts.append(_interval(one["lower_95"], one["upper_95"]) if one else "")
            flat |= {f"{name} {key}": one[key] for key in ("mean", "sd")} if one else {}
        rows.append((row.name, mark(row.status), *texts))
        numbers.append(flat)
    titles = (f"{name} ({unit})" if unit else name for name, unit in units.items())
    return Table(
        "records",
        "Records, 95 % intervals of each by itself",
        ("Record", "Status", *titles),
        rows,
        records=numbers,
        note="More is in campaign.csv and campaign.json; each record's own run is in records/.",
    )


def _population(spreads: list[Spread]) -> Table:
    rows = []
    for one in spreads:
        low, high = np.quantile(one.new, [0.025, 0.975])
        taken = sum(among.normal for among in one.specimens.values())
        rows.append(
            (
                one.name,
                unit_text(one.unit),
                _estimate(one.mean),
                _estimate(one.spread, percent=one.logarithmic),
                _interval(float(low), float(high)),
                f"{one.pareto_k:.2f}",
                f"{taken} of {len(one.specimens)}",
            )
        )
    titles = ("Parameter", "Unit", "Middle", "Spread", "A specimen not measured yet, 95 %")
    return Table(
        "population", "Population", (*titles, "Pareto k", "Taken for normal"), rows, note=NOTE
    )


def _estimate(draws: FloatArray, *, percent: bool = False) -> str:
    """Write a median and a 95 % interval; a relative spread in percent."""
    low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975]) * (100 if percent else 1)
    unit = " %" if percent else ""
    return f"{middle:.3g}{unit} ({_interval(float(low), float(high))})"


def _interval(low: float, high: float) -> str:
    return f"{digits(low, high - low)} to {digits(high, high - low)}"
