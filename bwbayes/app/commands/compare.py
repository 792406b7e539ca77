"""``bwbayes compare``: which model? Runs of the same readings, or models that are run for it."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from bwbayes.app.commands.shared import (
    FILE,
    NOT_CONVERGED,
    WithParts,
    executor_option,
    overwrite_option,
    present,
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
@click.option("--screen/--no-screen", default=True, help="Whether to sample likely models alone.")
@click.option("--future/--no-future", default=True, help="Whether to leave out the future, too.")
@overwrite_option
@workers_option
@executor_option
@quiet_option
def compare(
    paths: tuple[Path, ...],
    models: str | None,
    out: Path | None,
    screen: bool,
    future: bool,
    overwrite: bool,
    workers: int | None,
    backend: str | None,
    quiet: bool,
) -> int:
    """Compare the runs in folders PATHS, or models that one config is run with.

    Joint log scores of later readings given earlier ones, with errors; log evidence; what is
    recommended, and what speaks against it. Of --models the first word is an operator; gain,
    creep, dynamics and noise follow after plus signs. Models out of reach at their MAP estimates
    are only screened.

    Example: bwbayes compare results/bender results/bender_plays
    """
    from bwbayes.app.config.config import load
    from bwbayes.app.config.models import models_of
    from bwbayes.app.jobs import compare as job
    from bwbayes.app.jobs import models as models_job
    from bwbayes.report.saving import refuse_existing

    console = Console(stderr=True, quiet=quiet)
    path, *others = paths
    if models is None and not others and (path.is_file() or path.suffix == ".toml"):
        models = USUAL_MODELS
    if models is None and not others:
        raise InputError("compare: give two runs or more, or a CONFIG")
    if models is not None and others:
        raise InputError("compare: --models goes with one CONFIG; leave the others out")
    name = "comparison" if models is None else f"{path.stem}-comparison"
    out = out or Path("results") / name
    config = None if models is None else load(path)
    refuse_existing([out / "comparison.json"], overwrite=overwrite)
    if config is None or models is None:
        fits = models_job.open_runs(paths)
        comparison = job.compare(fits, console, future=future, workers=workers, executor=backend)
    else:
        comparison = models_job.compare_models(
            config,
            path.parent,
            models_of(models, config.model),
            out,
            console,
            overwrite=overwrite,
            screen=screen,
            future=future,
            workers=workers,
            executor=backend,
        )
    comparison.save(out)
    # What does not hold is among what speaks against the recommendation.
    status = present(
        comparison.report(), [out / "comparison.html"], comparison.standing, quiet=quiet
    )
    if comparison.recommended is None:
        click.echo("NOT CONVERGED: no model has converged, so none is recommended", err=True)
        return NOT_CONVERGED
    return status
