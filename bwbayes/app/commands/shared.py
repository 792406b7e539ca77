"""What several commands share: options, exit statuses, and one way to say that a run has ended."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console

if TYPE_CHECKING:
    from bwbayes.app.problem.problem import Problem
    from bwbayes.inference.engine import Engine

__all__ = [
    "BAD_INPUT",
    "DOES_NOT_HOLD",
    "FILE",
    "INTERRUPTED",
    "NOT_CONVERGED",
    "WithParts",
    "capacitance_option",
    "current_option",
    "executor_option",
    "finish",
    "overwrite_option",
    "quiet_option",
    "slew_option",
    "voltage_option",
    "workers_option",
]

BAD_INPUT = 2
DOES_NOT_HOLD = 3
NOT_CONVERGED = 4
INTERRUPTED = 130


class WithParts(click.Command):
    """A command whose help lists the parts that a model may have, as the registries do."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the parts, by kind."""
        # Here, because it is slow to load.
        from bwbayes.app.config.reference import PARTS

        del ctx
        with formatter.section("Parts"):
            formatter.write_dl([(kind, ", ".join(names)) for kind, names in PARTS.items()])


FILE = click.Path(path_type=Path)
workers_option = click.option(
    "--workers", type=click.IntRange(1), help="Ensembles side by side; default: all cores."
)
executor_option = click.option(
    "--executor",
    "how",
    metavar="KIND",
    help="local (default), threads, processes, dask, or dask://HOST:PORT.",
)
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace existing files.")
voltage_option = click.option(
    "--voltage",
    type=(float, float),
    metavar="LOW HIGH",
    help="Lowest and highest voltage of the amplifier, V; default: what was fitted.",
)
slew_option = click.option("--slew", type=float, help="Its fastest change of the voltage, V/s.")
current_option = click.option(
    "--current", type=float, help="Its largest current, A; with --capacitance."
)
capacitance_option = click.option(
    "--capacitance", type=float, help="The actuator's capacitance, F."
)
quiet_option = click.option("--quiet", is_flag=True, help="Print nothing but errors.")


def finish(
    path: Path,
    workers: int | None,
    quiet: bool,
    *,
    ess: float | None = None,
    steps: int | None = None,
    engine: Engine | None = None,
    how: str | None = None,
    show: Callable[[Problem], None] | None = None,
) -> int:
    """Sample the run in a folder to its end, say how it went, and return the exit status.

    ``show`` is called with the problem at first.
    """
    from bwbayes.app.running.folder import RunFolder
    from bwbayes.app.running.run import carry_on, going_on, load_run
    from bwbayes.app.screen import show_result

    folder = RunFolder.open(path)
    console = Console(stderr=True, quiet=quiet)
    try:
        result = carry_on(
            folder,
            console,
            workers=workers,
            ess=ess,
            steps=steps,
            engine=engine,
            how=how,
            apart=True,
            show=show,
        )
    except KeyboardInterrupt:
        click.echo(f"interrupted; go on with `bwbayes resume {path}`", err=True)
        return INTERRUPTED
    if not quiet:
        show_result(result, folder, Console())
    if result.failed:
        first, *others = result.failed
        more = f", and {len(others)} more" if others else ""
        # The screen begins with all of them.
        said = first.line if quiet else f"{first.name}{more}"
        click.echo(f"DOES NOT HOLD: {said}; see {path}/report.html", err=True)
        return DOES_NOT_HOLD
    if result.outcome.converged:
        return 0
    click.echo(
        f"NOT CONVERGED: {result.outcome.stop_reason}; no interval is given. Go on with "
        f"`{going_on(path, load_run(folder))}`, and look at the traces in {path}/report.html",
        err=True,
    )
    return NOT_CONVERGED
