"""What a campaign came to: a row for each record, their population, and both as tables.

Everything here is a function of what the runs have left, so the tables are the same whenever and in
however many pieces the campaign was done.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.population.population import Population, PopulationParameter, SpecimenEstimate
from bwbayes.report.report import (
    Banner,
    Block,
    Figure,
    Kind,
    Picture,
    Report,
    Section,
    Table,
    TableColumn,
    Text,
)
from bwbayes.report.words import STATUS_KINDS, digits, label_with_unit, mark, unit_text
from bwbayes.shown import brief

__all__ = ["CampaignResult", "Row"]

QUANTILES, EDGES = (0.025, 0.5, 0.975), ("lower_95", "median", "upper_95")

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
        counted = Counter(row.status for row in self.rows)
        return {status: counted[status] for status in STATUSES}

    @property
    def exit_status(self) -> int:
        """The status of the command: 2 if records were refused, else 4, 3, 5 or 0 as of a run."""
        return next((s for name, s in STATUSES.items() if self.counts[name]), 0)

    @property
    def outliers(self) -> dict[str, list[str]]:
        """The parameters in which a record lies off the population, by record."""
        off: dict[str, list[str]] = {}
        for name, spread in (self.population.parameters if self.population else {}).items():
            for record in spread.outliers:
                off.setdefault(record, []).append(name)
        return off

    def among(self, record: str, parameter: str) -> SpecimenEstimate | None:
        """Return what the population says of a record's parameter."""
        if self.population is None or parameter not in self.population.parameters:
            return None
        return self.population.parameters[parameter].specimens.get(record)

    @property
    def units(self) -> dict[str, str]:
        """The units of all parameters, by name."""
        units: dict[str, str] = {}
        for row in self.rows:
            units |= {name: str(numbers["unit"]) for name, numbers in row.parameters.items()}
        return units

    def draw(self) -> Figure:
        """Draw each parameter's intervals side by side, with the population."""
        from bwbayes.report.figures.campaign import (  # noqa: PLC0415  # slow to load
            Interval,
            ParameterPanel,
            draw_parameters,
        )

        records = [row for row in self.rows if row.parameters]
        panels = []
        for name, unit in self.units.items():
            spread = self.population.parameters.get(name) if self.population else None
            specimens = {} if spread is None else spread.specimens
            panels.append(
                ParameterPanel(
                    label_with_unit(name, unit),
                    {
                        row.name: Interval(
                            *(
                                row.parameters[name][key]
                                for key in ("lower_95", "median", "upper_95")
                            )
                        )
                        for row in records
                        if name in row.parameters
                    },
                    {
                        record: Interval(among.lower, among.median, among.upper, among.outlier)
                        for record, among in specimens.items()
                    },
                    None if spread is None else Interval(*np.quantile(spread.new, QUANTILES)),
                )
            )
        return draw_parameters([row.name for row in records], panels)

    def report(self, name: str) -> Report:
        """Return how the records of a campaign of that name ended, and what they say together."""
        kinds: list[Kind] = [
            STATUS_KINDS.get(status, "bad") for status, n in self.counts.items() if n
        ]
        worst: Kind = min(kinds, key=["bad", "note", "good"].index, default="good")
        counts = [f"{count} {status}" for status, count in self.counts.items() if count]
        outliers = [f"{record}: {', '.join(names)}" for record, names in self.outliers.items()]
        attention = [(row.name, mark(row.status), row.reason) for row in self.rows if row.reason]
        picture = Picture(
            "parameters",
            "Parameters side by side",
            "Median and 95 % interval of every record that has converged: gray, by itself; blue, "
            "with the population for a prior; red, if it lies off the population that all others "
            "show. Line and band: the population's middle, and where 95 % of specimens not "
            "measured yet lie.",
            self.draw,
        )
        if self.population is None:
            population: Block = Text(f"No population: {self.untold}.", on="both")
        else:
            population = _population_table([*self.population.parameters.values()])
        columns = ("Record", "Status", "Reason")
        return Report(
            title=f"{name}, campaign",
            heading=f"Campaign: {name}",
            banners=[
                Banner(worst, f"{len(self.rows)} records", [", ".join(counts)]),
                *[Banner("note", "Off the population", items=outliers)] * bool(outliers),
            ],
            blocks=[
                *[Table("short", "Records to look at", columns, attention)] * bool(attention),
                population,
                *[picture] * bool(self.units),
                Section("Records", [self._records_table()]),
            ],
            numbers=self.summary(),
            csv=self.table(),
        )

    def _records_table(self) -> Table:
        """Return a row for each record: its parameters by themselves."""
        rows, numbers = [], []
        for row in self.rows:
            texts = []
            flat: dict[str, object] = {"record": row.name, "status": row.status}
            for name in self.units:
                estimate = row.parameters.get(name)
                if estimate is None:
                    texts.append("")
                    continue
                texts.append(_interval(estimate["lower_95"], estimate["upper_95"]))
                flat |= {f"{name} {key}": estimate[key] for key in ("mean", "sd")}
            rows.append((row.name, mark(row.status), *texts))
            numbers.append(flat)
        return Table(
            "records",
            "Records, 95 % intervals of each by itself",
            ("Record", "Status", *(label_with_unit(*item) for item in self.units.items())),
            rows,
            records=numbers,
            note="More is in campaign.csv and campaign.json; each record's own run is in records/.",
        )

    def summary(self) -> dict[str, object]:
        """Return a campaign's numbers as ``campaign.json`` holds them."""
        return {
            "counts": self.counts,
            "exit_status": self.exit_status,
            "records": {row.name: self._numbers(row) for row in self.rows},
            "outliers": self.outliers,
            "population": None if self.population is None else self.population.summary(),
            "no_population_because": self.untold or None,
        }

    def _numbers(self, row: Row) -> dict[str, object]:
        parameters = {}
        for name, estimate in row.parameters.items():
            parameters[name] = dict(estimate)
            among = self.among(row.name, name)
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
        copied = ("steps", "validation", "remarks", "data_sha256")
        return {
            "file": row.file,
            "status": row.status,
            "reason": row.reason or None,
            "parameters": parameters or None,
        } | {key: row.numbers.get(key) for key in copied}

    def table(self) -> str:
        """Return the table as CSV: a line for each record, columns ``QUANTITY_what_UNIT``."""
        import pandas as pd  # noqa: PLC0415  # slow to load

        outliers = self.outliers
        pooled = {} if self.population is None else self.population.parameters
        flat = []
        for row in self.rows:
            line: dict[str, object] = {
                "record": row.name,
                "file": row.file,
                "status": row.status,
                "reason": row.reason,
                "outlier_in": " ".join(outliers.get(row.name, ())),
                "steps": str(row.numbers.get("steps", "")),
            }
            for name, unit in self.units.items():
                estimate, among = row.parameters.get(name, {}), self.among(row.name, name)
                for statistic in ("mean", "sd", "lower_95", "upper_95"):
                    line[f"{name}_{statistic}_{unit}"] = (
                        f"{estimate[statistic]:.7g}" if estimate else ""
                    )
                for statistic in ("lower", "upper") if name in pooled else ():
                    edge = "" if among is None else f"{getattr(among, statistic):.7g}"
                    line[f"{name}_shrunk_{statistic}_95_{unit}"] = edge
            flat.append(line)
        text: str = pd.DataFrame(flat).to_csv(index=False, lineterminator="\n")
        return text


def _population_table(spreads: Sequence[PopulationParameter]) -> Table:
    rows = []
    for spread in spreads:
        low, high = np.quantile(spread.new, [0.025, 0.975])
        normal = sum(among.normal for among in spread.specimens.values())
        rows.append(
            (
                spread.name,
                unit_text(spread.unit),
                _estimate(spread.mean),
                _estimate(spread.spread, percent=spread.logarithmic),
                _interval(float(low), float(high)),
                ", ".join(spread.outliers),
                f"{spread.pareto_k:.2f}",
                f"{normal} of {len(spread.specimens)}",
            )
        )
    return Table(
        "population",
        "Population",
        (
            "Parameter",
            "Unit",
            "Middle",
            "Spread",
            "A specimen not measured yet, 95 %",
            TableColumn("Outliers", on="screen"),
            TableColumn("Pareto k", on="page"),
            TableColumn("Taken for normal", on="page"),
        ),
        rows,
        note="Medians, and 95 % intervals. A parameter above zero has a population that is normal "
        "in the logarithm: its middle is the median, its spread relative, in percent. Each "
        "parameter by itself. The records' own posteriors were reweighted; where Pareto k is above "
        "0.7, or few draws count, a record's likelihood was taken for normal.",
        on="both",
    )


def _estimate(draws: FloatArray, *, percent: bool = False) -> str:
    """Write a median and a 95 % interval; a relative spread in percent."""
    low, median, high = np.quantile(draws, QUANTILES) * (100 if percent else 1)
    unit = " %" if percent else ""
    return f"{median:.3g}{unit} ({_interval(float(low), float(high))})"


def _interval(low: float, high: float) -> str:
    return f"{digits(low, high - low)} to {digits(high, high - low)}"
