"""Errors and warnings for users, one line each.

An error that a person can fix (a broken record, a misspelled key, a parameter outside its domain)
is an :class:`InputError`; its text says where, what, and what to do. The command line prints that
line and ends with status 2. Anything else is a defect of bwbayes and keeps its traceback.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from enum import IntEnum
from pathlib import PurePath
from shlex import quote
from typing import Any, NoReturn


class ExitStatus(IntEnum):
    """The exit status of a command; commands that build on a run end with that run's."""

    SUCCESS = 0
    INVALID_INPUT = 2
    VALIDATION_FAILED = 3
    NOT_CONVERGED = 4
    VALIDATION_INCONCLUSIVE = 5
    INTERRUPTED = 130
    UNREAD = 141


class InputError(ValueError):
    """Input that cannot be used; the text is one line: where, what, and what to do.

    It ``is_said`` once its text is in the words of the record's own quantities.
    """

    is_said = False

    def __init__(self, text: str) -> None:
        line = one_line(text)
        # A longer text, as a stranger's file may cause, shows its beginning and its end.
        if len(line) > 600:
            line = f"{line[:300]} ... {line[-200:]}"
        super().__init__(line)


class NotConvergedError(InputError):
    """An interval was asked of a sampling that has not converged; the text says how to go on."""


class NoNumbersError(InputError):
    """A text that is no record: it has no columns of numbers."""


class ColumnsError(InputError):
    """Columns or units of a file that are not known; ``columns`` and ``units`` are a guess.

    So is ``fs``, the sampling rate, Hz, if no column can be the time. A word, ``"HZ"``, or a
    question mark, which are refused, stand for parts that cannot be guessed.

    The text says what to write in Python; :meth:`in_config` and :meth:`in_command` what to write
    elsewhere. ``place`` is the table of the config that names the file.
    """

    def __init__(
        self,
        problem: str,
        columns: Mapping[str, str | int],
        units: Mapping[str, str],
        place: str = "record",
        fs: float | str | None = None,
    ) -> None:
        self.problem, self.place, self.fs = problem, place, fs
        self.guess: dict[str, dict[str, Any]] = {"columns": dict(columns), "units": dict(units)}
        stated = [f"{key}={table!r}" for key, table in self.guess.items() if table]
        stated += [] if fs is None else [f"fs={_rate(fs)}"]
        super().__init__(f"{problem}; say {', '.join(stated)}")

    def within(self, place: str) -> ColumnsError:
        """Return the error of a file that a table of a config names."""
        guess = self.guess["columns"], self.guess["units"]
        error = ColumnsError(self.problem, *guess, place, self.fs)
        error.is_said = self.is_said
        return error

    def in_config(self) -> InputError:
        """Return the error for a config, with the lines to write into its table."""
        lines = []
        for key, table in self.guess.items():
            pairs = ", ".join(f"{quantity} = {text!r}" for quantity, text in table.items())
            lines += [f"{key} = {{ {pairs} }}"] if table else []
        lines += [] if self.fs is None else [f"fs = {_rate(self.fs)}"]
        return InputError(f"{self.problem}; under [{self.place}] say {' and '.join(lines)}")

    def in_command(self, command: str) -> InputError:
        """Return the error for the command line, with the whole command to copy."""
        typed = with_naming(command, self.guess, self.fs)
        return InputError(f"{self.problem}; copy and correct: {typed}")


def _rate(fs: float | str) -> str:
    return fs if isinstance(fs, str) else f"{fs:.12g}"


def with_naming(
    command: str, tables: Mapping[str, Mapping[str, Any]], fs: float | str | None
) -> str:
    """Return a command with the options that say columns and units by quantity, and the rate."""
    options = [
        f"--{key.removesuffix('s')} {quantity}={quote(str(text))}"
        for key, table in tables.items()
        for quantity, text in table.items()
    ]
    return " ".join([command, *options, *([] if fs is None else [f"--fs {_rate(fs)}"])])


@contextmanager
def refuse_unwritable(where: object, advice: str = "choose another place") -> Iterator[None]:
    """Say in one line, as an :class:`InputError`, why a file or folder cannot be written."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{where}: cannot be written ({reason}); {advice}") from None


def suggestion(word: str, known: Collection[str], meanings: Mapping[str, str] | None = None) -> str:
    """Return what to say of a word that is not known: the nearest one that is, or all of them.

    `meanings` says which known word other people's words stand for.
    """
    meant = (meanings or {}).get(word.lower().replace("-", "_"))
    if meant in known:
        return f"did you mean {meant}?"
    near = get_close_matches(word, known, 1)
    return f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"


def path_text(path: str | PurePath) -> str:
    r"""Return a path as text in which bytes that are not UTF-8 are written as ``\xe4``."""
    return os.fsencode(path).decode("utf-8", errors="backslashreplace")


def one_line(text: str) -> str:
    """Return a text with blanks for line breaks and all else that does not print."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


class Renamed:
    """An earlier name of an attribute: whoever asks for it is told the new one."""

    def __init__(self, now: str) -> None:
        self.now = now

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: object, owner: type) -> NoReturn:
        missing = f"{owner.__name__} has no attribute {self.name!r}"
        raise AttributeError(f"{missing}; it is {self.now} now")


class InputWarning(UserWarning):
    """Input that can be used, with something about it that the user should know."""
