"""``bwbayes compare``: which model? Runs of the same readings, or models that are run for it."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from bwbayes.app.commands.shared import (
    FILE,
    NOT_CONVERGED,
    WithParts,
    conclude,
    executor_option,
    overwrite_option,
    quiet_option,
    workers_option,
)
from bwbayes.app.config.limits import USUAL_MODELS
from bwbayes.errors import InputError

__all__ = ["compare"]


@click.command(cls=WithParts)
@click.argument("paths", type=FILE, nargs=-1, required=True)
@click.option("--models", help=f"Models to run a CONFIG with; default: {USUAL_MODELS}.")
@click.option("--out", type=FILE, help="Its folder; default: results/comparison, or by the config.")
@click.option("--future/--no-future", default=True, help="Whether to leave out the future, too.")
@overwrite_option
@workers_option
@executor_option
@quiet_option
def compare(
    paths: tuple[Path, ...],
    models: str | None,
    out: Path | None,
    future: bool,
    overwrite: bool,
    workers: int | None,
    how: str | None,
    quiet: bool,
) -> int:
    """Compare the runs in folders PATHS, or models that one config is run with.

    Scores on what was held out, on the training readings' own future, log evidence; differences
    with paired errors; what is recommended, and what speaks against it. Of --models the first word
    is an operator; gain, creep, dynamics and noise follow after plus signs.

    Example: bwbayes compare results/bender results/bender_plays
    """
    from bwbayes.app.config.config import load
    from bwbayes.app.config.models import models_of
    from bwbayes.app.jobs.compare import compare_models, compare_runs
    from bwbayes.app.screen import show_comparison

    console = Console(stderr=True, quiet=quiet)
    if models is None and len(paths) == 1 and (paths[0].is_file() or paths[0].suffix == ".toml"):
        models = USUAL_MODELS
    if models is None:
        if len(paths) < 2:
            raise InputError("compare: give two runs or more, or a CONFIG")
        where = out or Path("results") / "comparison"
        made = compare_runs(
            paths, where, console, workers=workers, how=how, with_future=future, overwrite=overwrite
        )
    else:
        if len(paths) > 1:
            raise InputError("compare: --models goes with one CONFIG; leave the others out")
        (path,) = paths
        config = load(path)
        where = out or Path("results") / f"{path.stem}-comparison"
        made = compare_models(
            config,
            path.parent,
            models_of(models, config.model),
            where,
            console,
            workers=workers,
            how=how,
            with_future=future,
            overwrite=overwrite,
        )
    if not quiet:
        show_comparison(made, where, Console())
    if made.recommended is None:
        click.echo("NOT CONVERGED: no model has converged, so none is recommended", err=True)
        return NOT_CONVERGED
    # It is among what speaks against the recommendation.
    return conclude(made.standing, say=quiet)
