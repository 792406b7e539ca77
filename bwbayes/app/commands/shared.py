"""Shared parts of the commands: output, exit status and errors.

Errors speak to those who call the package from Python, of arguments and functions in backticks:
``overwrite=True``, ``bwbayes.resume("results/a", steps=100)``. On the command line the same
are ``--overwrite`` and ``bwbayes resume results/a --steps 100``.
"""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console

from bwbayes.errors import ExitStatus, InputError

if TYPE_CHECKING:
    from bwbayes.app.running.progress import StepProgress
    from bwbayes.diagnosis.validation import ValidationSummary
    from bwbayes.report.report import Product, Report


def refuse_beside_config(config: Path, reading: Mapping[str, Any]) -> None:
    """Refuse what says how a file is read beside a config, which says that itself."""
    if any(value not in (None, {}) for value in reading.values()):
        raise InputError(
            f"{config}: --column, --unit, --covariate, --fs, --table and --displacement are for a "
            "record; in a config say columns, units, covariates, fs, table and displacement_file "
            "under [record]"
        )


def command_as_typed() -> str:
    """Return the command as it was typed, but for the options that say which columns are meant."""
    words, typed = ["bwbayes"], iter(sys.argv[1:])
    for word in typed:
        flag, has_value, _ = word.partition("=")
        if flag not in ("--column", "--unit", "--fs"):
            words.append(word)
        elif not has_value:
            next(typed)
    return shlex.join(words)


def show_report(report: Report) -> None:
    """Show a report on the screen."""
    # Here, because it is slow to load.
    from bwbayes.report.report import show

    show(report, Console())


def show_paths(paths: Iterable[Path]) -> None:
    """Say which files were written."""
    for path in paths:
        click.echo(f"wrote {path}")


def working() -> StepProgress:
    """Return a line that says on a terminal which command is at work, at what, and for how long."""
    # Here, because it is slow to load.
    from bwbayes.app.running.progress import StepProgress

    context = click.get_current_context()
    console = Console(stderr=True, quiet=context.params.get("quiet", False))
    return StepProgress(console, f"{context.info_name} ...", announced=False)


@contextmanager
def resumable(command: str) -> Iterator[None]:
    """End what is interrupted with the command that resumes it."""
    try:
        yield
    except KeyboardInterrupt:
        click.echo(f"interrupted; resume with {command}", err=True)
        raise click.exceptions.Exit(ExitStatus.INTERRUPTED) from None


def present(
    product: Product, files: Iterable[Path], standing: ValidationSummary, *, quiet: bool = False
) -> int:
    """Show a product of a run and its files; return the worse of the run's and its own status."""
    report = product.full_report()
    if not quiet:
        show_report(report)
        show_paths(files)
    # Where no banner says it.
    of_product: ValidationSummary = getattr(product, "standing", standing)
    messages = dict.fromkeys([*standing.messages, *of_product.messages])
    for line in messages if quiet or not report.banners else ():
        click.echo(line, err=True)
    if product.shortfall and (quiet or product.shortfall not in product.remarks):
        click.echo(product.shortfall, err=True)
    return worse(standing.exit_status, product.exit_status)


def worse(*statuses: ExitStatus) -> ExitStatus:
    """Return the worst: invalid input, what has not converged, a failure, what is uncertain."""
    order = (2, 4, 3, 5)
    return min(statuses, key=lambda status: (*order, status).index(status))


def finish(path: Path, *, quiet: bool, **options: Any) -> int:
    """Sample the run in a folder to its end, say how it went, and return the exit status.

    ``options`` are those of :func:`~bwbayes.app.running.run.resume`.
    """
    from bwbayes.app.running.folder import RunFolder
    from bwbayes.app.running.run import resume

    folder = RunFolder.open(path)
    with resumable(f"`bwbayes resume {path}`"):
        fit = resume(
            folder,
            Console(stderr=True, quiet=quiet),
            answer=lambda fit: None if quiet else show_report(fit.full_report()),
            **options,
        )
    if not quiet:
        click.echo(f"report: {folder.path / 'report.html'}")
    if not fit.converged:
        click.echo(
            f"NOT CONVERGED: {fit.outcome.stop_reason}; intervals are withheld. Resume with "
            f"`{fit.resuming}`, and look at the traces in {path}/report.html",
            err=True,
        )
        return ExitStatus.NOT_CONVERGED
    # The screen begins with how the bands do.
    for line in fit.standing.messages if quiet else ():
        click.echo(line, err=True)
    return fit.standing.exit_status


# Keywords with another name there.
OTHERWISE = {"fit": "run", "folder": "out", "displacement_file": "displacement"}


def as_typed(text: str) -> str:
    """Return a text with what is in backticks, arguments and calls, as it is typed in a shell."""
    arguments = r"\w+=[^\s,]+(?:, \w+=[^\s,]+)*"
    pattern = rf"`(?:bwbayes\.(?P<call>fit|resume)\((?P<inside>[^`]*)\)|(?P<alone>{arguments}))`"

    def typed(code: re.Match[str]) -> str:
        call = code["call"]
        words = [f"bwbayes {OTHERWISE.get(call, call)}"] if call else []
        for argument in (code["alone"] or code["inside"]).split(", "):
            name, sign, value = argument.rpartition("=")
            words += [f"--{OTHERWISE.get(name, name)}".replace("_", "-")] if sign else []
            words += [value.strip("'\"")] if value != "True" else []
        return f"`{' '.join(words)}`"

    return re.sub(pattern, typed, text)
