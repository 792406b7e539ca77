"""Pages of reports: one self-contained HTML file each, with one template for all of them.

The page holds the numbers of a table twice: rounded, for reading, and exactly, in the CSV behind
its button. A page runs no scripts except its own, and fetches nothing.
"""

from __future__ import annotations

import re
import struct
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from itertools import groupby
from operator import attrgetter
from typing import Any, NamedTuple
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from bwbayes.report.report import Report, Table


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
