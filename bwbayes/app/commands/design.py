"""``bwbayes design``: what to measure next."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from bwbayes.app.commands.shared import (
    FILE,
    capacitance_option,
    current_option,
    overwrite_option,
    present,
    slew_option,
    voltage_option,
)
from bwbayes.errors import InputError

__all__ = ["design"]


@click.command()
@click.argument("folder", type=FILE)
@click.option("--parameter", help="The parameter to know better.")
@click.option(
    "--drive", type=FILE, help="Or the drive whose band is to be narrow: a record or a signal."
)
@click.option(
    "--candidates",
    default="standard",
    show_default=True,
    help="A TOML file with a table for each signal, or the preset.",
)
@voltage_option
@slew_option
@current_option
@capacitance_option
@click.option("--out", type=FILE, help="Where the best goes; default: FOLDER/design.")
@overwrite_option
def design(
    folder: Path,
    out: Path | None,
    parameter: str | None,
    drive: Path | None,
    overwrite: bool,
    **options: Any,
) -> int:
    """Rank signals by what they would teach, from the run in FOLDER.

    What would be left of a parameter's standard deviation, or of a band's width along a drive,
    after one more record; the best signal within the amplifier's limits goes into best.csv.

    Example: bwbayes design results/ring_bender --parameter beta --slew 2000
    """
    from bwbayes.app.fit.opening import converged
    from bwbayes.app.jobs.design import design as rank
    from bwbayes.data import Record, write_record
    from bwbayes.report.saving import refuse_existing, save

    target = parameter if drive is None else drive
    if target is None or (parameter is not None and drive is not None):
        raise InputError("design: give either a parameter or a drive")
    out = out or folder / "design"
    names = ("best.csv", "design.html", "design.json")
    refuse_existing([out / name for name in names], overwrite=overwrite)
    ranking = rank(converged(folder), target, **options)
    files = save(ranking.report(), out, "design")
    best = ranking.signals[ranking.best.name]
    write_record(Record(best, None, ranking.interval, voltage_is="command"), out / "best.csv")
    return present(ranking.report(), [out / "best.csv", *files], ranking.standing)
