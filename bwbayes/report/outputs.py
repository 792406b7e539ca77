"""The files of a report and of a finished run: page, pictures, posterior, bands, numbers.

Each file is written under another name and renamed when it is complete, so that a reader never sees
half a file. A page is one self-contained HTML file, which runs no scripts except its own, fetches
nothing, and holds the numbers of a table twice: rounded, for reading, and exactly, in the CSV
behind its button.
"""

from __future__ import annotations

import json
import math
import re
import struct
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
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
from bwbayes.errors import InputError, refuse_unwritable
from bwbayes.prediction.bands import Bands
from bwbayes.quantities import DEFAULT, Quantities
from bwbayes.record.io.formats import draft_of
from bwbayes.record.record import Record
from bwbayes.report.figures import picture_of, save_pictures
from bwbayes.report.report import Picture, Report, Table
from bwbayes.report.result import Result
from bwbayes.watching import Watch, counted, unwatched, watched


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
        headings = [*["set"] * (len(bands) > 1), *map(quantities.heading, names)]
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
        report = report.said()
        if report.csv:
            with draft_of(table) as draft:
                draft.write_text(report.csv, encoding="utf-8", newline="")
        if report.numbers:
            write_summary(numbers, report.numbers)
    return [*[numbers] * bool(report.numbers), *[table] * bool(report.csv), page]


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
