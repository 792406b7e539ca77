"""The command line: a thin layer over the package.

Exit status 0: success. 2: invalid input, said in one line. 3: converged, but validation failed: the
bands do not hold on a record that was measured, fitted or not. 4: not converged, or calibration
failed. 5: converged, but validation is inconclusive. 130: interrupted; what was computed is kept.
141: nobody reads its output any more, as behind `head`; a run can be resumed. Commands that build
on a run end with the status of that run.

A verb gives its command words and options by its arguments, and help by its docstring. All of it is
read from the function's source: loading it takes a second, which neither ``--help`` nor completion
should wait for.

Errors speak to those who call the package from Python, of arguments and functions in backticks:
``overwrite=True``, ``bwbayes.resume("results/a", steps=100)``. On the command line the same
are ``--overwrite`` and ``bwbayes resume results/a --steps 100``.
"""

from __future__ import annotations

import ast
import gc
import io
import os
import re
import shlex
import signal
import sys
import threading
import warnings
from collections import UserDict
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console

from bwbayes.app.config import MAX_SEED, USUAL_MODELS
from bwbayes.app.verbs import COMMANDS, VERBS, Verb
from bwbayes.errors import (
    ColumnsError,
    ExitStatus,
    InputError,
    NotConvergedError,
    one_line,
    path_text,
)

if TYPE_CHECKING:
    from bwbayes.app.running.progress import StepProgress
    from bwbayes.diagnosis.validation import ValidationSummary
    from bwbayes.report.report import Product, Report

FILE = click.Path(path_type=Path)

# Arguments that have a range.
RANGES = {
    "workers": click.IntRange(1),
    "replicates": click.IntRange(1),
    "steps": click.IntRange(1),
    "ess": click.FloatRange(1),
    "seed": click.IntRange(0, MAX_SEED),
}

# Help of options that many commands have, where a docstring says nothing of them.
TEXTS = {
    "overwrite": "Replace existing files.",
    "quiet": "Print nothing but errors.",
    "search": "Longest time of the search for stages, as 60s or 2min; none: no search.",
    "seed": "Seed, instead of the config's.",
}


class WithParts(click.Command):
    """A command whose help lists the parts that a model may have, as the registries do."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the parts, by kind."""
        # Here, because it is slow to load.
        from bwbayes.app.config.reference import PARTS

        del ctx
        with formatter.section("Parts"):
            formatter.write_dl([(kind, ", ".join(names)) for kind, names in PARTS.items()])
        with formatter.section("Models that are compared by default"):
            formatter.write_text(USUAL_MODELS)


def command_of(verb: Verb) -> click.Command:
    """Return the command of a verb."""
    words, options, reading = [*_words(verb)], _options(verb), dict[str, click.Option]()
    if options.pop("reading", None):
        # How a file is read.
        flags = {"columns": "column", "units": "unit", "covariates": "covariate"}
        flags |= {"displacement_file": "displacement", "voltage_is": "", "need_displacement": ""}
        reading = _options(Verb("bwbayes.record.io.formats:read_record", flags=flags))
        if not any("--voltage" in usage for usage in verb.either):
            del reading["displacement_file"]

    def called(**values: Any) -> int:
        if values.get("executor") is not None:
            # It is refused before anything is done. Here, because it is slow to load.
            from bwbayes.app.running.workers import require_executor

            require_executor(values["executor"])
        if reading:
            _require_file(verb, words, values, reading)
            values["reading"] = {key: values.pop(key) for key in reading}
        arguments = list[Any]()
        for word in words:
            value = values.pop(str(word.name))
            arguments += value if word.nargs == -1 else [value]
        if verb.either:
            arguments = [value for value in arguments if value is not None]
            if len(arguments) + sum(bool(values[key]) for key in verb.instead) != 1:
                ways = [*verb.either.values(), *verb.instead.values()]
                raise InputError(f"{verb.name}: give either {' or '.join(ways)}")
        return (_make_product if verb.is_of_run else _call)(verb, arguments, **values)

    about, *example = verb.help
    if verb.is_of_run:
        where = f"Where it goes; default: FOLDER/{verb.below or verb.name}."
        options["out"] = _option("out", "out", "Path", None, where)
        options |= {key: _option(key, key, "bool", False) for key in ("overwrite", "quiet")}
        example.insert(0, "FOLDER has the run, with whose status the command ends.")
    last = {key: options.pop(key) for key in ("out", "overwrite", "quiet") if key in options}
    folder = [click.Argument(["folder"], type=FILE)] if verb.is_of_run else []
    params = [*folder, *words, *(options | reading | last).values()]
    text = "\n\n".join([about, *example])
    kind = WithParts if verb.parts else click.Command
    return kind(verb.name, params=params, help=text, callback=called)


def _require_file(
    verb: Verb, words: list[click.Parameter], values: dict[str, Any], reading: Iterable[str]
) -> None:
    """Refuse options that say how a file is read, where none is given."""
    ways = zip(words, verb.either.values(), strict=True)
    files = {
        str(word.name): word.opts[0] if isinstance(word, click.Option) else way
        for word, way in ways
        if word.type is FILE
    }
    has_file = any(values[name] is not None for name in files)
    if not has_file and any(values[key] not in (None, {}) for key in reading):
        problem = "--column, --unit, --covariate, --fs and --table are for a file"
        give = next(iter(files.values()))
        raise InputError(f"{verb.name}: {problem}; give {give}, or remove them")


def _make_product(
    verb: Verb,
    arguments: list[Any],
    *,
    folder: Path,
    out: Path | None,
    overwrite: bool,
    quiet: bool,
    **options: Any,
) -> int:
    """Make the product of the run in FOLDER; save and show it."""
    named = [*arguments, *(options[key] for key in verb.instead)]
    stem = "".join(path_text(Path(value).stem) for value in named if isinstance(value, str | Path))
    out = out or folder / (verb.below or verb.name).replace("NAME", stem)
    with working() as watch:
        from bwbayes.app.fit.calls import open_converged
        from bwbayes.report.result import refuse_existing

        # Refuse before the computation; saving refuses every single file.
        refuse_existing(verb.load(verb.product).files(out), overwrite=overwrite)
        fit = open_converged(folder)
        if verb.is_watched:
            options["watch"] = watch
        try:
            with fit.quantities.spoken():
                product = verb.load()(fit, *arguments, **options)
        except ColumnsError as error:
            raise error.in_command(command_as_typed()) from None
        product.said_in(fit.quantities)
        saved = product.save(out, overwrite=overwrite, watch=partial(watch, "figures"))
    return present(product, saved, fit.standing, quiet=quiet)


def _call(verb: Verb, arguments: list[Any], **options: Any) -> int:
    """Call a function; show the text that it returns, or the files that it has written."""
    if verb.product == "int":  # an exit status, of what shows all by itself
        status: int = verb.load()(*arguments, **options)
        return status
    with working():
        result: str | list[Path] = verb.load()(*arguments, **options)
    if isinstance(result, str):
        click.echo(result)
    else:
        show_paths(result)
    return 0


def _words(verb: Verb) -> Iterator[click.Parameter]:
    """Yield the words, and the options in place of one, that give a verb's arguments."""
    for name, hint, number in verb.words:
        for usage, text in zip(
            verb.either or [verb.flags.get(name, name)], verb.sentences(name), strict=False
        ):
            flags, _, value = usage.partition(" ")
            if flags.startswith("--"):
                kind = FILE if value else str
                yield click.Option(flags.split("/"), type=kind, help=text)
            else:
                yield click.Argument(
                    [flags.lower()],
                    type=_type_of(name, hint),
                    required=number != "optional",
                    nargs=-1 if number == "several" else 1,
                )


def _options(verb: Verb) -> dict[str, click.Option]:
    """Return the options of a verb, by the keyword arguments that they give."""
    options = {}
    for key, (hint, default, text) in verb.options().items():
        flag = verb.flags.get(key, key).replace("_", "-")
        if flag:
            options[key] = _option(flag, key, hint, default, text)
    return options


def _type_of(name: str, hint: str) -> Any:
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


def _option(flag: str, key: str, hint: str, default: Any, text: str = "") -> click.Option:
    """Return the option of an argument with a type hint."""
    text = text or TEXTS.get(key, "")
    if hint == "bool":
        off = "" if "/" in flag or not default else f"/--no-{flag}"
        return click.Option(
            [f"--{flag.replace('/', '/--')}{off}", key],
            is_flag=True,
            default=bool(default),
            help=text,
        )
    if hint.startswith("Mapping[str, str"):
        metavar = f"QUANTITY={flag.upper()}"
        return click.Option(
            [f"--{flag}", key], multiple=True, metavar=metavar, callback=_pairs, help=text
        )
    return click.Option(
        [f"--{flag}", key],
        type=_type_of(key, hint),
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


def as_typed(text: str) -> str:
    """Return a text with what is in backticks, arguments and calls, as it is typed in a shell."""
    names = {"fit": "run", "folder": "out", "displacement_file": "displacement"}
    arguments = r"\w+=[^\s,]+(?:, \w+=[^\s,]+)*"
    pattern = rf"`(?:bwbayes\.(?P<call>fit|resume)\((?P<inside>[^`]*)\)|(?P<alone>{arguments}))`"

    def typed(code: re.Match[str]) -> str:
        call = code["call"]
        words = [f"bwbayes {names.get(call, call)}"] if call else []
        for argument in (code["alone"] or code["inside"]).split(", "):
            name, sign, value = argument.rpartition("=")
            words += [f"--{names.get(name, name)}".replace("_", "-")] if sign else []
            words += [value.strip("'\"")] if value != "True" else []
        return f"`{' '.join(words)}`"

    return re.sub(pattern, typed, text)


class Commands(UserDict[str, Any]):
    """Commands by name, each made of its verb when it is asked for."""

    def __getitem__(self, name: str) -> click.Command:
        """Return a command."""
        return command_of(self.data[name])


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="bwbayes", prog_name="bwbayes")
def cli() -> None:
    """Bayesian uncertainty of piezoelectric actuators with the Bouc-Wen hysteresis model.

    Exit status: 0 success; 2 invalid input; 3 validation failed; 4 not converged or calibration
    failed; 5 validation inconclusive; 130 interrupted; 141 output no longer read. Commands that
    build on a run end with the status of that run.
    """


cli.commands = Commands({verb.name: verb for verb in (*VERBS, *COMMANDS)})


def _failure(error: BaseException) -> tuple[str, int]:
    """Return the line that says what went wrong, and the exit status; raise what is a defect."""
    text, status = str(error), ExitStatus.INVALID_INPUT
    match error:
        case NotConvergedError():
            text = text.removeprefix("not converged: ")
            return f"NOT CONVERGED: {as_typed(text)}", ExitStatus.NOT_CONVERGED
        case ColumnsError():
            text = str(error.in_config())
        case InputError():
            pass
        case click.ClickException():
            text = one_line(error.format_message())
        case OSError():
            # A full disk, a folder that went away: what is on disk already stays whole.
            where = f"{error.filename}: " if error.filename else ""
            text = f"{where}{error.strerror or error}; fix it and resume"
        case BrokenExecutor():
            # Here, because it is slow to load.
            from concurrent.futures.process import BrokenProcessPool

            # Python's own says nothing of use.
            text = one_line("" if isinstance(error, BrokenProcessPool) else text)
            text = (
                text
                or "a worker process was killed, probably out of memory; free memory, then resume"
            )
        case MemoryError():
            text = "out of memory; use a shorter record or fewer `sampling.walkers`"
        case KeyboardInterrupt() | click.Abort():
            text, status = "interrupted", ExitStatus.INTERRUPTED
        case _:
            raise error
    return f"bwbayes: {as_typed(text)}", status


def _interrupt(_: int, frame: FrameType | None) -> None:
    """End what is under way, but a library that is being loaded only once it is there.

    Modules that it loads in C may lose an interruption, or take it for a module that is missing.
    """
    while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
        frame = frame.f_back
    if frame is None:
        raise KeyboardInterrupt
    _ask_again()


def _interrupt_again(ignored: sys.UnraisableHookArgs) -> None:
    """End what is under way, where the request fell into a callback, which cannot raise."""
    if ignored.exc_type is KeyboardInterrupt:
        _ask_again()
    else:
        sys.__unraisablehook__(ignored)


def _ask_again() -> None:
    """Ask this process to stop, a little later."""
    threading.Timer(0.1, os.kill, [os.getpid(), signal.SIGTERM]).start()


def main() -> None:
    """Run the command line; every error that a user can fix becomes one line and exit status 2."""
    # Loading libraries and compiling make hundreds of thousands of objects that stay. Looking for
    # garbage among them again and again would take a twentieth of a run.
    gc.set_threshold(50_000, 1_000)
    # A code page may lack a character of a text, and no text is worth a traceback.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    # A polite request to stop ends a run as Ctrl-C does.
    signal.signal(signal.SIGTERM, _interrupt)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # nohup ignores it
        signal.signal(signal.SIGINT, _interrupt)
    sys.unraisablehook = _interrupt_again
    warnings.formatwarning = lambda message, *_, **__: f"bwbayes: {as_typed(str(message))}\n"
    try:
        status = cli.main(sys.argv[1:] or ["--help"], standalone_mode=False)
    except (Exception, KeyboardInterrupt) as error:
        line, status = _failure(error)
        click.echo(line, err=True)
    except SystemExit:  # click's own, without a word, where nobody reads the output any more
        status = ExitStatus.UNREAD
    # All that is left ends with the process: to look through it once more takes a second.
    gc.freeze()
    sys.exit(status if isinstance(status, int) else 0)
