"""What a campaign came to: a row for each record, their population, and both as tables.

Everything here is a function of what the runs have left, so the tables are the same whenever and in
however many pieces the campaign was done.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bwbayes.population.population import Among, Population
from bwbayes.shown import brief

__all__ = ["CampaignResult", "Row", "summary", "table"]

# How a record ended, in the order in which they matter, and the exit status of each.
STATUSES = {
    "refused": 2,
    "not converged": 4,
    "validation failed": 3,
    "validation inconclusive": 5,
    "passed": 0,
}


@dataclass(frozen=True)
class Row:
    """One record of a campaign: how it ended, why, and its numbers.

    ``numbers`` are those of the run's ``summary.json``, empty for a record that was refused.
    """

    name: str
    file: str
    status: str
    reason: str
    numbers: Mapping[str, Any]

    @property
    def parameters(self) -> Mapping[str, Mapping[str, Any]]:
        """The parameters' means and intervals by name; none without convergence."""
        return self.numbers.get("parameters") or {}


@dataclass(frozen=True)
class CampaignResult:
    """All records of a campaign, and their population if there are enough of them.

    ``untold`` says why there is none.
    """

    __repr__ = brief

    rows: tuple[Row, ...]
    population: Population | None
    untold: str = ""

    @property
    def counts(self) -> dict[str, int]:
        """How many records ended in each way."""
        ended = Counter(row.status for row in self.rows)
        return {status: ended[status] for status in STATUSES}

    @property
    def exit_status(self) -> int:
        """The status of the command: 2 if records were refused, else 4, 3, 5 or 0 as of a run."""
        return next((s for name, s in STATUSES.items() if self.counts[name]), 0)

    @property
    def outliers(self) -> dict[str, list[str]]:
        """The parameters in which a record lies off the population, by record."""
        off: dict[str, list[str]] = {}
        for name, one in (self.population.parameters if self.population else {}).items():
            for record in one.outliers:
                off.setdefault(record, []).append(name)
        return off

    def among(self, record: str, parameter: str) -> Among | None:
        """Return what the population says of a record's parameter."""
        if self.population is None or parameter not in self.population.parameters:
            return None
        return self.population.parameters[parameter].specimens.get(record)


def summary(campaign: CampaignResult) -> dict[str, object]:
    """Return a campaign's numbers as ``campaign.json`` holds them."""
    told = campaign.population
    return {
        "counts": campaign.counts,
        "exit_status": campaign.exit_status,
        "records": {row.name: _numbers(campaign, row) for row in campaign.rows},
        "outliers": campaign.outliers,
        "population": None if told is None else told.summary(),
        "no_population_because": campaign.untold or None,
    }


def _numbers(campaign: CampaignResult, row: Row) -> dict[str, object]:
    kept = ("steps", "validation", "remarks", "data_sha256")
    known = {key: row.numbers.get(key) for key in kept}
    parameters = {}
    for name, one in row.parameters.items():
        parameters[name] = dict(one)
        among = campaign.among(row.name, name)
        if among is not None:
            parameters[name] |= {
                "shrunk_median": among.median,
                "shrunk_lower_95": among.lower,
                "shrunk_upper_95": among.upper,
                "off_population_p": among.p,
                "outlier": among.outlier,
                "pareto_k": among.pareto_k,
                "taken_for_normal": among.normal,
            }
    return {
        "file": row.file,
        "status": row.status,
        "reason": row.reason or None,
        "parameters": parameters or None,
    } | known


def table(campaign: CampaignResult) -> str:
    """Return the table as CSV: a line for each record, columns named ``QUANTITY_what_UNIT``."""
    units: dict[str, str] = {}
    for row in campaign.rows:
        units |= {name: one["unit"] for name, one in row.parameters.items()}
    off = campaign.outliers
    whats = ("mean", "sd", "lower_95", "upper_95")
    shrunk = ("shrunk_lower_95", "shrunk_upper_95")
    head = ["record", "file", "status", "reason", "outlier_in", "steps"]
    for name, unit in units.items():
        told = campaign.population is not None and name in campaign.population.parameters
        head += [f"{name}_{what}_{unit}" for what in (*whats, *(shrunk if told else ()))]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    for row in campaign.rows:
        line = [row.name, row.file, row.status, row.reason, " ".join(off.get(row.name, ()))]
        line.append(str(row.numbers.get("steps", "")))
        for name in units:
            one = row.parameters.get(name, {})
            line += [f"{one[what]:.7g}" if one else "" for what in whats]
            if campaign.population is not None and name in campaign.population.parameters:
                among = campaign.among(row.name, name)
                ends = (among.lower, among.upper) if among else ()
                line += [f"{end:.7g}" for end in ends] or ["", ""]
        writer.writerow(line)
    return text.getvalue()
