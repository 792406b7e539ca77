"""``bwbayes check``: what to know of a record and a config before a run."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from bwbayes.app.commands.init import config_or_proposal
from bwbayes.app.commands.shared import FILE, NamingOptions, naming_options

__all__ = ["check"]


@click.command()
@click.argument("config", type=FILE)
@click.option("--record", type=FILE, help="Check this record instead of the config's.")
@naming_options
@click.option("--out", type=FILE, help="Folder of the page; default: results/NAME-check.")
def check(config: Path, record: Path | None, naming: NamingOptions, out: Path | None) -> int:
    """Check a CONFIG or record for issues and compute a MAP estimate; no sampling.

    Example: bwbayes check runs/measured_stack.toml --record my_record.csv
    """
    from bwbayes.app.jobs.check import check as look
    from bwbayes.report.screen import show

    chosen, _ = config_or_proposal(config, naming, Console(quiet=True), "check", refuse=False)
    if record is not None:
        chosen = chosen.with_record(record)
    out = out or Path("results") / f"{config.stem}-check"
    _, report = look(chosen, config.parent, out)
    show(report, Console())
    click.echo(f"report: {out / 'check.html'}")
    return 0
