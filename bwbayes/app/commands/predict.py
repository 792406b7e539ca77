"""``bwbayes predict``: displacement bands for another record or voltage."""

from __future__ import annotations

import math
from pathlib import Path

import click
from rich.console import Console

from bwbayes.app.commands.shared import FILE, NamingOptions, naming_options, overwrite_option
from bwbayes.errors import InputError

__all__ = ["predict"]


@click.command()
@click.argument("folder", type=FILE)
@click.option("--record", type=FILE, help="A record to predict; measured or a voltage alone.")
@naming_options
@click.option("--signal", "waveform", help="A signal to predict instead, by its name.")
@click.option("--from-rest", is_flag=True, help="The record starts from a demagnetised actuator.")
@click.option(
    "--lead-in",
    type=float,
    help="Length of the lead-in, s, that estimates initial state and offset; default: a quarter of "
    "the record, and ten correlation times of the discrepancy at most.",
)
@click.option(
    "--lead-in-from", type=float, help="Where the lead-in begins, s; default: the record's start."
)
@click.option(
    "--window", type=(float, float), help="Judge and write this part alone: start and stop, s."
)
@click.option("--same-offset", is_flag=True, help="The sensor's offset is the training record's.")
@click.option(
    "--after",
    is_flag=True,
    help="A forecast: go on from where the lead-in's readings leave the discrepancy, or with "
    "--signal from the end of the training record.",
)
@click.option("--of", "training", help="Of several training records, the one that is meant.")
@click.option("--out", type=FILE, help="The bands' CSV; default: FOLDER/predictions/NAME.csv.")
@overwrite_option
def predict(
    folder: Path,
    record: Path | None,
    naming: NamingOptions,
    waveform: str | None,
    from_rest: bool,
    lead_in: float | None,
    lead_in_from: float | None,
    window: tuple[float, float] | None,
    same_offset: bool,
    after: bool,
    training: str | None,
    out: Path | None,
    overwrite: bool,
) -> int:
    """Write displacement bands for another record or voltage, from the run in FOLDER.

    Beside the bands, their scores (JSON) and a figure. Exit status 3: validation failed on the
    record; 5: it is inconclusive.

    Example: bwbayes predict results/ring_bender --record new.csv --lead-in 2
    """
    from bwbayes.app.jobs.predict import predict as write
    from bwbayes.results.prediction import Start

    if (record is None) == (waveform is None):
        raise InputError("predict: give either --record or --signal")
    if after and record is None and window is not None:
        raise InputError(
            "predict: --window is for a --record; what comes after the training record is "
            "predicted whole"
        )
    if lead_in is not None and not 0 < lead_in < math.inf:
        raise InputError(
            f"predict: a lead-in of {lead_in:g} s is not a positive length of time; give another"
        )
    begin = Start(from_rest, not same_offset, lead_in, lead_in_from, after=after)
    return write(
        folder,
        record,
        waveform,
        begin,
        out,
        Console(),
        naming=naming.naming(),
        window=window,
        of=training,
        overwrite=overwrite,
    )
