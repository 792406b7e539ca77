"""One writer at a time: a folder is held by the process that writes it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from bwbayes.errors import InputError

__all__ = ["only_writer"]


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
