"""What a fit in Python needs around it: a folder for a while, somewhere to report, and warnings.

What the command line prints as a remark is a warning here.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import warnings
import weakref
from collections.abc import Iterable
from pathlib import Path

from rich.console import Console

from bwbayes.errors import InputWarning

__all__ = ["Scratch", "console_of", "folder_or_scratch", "warn"]


class Scratch:
    """A temporary folder that is removed when nobody needs it any more."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="bwbayes-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


def folder_or_scratch(folder: str | Path | None, name: str) -> tuple[Path, Scratch | None]:
    """Return a user's folder, or without one a temporary one and what keeps it there."""
    if folder is not None:
        return Path(folder), None
    scratch = Scratch()
    return scratch.path / name, scratch


def console_of(progress: bool) -> Console:
    """Return where progress goes: the terminal's own lines, and in a notebook plain ones."""
    if Console(quiet=True).is_jupyter:
        return Console(file=sys.stdout, force_jupyter=False, quiet=not progress)
    return Console(stderr=True, quiet=not progress)


def warn(lines: Iterable[str], level: int) -> None:
    """Warn of each line; the caller of the function that calls this is level 3."""
    for line in lines:
        warnings.warn(line, InputWarning, stacklevel=level)
