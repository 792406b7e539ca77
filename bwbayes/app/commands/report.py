"""``bwbayes report``: the pictures and the page of a run, drawn again."""

from __future__ import annotations

from pathlib import Path

import click

from bwbayes.app.commands.shared import FILE

__all__ = ["report"]


@click.command()
@click.argument("folder", type=FILE)
def report(folder: Path) -> int:
    """Draw the pictures and the page of the run in FOLDER again.

    Example: bwbayes report results/ring_bender
    """
    from bwbayes.app.running.folder import RunFolder
    from bwbayes.app.running.run import redraw

    run_folder = RunFolder.open(folder)
    redraw(run_folder)
    click.echo(f"wrote {run_folder.path / 'report.html'}")
    return 0
