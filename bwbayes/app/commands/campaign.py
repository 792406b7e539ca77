"""``bwbayes campaign``: one posterior for each record of a folder, and what they say together."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console

from bwbayes.app.commands.shared import FILE, INTERRUPTED, executor_option, quiet_option
from bwbayes.errors import InputError

if TYPE_CHECKING:
    from bwbayes.app.running.campaign_folder import CampaignFolder

__all__ = ["campaign"]


@click.command()
@click.argument("folder", type=FILE, required=False)
@click.option("--config", type=FILE, help="Config of all records; default: each proposes its own.")
@click.option("--out", type=FILE, help="The campaign's folder; default: results/NAME-OF-FOLDER.")
@click.option("--resume", "resumed", type=FILE, help="Go on with the campaign in this folder.")
@click.option("--overwrite", is_flag=True, help="Replace an existing campaign.")
@click.option("--no-pictures", is_flag=True, help="Leave out the runs' own figures and reports.")
@click.option("--workers", type=click.IntRange(1), help="Records side by side; default: cores.")
@executor_option
@quiet_option
def campaign(
    folder: Path | None,
    config: Path | None,
    out: Path | None,
    resumed: Path | None,
    overwrite: bool,
    no_pictures: bool,
    workers: int | None,
    backend: str | None,
    quiet: bool,
) -> int:
    """Fit every record of a FOLDER as a run does, and put them side by side.

    The same command goes on after an interruption, and fits records that were added or changed.
    Exit status: 2 if records were refused, else 4 if some did not converge, else 3 if validation
    failed for some, else 5 if it is inconclusive; every record is in the table in any case.

    Example: bwbayes campaign records/ --config my.toml --out results/batch
    """
    from bwbayes.app.jobs.campaign import config_text, start
    from bwbayes.app.running.campaign_folder import CampaignFolder

    if (folder is None) == (resumed is None):
        raise InputError("campaign: give either a FOLDER of records or --resume CAMPAIGN")
    if resumed is not None:
        if out is not None or config is not None or overwrite or no_pictures:
            raise InputError("campaign: --resume goes on as begun; leave the other options out")
        return _resume(CampaignFolder.open(resumed), workers, backend, quiet)
    assert folder is not None
    text = "" if config is None else config_text(config)
    where = folder if config is None else config.parent
    created = start(
        folder,
        text,
        where,
        out or Path("results") / folder.absolute().name,
        pictures=not no_pictures,
        overwrite=overwrite,
    )
    return _resume(created, workers, backend, quiet)


def _resume(folder: CampaignFolder, workers: int | None, backend: str | None, quiet: bool) -> int:
    from bwbayes.app.jobs.campaign import resume
    from bwbayes.report.screen import show

    console = Console(stderr=True, quiet=quiet)
    try:
        result = resume(folder, console, workers=workers, backend=backend)
    except KeyboardInterrupt:
        click.echo(f"interrupted; resume with `bwbayes campaign --resume {folder.path}`", err=True)
        return INTERRUPTED
    if not quiet:
        show(result.report(folder.path.name), Console())
        click.echo(f"report: {folder.page}")
    for row in result.rows:
        if row.reason:
            click.echo(f"{row.status.upper()}: {row.name}: {row.reason}", err=True)
    return result.exit_status
