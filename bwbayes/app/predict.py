"""``bwbayes predict``: displacement bands of a finished run for another record or voltage."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from bwbayes.app.folder import RunFolder
from bwbayes.app.problem import generator
from bwbayes.app.run import finished
from bwbayes.app.screen import show_scores
from bwbayes.data import Record, read_record
from bwbayes.data.waveforms import signal
from bwbayes.errors import InputError
from bwbayes.inference.sampling import draws
from bwbayes.results.extrapolation import beyond_training
from bwbayes.results.files import write_bands
from bwbayes.results.prediction import Start, predict_record, thinned
from bwbayes.results.scores import score

__all__ = ["predict"]


def predict(
    path: Path,
    record: Path | None,
    wanted: str | None,
    start: Start,
    out: Path | None,
    console: Console,
    *,
    overwrite: bool = False,
) -> int:
    """Predict a record or a signal, write the bands, show their scores; return the exit status.

    Raises
    ------
    InputError
        No such run, a record that cannot be used, or a file ``out`` that is there already.
    """
    if out is not None and out.exists() and not overwrite:
        raise InputError(f"{out}: exists; choose another name, or give --overwrite")
    folder = RunFolder.open(path)
    problem, chain, outcome = finished(folder)
    if not outcome.converged:
        click.echo(
            f"NOT CONVERGED: {path} gives no interval; go on with `bwbayes resume {path}`", err=True
        )
        return 4
    if record is not None:
        other, name = read_record(record, need_displacement=False), record.stem
    else:
        assert wanted is not None
        interval = problem.record.interval
        _, voltage = signal(wanted).sample(1 / interval)
        other = Record(voltage, None, interval, origin=f"{wanted} signal")
        name = wanted
    seed = problem.config.seed
    posterior = problem.posterior
    flat = draws(posterior, chain).reshape(-1, len(posterior.names))
    chosen = thinned(flat, generator(seed, "draws"))
    bands = predict_record(
        posterior, chosen, other, start, generator(seed, f"predict {name}"), name
    )
    for remark in beyond_training(posterior, other.voltage, other.interval):
        click.echo(f"bwbayes: {name}: {remark}", err=True)
    target = out or folder.path / "predictions" / f"{name}.csv"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_bands(target, [bands])
    except OSError as error:
        raise InputError(f"{target}: {error.strerror}; choose another place with --out") from None
    if bands.measured is not None:
        show_scores({name: score(bands, generator(seed, f"score {name}"))}, console)
    console.print(f"wrote {target}", highlight=False, soft_wrap=True)
    return 0
