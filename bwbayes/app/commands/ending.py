"""How commands end: what they show, what they say was written, their exit status, and their errors.

Errors speak to those who call the package from Python, of arguments and functions in backticks:
``overwrite=True``, ``bwbayes.resume("results/a", steps=100)``. On the command line the same
are ``--overwrite`` and ``bwbayes resume results/a --steps 100``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console

from bwbayes.errors import ExitStatus, InputError

if TYPE_CHECKING:
    from bwbayes.app.problem.problem import Problem
    from bwbayes.diagnosis.validation import Standing
    from bwbayes.report.report import Report


def show_report(report: Report) -> None:
    """Show a report on the screen."""
    # Here, because it is slow to load.
    from bwbayes.report.screen import show

    show(report, Console())


@contextmanager
def resumable(command: str) -> Iterator[None]:
    """End what is interrupted with the command that resumes it."""
    try:
        yield
    except KeyboardInterrupt:
        click.echo(f"interrupted; resume with {command}", err=True)
        raise click.exceptions.Exit(ExitStatus.INTERRUPTED) from None


def require_new_or_resumed(
    command: str, either: str, new: object, resumed: object, options: Mapping[str, object]
) -> None:
    """Refuse neither a new study nor one to resume, both, and options of a new one to resume."""
    if (new is None) == (resumed is None):
        raise InputError(f"{command}: give either {either}")
    if new is None and any(value not in (None, False) for value in options.values()):
        raise InputError(f"{command}: --resume takes no other options; remove them")


def present(
    report: Report, files: Sequence[Path], standing: Standing, *, quiet: bool = False
) -> int:
    """Show what came of a run and the files of it; return the exit status of that run."""
    if quiet:
        for line in standing.said:
            click.echo(line, err=True)
    else:
        show_report(report)
        for path in files:
            click.echo(f"wrote {path}")
    return standing.exit_status


def finish(
    path: Path, *, quiet: bool, show: Callable[[Problem], None] | None = None, **options: Any
) -> int:
    """Sample the run in a folder to its end, say how it went, and return the exit status.

    ``show`` is called with the problem at first; ``options`` are those of
    :func:`~bwbayes.app.running.run.resume`.
    """
    from bwbayes.app.running.folder import RunFolder
    from bwbayes.app.running.run import resume

    folder = RunFolder.open(path)
    with resumable(f"`bwbayes resume {path}`"):
        fit = resume(
            folder,
            Console(stderr=True, quiet=quiet),
            show=show,
            answer=lambda fit: None if quiet else show_report(fit.report()),
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
    for line in fit.standing.said if quiet else ():
        click.echo(line, err=True)
    return fit.standing.exit_status


# What is called otherwise there.
OTHERWISE = {"fit": "run", "folder": "out"}


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
