"""Shared parts of the commands: options, output, exit status and errors.

The keyword arguments of a function are options of the same names, with their types and defaults;
their help is the first sentence of each description. They are read from the function's source:
loading it takes a second, which neither ``--help`` nor completion should wait for.

Errors speak to those who call the package from Python, of arguments and functions in backticks:
``overwrite=True``, ``bwbayes.resume("results/a", steps=100)``. On the command line the same
are ``--overwrite`` and ``bwbayes resume results/a --steps 100``.
"""

from __future__ import annotations

import ast
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console

from bwbayes.app.config import MAX_SEED
from bwbayes.app.verbs import Verb
from bwbayes.errors import ExitStatus, InputError

if TYPE_CHECKING:
    from bwbayes.app.running.progress import StepProgress
    from bwbayes.diagnosis.validation import ValidationSummary
    from bwbayes.report.report import Product, Report

type AnyCommand = Callable[..., Any]

FILE = click.Path(path_type=Path)

# Arguments that have a range.
RANGES = {
    "workers": click.IntRange(1),
    "replicates": click.IntRange(1),
    "steps": click.IntRange(1),
    "ess": click.FloatRange(1),
    "seed": click.IntRange(0, MAX_SEED),
}

folder_argument = click.argument("folder", type=FILE)
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace existing files.")
quiet_option = click.option("--quiet", is_flag=True, help="Print nothing but errors.")
seed_option = click.option("--seed", type=RANGES["seed"], help="Seed, instead of the config's.")
search_option = click.option(
    "--search", help="Longest time of the search for stages, as 60s or 2min; none: no search."
)


def options_of(verb: Verb, *omitted: str) -> Callable[[AnyCommand], AnyCommand]:
    """Return a decorator that adds a function's keyword arguments, but some, as options."""

    def decorate(command: AnyCommand) -> AnyCommand:
        @wraps(command)
        def usable(*args: Any, **options: Any) -> Any:
            # A command that computes is refused before it does anything.
            if options.get("executor") is not None:
                # Here, because it is slow to load.
                from bwbayes.app.running.workers import require_executor

                require_executor(options["executor"])
            return command(*args, **options)

        decorated: AnyCommand = usable
        # The first decorator of a command is applied last.
        for key, hint, default, text in reversed([*verb.options()]):
            if key not in ("reading", *omitted):
                flag = verb.flags.get(key, key).replace("_", "-")
                decorated = _option(flag, key, hint, default, text)(decorated)
        return decorated

    return decorate


def type_of(name: str, hint: str) -> Any:
    """Return the type of an argument with a type hint, as click has it; None if it is a text."""
    if name in RANGES:
        return RANGES[name]
    choices = re.search(r"Literal(\[.*?\])", hint)
    if choices:
        return click.Choice(ast.literal_eval(choices[1]))
    if "Path" in hint:
        return FILE
    types = {"tuple[float, float]": (float, float), "tuple[float, ...]": float}
    return {**types, "float": float, "int": int}.get(hint)


def _option(
    flag: str, key: str, hint: str, default: Any, text: str
) -> Callable[[AnyCommand], AnyCommand]:
    """Return the option of an argument with a type hint."""
    if hint == "bool":
        flags = f"--{flag}/--no-{flag}" if default else f"--{flag}"
        return click.option(flags, key, is_flag=True, default=default, help=text)
    if hint.startswith("Mapping[str, str"):
        metavar = f"QUANTITY={flag.upper()}"
        return click.option(
            f"--{flag}", key, multiple=True, metavar=metavar, callback=_pairs, help=text
        )
    return click.option(
        f"--{flag}",
        key,
        type=type_of(key, hint),
        metavar="FROM TO" if hint == "tuple[float, float]" else None,
        multiple=hint == "tuple[float, ...]",
        default=default,
        show_default=default is not None,
        help=text,
    )


def _pairs(_: click.Context, option: click.Parameter, texts: tuple[str, ...]) -> dict[str, str]:
    """Read what stands to the left and right of equals signs."""
    for text in texts:
        if "=" not in text:
            flag = option.opts[0]
            raise InputError(f"{flag} {text}: write {flag} displacement=..., with a value")
    pairs = (text.partition("=") for text in texts)
    return {quantity.strip(): value.strip() for quantity, _, value in pairs}


# Options that say how a record's files are read, and a single file.
_reading = Verb(
    "bwbayes.record.io.formats:read_record",
    flags={
        "columns": "column",
        "units": "unit",
        "covariates": "covariate",
        "displacement_file": "displacement",
    },
)
naming_options = options_of(_reading, "voltage_is", "need_displacement")
column_options = options_of(_reading, "voltage_is", "need_displacement", "displacement_file")


class WithParts(click.Command):
    """A command whose help lists the parts that a model may have, as the registries do."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the parts, by kind."""
        # Here, because it is slow to load.
        from bwbayes.app.config.reference import PARTS

        del ctx
        with formatter.section("Parts"):
            formatter.write_dl([(kind, ", ".join(names)) for kind, names in PARTS.items()])


def file_argument(name: str) -> Callable[[AnyCommand], AnyCommand]:
    """Return a decorator that adds the file that a command is about, or --voltage in its place."""

    def decorate(command: AnyCommand) -> AnyCommand:
        @wraps(command)
        def usable(*, voltage: Path | None, **options: Any) -> Any:
            given = [file for file in (options[name], voltage) if file is not None]
            if len(given) != 1:
                context = click.get_current_context()
                raise InputError(
                    f"{context.info_name}: give either {name.upper()}, or --voltage FILE and "
                    "--displacement FILE"
                )
            return command(**options | {name: given[0]})

        argument = click.argument(name, type=FILE, required=False)
        text = "A record's file with the voltage, if --displacement has the rest."
        option = click.option("--voltage", type=FILE, help=text)
        decorated: AnyCommand = argument(option(usable))
        return decorated

    return decorate


def reading_of(options: dict[str, Any], file: object, flag: str) -> dict[str, Any]:
    """Take what :func:`column_options` say out of a command's options.

    Raises InputError: they say something, and the command is given no ``file``.
    """
    keys = ("columns", "units", "fs", "covariates", "table", "input", "output")
    reading = {key: options.pop(key) for key in keys}
    if file is None and any(value not in (None, {}) for value in reading.values()):
        context = click.get_current_context()
        problem = "--column, --unit, --covariate, --fs and --table are for a file"
        raise InputError(f"{context.info_name}: {problem}; give {flag}, or remove them")
    return reading


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


def require_new_or_resumed(
    command: str, either: str, new: object, resumed: object, options: Mapping[str, object]
) -> None:
    """Refuse neither a new study nor one to resume, both, and options of a new one to resume."""
    if (new is None) == (resumed is None):
        raise InputError(f"{command}: give either {either}")
    if new is None and any(value not in (None, False) for value in options.values()):
        raise InputError(f"{command}: --resume takes no other options; remove them")


def present(
    product: Product, files: Sequence[Path], standing: ValidationSummary, *, quiet: bool = False
) -> int:
    """Show a product of a run and its files; return the worse of the run's and its own status."""
    report = product.full_report()
    if not quiet:
        show_report(report)
        for path in files:
            click.echo(f"wrote {path}")
    # Where no banner says it.
    for line in standing.messages if quiet or not report.banners else ():
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
