"""The files of a report: page, pictures, a CSV of its table and a JSON of its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bwbayes.errors import InputError
from bwbayes.report.figures import picture_of, save_pictures
from bwbayes.report.outputs import write_summary
from bwbayes.report.page import render
from bwbayes.report.report import Picture, Report

__all__ = ["draw_pictures", "refuse_existing", "save"]


def save(report: Report, folder: Path, name: str, *, pictures: str = "") -> list[Path]:
    """Write a report's files, and return those named after it: JSON, CSV, page.

    Parameters
    ----------
    report
        What is written: pictures as PNG, ``NAME.html``, ``NAME.csv`` and ``NAME.json`` if it has
        such; the JSON last, as the sign that all is there.
    folder
        Where to; it is made if need be.
    name
        Of the files.
    pictures
        The folder below it where the pictures go.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    numbers, table, page = (folder / f"{name}.{kind}" for kind in ("json", "csv", "html"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        drawn = draw_pictures(report)
        if drawn:
            save_pictures(drawn, folder / pictures)
        page.write_text(render(report, drawn), encoding="utf-8")
        if report.csv:
            draft = table.with_suffix(".partial")
            draft.write_text(report.csv, encoding="utf-8", newline="")
            draft.replace(table)
        if report.numbers:
            write_summary(numbers, report.numbers)
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}; choose another folder") from None
    return [*[numbers] * bool(report.numbers), *[table] * bool(report.csv), page]


def draw_pictures(report: Report) -> dict[str, bytes]:
    """Draw a report's pictures, PNG by name."""
    return {
        block.name: picture_of(block.draw)
        for block in report.all_blocks()
        if isinstance(block, Picture)
    }


def refuse_existing(files: Sequence[Path], *, overwrite: bool) -> None:
    """Refuse to replace a file, unless that is asked for.

    Raises
    ------
    InputError
        One of them exists.
    """
    for path in files:
        if path.exists() and not overwrite:
            raise InputError(f"{path}: exists; choose another name, or give `overwrite=True`")
