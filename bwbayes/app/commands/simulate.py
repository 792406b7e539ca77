"""``bwbayes simulate``: a record of the virtual test stand."""

from __future__ import annotations

from pathlib import Path

import click

from bwbayes.app.commands.shared import FILE, overwrite_option
from bwbayes.app.config.limits import LARGEST_SEED
from bwbayes.errors import InputError

__all__ = ["simulate"]


@click.command()
@click.argument("out", type=FILE)
@click.option(
    "--signal",
    "waveform",
    default="identification",
    show_default=True,
    help="identification, verification, step10, step50, step100, or sine (see the next options).",
)
@click.option("--amplitude", type=float, help="Of the sine, V; default: 100.")
@click.option("--frequency", type=float, help="Of the sine, Hz; default: 1.")
@click.option("--duration", type=float, help="Of the sine, s; default: 16.")
@click.option(
    "--discrepancy",
    type=click.Choice(["none", "process", "structural"]),
    default="process",
    show_default=True,
    help="How the stand's actuator departs from the model.",
)
@click.option("--seed", type=click.IntRange(0, LARGEST_SEED), default=1, show_default=True)
@click.option("--rate", type=float, default=1000.0, show_default=True, help="Samples a second.")
@overwrite_option
def simulate(
    out: Path,
    waveform: str,
    amplitude: float | None,
    frequency: float | None,
    duration: float | None,
    discrepancy: str,
    seed: int,
    rate: float,
    overwrite: bool,
) -> int:
    """Write a record of the virtual test stand to OUT (.csv, .h5, .mat), its truth beside it.

    Example: bwbayes simulate ring.csv --signal verification --seed 7
    """
    from bwbayes.app.jobs.simulate import simulate as write

    sine_options = (amplitude, frequency, duration)
    if waveform != "sine" and any(value is not None for value in sine_options):
        raise InputError("simulate: amplitude, frequency and duration need --signal sine")
    first, second, third = (
        default if value is None else value
        for value, default in zip(sine_options, (100.0, 1.0, 16.0), strict=True)
    )
    sine = (first, second, third)
    for path in write(out, waveform, sine, discrepancy, seed, rate, overwrite=overwrite):
        click.echo(f"wrote {path}")
    return 0
