"""``bwbayes run`` and ``bwbayes resume``: sample a posterior, or go on with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, get_args

import click
from rich.console import Console

from bwbayes.app.commands.init import config_or_proposal
from bwbayes.app.commands.shared import (
    FILE,
    NamingOptions,
    executor_option,
    finish,
    naming_options,
    quiet_option,
    workers_option,
)
from bwbayes.app.config.limits import LARGEST_SEED
from bwbayes.inference.engine import Engine

if TYPE_CHECKING:
    from bwbayes.app.problem.problem import Problem

__all__ = ["resume", "run"]


@click.command()
@click.argument("config", type=FILE)
@click.option("--record", type=FILE, help="Fit this record instead of the config's.")
@naming_options
@click.option("--out", type=FILE, help="The run's folder; default: results/NAME-OF-CONFIG.")
@click.option("--seed", type=click.IntRange(0, LARGEST_SEED), help="Seed, instead of the config's.")
@click.option("--overwrite", is_flag=True, help="Replace an existing run.")
@click.option(
    "--improve", is_flag=True, help="Add the parts of the model that the record supports."
)
@workers_option
@executor_option
@quiet_option
def run(
    config: Path,
    record: Path | None,
    naming: NamingOptions,
    out: Path | None,
    seed: int | None,
    overwrite: bool,
    improve: bool,
    workers: int | None,
    backend: str | None,
    quiet: bool,
) -> int:
    """Fit a model to a record: sample the posterior, predict, write the report.

    CONFIG is a config in TOML, or a record without one.

    Example: bwbayes run runs/ring_bender.toml --out results/ring_bender
    """
    from bwbayes.app.running.folder import RunFolder
    from bwbayes.app.running.improving import improve_model
    from bwbayes.app.running.run import start
    from bwbayes.report.priors import priors_table
    from bwbayes.report.report import Report, remarks_banner
    from bwbayes.report.screen import show as show_report

    chosen, is_proposal = config_or_proposal(config, naming, Console(quiet=quiet), "run")
    if record is not None:
        chosen = chosen.with_record(record)
    if seed is not None:
        chosen = chosen.model_copy(update={"seed": seed})
    if chosen.name is None:
        chosen = chosen.model_copy(update={"name": config.stem})
    path = out or Path("results") / config.stem
    if improve:
        RunFolder.require_free(path, overwrite)
        chosen = improve_model(chosen, config.parent, Console(stderr=True, quiet=quiet))
    folder = start(chosen, config.parent, path, overwrite=overwrite)

    def show(problem: Problem) -> None:
        # Of a record alone the remarks are shown already.
        banners = [] if is_proposal else remarks_banner(problem.remarks)
        priors = priors_table(problem.posterior.prior)
        show_report(Report(title="priors", banners=banners, blocks=[priors]), Console())

    return finish(folder.path, workers, quiet, backend=backend, show=None if quiet else show)


@click.command()
@click.argument("folder", type=FILE)
@click.option("--ess", type=click.FloatRange(1), help="A new target of effective draws.")
@click.option("--steps", type=click.IntRange(1), help="A new budget of steps.")
@click.option("--engine", type=click.Choice(get_args(Engine)), help="Go on with this engine.")
@workers_option
@executor_option
@quiet_option
def resume(
    folder: Path,
    ess: float | None,
    steps: int | None,
    engine: Engine | None,
    workers: int | None,
    backend: str | None,
    quiet: bool,
) -> int:
    """Go on with the run in FOLDER, interrupted or short of its target.

    Example: bwbayes resume results/ring_bender --steps 40000
    """
    return finish(folder, workers, quiet, ess=ess, steps=steps, engine=engine, backend=backend)
