"""The commands that print the reference: ``bwbayes config`` and ``models``."""

from __future__ import annotations

import click

from bwbayes.app.commands.shared import WithParts


@click.command()
@click.argument("key", required=False)
def config(key: str | None) -> int:
    """Print the keys of a config: type, unit, default and an example; of all, or of one KEY.

    Example: bwbayes config record.train
    """
    from bwbayes.app.config.reference import config_reference

    click.echo(config_reference(key))
    return 0


@click.command(cls=WithParts)
@click.argument("name", required=False)
def models(name: str | None) -> int:
    """Print the parts of a model, or of one NAME its equation, parameters and default priors.

    Example: bwbayes models prandtl-ishlinskii
    """
    from bwbayes.app.config.reference import parts_reference

    click.echo(parts_reference(name))
    return 0
