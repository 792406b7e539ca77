"""A campaign: one posterior for each record of a folder, and what they say together.

:func:`start` makes the folder; :func:`resume` fits the records whose runs have not ended, side by
side and each as ``bwbayes run`` fits it, and writes table and page over all of them. One that
cannot be used comes back as a refusal of one line. A record's run depends on the config, the seed
and the record alone, and the tables on the runs alone. So pieces and workers do not matter, and
records that come later are fitted by themselves.
"""

from __future__ import annotations

import os
import shutil
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from rich.console import Console

from bwbayes.app.config.config import ALONE, dump, parse, read_toml, validated_config
from bwbayes.app.config.proposal import draft_config
from bwbayes.app.fit.fitted import Run, open_finished
from bwbayes.app.jobs.predict import Prediction, predict_another
from bwbayes.app.running.fingerprint import fingerprint
from bwbayes.app.running.folder import CampaignFolder, Origin, RunFolder
from bwbayes.app.running.progress import LastLine, StepProgress, batch
from bwbayes.app.running.run import resume as resume_run
from bwbayes.app.running.workers import one_thread
from bwbayes.app.study.from_config import open_like
from bwbayes.app.study.resolve import resolve_config, with_noise
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.errors import ExitStatus, InputError, InputWarning, one_line
from bwbayes.inference.study import InitialConditions, Validation, generator
from bwbayes.population.population import (
    FEWEST,
    Population,
    PopulationParameter,
    Specimen,
    next_specimen,
    population,
    specimen_of,
)
from bwbayes.record import Record
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.formats import SUFFIXES, read_named
from bwbayes.report.figures import draw_styled
from bwbayes.report.report import (
    STATUS_KINDS,
    Banner,
    Block,
    Figure,
    Kind,
    Picture,
    Product,
    Report,
    Section,
    Table,
    TableColumn,
    Text,
    digits,
    label_with_unit,
    mark,
    unit_text,
)
from bwbayes.report.result import save, write_summary
from bwbayes.shown import brief
from bwbayes.watching import WatchSteps, unwatched, watched

# How a record ended, in the order in which they matter, and the exit status of each.
STATUSES = {
    "refused": ExitStatus.INVALID_INPUT,
    "not converged": ExitStatus.NOT_CONVERGED,
    "validation failed": ExitStatus.VALIDATION_FAILED,
    "validation inconclusive": ExitStatus.VALIDATION_INCONCLUSIVE,
    "passed": ExitStatus.SUCCESS,
}


@dataclass(frozen=True)
class Row:
    """One record of a campaign: how it ended, why, and its numbers.

    ``numbers`` are those of the run's ``summary.json``, empty for a record that was refused.
    """

    __repr__ = brief

    name: str
    file: str
    status: str
    reason: str
    numbers: Mapping[str, Any]

    @classmethod
    def of(cls, folder: CampaignFolder, file: Path, refusal: str) -> Self:
        """Return the row of a record's file, which was refused, or whose run has ended."""
        if refusal:
            return cls(file.stem, file.name, "refused", refusal, {})
        numbers = RunFolder(folder.run(file.stem)).numbers()
        if not numbers["converged"]:
            reason = f"{numbers['stop_reason']}; resume with `{numbers['go_on']}`"
            return cls(file.stem, file.name, "not converged", reason, numbers)
        standing = ValidationSummary.read(numbers)
        status = standing.status if standing.passed else f"validation {standing.status}"
        return cls(file.stem, file.name, status, "; ".join(standing.lines), numbers)

    @property
    def parameters(self) -> Mapping[str, Mapping[str, Any]]:
        """The parameters' means and intervals by name; none without convergence."""
        return self.numbers.get("parameters") or {}


@dataclass(frozen=True, eq=False, repr=False)
class Campaign(Product):
    """Records that were fitted one by one, and what they say together.

    ``rows`` say how each record ended; ``together`` is their population, or why there is none.
    """

    NAME: ClassVar[str] = "campaign"

    folder: CampaignFolder
    rows: tuple[Row, ...]
    together: Population | str
    _scratch: object = field(default=None, repr=False)

    @classmethod
    def of(
        cls,
        folder: CampaignFolder,
        files: Sequence[Path],
        refused: Mapping[str, str],
        watch: WatchSteps = unwatched,
    ) -> Self:
        """Return what came of the records' files; ``refused`` says why, by the name of the file.

        ``watch`` is called with the name of a step and the share of it that is done.
        """
        rows = tuple(
            Row.of(folder, file, refused.get(file.name, ""))
            for file in watched(files, partial(watch, "results"))
        )
        names = [row.name for row in rows if row.parameters]
        specimens = [
            Specimen.load(name, folder.specimen(name))
            for name in watched(names, partial(watch, "draws"))
        ]
        if len(specimens) < FEWEST:
            return cls(folder, rows, f"a population needs {FEWEST} records or more")
        try:
            together = population(
                specimens, generator(1, "population"), partial(watch, "population")
            )
            return cls(folder, rows, together)
        except InputError as error:
            return cls(folder, rows, str(error))

    @property
    def population(self) -> Population:
        """Population mean and spread of each parameter, and every specimen among the others.

        Raises
        ------
        InputError
            There is none, and why.
        """
        if isinstance(self.together, str):
            raise InputError(f"campaign: no population: {self.together}")
        return self.together

    @property
    def counts(self) -> dict[str, int]:
        """How many records ended in each way."""
        counted = Counter(row.status for row in self.rows)
        return {status: counted[status] for status in STATUSES}

    @property
    def exit_status(self) -> ExitStatus:
        """The status of the command: 2 if records were refused, else 4, 3, 5 or 0 as of a run."""
        return next((s for name, s in STATUSES.items() if self.counts[name]), ExitStatus.SUCCESS)

    @property
    def outliers(self) -> dict[str, list[str]]:
        """The parameters in which a record lies off the population, by record."""
        off: dict[str, list[str]] = {}
        for name, spread in self._spreads.items():
            for record in spread.outliers:
                off.setdefault(record, []).append(name)
        return off

    @property
    def short(self) -> dict[str, str]:
        """Why records were refused, did not converge, or have bands that do not hold, by record."""
        return {row.name: f"{row.status}: {row.reason}" for row in self.rows if row.reason}

    @property
    def notes(self) -> list[str]:
        """Records that fell short, and outliers of the population, a line each."""
        notes = [f"{name}: {why}" for name, why in self.short.items()]
        return notes + [
            f"{n}: off the population in {', '.join(o)}" for n, o in self.outliers.items()
        ]

    @cached_property
    def table(self) -> Any:
        """A pandas.DataFrame with a row for each record: status, reason, means, intervals.

        It is what ``campaign.csv`` holds; the columns of numbers are ``QUANTITY_what_UNIT``.
        """
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        quantities = ("mean", "sd", "lower_95", "upper_95")
        lines = [
            {
                "record": row.name,
                "file": row.file,
                "status": row.status,
                "reason": row.reason,
                "outlier_in": " ".join(self.outliers.get(row.name, ())),
                "steps": row.numbers.get("steps"),
                **{
                    f"{name}_{key}_{unit}": self._estimates(row).get(name, {}).get(key)
                    for name, unit in self._units.items()
                    for key in (
                        *quantities,
                        *(f"shrunk_{edge}" for edge in quantities[2:] if name in self._spreads),
                    )
                },
            }
            for row in self.rows
        ]
        return pd.DataFrame(lines).astype({"steps": "Int64"}).set_index("record")

    def fit(self, name: str) -> Run:
        """Return the fit of one record.

        Raises
        ------
        InputError
            It has none.
        """
        return open_finished(RunFolder.open(self.folder.run(name)))

    def predict(
        self, record: Record | str | Path, *, from_rest: bool = False, lead_in: float | None = None
    ) -> Prediction:
        """Predict a specimen that was not measured, along a record or a planned voltage.

        Its parameters are drawn from the population; noise and offset are those of the campaign's
        first record that has converged. `from_rest` and `lead_in` are as in :meth:`Run.predict`.

        Raises
        ------
        InputError
            There is no population, or the record cannot be used.
        """
        first = self.fit(self.population.names[0])
        study = first.study
        if not isinstance(record, Record):
            read_as = next(iter(first.config.records.values())).read_as
            with first.quantities.spoken():
                record = read_named(*open_like(record, read_as), need_displacement=False)
        source = study.generator("next specimen")
        draws = next_specimen(self.population, study.posterior, first.flat_draws, source)
        start, like = InitialConditions(from_rest, True, lead_in), next(iter(study.records))
        other = Validation((), record, start, of=like)
        specimen = Run(first.folder).with_cache(
            config=first.config, study=study, flat_draws=draws, drive_locks=first.drive_locks
        )
        return predict_another(specimen, other, "next specimen")

    def plot(self) -> Figure:
        """Draw each parameter's intervals side by side, with the population.

        Raises
        ------
        InputError
            No record has converged.
        """
        if not self._units:
            raise InputError("campaign: no record has converged, so there is nothing to draw")
        return draw_styled(self._draw, quantities=self.quantities)

    def report(self) -> Report:
        """Return how the records of a campaign ended, and what they say together."""
        kinds: list[Kind] = [STATUS_KINDS.get(row.status, "bad") for row in self.rows]
        worst: Kind = min(kinds, key=["bad", "note", "good"].index, default="good")
        counts = ", ".join(f"{count} {status}" for status, count in self.counts.items() if count)
        outliers = [f"{record}: {', '.join(names)}" for record, names in self.outliers.items()]
        attention = [(row.name, mark(row.status), row.reason) for row in self.rows if row.reason]
        columns = ("Record", "Status", "Reason")
        picture = Picture(
            "parameters",
            "Parameters side by side",
            "Median and 95% interval of every record that has converged: gray, by itself; blue, "
            "with the population for a prior; red, if it lies off the population that all others "
            "show. Line and band: the population's middle, and where 95% of specimens not "
            "measured yet lie.",
            self._draw,
        )
        population: Block = Text(f"No population: {self.together}.", on="both")
        if self._spreads:
            population = self._population_table()
        name = self.folder.path.name
        banners = [Banner(worst, f"{len(self.rows)} records", [counts])]
        if outliers:
            headline = "Off the population, and without weight in it"
            banners.append(Banner("note", headline, items=outliers))
        blocks = [population]
        if attention:
            blocks.insert(0, Table("short", "Records to look at", columns, attention, on="both"))
        if self._units:
            blocks.append(picture)
        return Report(
            title=f"{name}, campaign",
            heading=f"Campaign: {name}",
            banners=banners,
            blocks=[*blocks, Section("Records", [self._records_table()])],
            numbers=self._numbers(),
            csv=self.table.to_csv(float_format="%.7g", lineterminator="\n"),
        )

    @property
    def _spreads(self) -> Mapping[str, PopulationParameter]:
        return {} if isinstance(self.together, str) else self.together.parameters

    @property
    def _units(self) -> dict[str, str]:
        return {name: str(e["unit"]) for row in self.rows for name, e in row.parameters.items()}

    def _estimates(self, row: Row) -> dict[str, dict[str, Any]]:
        """Return a record's estimates by parameter: by itself, and what the population says."""
        estimates = {name: dict(estimate) for name, estimate in row.parameters.items()}
        for name in estimates.keys() & self._spreads.keys():
            among = self._spreads[name].specimens.get(row.name)
            if among is not None:
                estimates[name] |= {
                    "shrunk_median": among.median,
                    "shrunk_lower_95": among.lower,
                    "shrunk_upper_95": among.upper,
                    "off_population_p": among.p,
                    "outlier": among.outlier,
                    "pareto_k": among.pareto_k,
                    "taken_for_normal": among.normal,
                }
        return estimates

    def _numbers(self) -> dict[str, object]:
        """Return a campaign's numbers as ``campaign.json`` holds them."""
        copied = ("steps", "validation", "remarks", "data_sha256")
        records = {
            row.name: {
                "file": row.file,
                "status": row.status,
                "reason": row.reason or None,
                "parameters": self._estimates(row) or None,
                **{key: row.numbers.get(key) for key in copied},
            }
            for row in self.rows
        }
        alone = isinstance(self.together, str)
        return {
            "counts": self.counts,
            "exit_status": self.exit_status,
            "records": records,
            "outliers": self.outliers,
            "population": None if alone else self.population.summary(),
            "no_population_because": self.together if alone else None,
        }

    def _draw(self) -> Figure:
        from bwbayes.report.figures.products import draw_parameters  # noqa: PLC0415  # slow to load

        estimates = {row.name: self._estimates(row) for row in self.rows if row.parameters}
        return draw_parameters(estimates, {name: s.new for name, s in self._spreads.items()})

    def _records_table(self) -> Table:
        """Return a row for each record: its parameters by themselves."""
        rows = []
        for row in self.rows:
            estimates = [row.parameters.get(name) for name in self._units]
            intervals = [_range(e["lower_95"], e["upper_95"]) if e else "" for e in estimates]
            rows.append([row.name, mark(row.status), *intervals])
        labels = [label_with_unit(name, unit) for name, unit in self._units.items()]
        return Table(
            "records",
            "Records, 95% intervals of each by itself",
            ["Record", "Status", *labels],
            rows,
            records=self.table.reset_index().to_dict("records"),
            note="More is in campaign.json; each record's own run is in records/.",
        )

    def _population_table(self) -> Table:
        def normal(spread: PopulationParameter) -> str:
            count = sum(among.normal for among in spread.specimens.values())
            return f"{count} of {len(spread.specimens)}"

        columns = (
            TableColumn("Parameter", text=lambda spread: spread.name),
            TableColumn("Unit", text=lambda spread: unit_text(spread.unit)),
            TableColumn("Middle", text=lambda spread: _estimate(spread.mean)),
            TableColumn("Spread", text=lambda s: _estimate(s.spread, percent=s.logarithmic)),
            TableColumn(
                "A specimen not measured yet, 95%",
                text=lambda spread: _range(*np.quantile(spread.new, [0.025, 0.975])),
            ),
            TableColumn("Outliers", on="screen", text=lambda spread: ", ".join(spread.outliers)),
            TableColumn("Pareto k", on="page", text=lambda spread: f"{spread.pareto_k:.2f}"),
            TableColumn("Taken for normal", on="page", text=normal),
        )
        return Table.of(
            "population",
            "Population",
            self._spreads.values(),
            columns,
            note="Medians, and 95% intervals. A parameter above zero has a population that is "
            "normal in the logarithm: its middle is the median, its spread relative, in percent. "
            "Each parameter by itself. The records' own posteriors were reweighted; where Pareto k "
            "is above 0.7, or few draws count, a record's likelihood was taken for normal.",
            on="both",
        )


def config_text(path: Path) -> str:
    """Return the config of all records as TOML, every default explicit; it need name no record."""
    table = read_toml(path)
    record = table.setdefault("record", {})
    if isinstance(record, dict) and not {"file", "signal"} & set(record):
        record["file"] = "each"
    return dump(validated_config(table, str(path)))


def records_in(folder: Path) -> list[Path]:
    """Return the files of a folder that may be records, by name.

    Hidden ones do not count, nor does the truth (``NAME.truth.csv``) beside a simulated record.

    Raises InputError: no such folder, or no such file in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; give the one that the records are in")
    files = [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in SUFFIXES
        and not path.name.startswith(".")
        and not path.stem.endswith(".truth")
    ]
    if not files:
        raise InputError(f"{folder}: has no record; records end in {', '.join(SUFFIXES)}")
    return files


def start(
    records: Path,
    config: str,
    where: Path,
    out: Path,
    *,
    pictures: bool = True,
    overwrite: bool = False,
    reading: Mapping[str, Any] | None = None,
) -> CampaignFolder:
    """Make the folder ``out`` of a campaign, or open the same one that was begun.

    ``config`` is that of all ``records``, as TOML, its files relative to the folder ``where``;
    empty lets each record propose its own, read as ``reading`` says, keyword arguments of
    ``read_record``. With ``pictures`` every run has figures and report.

    Raises InputError: no records, or a folder of something else.
    """
    records_in(records)
    stated = {key: value for key, value in (reading or {}).items() if value not in (None, {})}
    Naming.stated(**stated)  # what cannot be is refused before any record is
    origin = Origin(str(records.absolute()), str(where.absolute()), pictures, stated)
    return CampaignFolder.create(out, config, origin, overwrite=overwrite)


def resume(
    folder: CampaignFolder,
    console: Console,
    *,
    workers: int | None = None,
    executor: str | Executor | None = None,
) -> Campaign:
    """Fit the records that are missing, and write table and page over all; options as Python's.

    Raises InputError: the folder's files do not fit together, or another process is writing them.
    """
    with folder.locked(), one_thread():
        files = records_in(Path(folder.origin().records))
        stems = Counter(file.stem.lower() for file in files)
        refused = {
            file.name: f"{file}: shares its name with another record; rename one of them"
            for file in files
            if stems[file.stem.lower()] > 1
        }
        fitted = [file for file in files if file.name not in refused]
        anywhere = CampaignFolder(folder.path.absolute())
        tasks = [(file, anywhere) for file in fitted if not folder.is_done(file)]
        folder.summary.unlink(missing_ok=True)
        for file, status, reason in batch(
            fit_record,
            tasks,
            lambda outcome: outcome[1],
            console=console,
            kind="record",
            done=len(fitted) - len(tasks),
            short={"not converged": 0, "refused": 0},
            workers=workers,
            executor=executor,
            doing=folder.first_progress,
        ):
            if status == "refused":
                refused[file.name] = reason
        with StepProgress(console, "combining the records ...") as watch:
            campaign = Campaign.of(folder, files, refused, watch).said_in(folder.quantities())
            # Nothing in its files depends on when or how it was computed.
            figures = partial(watch, "figures")
            save(campaign.full_report(), folder.path, "campaign", pictures="figures", watch=figures)
    return campaign


def fit_record(file: Path, campaign: CampaignFolder) -> tuple[Path, str, str]:
    """Fit a record of a campaign to its end, from wherever its run stands.

    A run of an earlier form of the record or config is replaced. Figures, report and bands are
    written if the campaign has pictures. Returns the file, "refused", "not converged" or "", and
    why it was refused.
    """
    origin = campaign.origin()
    console = LastLine(campaign.progress(file.stem))
    with warnings.catch_warnings():
        # They are the run's remarks, and a hundred records of one kind say the same.
        warnings.simplefilter("ignore", InputWarning)
        try:
            digests = campaign.digests(file)
            begun, files = _begun_run(file, campaign), origin.pictures
            fit = resume_run(begun.folder, console, workers=1, files=files, run=begun)
            if not origin.pictures:
                write_summary(fit.folder.summary, fit.numbers)
            if fit.converged:
                source = fit.study.generator("specimen")
                instruments = fit.study.record.instruments
                specimen = specimen_of(
                    file.stem, fit.study.posterior, fit.flat_draws, source, instruments
                )
                specimen.save(campaign.specimen(file.stem))
            campaign.mark_done(file.stem, digests)
            return file, "" if fit.converged else "not converged", ""
        except InputError as error:
            # The name of a file in the folder of the records is enough.
            return file, "refused", str(error).replace(f"{file.parent}{os.sep}", "")
        # One record must not end the others, whatever is wrong with it.
        except Exception as error:
            return file, "refused", one_line(f"{type(error).__name__}: {error}")
        finally:
            with suppress(OSError):
                console.path.unlink(missing_ok=True)


def _begun_run(file: Path, campaign: CampaignFolder) -> Run:
    """Return a record's run as it stands, if it is of this record and config; a new one if not."""
    origin = campaign.origin()
    where = Path(origin.where)
    if text := campaign.config.read_text(encoding="utf-8"):
        config, in_memory = parse(text, "campaign.toml").with_record(file), {}
    else:
        proposal = draft_config(file, where, Naming.stated(**origin.reading))
        if proposal.blocking_issue is not None:
            raise InputError(f"{file}: {proposal.blocking_issue.error}")
        config, in_memory = proposal.config, {ALONE: proposal.record}
    # All have the same model.
    config = config.with_search("none").model_copy(update={"name": file.stem})
    run = resolve_config(config, where, in_memory)
    path = campaign.run(file.stem)
    if path.exists():
        try:
            # A target or budget that was changed by `bwbayes resume` is kept.
            existing = Run(RunFolder.open(path))
            expected = with_noise(run, existing.config.model.noise)
            same_posterior = fingerprint(existing) == fingerprint(expected)
            if same_posterior and existing.study.digests == run.study.digests:
                return existing
        except (InputError, OSError):
            pass  # half a folder, or one of an earlier version
        shutil.rmtree(path, ignore_errors=True)
    return run.with_cache(folder=RunFolder.create(path, run))


def _estimate(draws: FloatArray, *, percent: bool = False) -> str:
    """Write a median and a 95% interval; a relative spread in percent."""
    low, median, high = np.quantile(draws, [0.025, 0.5, 0.975]) * (100 if percent else 1)
    return f"{median:.3g}{'%' if percent else ''} ({_range(low, high)})"


def _range(low: float, high: float) -> str:
    return f"{digits(low, high - low)} to {digits(high, high - low)}"
