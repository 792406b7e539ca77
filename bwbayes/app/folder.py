"""A run's folder: what is in it, who may write it, and how it comes to be.

The folder appears in one step, with the resolved config and the records in it, so that a run can be
continued from any moment on. It is never overwritten unless that is asked for, and a lock refuses
a second writer.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from bwbayes.app.config import dump
from bwbayes.app.problem import Problem
from bwbayes.data import write_record
from bwbayes.errors import InputError

__all__ = ["RunFolder"]


@dataclass(frozen=True)
class RunFolder:
    """The files of one run, by what they are."""

    path: Path

    @property
    def config(self) -> Path:
        """The resolved config: every choice an explicit number."""
        return self.path / "config.toml"

    @property
    def chain(self) -> Path:
        """The chain, appended block by block."""
        return self.path / "chain.h5"

    @property
    def summary(self) -> Path:
        """The run's numbers."""
        return self.path / "summary.json"

    @classmethod
    def create(cls, path: Path, problem: Problem, overwrite: bool) -> RunFolder:
        """Make the folder of a new run, whole or not at all.

        Raises
        ------
        InputError
            It exists and ``overwrite`` is not given, or it is no run's, or it cannot be written.
        """
        if path.exists():
            if not overwrite:
                raise InputError(
                    f"{path}: exists; go on with `bwbayes resume {path}`, choose another folder "
                    "with --out, or give --overwrite"
                )
            if not cls(path)._may_go():
                raise InputError(f"{path}: is not a run's folder; choose another with --out")
        draft = path.absolute().with_name(f".{path.name}.partial")
        try:
            shutil.rmtree(draft, ignore_errors=True)
            (draft / "records").mkdir(parents=True)
            write_record(problem.record, draft / "records/record.h5")
            for name, validation in problem.validations.items():
                if validation.record is not None:
                    write_record(validation.record, draft / f"records/{name}.h5")
            (draft / "config.toml").write_text(dump(problem.config), encoding="utf-8")
            if path.exists():
                with cls(path).locked():
                    shutil.rmtree(path)
            draft.rename(path)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"{path}: {reason}; choose another folder with --out") from None
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Return the folder of a run that exists.

        Raises
        ------
        InputError
            There is no run.
        """
        folder = cls(path)
        if not folder.config.is_file():
            raise InputError(
                f"{path}: no run here; start one with `bwbayes run CONFIG --out {path}`"
            )
        return folder

    def _may_go(self) -> bool:
        """Tell whether nothing but a run would be lost with this folder."""
        record = self.path / "records/record.h5"
        empty = self.path.is_dir() and not any(self.path.iterdir())
        return empty or (self.config.is_file() and record.is_file())

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder as its only writer.

        Raises
        ------
        InputError
            Another process holds it, or it cannot be written.
        """
        lock = FileLock(self.path / ".lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            raise InputError(
                f"{self.path}: another process is writing this run; wait for it to end"
            ) from None
        except OSError as error:
            raise InputError(f"{self.path}: {error.strerror}; make the folder writable") from None
        try:
            yield
        finally:
            lock.release()
