"""The command line: a thin layer over the package.

Exit status 0: success. 2: invalid input, said in one line. 3: converged, but validation failed: the
bands do not hold on a record that was measured, fitted or not. 4: not converged, or calibration
failed. 5: converged, but validation is inconclusive. 130: interrupted; what was computed is kept.
141: nobody reads its output any more, as behind `head`; a run can be resumed. Commands that build
on a run end with the status of that run.
"""

from __future__ import annotations

import gc
import io
import os
import signal
import sys
import threading
import warnings
from collections import UserDict
from concurrent.futures import BrokenExecutor
from types import FrameType
from typing import Any

import click

from bwbayes.app.commands.command import as_typed
from bwbayes.app.verbs import COMMANDS, VERBS
from bwbayes.errors import ColumnsError, ExitStatus, InputError, NotConvergedError, one_line


class Commands(UserDict[str, Any]):
    """Commands by name, each made of its verb when it is asked for."""

    def __getitem__(self, name: str) -> click.Command:
        """Return a command."""
        from bwbayes.app.commands.command import command_of

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
