"""How a user begins: ``bwbayes init`` writes a record's config, and a run may do without one."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.markup import escape

from bwbayes.app.commands.shared import NamingOptions, naming_options
from bwbayes.errors import ColumnsError, InputError

if TYPE_CHECKING:
    from bwbayes.app.config.config import Config
    from bwbayes.app.config.proposal import ConfigProposal

__all__ = ["config_or_proposal", "init"]

CONFIG = ".toml"


@click.command()
@click.argument("record", type=click.Path(path_type=Path))
@naming_options
@click.option(
    "--out", type=click.Path(path_type=Path), help="The config; default: NAME-OF-RECORD.toml."
)
def init(record: Path, naming: NamingOptions, out: Path | None) -> int:
    """Write a commented config for RECORD.

    Example: bwbayes init my_record.csv --unit displacement=nm
    """
    out = out or record.with_suffix(CONFIG)
    if out.exists():
        raise InputError(f"{out}: exists; edit it, or choose another name with --out")
    proposal = _proposed(record, out.parent, naming, "init")
    try:
        out.write_text(proposal.text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out}: {error.strerror}; choose another place with --out") from None
    console = Console()
    _show(proposal, console)
    console.print(
        f"wrote {out}; next: `bwbayes check {out}`, then `bwbayes run {out}`",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    return 0


def config_or_proposal(
    path: Path, naming: NamingOptions, console: Console, command: str, *, refuse: bool = True
) -> tuple[Config, bool]:
    """Read a config; or propose one where the file is a record, and show what is wrong with it.

    Return the config, and whether it is a proposal.

    Raises
    ------
    InputError
        The file cannot be used; or, if that is to be refused, a fit of the record is pointless.
    """
    from bwbayes.app.config.config import is_config, load

    if is_config(path):
        config = load(path)
        if naming.given:
            raise InputError(
                f"{path}: --column, --unit and --fs are for a record; in a config say columns, "
                "units and fs under [record]"
            )
        return config, False
    proposal = _proposed(path, path.parent, naming, command)
    if refuse and proposal.pointless is not None:
        raise InputError(
            f"{path}: {proposal.pointless.error}; if the record is right as it is, write a config "
            f"with `bwbayes init {path}` and run that"
        )
    _show(proposal, console)
    train = ", ".join(f"{a:g} to {b:g}" for a, b in proposal.config.records["record"].train or ())
    held = "the rest" if "held_out" in proposal.config.validation else "nothing"
    console.print(
        f"training on {train} s, holding out {held}; save this config with `bwbayes init {path}`",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    return proposal.config, True


def _proposed(path: Path, where: Path, naming: NamingOptions, command: str) -> ConfigProposal:
    """Propose a config; of unknown columns say the command that settles them."""
    from bwbayes.app.config.proposal import propose

    try:
        return propose(path, where, naming.naming())
    except ColumnsError as error:
        raise error.in_command(f"bwbayes {command} {shlex.quote(str(path))}") from None


def _show(proposal: ConfigProposal, console: Console) -> None:
    """Show what was said of the record, with what to do."""
    from bwbayes.report.report import Report, remarks_banner
    from bwbayes.report.screen import show

    show(Report(title="remarks", banners=remarks_banner(proposal.remarks)), console)
    for finding in proposal.findings:
        text = f"{finding.kind}: {finding.text}\n    fix: {finding.fix}"
        console.print(escape(text), highlight=False, soft_wrap=True)
