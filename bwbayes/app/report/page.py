"""What every page is made of: a frame, tables that can be taken along as CSV, pictures, plots.

A page is one HTML file that needs nothing else. Its template extends ``base.html.j2`` and fills the
blocks that are explained there with the macros of ``parts.html.j2``; what goes in comes out
escaped. The numbers of a table come twice: rounded, to be read, and as they are, in the CSV behind
its button.
"""

from __future__ import annotations

import re
import struct
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import NamedTuple
from urllib.parse import quote

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup, escape

__all__ = ["PagePlots", "Picture", "Script", "Table", "picture", "template"]

# What a cell with a number begins with, or what stands for a number that is not known.
NUMBER = re.compile(r"[-+−±]?[\d.]|nan$|[-+]?inf$|–?$")

PNG_MARK = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Picture:
    """A picture with what is said below it.

    Parameters
    ----------
    name
        Names it within the page: ``#loop``.
    title, caption
        What it shows, in a few words and at length.
    alt
        What one would see, for those who do not.
    source
        The PNG file, as a data URI.
    width, height
        Pixels; 0 if not known.
    plot
        The same to zoom and hover: what ``bwbayes.app.figures.interactive`` returns, or nothing.
    """

    name: str
    title: str
    caption: str
    alt: str
    source: str
    width: int = 0
    height: int = 0
    plot: str = ""


def picture(
    png: bytes, name: str, title: str, caption: str, alt: str = "", plot: str = ""
) -> Picture:
    """Return a picture with its file inside; ``alt`` is the title if nothing else is given."""
    source = "data:image/png;base64," + b64encode(png).decode("ascii")
    known = png.startswith(PNG_MARK) and len(png) >= 24
    width, height = struct.unpack(">2I", png[16:24]) if known else (0, 0)
    return Picture(name, title, caption, alt or title, source, width, height, plot)


@dataclass(frozen=True)
class Script:
    """A script of the page, and the digest by which the page allows it and no other."""

    text: Markup

    @property
    def digest(self) -> str:
        """The SHA-256, as a Content-Security-Policy names it."""
        return "sha256-" + b64encode(sha256(self.text.encode()).digest()).decode("ascii")


class PagePlots(NamedTuple):
    """Plots to zoom and hover, JSON by the name of the picture that shows the same, and scripts.

    What makes either is ``bwbayes.app.figures.interactive``.
    """

    drawn: Mapping[str, Markup]
    scripts: Sequence[Script]


@dataclass(frozen=True)
class Table:
    """A table with a header for each row and column.

    Parameters
    ----------
    name
        Names it within the page, and its CSV.
    caption
        What it holds.
    titles
        One for each column.
    rows
        The texts of each row, its header first. A :class:`~markupsafe.Markup` is taken as HTML.
    groups
        Titles above those of the columns, each with how many columns it spans; the first column,
        which holds the headers, is not counted.
    records
        The rows of the CSV, by column: numbers as they are. By default the texts that are shown.
    note
        What is to be said below it.
    """

    name: str
    caption: str
    titles: Sequence[str]
    rows: Sequence[Sequence[str]]
    groups: Sequence[tuple[str, int]] = ()
    records: Sequence[Mapping[str, object]] = ()
    note: str = ""

    @property
    def wordy(self) -> list[bool]:
        """For each column, whether it holds words, which go to the left."""
        columns = zip(*self.rows, strict=True)
        return [not all(NUMBER.match(text) for text in column) for column in columns]

    @property
    def labels(self) -> list[str]:
        """For each column, its title, with that of its group."""
        first, *others = self.titles
        groups = [group for group, columns in self.groups for _ in range(columns)]
        return [
            first,
            *(
                f"{group}: {title}" if group else title
                for group, title in zip(groups or [""] * len(others), others, strict=True)
            ),
        ]

    @property
    def csv(self) -> str:
        """The table as CSV, as a data URI."""
        titles, *rows = (
            [Markup(escape(text)).striptags() for text in row] for row in (self.titles, *self.rows)
        )
        frame = pd.DataFrame(self.records) if self.records else pd.DataFrame(rows, columns=titles)
        return "data:text/csv;charset=utf-8," + quote(frame.to_csv(index=False))


def template(name: str) -> Template:
    """Return a template of the package; what it is filled with comes out escaped."""
    environment = Environment(
        loader=PackageLoader("bwbayes.app.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)
