"""Reports on a terminal of 80 columns, and as the text of an object at a prompt."""

from __future__ import annotations

from io import StringIO

from markupsafe import Markup
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as Grid

from bwbayes.report.report import Report, Table, Text


def show(report: Report, console: Console) -> None:
    """Show the banners of a report, and the tables and texts that are meant for a screen."""
    for banner in report.banners:
        if banner.on == "page":
            continue
        color = {"good": "green", "note": "yellow", "bad": "red"}[banner.kind]
        lines = [escape(_plain(line)) for line in banner.lines]
        headline = f"[bold {color}]{escape(_plain(banner.headline))}[/]"
        label = escape(banner.label) or headline
        if lines or not banner.items:
            lines = [": ".join([headline, *lines[:1]]), *lines[1:]]
        for line in [*lines, *(f"{label}: {escape(_plain(item))}" for item in banner.items)]:
            _say(line, console)
    for block in report.all_blocks():
        if isinstance(block, Table) and block.on != "page" and block.rows:
            columns, rows = block.cells("screen")
            grid = Grid(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
            for i, column in enumerate(columns):
                title = f"{column.group}: {column.title}" if column.group else column.title
                grid.add_column(escape(_plain(title)), no_wrap=i == 0)
            for row in rows:
                grid.add_row(*(escape(_plain(text)) for text in row))
            console.print(grid)
        elif isinstance(block, Text) and block.on != "page":
            _say(escape(_plain(block.text)), console)


def as_text(report: Report, width: int = 110) -> str:
    """Return a report as it is shown on a screen of so many columns."""
    text = StringIO()
    show(report, Console(file=text, width=width, force_jupyter=False, color_system=None))
    return text.getvalue().rstrip()


def _say(text: str, console: Console) -> None:
    console.print(text, highlight=False, soft_wrap=True)


def _plain(text: str) -> str:
    """Return a text in characters that every terminal has, without tags."""
    text = Markup(text).striptags() if isinstance(text, Markup) else text
    return text.replace("µ", "u").replace("–", "-")
