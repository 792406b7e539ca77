"""What several commands share: options, exit statuses, and one way to say that a run has ended."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console

from bwbayes.errors import InputError

if TYPE_CHECKING:
    from bwbayes.app.problem.problem import Problem
    from bwbayes.data.io.columns import Naming
    from bwbayes.inference.engine import Engine
    from bwbayes.report.report import Report
    from bwbayes.results.standing import Standing

__all__ = [
    "BAD_INPUT",
    "FILE",
    "INTERRUPTED",
    "NOT_CONVERGED",
    "NamingOptions",
    "WithParts",
    "capacitance_option",
    "conclude",
    "current_option",
    "executor_option",
    "finish",
    "hold_option",
    "naming_options",
    "overwrite_option",
    "present",
    "quiet_option",
    "slew_option",
    "voltage_option",
    "workers_option",
]

BAD_INPUT = 2
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


@dataclass(frozen=True)
class NamingOptions:
    """What the command line says of a record's columns, units and sampling rate."""

    columns: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    fs: float | None = None

    @property
    def given(self) -> bool:
        """Whether it says anything."""
        return bool(self.columns or self.units or self.fs is not None)

    def naming(self) -> Naming:
        """Return what it says.

        Raises
        ------
        InputError
            A text that is no pair, a quantity or a unit that does not exist.
        """
        # Here, because it is slow to load.
        from bwbayes.data.io.columns import Naming

        columns = dict(_pair("--column", text) for text in self.columns)
        units = dict(_pair("--unit", text) for text in self.units)
        return Naming(columns, units, self.fs)


def _pair(option: str, text: str) -> tuple[str, str]:
    quantity, equals, value = text.partition("=")
    if not equals:
        raise InputError(f"{option} {text}: write {option} displacement=..., with a value")
    return quantity.strip(), value.strip()


def naming_options[**P, R](command: Callable[P, R]) -> Callable[P, R]:
    """Add the options that say which columns of a record are meant, as the argument `naming`."""

    @wraps(command)
    def with_naming(*args: Any, **kwargs: Any) -> R:
        names = (kwargs.pop(name) for name in ("columns", "units", "fs"))
        return command(*args, naming=NamingOptions(*names), **kwargs)  # type: ignore[arg-type]

    for option in (
        click.option("--fs", type=float, help="Sampling rate, Hz, in place of a time column."),
        click.option(
            "--unit",
            "units",
            multiple=True,
            metavar="QUANTITY=UNIT",
            help="A column's unit, if the file does not state it; -nm turns the sign.",
        ),
        click.option(
            "--column",
            "columns",
            multiple=True,
            metavar="QUANTITY=NAME",
            help="The column of time, voltage or displacement: a name, or a number from 1 on.",
        ),
    ):
        with_naming = option(with_naming)
    return with_naming


FILE = click.Path(path_type=Path)
workers_option = click.option(
    "--workers", type=click.IntRange(1), help="Ensembles side by side; default: all cores."
)
executor_option = click.option(
    "--executor",
    "backend",
    metavar="KIND",
    help="local (default), threads, processes, dask, or dask://HOST:PORT.",
)
hold_option = click.option(
    "--hold",
    metavar="zoh|foh",
    default="zoh",
    show_default=True,
    help="Voltage between samples: held, as a DAC does (zoh), or straight lines (foh).",
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
    backend: str | None = None,
    show: Callable[[Problem], None] | None = None,
) -> int:
    """Sample the run in a folder to its end, say how it went, and return the exit status.

    ``show`` is called with the problem at first.
    """
    from bwbayes.app.running.folder import RunFolder
    from bwbayes.app.running.run import resume
    from bwbayes.report.screen import show as show_report

    folder = RunFolder.open(path)
    console = Console(stderr=True, quiet=quiet)
    try:
        fit = resume(
            folder,
            console,
            workers=workers,
            ess=ess,
            steps=steps,
            engine=engine,
            backend=backend,
            background=True,
            show=show,
            answer=None if quiet else lambda fit: show_report(fit.report(), Console()),
        )
    except KeyboardInterrupt:
        click.echo(f"interrupted; resume with `bwbayes resume {path}`", err=True)
        return INTERRUPTED
    if not quiet:
        click.echo(f"report: {folder.path / 'report.html'}")
    if not fit.converged:
        click.echo(
            f"NOT CONVERGED: {fit.outcome.stop_reason}; intervals are withheld. Resume with "
            f"`{fit.resuming}`, and look at the traces in {path}/report.html",
            err=True,
        )
        return NOT_CONVERGED
    # The screen begins with it.
    return conclude(fit.standing, say=quiet)


def conclude(standing: Standing, *, say: bool = True) -> int:
    """Say that the bands of a run do not hold, or that nobody knows; return the exit status."""
    for line in standing.said if say else ():
        click.echo(line, err=True)
    return standing.exit_status


def present(
    report: Report, files: Sequence[Path], standing: Standing, *, quiet: bool = False
) -> int:
    """Show what came of a run and the files of it; return the exit status of that run."""
    # Here, because it is slow to load.
    from bwbayes.report.screen import show

    if quiet:
        return conclude(standing)
    show(report, Console())
    for path in files:
        click.echo(f"wrote {path}")
    return standing.exit_status
