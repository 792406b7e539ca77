"""How a user begins: ``bwbayes init`` writes a record's config, and a run may do without one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.markup import escape

from bwbayes.errors import InputError

if TYPE_CHECKING:
    from bwbayes.app.config.config import Config
    from bwbayes.app.config.proposal import Proposal

__all__ = ["config_or_proposal", "init"]

CONFIG = ".toml"


@click.command()
@click.argument("record", type=click.Path(path_type=Path))
@click.option(
    "--unit",
    "units",
    multiple=True,
    metavar="QUANTITY=UNIT",
    help="A column's unit, if its name does not say it: displacement=nm; -nm turns the sign.",
)
@click.option(
    "--column",
    "columns",
    multiple=True,
    metavar="QUANTITY=NAME",
    help="Which column holds the time, voltage or displacement, if its name does not say it.",
)
@click.option(
    "--out", type=click.Path(path_type=Path), help="The config; default: NAME-OF-RECORD.toml."
)
def init(record: Path, units: tuple[str, ...], columns: tuple[str, ...], out: Path | None) -> int:
    """Look at a RECORD and write a config for it, with comments.

    Example: bwbayes init my_record.csv --unit displacement=nm
    """
    from bwbayes.app.config.proposal import propose

    out = out or record.with_suffix(CONFIG)
    if out.exists():
        raise InputError(f"{out}: exists; edit it, or choose another name with --out")
    said = [dict(_pair("--unit", text) for text in units)]
    said += [dict(_pair("--column", text) for text in columns)]
    made = propose(record, out.parent, *said)
    try:
        out.write_text(made.text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out}: {error.strerror}; choose another place with --out") from None
    console = Console()
    _show(made, console)
    console.print(
        f"wrote {out}; look at the record with `bwbayes check {out}`, then `bwbayes run {out}`",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    return 0


def config_or_proposal(path: Path, console: Console, *, refuse: bool = True) -> Config:
    """Read a config; or propose one where the file is a record, and show what is wrong with it.

    Raises
    ------
    InputError
        The file cannot be used; or, if that is to be refused, a fit of the record is pointless.
    """
    from bwbayes.data.io.formats import SUFFIXES

    if path.suffix.lower() not in SUFFIXES:
        from bwbayes.app.config.config import load

        return load(path)
    from bwbayes.app.config.proposal import propose

    made = propose(path, path.parent)
    if refuse and made.pointless is not None:
        raise InputError(
            f"{path}: {made.pointless}; if the record is right as it is, write a config with "
            f"`bwbayes init {path}` and run that"
        )
    _show(made, console)
    held = "held_out" in made.config.validation
    train = ", ".join(f"{a:g} to {b:g} s" for a, b in made.config.records["record"].train or ())
    rest = "the rest is held out" if held else "nothing is held out"
    console.print(
        f"fitting {train}; {rest}; `bwbayes init {path}` writes this as a config",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    return made.config


def _show(made: Proposal, console: Console) -> None:
    """Show what was said of the record, with what to do."""
    from bwbayes.app.screen import show_remarks

    show_remarks(made.remarks, console)
    for one in made.findings:
        text = f"{one.kind}: {one.text}\n    what to do: {one.remedy}"
        console.print(escape(text), highlight=False, soft_wrap=True)


def _pair(option: str, text: str) -> tuple[str, str]:
    quantity, equals, value = text.partition("=")
    if not equals:
        raise InputError(f"init: {option} {text}: write {option} displacement=..., with a value")
    return quantity.strip(), value.strip()
