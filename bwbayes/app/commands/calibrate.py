"""``bwbayes calibrate``: simulation-based calibration, whether posteriors are what they say."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console

from bwbayes.app.commands.shared import (
    FILE,
    INTERRUPTED,
    NOT_CONVERGED,
    executor_option,
    quiet_option,
)
from bwbayes.app.config.limits import LARGEST_SEED
from bwbayes.errors import InputError

if TYPE_CHECKING:
    from bwbayes.app.running.folder import CalibrationFolder

__all__ = ["calibrate"]

# Replicates of a calibration, unless told otherwise.
REPLICATES = 500


@click.command()
@click.argument("config", type=FILE, required=False)
@click.option("--resume", "resumed", type=FILE, help="Go on with the calibration in this folder.")
@click.option(
    "--replicates", type=click.IntRange(1), help=f"How many; default: {REPLICATES}, or as begun."
)
@click.option("--out", type=FILE, help="Its folder; default: results/NAME-OF-CONFIG-calibration.")
@click.option("--seed", type=click.IntRange(0, LARGEST_SEED), help="Seed, instead of the config's.")
@click.option("--overwrite", is_flag=True, help="Replace an existing calibration.")
@click.option("--workers", type=click.IntRange(1), help="Replicates side by side; default: cores.")
@executor_option
@quiet_option
def calibrate(
    config: Path | None,
    resumed: Path | None,
    replicates: int | None,
    out: Path | None,
    seed: int | None,
    overwrite: bool,
    workers: int | None,
    backend: str | None,
    quiet: bool,
) -> int:
    """Simulation-based calibration of a CONFIG: fit simulated records whose truth is known.

    Each replicate draws parameters from the config's prior, simulates its record and fits it
    as a run does. Exit status 4: the posteriors are not what they say, or more than 1 % of the
    replicates did not converge.

    Example: bwbayes calibrate runs/calibration.toml --replicates 500
    """
    from bwbayes.app.jobs.calibrate import start
    from bwbayes.app.running.folder import CalibrationFolder

    if (config is None) == (resumed is None):
        raise InputError("calibrate: give either a CONFIG or --resume FOLDER")
    if resumed is not None:
        if out is not None or seed is not None or overwrite:
            raise InputError("calibrate: --resume goes on as begun; leave the other options out")
        return _calibrate(CalibrationFolder.open(resumed), replicates, workers, backend, quiet)
    assert config is not None
    changes = {"name": config.stem} | ({} if seed is None else {"seed": seed})
    from bwbayes.app.config.config import load

    chosen = load(config)
    chosen = chosen.model_copy(update=changes | ({"name": chosen.name} if chosen.name else {}))
    where = out or Path("results") / f"{config.stem}-calibration"
    folder = start(chosen, config.parent, where, replicates or REPLICATES, overwrite=overwrite)
    return _calibrate(folder, None, workers, backend, quiet)


def _calibrate(
    folder: CalibrationFolder,
    replicates: int | None,
    workers: int | None,
    backend: str | None,
    quiet: bool,
) -> int:
    from bwbayes.app.jobs.calibrate import resume
    from bwbayes.report.calibration import calibration_report
    from bwbayes.report.screen import show

    console = Console(stderr=True, quiet=quiet)
    try:
        calibration = resume(folder, console, workers=workers, count=replicates, backend=backend)
    except KeyboardInterrupt:
        click.echo(f"interrupted; resume with {folder.resuming}", err=True)
        return INTERRUPTED
    if not quiet:
        show(calibration_report(calibration), Console())
        click.echo(f"report: {folder.path / 'calibration.html'}")
    if calibration.passed:
        return 0
    first, *others = calibration.shortcomings
    more = f", and {len(others)} more" if others else ""
    click.echo(f"NOT PASSED: {first}{more}; see {folder.path}/calibration.html", err=True)
    return NOT_CONVERGED
