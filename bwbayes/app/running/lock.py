"""Folders come whole or not at all, and one process at a time writes them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from bwbayes.errors import InputError

__all__ = ["drafted", "only_writer"]


@contextmanager
def only_writer(path: Path, kind: str) -> Iterator[None]:
    """Hold the folder of a run, calibration or campaign as its only writer.

    Raises
    ------
    InputError
        Another process holds it, or it cannot be written.
    """
    lock = FileLock(path / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise InputError(
            f"{path}: another process is writing this {kind}; wait for it to end"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; make the folder writable") from None
    try:
        yield
    finally:
        lock.release()


@contextmanager
def drafted(path: Path, kind: str) -> Iterator[Path]:
    """Give a draft of a folder, with ``records`` in it; it takes the folder's place when whole.

    Raises
    ------
    InputError
        It cannot be written, or another process is writing the one that it replaces.
    """
    draft = path.absolute().with_name(f".{path.name}.partial")
    try:
        shutil.rmtree(draft, ignore_errors=True)
        (draft / "records").mkdir(parents=True)
        yield draft
        if path.exists():
            with only_writer(path, kind):
                shutil.rmtree(path)
        draft.rename(path)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: {reason}; choose another folder") from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)
