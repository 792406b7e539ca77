"""``bwbayes design``: what to measure next."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from bwbayes.app.commands.shared import (
    FILE,
    capacitance_option,
    conclude,
    current_option,
    overwrite_option,
    slew_option,
    voltage_option,
)

__all__ = ["design"]


@click.command()
@click.argument("folder", type=FILE)
@click.option("--parameter", help="The parameter to know better.")
@click.option("--drive", help="Or the drive whose band is to be narrow: a record or a signal.")
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
    parameter: str | None,
    drive: str | None,
    candidates: str,
    voltage: tuple[float, float] | None,
    slew: float | None,
    current: float | None,
    capacitance: float | None,
    out: Path | None,
    overwrite: bool,
) -> int:
    """Rank signals by what they would teach, from the run in FOLDER.

    What would be left of a parameter's standard deviation, or of a band's width along a drive,
    after one more record; the best signal within the amplifier's limits goes into best.csv.

    Example: bwbayes design results/ring_bender --parameter beta --slew 2000
    """
    from bwbayes.app.jobs.design import design as rank
    from bwbayes.app.running.folder import RunFolder

    rank(
        folder,
        out or folder / "design",
        Console(),
        candidates=candidates,
        parameter=parameter,
        drive=drive,
        voltage=voltage,
        slew=slew,
        current=current,
        capacitance=capacitance,
        overwrite=overwrite,
    )
    # The screen begins with it.
    return conclude(RunFolder.open(folder).standing(), say=False)
