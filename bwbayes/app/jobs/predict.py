"""``bwbayes predict``: displacement bands of a finished run for another record or voltage.

Three files come of it: the bands (CSV), and beside them under the same name their scores and
verdict (JSON) and a picture (PNG). No file is replaced unless that is asked for.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from bwbayes.app.figures import save_one
from bwbayes.app.jobs.at_work import drawn
from bwbayes.app.problem.problem import Problem
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.predictions import (
    predict_after,
    predict_another,
    training_record,
)
from bwbayes.app.screen import show_scores, show_standing
from bwbayes.data import Record, read_record
from bwbayes.data.io.columns import Naming
from bwbayes.data.waveforms import signal
from bwbayes.errors import ColumnsError, InputError
from bwbayes.results.outputs import write_bands, write_summary
from bwbayes.results.prediction import Start
from bwbayes.results.standing import Standing

__all__ = ["predict"]


def predict(
    path: Path,
    record: Path | None,
    waveform: str | None,
    start: Start,
    out: Path | None,
    console: Console,
    *,
    naming: Naming | None = None,
    window: tuple[float, float] | None = None,
    of: str | None = None,
    overwrite: bool = False,
) -> int:
    """Predict a record or a signal, write and show what came of it; return the exit status.

    A signal with ``start.after`` goes on from the end of the training record, ``of`` that name.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        No such run, a record that cannot be used, or a file that exists already.
    """
    folder = RunFolder.open(path)
    name = record.stem if record is not None else str(waveform)
    table = out or folder.path / "predictions" / f"{name}.csv"
    numbers, picture = table.with_suffix(".json"), table.with_suffix(".png")
    if table in (numbers, picture):
        raise InputError(f"{table}: the bands are a table; give a name that ends in .csv")
    for target in (table, numbers, picture):
        if target.exists() and not overwrite:
            raise InputError(f"{target}: exists; choose another name, or give `overwrite=True`")
    problem, flat, standing = drawn(path)
    of = training_record(problem, of)
    other = _record(problem, of, path, record, naming or Naming(), waveform)
    if record is None and start.after:
        bands = predict_after(problem, flat, other.voltage, name, of)
    else:
        bands = predict_another(problem, flat, other, start, name, window, of)
    scores, verdict = bands.scores, bands.verdict
    own = Standing.of([verdict] if verdict else [])
    for each in (standing, own):
        show_standing(each, console)
    for remark in bands.remarks:
        click.echo(f"bwbayes: {name}: {remark}", err=True)
    try:
        table.parent.mkdir(parents=True, exist_ok=True)
        write_bands(table, [bands])
        write_summary(numbers, bands.numbers() | {"run_validation": standing.numbers})
        save_one(bands.plot(), picture)
    except OSError as error:
        raise InputError(f"{table}: {error.strerror}; choose another place") from None
    if scores is not None and verdict is not None:
        show_scores({name: scores}, console, {name: verdict})
    for target in (table, numbers, picture):
        console.print(f"wrote {target}", highlight=False, soft_wrap=True)
    # The worse of the two.
    return (own if own.holds is False or standing.holds else standing).exit_status


def _record(
    problem: Problem,
    of: str,
    folder: Path,
    path: Path | None,
    naming: Naming,
    waveform: str | None,
) -> Record:
    """Read the record, or sample the signal as the training record was sampled."""
    if path is not None:
        known: dict[str, Any] = {"columns": naming.columns, "units": naming.units, "fs": naming.fs}
        try:
            return read_record(path, need_displacement=False, **known)
        except ColumnsError as error:
            command = (
                f"bwbayes predict {shlex.quote(str(folder))} --record {shlex.quote(str(path))}"
            )
            raise error.in_command(command) from None
    assert waveform is not None
    interval = problem.records[of].interval
    _, voltage = signal(waveform).sample(1 / interval)
    return Record(voltage, None, interval, origin=f"{waveform} signal")
