"""Studies of many fits: ``bwbayes compare``, ``campaign`` and ``calibrate``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from bwbayes.app.commands.shared import (
    present,
    refuse_beside_config,
    resumable,
    show_report,
    working,
)
from bwbayes.errors import ExitStatus, InputError


def calibrate(
    config: Path | None = None,
    *,
    resumed: Path | None,
    out: Path | None,
    seed: int | None,
    overwrite: bool,
    quiet: bool,
    replicates: int | None,
    **options: Any,
) -> int:
    """Simulation-based calibration of CONFIG, or of the run whose folder CONFIG is.

    Each replicate draws parameters from the config's prior, simulates its record and fits it
    as a run does. Those of a run are drawn from its posterior, and each record is fitted together
    with the run's: are these intervals right for this record? It is kept in the run's folder, 200
    replicates by default, and shown in its report. Exit status 4: the posteriors are not what they
    say, or more than 1% of the replicates did not converge.

    Parameters
    ----------
    resumed
        Resume the calibration in this folder.
    out
        Its folder; default: results/NAME-OF-CONFIG-calibration.
    overwrite
        Replace an existing calibration.

    Examples
    --------
    bwbayes calibrate runs/calibration.toml --replicates 500
    """
    with working():
        from bwbayes.app.config.config import load
        from bwbayes.app.fit.calls import open_converged
        from bwbayes.app.jobs.calibrate import calibrate as calibrate_run, resume, start
        from bwbayes.app.running.folder import CalibrationFolder
        from bwbayes.report.calibration import calibration_report

    new = {"out": out, "seed": seed, "overwrite": overwrite}
    _refuse_beside_resume("calibrate", resumed, new)
    console, standing = Console(stderr=True, quiet=quiet), ExitStatus.SUCCESS
    options["replicates"] = replicates
    if config is not None and config.is_dir():
        if out is not None or seed is not None:
            raise InputError(f"{config}: is a run, with its seed and folder; remove --seed, --out")
        with working():
            fit = open_converged(config)
        folder, standing = fit.folder.calibration, fit.standing.exit_status
        for line in fit.standing.messages:
            click.echo(line, err=True)
        with resumable(f"`bwbayes calibrate {config}`"):
            calibration = calibrate_run(fit, overwrite=overwrite, progress=not quiet, **options)
    else:
        if config is None:
            folder = CalibrationFolder.open(Path(str(resumed)))
        else:
            chosen = load(config).renamed(config.stem, seed)
            path = out or Path("results") / f"{config.stem}-calibration"
            with working():
                folder = start(chosen, config.parent, path, replicates, overwrite=overwrite)
        with resumable(folder.resuming):
            calibration = resume(folder, console, **options)
    page = folder.path / "calibration.html"
    if not quiet:
        show_report(calibration_report(calibration))
        click.echo(f"report: {page}")
    if calibration.passed:
        return standing
    first, *others = calibration.failures
    more = f", and {len(others)} more" if others else ""
    click.echo(f"CALIBRATION FAILED: {first}{more}; see {page}", err=True)
    return ExitStatus.NOT_CONVERGED


def campaign(
    folder: Path | None = None,
    *,
    config: Path | None,
    out: Path | None,
    resumed: Path | None,
    overwrite: bool,
    pictures: bool = True,
    reading: dict[str, Any],
    quiet: bool,
    **options: Any,
) -> int:
    """Fit every record in FOLDER and compare the actuators.

    The same command goes on after an interruption, and fits records that were added or changed.
    Exit status: 2 if records were refused, else 4 if some did not converge, else 3 if validation
    failed for some, else 5 if it is inconclusive; every record is in the table in any case.

    Parameters
    ----------
    config
        Config of all records; default: each proposes its own.
    out
        The campaign's folder; default: results/NAME-OF-FOLDER.
    resumed
        Resume the campaign in this folder.
    overwrite
        Replace an existing campaign.
    pictures
        Draw each run's own figures and report.

    Examples
    --------
    bwbayes campaign records/ --config my.toml --out results/batch
    """
    with working():
        from bwbayes.app.jobs.campaign import config_text, resume, start
        from bwbayes.app.running.folder import CampaignFolder

    new = {"out": out, "config": config, "overwrite": overwrite, "pictures": not pictures}
    _refuse_beside_resume("campaign", resumed, new)
    if folder is None:
        batch = CampaignFolder.open(Path(str(resumed)))
    else:
        text, where = "", folder
        if config is not None:
            refuse_beside_config(config, reading)
            text, where = config_text(config), config.parent
        out = out or Path("results") / folder.absolute().name
        kept = {"pictures": pictures, "overwrite": overwrite}
        batch = start(folder, text, where, out, **kept, reading=reading)
    with resumable(batch.resuming):
        result = resume(batch, Console(stderr=True, quiet=quiet), **options)
    if not quiet:
        show_report(result.full_report())
        click.echo(f"report: {batch.page}")
    for row in result.rows:
        if row.reason:
            click.echo(f"{row.status.upper()}: {row.name}: {row.reason}", err=True)
    return result.exit_status


def _refuse_beside_resume(command: str, resumed: object, new: Mapping[str, object]) -> None:
    """Refuse options of a new study to resume one."""
    if resumed is not None and any(value not in (None, False) for value in new.values()):
        raise InputError(f"{command}: --resume takes no other options; remove them")


def compare(*paths: Path, models: str | None, out: Path | None, quiet: bool, **options: Any) -> int:
    """Compare the runs in folders PATHS, or models that one config is run with.

    Reports joint log scores of later readings given earlier ones, with errors; log evidence; a
    recommendation and its caveats. In --models the first word is an operator; nonlinearity, creep,
    dynamics and noise follow after plus signs. Models out of reach at their MAP estimates are only
    screened.

    Parameters
    ----------
    models
        Models to fit to a CONFIG's record; default: seven usual ones, see below.
    out
        Its folder; default: results/comparison, or by the config.

    Examples
    --------
    bwbayes compare results/bender results/bender_plays
    """
    with working():
        import bwbayes.app.jobs.compare  # noqa: F401  # what takes long to load
        from bwbayes.app.fit.calls import compare as compare_runs

    alone = len(paths) == 1 and not paths[0].is_dir()
    out = out or Path("results") / (f"{paths[0].stem}-comparison" if alone else "comparison")
    comparison = compare_runs(*paths, models=models, folder=out, progress=not quiet, **options)
    return present(comparison, [out / "comparison.html"], comparison.standing, quiet=quiet)
