"""``bwbayes predict``: displacement bands for another record or voltage."""

from __future__ import annotations

import math
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console

from bwbayes.app.commands.shared import FILE, NamingOptions, naming_options, overwrite_option
from bwbayes.errors import ColumnsError, InputError

if TYPE_CHECKING:
    from bwbayes.data import Record

__all__ = ["predict"]


@click.command()
@click.argument("folder", type=FILE)
@click.option("--record", type=FILE, help="A record to predict; measured or a voltage alone.")
@naming_options
@click.option("--signal", "waveform", help="A signal to predict instead, by its name.")
@click.option("--from-rest", is_flag=True, help="The record starts from a demagnetized actuator.")
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
    from bwbayes.app.fit.opening import converged
    from bwbayes.app.running.predictions import predict_after, predict_another, training_record
    from bwbayes.data import Record
    from bwbayes.data.waveforms import signal
    from bwbayes.report.figures import picture_of
    from bwbayes.report.report import Report, standing_banner
    from bwbayes.report.saving import refuse_existing
    from bwbayes.report.screen import show
    from bwbayes.results.outputs import write_bands, write_summary
    from bwbayes.results.prediction import Start
    from bwbayes.results.standing import Standing

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
    name = record.stem if record is not None else str(waveform)
    table = out or folder / "predictions" / f"{name}.csv"
    numbers, picture = table.with_suffix(".json"), table.with_suffix(".png")
    if table in (numbers, picture):
        raise InputError(f"{table}: the bands are a table; give a name that ends in .csv")
    refuse_existing([table, numbers, picture], overwrite=overwrite)
    fit = converged(folder)
    problem, flat, standing = fit.problem, fit.flat_draws, fit.standing
    of = training_record(problem, training)
    if record is not None:
        other = _read(record, naming, folder)
    else:
        interval = problem.records[of].interval
        voltage = signal(name).sample(1 / interval)[1]
        other = Record(voltage, None, interval, origin=f"{name} signal")
    if record is None and after:
        bands = predict_after(problem, flat, other.voltage, name, of)
    else:
        start = Start(from_rest, not same_offset, lead_in, lead_in_from, after=after)
        bands = predict_another(problem, flat, other, start, name, window, of)
    validated = Standing.of([bands.verdict] if bands.verdict else [])
    try:
        table.parent.mkdir(parents=True, exist_ok=True)
        write_bands(table, [bands])
        write_summary(numbers, bands.numbers() | {"run_validation": standing.numbers})
        picture.write_bytes(picture_of(bands.plot))
    except OSError as error:
        raise InputError(f"{table}: {error.strerror}; choose another place") from None
    console = Console()
    show(Report(title=name, banners=standing_banner(standing)), console)
    show(bands.report(), console)
    for path in (table, numbers, picture):
        click.echo(f"wrote {path}")
    # The worse of the two.
    return (validated if validated.holds is False or standing.holds else standing).exit_status


def _read(path: Path, naming: NamingOptions, folder: Path) -> Record:
    """Read a record to predict; of unknown columns say the command that settles them."""
    from bwbayes.data import read_record

    meant = naming.naming()
    options: dict[str, Any] = {"columns": meant.columns, "units": meant.units, "fs": meant.fs}
    try:
        return read_record(path, need_displacement=False, **options)
    except ColumnsError as error:
        raise error.in_command(
            f"bwbayes predict {quote(str(folder))} --record {quote(str(path))}"
        ) from None
