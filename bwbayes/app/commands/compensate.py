"""``bwbayes compensate``: the voltage for a displacement, with a promised error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from bwbayes.app.commands.shared import (
    FILE,
    capacitance_option,
    current_option,
    hold_option,
    overwrite_option,
    present,
    slew_option,
    voltage_option,
)
from bwbayes.errors import InputError

__all__ = ["compensate"]


@click.command()
@click.argument("folder", type=FILE)
@click.argument(
    "shape", required=False, type=click.Choice(["sine", "triangle", "staircase", "raster"])
)
@click.option(
    "--reference", type=FILE, help="A file with time and displacement, in place of SHAPE."
)
@click.option("--amplitude", type=float, help="Of the shape, um.")
@click.option("--frequency", type=float, help="Of the shape, or of a raster's lines, Hz.")
@click.option("--middle", type=float, help="Of the shape, um; default: 0.")
@click.option("--periods", type=float, help="Periods, or lines; default: 3.")
@click.option("--levels", type=int, help="Steps of a staircase to either end; default: 5.")
@click.option(
    "--interval", type=float, help="Sampling interval of a shape, s; default: the record's."
)
@click.option(
    "--smooth",
    "smoothed",
    type=float,
    help="Smooths the reference, s (SD); default: a shape's 0.01 periods.",
)
@click.option(
    "--command",
    type=click.Choice(["mean", "expected"]),
    default="mean",
    show_default=True,
    help="Inverse of the mean model, or least expected squared error.",
)
@hold_option
@click.option("--limit", type=float, help="Of the error, um; says how probably it is kept.")
@click.option("--from-rest", is_flag=True, help="The actuator starts demagnetized.")
@voltage_option
@slew_option
@current_option
@capacitance_option
@click.option("--nearest", is_flag=True, help="Where that does not suffice, come near.")
@click.option("--out", type=FILE, help="Where the files go; default: FOLDER/compensation/NAME.")
@overwrite_option
def compensate(
    folder: Path,
    shape: str | None,
    reference: Path | None,
    out: Path | None,
    overwrite: bool,
    **options: Any,
) -> int:
    """Write the voltage that makes a displacement, with the model of the run in FOLDER.

    The displacement is in a file, or one of the usual shapes. 0 um is where the actuator stands at
    zero volts as the command begins, so the default voltages are those fitted and 0 V. What the
    voltage will do is predicted with its error; beside it stands what a linear command would do.

    Example: bwbayes compensate results/ring_bender sine --amplitude 40 --frequency 1 --from-rest
    """
    from bwbayes.app.fit.opening import converged
    from bwbayes.app.jobs.compensate import compensate as invert

    if (shape is None) == (reference is None):
        raise InputError("compensate: give either a shape or --reference")
    command = invert(converged(folder), shape or reference, **options)
    where = out or folder / "compensation" / command.reference.name
    files = command.save(where, overwrite=overwrite)
    return present(command.report(), files, command.standing)
