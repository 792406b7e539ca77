"""``bwbayes export``: the model of a run for a controller."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from bwbayes.app.commands.shared import FILE, conclude, hold_option, overwrite_option

__all__ = ["export"]


@click.command()
@click.argument("folder", type=FILE)
@click.option("--out", type=FILE, help="Where the files go; default: FOLDER/export.")
@click.option(
    "--voltage",
    type=(float, float),
    metavar="LOW HIGH",
    help="Lowest and highest voltage of the inverse, V; default: what was fitted, and 0 V.",
)
@click.option(
    "--rate", type=float, help="The controller's samples a second; default: the record's."
)
@hold_option
@overwrite_option
def export(folder: Path, out: Path | None, **options: Any) -> int:
    """Write the model of the run in FOLDER for a controller: JSON, and C with its inverse.

    It is the posterior's mean. The C file needs math.h alone and does a sample a call. 0 um is
    where the demagnetized actuator stands at zero volts.

    Example: bwbayes export results/ring_bender --rate 1000
    """
    from bwbayes.app.fit.opening import converged
    from bwbayes.app.jobs.export import FILES
    from bwbayes.app.jobs.export import export as write

    out = out or folder / "export"
    model = write(converged(folder), out, **options)
    status = conclude(model.standing)
    if model.without_inverse is not None:
        click.echo(f"bwbayes: no inverse in it: {model.without_inverse}", err=True)
    for name in FILES:
        click.echo(f"wrote {out / name}")
    return status
