"""``bwbayes compensate``: the voltage for a displacement, with a promised error."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from bwbayes.app.commands.shared import (
    FILE,
    capacitance_option,
    current_option,
    overwrite_option,
    slew_option,
    voltage_option,
)
from bwbayes.errors import InputError

if TYPE_CHECKING:
    from bwbayes.control.compensation import Choice
    from bwbayes.control.wished import Reference

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
@click.option("--middle", type=float, default=0.0, show_default=True, help="Of the shape, um.")
@click.option("--periods", type=float, default=3.0, show_default=True, help="Periods, or lines.")
@click.option(
    "--levels", type=int, default=5, show_default=True, help="Steps of a staircase to either end."
)
@click.option(
    "--smooth", type=float, help="Smooths the reference, s (sd); default: a shape's 0.01 periods."
)
@click.option(
    "--command",
    type=click.Choice(["mean", "expected"]),
    default="mean",
    show_default=True,
    help="Inverse of the mean model, or least expected squared error.",
)
@click.option("--limit", type=float, help="Of the error, um; says how probably it is kept.")
@click.option("--from-rest", is_flag=True, help="The actuator starts demagnetised at zero volts.")
@voltage_option
@slew_option
@current_option
@capacitance_option
@click.option("--nearest", is_flag=True, help="Where that does not suffice, come near.")
@click.option("--out", type=FILE, help="Where the files go; default: FOLDER/compensation/NAME.")
@overwrite_option
def compensate(
    folder: Path, shape: str | None, reference: Path | None, out: Path | None, **options: Any
) -> int:
    """Write the voltage that makes a displacement, with the model of the run in FOLDER.

    The displacement is in a file, or one of the usual shapes. What the voltage will do is predicted
    with its error; beside it stands what a linear command would do.

    Example: bwbayes compensate results/ring_bender sine --amplitude 40 --frequency 1 --from-rest
    """
    from bwbayes.app.jobs.at_work import drawn
    from bwbayes.app.jobs.compensate import compensate_draws, reference_of

    if (shape is None) == (reference is None):
        raise InputError("compensate: give either a shape or --reference")
    problem, flat = drawn(folder)
    interval = problem.record.interval
    if shape is None:
        asked = reference_of(reference, interval, options["smooth"])
    else:
        asked = _shaped(shape, interval, options)
    made = compensate_draws(
        problem,
        flat,
        asked,
        command=cast("Choice", options["command"]),
        from_rest=options["from_rest"],
        voltage=options["voltage"],
        slew=options["slew"],
        current=options["current"],
        capacitance=options["capacitance"],
        nearest=options["nearest"],
        limit=options["limit"],
    )
    files = made.save(out or folder / "compensation" / asked.name, overwrite=options["overwrite"])
    for remark in made.remarks:
        click.echo(f"bwbayes: {remark}", err=True)
    click.echo(repr(made))
    for path in files:
        click.echo(f"wrote {path}")
    return 0


def _shaped(shape: str, interval: float, options: dict[str, Any]) -> Reference:
    from bwbayes.control.wished import shaped

    for name in ("amplitude", "frequency"):
        if options[name] is None:
            raise InputError(f"compensate: a {shape} needs --{name}; give it")
    return shaped(
        shape,
        interval,
        options["amplitude"],
        options["frequency"],
        middle=options["middle"],
        periods=options["periods"],
        levels=options["levels"],
        smoothed=options["smooth"],
    )
