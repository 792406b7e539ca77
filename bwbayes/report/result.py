"""A finished run in one object, and its summary in numbers.

Everything that is written or drawn after sampling comes from a :class:`Result`. If the sampling
has not converged, the result keeps the draws but contains no interval: no parameter table, no
bands, no scores.

Its files are page, pictures, posterior, bands and numbers. Each file is written under another name
and renamed when it is complete, so that a reader never sees half a file. A page is one
self-contained HTML file, which runs no scripts except its own, fetches nothing, and holds the
numbers of a table twice: rounded, for reading, and exactly, in the CSV behind its button.
"""

from __future__ import annotations

import json
import math
import re
import struct
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from hashlib import sha256
from itertools import batched, groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.consistency import Consistency
from bwbayes.diagnosis.identifiability import InformationGain
from bwbayes.diagnosis.innovations import Innovations, PredictiveChecks
from bwbayes.diagnosis.residual_analysis import Explanation
from bwbayes.diagnosis.rivals import DriveLock
from bwbayes.diagnosis.validation import BandValidation, ValidationSummary
from bwbayes.errors import InputError, Renamed, refuse_unwritable
from bwbayes.inference.parameters import Parameter
from bwbayes.prediction.bands import Bands, Scores
from bwbayes.prediction.budget import Budget
from bwbayes.prediction.loops import Loops, StepResponse
from bwbayes.quantities import DEFAULT, Quantities
from bwbayes.record.io.formats import draft_of
from bwbayes.record.record import Record
from bwbayes.report.figures import picture_of, save_pictures
from bwbayes.report.report import Picture, Report, Table
from bwbayes.sampling.diagnostics import SamplingResult
from bwbayes.shown import brief
from bwbayes.watching import Watch, counted, unwatched, watched


@dataclass(frozen=True)
class Result:
    """A finished run.

    Parameters
    ----------
    name, outcome
        The run's name, and the outcome of the sampling.
    parameters
        All parameters, fixed ones included.
    draws, log_density
        (steps, ensembles, walkers, free), parameters in their own units; (steps, ensembles,
        walkers), nats. Where a voltage has noise, or the instruments' scales are unsure, the draws
        are the chain's made wider; where the record does not rule out other models, some are moved
        to where those have them. The density is that of the chain's own.
    moves
        Numbers of proposals to a walker for these draws, and of acceptances, by kind of move.
    predictions, validation
        All predicted bands; the validation of those with readings, by the bands' names.
        They are empty unless converged, and so are all results below.
    innovations, drive_locks, consistency, explanations, posterior_checks
        By fitted record: the innovation of each reading at the most probable draw; the test whether
        the model's error follows the drive; for several records, its consistency with the others;
        explanations that may describe it better, the best first; its place among replicated
        records.
    loops, step_responses
        The loops of the actuator, measured, and its responses to the predicted steps by name.
    uncertainty_budgets
        Shares of the sources in the uncertainty of the main quantities.
    information_gain
        Information gained from the data: prior against posterior.
    facts
        Description of the run for people: one line each, by subject.
    remarks
        Notes for the user: warnings of the record, combinations that are not identifiable.
    truth
        The true parameters, of a simulated record.
    quantities
        Quantities of the records, in whose words the run is shown.
    """

    __repr__ = brief

    name: str
    outcome: SamplingResult
    parameters: tuple[Parameter, ...]
    draws: FloatArray
    log_density: FloatArray
    moves: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    predictions: tuple[Bands, ...] = ()
    validation: Mapping[str, BandValidation] = field(default_factory=dict)
    innovations: Mapping[str, Innovations] = field(default_factory=dict)
    drive_locks: Mapping[str, DriveLock] = field(default_factory=dict)
    loops: Loops | None = None
    step_responses: Mapping[str, StepResponse] = field(default_factory=dict)
    uncertainty_budgets: tuple[Budget, ...] = ()
    consistency: Mapping[str, Consistency] = field(default_factory=dict)
    explanations: Mapping[str, tuple[Explanation, ...]] = field(default_factory=dict)
    information_gain: InformationGain | None = None
    posterior_checks: Mapping[str, PredictiveChecks] = field(default_factory=dict)
    facts: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    truth: Mapping[str, float] = field(default_factory=dict)
    quantities: Quantities = DEFAULT

    # Earlier names
    agreement = Renamed("consistency")
    bands = Renamed("predictions")
    learned = Renamed("information_gain")
    replicated = Renamed("posterior_checks")
    steps = Renamed("step_responses")
    verdicts = Renamed("validation")

    @property
    def free(self) -> tuple[Parameter, ...]:
        """The sampled parameters, in the order of the draws."""
        return tuple(p for p in self.parameters if p.fixed is None)

    @property
    def flat_draws(self) -> FloatArray:
        """All draws, (draws, free)."""
        return self.draws.reshape(-1, self.draws.shape[-1])

    @property
    def scores(self) -> dict[str, Scores]:
        """Scores of the bands that have readings, by name."""
        return {b.name: b.scores for b in self.predictions if b.scores is not None}

    @property
    def looped(self) -> list[Bands]:
        """The bands that have a loop: a step has none."""
        return [bands for bands in self.predictions if bands.name not in self.step_responses]

    @property
    def standing(self) -> ValidationSummary:
        """Validation of all bands together."""
        return ValidationSummary.of(self.validation.values())

    @property
    def validation_numbers(self) -> dict[str, dict[str, Any]]:
        """Scores, validation and correction of all bands that have readings, by name."""
        numbers = {
            name: scores.numbers
            | (self.validation[name].summary if name in self.validation else {})
            for name, scores in self.scores.items()
        }
        for bands in self.predictions:
            if bands.correction is not None:
                numbers[bands.name]["correction"] = asdict(bands.correction)
        return numbers

    @cached_property
    def estimates(self) -> dict[str, dict[str, Any]]:
        """Mean, sd, quantiles, convergence and unit of each free parameter, by name."""
        flat, check = self.flat_draws, self.outcome.check
        lower, median, upper = np.quantile(flat, [0.025, 0.5, 0.975], axis=0)
        sd = np.std(flat, axis=0, ddof=1)
        columns = {
            "mean": np.mean(flat, axis=0),
            "sd": sd,
            "median": median,
            "lower_95": lower,
            "upper_95": upper,
            "ess_bulk": check.ess_bulk,
            "ess_tail": check.ess_tail,
            "rhat": check.rhat,
            "mcse_mean": sd / np.sqrt(check.ess_mean),
        }
        table: dict[str, dict[str, Any]] = {}
        for i, parameter in enumerate(self.free):
            row = {key: float(values[i]) for key, values in columns.items()}
            table[parameter.name] = row | {"unit": parameter.unit}
            if parameter.name in self.truth:
                table[parameter.name]["truth"] = self.truth[parameter.name]
        return table


def summary(result: Result) -> dict[str, object]:
    """Return a run's numbers as ``summary.json`` holds them.

    ``parameters``, ``validation``, ``innovations``, ``loops``, ``step_responses``,
    ``uncertainty_budget``, ``identifiability``, ``model_error``, ``replicated`` and
    ``explanations`` are None unless the sampling has converged; ``agreement`` is there for several
    records alone.
    """
    outcome, check = result.outcome, result.outcome.check
    numbers: dict[str, object] = {
        "converged": outcome.converged,
        "stop_reason": outcome.stop_reason,
        "steps": check.steps,
        "acceptance": check.acceptance,
        "sampling": {
            "proposals": {move: proposed for move, (proposed, _) in result.moves.items()},
            "acceptance": {
                move: accepted / proposed for move, (proposed, accepted) in result.moves.items()
            },
            "pareto_k": check.pareto_k,
        },
        "remarks": list(result.remarks),
    }
    if not outcome.converged:
        sections = (
            *("parameters", "validation", "validated_drives", "innovations", "loops"),
            *("step_responses", "uncertainty_budget", "identifiability", "model_error"),
            *("replicated", "explanations"),
        )
        return numbers | dict.fromkeys(sections)
    innovations: Mapping[str, object] = {n: s.numbers for n, s in result.innovations.items()}
    if len(innovations) == 1:
        # The innovations of a single record have no name above them.
        innovations = next(iter(result.innovations.values())).numbers
    if result.consistency:
        numbers["agreement"] = {n: record.numbers for n, record in result.consistency.items()}
    gain = result.information_gain
    return numbers | {
        "parameters": result.estimates,
        "validation": result.validation_numbers,
        # The validation is for these drives alone: on others the model's error has another size.
        "validated_drives": result.facts.get("drive") if result.standing.passed else None,
        "innovations": innovations or None,
        "loops": None if result.loops is None else result.loops.numbers,
        "step_responses": {name: step.numbers for name, step in result.step_responses.items()},
        "uncertainty_budget": [budget.numbers for budget in result.uncertainty_budgets],
        "identifiability": None if gain is None else gain.numbers,
        "model_error": {name: lock.numbers for name, lock in result.drive_locks.items()},
        "replicated": {n: checks.numbers for n, checks in result.posterior_checks.items()} or None,
        "explanations": {
            name: [explanation.numbers for explanation in explanations]
            for name, explanations in result.explanations.items()
        },
    }


def posterior_tree(
    result: Result, log_likelihood: FloatArray, records: Mapping[str, Record]
) -> Any:
    """Return the draws as arviz groups, an xarray.DataTree, and whether they have converged.

    The groups are posterior, sample_stats, log_likelihood (of all readings together, (steps,
    ensembles, walkers), nats), observed_data and constant_data. A chain is a walker; the
    coordinates ``ensemble`` and ``walker`` identify it. With several training records, variables
    and times have their record's name appended: ``displacement_loops``. The attribute ``converged``
    is 1 or 0: without convergence the draws are not from the posterior.
    """
    import xarray as xr  # noqa: PLC0415  # slow to load

    steps, ensembles, walkers, _ = result.draws.shape
    index = {
        "chain": np.arange(ensembles * walkers),
        "draw": np.arange(steps),
        "ensemble": ("chain", np.repeat(np.arange(ensembles), walkers)),
        "walker": ("chain", np.tile(np.arange(walkers), ensembles)),
    }

    def chains(values: FloatArray, unit: str = "") -> tuple[Any, ...]:
        by_walker = np.moveaxis(values, 0, 2).reshape(ensembles * walkers, steps)
        return ("chain", "draw"), by_walker, {"units": unit} if unit else {}

    converged = {"converged": int(result.outcome.converged)}
    say = result.quantities.say
    draws = {p.name: chains(result.draws[..., i], say(p.unit)) for i, p in enumerate(result.free)}
    measured: dict[str, Any] = {}
    driven: dict[str, Any] = {}
    for name, record in records.items():
        end = f"_{name}" if len(records) > 1 else ""
        time = xr.Variable(f"time{end}", record.time, {"units": record.quantities.clock.unit})
        output, driver = record.quantities.output, record.quantities.input
        for group, series, values, unit in (
            (measured, f"{output.name}{end}", record.displacement, output.unit),
            (driven, f"{driver.name}{end}", record.voltage, driver.unit),
        ):
            dims = [f"time{end}"]
            group[series] = xr.DataArray(
                np.asarray(values), {dims[0]: time}, dims, attrs={"units": unit}
            )
    tree = xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset(draws, index, converged),
            "sample_stats": xr.Dataset({"lp": chains(result.log_density)}, index),
            "log_likelihood": xr.Dataset({say("displacement"): chains(log_likelihood)}, index),
            "observed_data": xr.Dataset(measured),
            "constant_data": xr.Dataset(driven),
        }
    )
    tree.attrs |= converged
    return tree


def write_bands(
    path: Path,
    bands: Sequence[Bands],
    watch: Watch = unwatched,
    quantities: Quantities = DEFAULT,
) -> None:
    """Write bands as CSV; of several sets, a first column ``set`` names each.

    Columns that a set does not have are nan there. Every column has seven digits of its range,
    however far from zero it lies. ``watch`` is called with the share that is done.
    """
    more = counted(sum(predicted.time.size for predicted in bands), watch)
    with draft_of(path) as draft, draft.open("w", encoding="utf-8") as file:
        tables = [dict(predicted.columns()) for predicted in bands]
        names = [*dict.fromkeys(name for table in tables for name in table)]
        headings = [*map(quantities.heading, names)]
        if len(bands) > 1:
            headings.insert(0, "set")
        file.write(",".join(headings) + "\n")
        for predicted, table in zip(bands, tables, strict=True):
            missing = np.full(table["time_s"].size, np.nan)
            columns = [table.get(name, missing) for name in names]
            prefix = f"{predicted.name}," if len(bands) > 1 else ""
            formats = []
            for name, column in zip(names, columns, strict=True):
                values = column[np.isfinite(column)]
                span = float(np.ptp(values)) if values.size else 0.0
                ratio = float(np.max(np.abs(values))) / span if span > 0 else 1.0
                # A float has no more than 17 digits.
                extra = math.ceil(math.log10(min(max(ratio, 1.0), 1e10)))
                formats.append(f"%.{min((9 if name.endswith('time_s') else 7) + extra, 17)}g")
            row = f"{prefix}{','.join(formats)}\n"
            for rows in batched(zip(*columns, strict=True), 10_000):
                file.writelines(row % values for values in rows)
                more(len(rows))


def write_summary(path: Path, summary: Mapping[str, object]) -> None:
    """Write a summary as JSON; numbers that are not finite become null."""
    with draft_of(path) as draft:
        draft.write_text(json.dumps(_finite(summary), indent=2, allow_nan=False) + "\n")


def _finite(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def save(
    report: Report, folder: Path, name: str, *, pictures: str = "", watch: Watch = unwatched
) -> list[Path]:
    """Write a report's files to a folder, and return those named after it: JSON, CSV, page.

    The files are pictures as PNG, in a folder below it if ``pictures`` names one, ``NAME.html``,
    and ``NAME.csv`` and ``NAME.json`` if the report has them; the JSON comes last, as the sign that
    all files exist. ``watch`` is called with the share of the pictures that is drawn.

    Raises InputError if the folder cannot be written.
    """
    numbers, table, page = (folder / f"{name}.{kind}" for kind in ("json", "csv", "html"))
    with refuse_unwritable(folder, "choose another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        blocks = [block for block in report.all_blocks() if isinstance(block, Picture)]
        quantities = report.quantities
        drawn = {block.name: picture_of(block.draw, quantities) for block in watched(blocks, watch)}
        if drawn:
            save_pictures(drawn, folder / pictures)
        page.write_text(render(report, drawn), encoding="utf-8")
        report, files = report.said(), [page]
        if report.csv:
            files.insert(0, table)
            with draft_of(table) as draft:
                draft.write_text(report.csv, encoding="utf-8", newline="")
        if report.numbers:
            files.insert(0, numbers)
            write_summary(numbers, report.numbers)
    return files


def refuse_existing(files: Sequence[Path], *, overwrite: bool) -> None:
    """Refuse to replace a file, with an InputError, unless ``overwrite`` allows it."""
    for path in files:
        if path.exists() and not overwrite:
            raise InputError(f"{path}: exists; choose another name, or give `overwrite=True`")


class PagePlots(NamedTuple):
    """Interactive plots, JSON by the name of the picture that shows the same, and their scripts.

    ``bwbayes.report.figures.interactive`` makes both.
    """

    drawn: Mapping[str, Markup]
    scripts: Sequence[Markup]


NO_PLOTS = PagePlots({}, ())


def render(report: Report, pictures: Mapping[str, bytes], plots: PagePlots = NO_PLOTS) -> str:
    """Return a report's page, with pictures (PNG by name), which scripts replace by plots.

    A picture of the report without a PNG is left out.
    """
    is_plotted = any(name in plots.drawn for name in pictures)
    scripts = plots.scripts if is_plotted else ()
    return (
        _environment(pictures, plots)
        .get_template("page.html.j2")
        .render(report=report.said(), scripts=scripts)
    )


def fragment(report: Report) -> str:
    """Return a report as HTML for a notebook, with the parts that a screen shows."""
    return _environment({}, NO_PLOTS).get_template("notebook.html.j2").render(report=report.said())


def _environment(pictures: Mapping[str, bytes], plots: PagePlots) -> Environment:
    """Return the environment of the templates, which get pictures and plots by name."""
    # Matches the beginning of a cell with a number, or the sign for an unknown number.
    number = re.compile(r"[-+−±]?[\d.]|nan$|[-+]?inf$|–?$")
    environment = Environment(
        loader=PackageLoader("bwbayes.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"pictures": pictures, "plots": plots.drawn}
    filters: dict[str, Callable[..., Any]] = {
        "data_uri": lambda png: "data:image/png;base64," + b64encode(png).decode("ascii"),
        # Digest by which a Content-Security-Policy allows a script.
        "digest": lambda script: "sha256-" + b64encode(sha256(script.encode()).digest()).decode(),
        # Width and height of a picture, if it is complete.
        "pixels": lambda png: struct.unpack(">2I", png[16:24]) if len(png) > 24 else None,
        "csv_link": csv_link,
        # True for each column that holds words, which are aligned to the left.
        "is_wordy": lambda rows: [
            not all(map(number.match, column)) for column in zip(*rows, strict=True)
        ],
        # Titles above those of the columns except the first, with the number of columns of each.
        "spans": lambda columns: [
            (title, len(list(spanned)))
            for title, spanned in groupby(columns[1:], key=attrgetter("group"))
        ],
    }
    environment.filters |= filters
    return environment


def csv_link(table: Table) -> str:
    """Return a table as CSV, as a data URI."""
    import pandas as pd  # noqa: PLC0415  # slow to load

    if table.records:
        frame = pd.DataFrame(table.records)
    else:
        columns, rows = table.cells("page")
        titles, *texts = (
            [Markup(escape(text)).striptags() for text in row]
            for row in ([column.title for column in columns], *rows)
        )
        frame = pd.DataFrame(texts, columns=titles)
    return "data:text/csv;charset=utf-8," + quote(frame.to_csv(index=False))
