"""The folders of runs, calibrations and campaigns: what is in them, and who may write them.

A folder appears in one step, with the resolved config and the records in it, so that its work can
be continued from any moment on. It is never overwritten unless that is asked for, and a lock
refuses a second writer.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

from filelock import FileLock, Timeout

from bwbayes.app.config.config import dump, load
from bwbayes.app.problem.problem import Problem, resolve
from bwbayes.diagnosis.standing import Standing
from bwbayes.errors import InputError
from bwbayes.record import write_record

__all__ = ["CalibrationFolder", "Folder", "RunFolder"]


@dataclass(frozen=True)
class Folder:
    """A folder of work that comes whole or not at all, and that one process at a time writes."""

    path: Path

    KIND: ClassVar[str] = ""

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
                f"{self.path}: another process is writing this {self.KIND}; wait for it to end"
            ) from None
        except OSError as error:
            raise InputError(f"{self.path}: {error.strerror}; make the folder writable") from None
        try:
            yield
        finally:
            lock.release()

    @contextmanager
    def drafted(self) -> Iterator[Self]:
        """Give a draft of the folder, with ``records`` in it, that takes its place when whole.

        Raises
        ------
        InputError
            It cannot be written, or another process is writing the one that it replaces.
        """
        draft = self.path.absolute().with_name(f".{self.path.name}.partial")
        try:
            shutil.rmtree(draft, ignore_errors=True)
            (draft / "records").mkdir(parents=True)
            yield type(self)(draft)
            if self.path.exists():
                with self.locked():
                    shutil.rmtree(self.path)
            draft.rename(self.path)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"{self.path}: {reason}; choose another folder") from None
        finally:
            shutil.rmtree(draft, ignore_errors=True)


@dataclass(frozen=True)
class RunFolder(Folder):
    """The files of one run, by what they are."""

    # What it holds, the file that only such a folder has at its start, and what begins and resumes
    # it.
    KIND: ClassVar[str] = "run"
    MARK: ClassVar[str | None] = None
    BEGIN: ClassVar[str] = "bwbayes.fit(RECORD, folder={path!r})"
    RESUME: ClassVar[str] = "bwbayes.resume({path!r})"

    @property
    def resuming(self) -> str:
        """What resumes it, for messages."""
        return f"`{self.RESUME.format(path=str(self.path))}`"

    @property
    def config(self) -> Path:
        """The resolved config: every choice an explicit number."""
        return self.path / "config.toml"

    @property
    def chain(self) -> Path:
        """The folder of the chain, which grows by a file a block."""
        return self.path / "chain"

    @property
    def result(self) -> Path:
        """What was worked out of the chain."""
        return self.path / "result.npz"

    @property
    def summary(self) -> Path:
        """The run's numbers."""
        return self.path / "summary.json"

    def problem(self) -> Problem:
        """Return what its config and records say."""
        return resolve(load(self.config), self.path)

    def numbers(self) -> dict[str, Any]:
        """Return the numbers of its summary; none as long as it is not finished."""
        if not self.summary.is_file():
            return {}
        numbers: dict[str, Any] = json.loads(self.summary.read_text(encoding="utf-8"))
        return numbers

    def standing(self) -> Standing:
        """Return whether the bands of the run hold.

        Raises
        ------
        InputError
            The run is not finished.
        """
        if not self.summary.is_file():
            raise InputError(f"{self.path}: is not finished; resume with {self.resuming}")
        return Standing.read(self.numbers())

    @classmethod
    def create(cls, path: Path, problem: Problem, overwrite: bool, mark: bytes = b"") -> Self:
        """Make the folder of a new run, whole or not at all; ``mark`` goes into its mark.

        Raises
        ------
        InputError
            It exists and ``overwrite`` is not given, it is not a run's, or cannot be written.
        """
        cls.require_free(path, overwrite)
        folder = cls(path)
        with folder.drafted() as draft:
            for name, record in {**problem.records, **problem.others}.items():
                write_record(record, draft.path / f"records/{name}.h5")
            draft.config.write_text(dump(problem.config), encoding="utf-8")
            if cls.MARK:
                (draft.path / cls.MARK).write_bytes(mark)
        return folder

    @classmethod
    def require_free(cls, path: Path, overwrite: bool) -> None:
        """Refuse a place where a new run cannot be made, as :meth:`create` does."""
        if path.name == "..":
            raise InputError(f"{path}: is not a valid folder name; choose another")
        if path.exists():
            if not overwrite:
                raise InputError(
                    f"{path}: exists; resume with {cls(path).resuming}, choose another folder, "
                    "or give `overwrite=True`"
                )
            empty = path.is_dir() and not any(path.iterdir())
            if not (empty or cls(path)._is_of_its_kind()):
                raise InputError(f"{path}: is not a {cls.KIND}'s folder; choose another")

    @classmethod
    def open(cls, path: Path) -> Self:
        """Return the folder of a run that exists.

        Raises
        ------
        InputError
            There is no run.
        """
        folder = cls(path)
        if folder._is_of_its_kind():
            return folder
        where = f"{path}: no {cls.KIND} here"
        if path.is_file():
            raise InputError(f"{where}, but a file; give the folder that a {cls.KIND} has made")
        if folder._has_records():
            raise InputError(f"{where}, but something else's folder; give a {cls.KIND}'s folder")
        raise InputError(f"{where}; start one with `{cls.BEGIN.format(path=str(path))}`")

    def _has_records(self) -> bool:
        """Tell a folder that was made from one that holds a config alone."""
        return self.config.is_file() and any((self.path / "records").glob("*.h5"))

    def _is_of_its_kind(self) -> bool:
        """Tell a run's folder from a calibration's, and from what is neither."""
        is_calibration = (self.path / CalibrationFolder.MARK).is_file()
        return self._has_records() and is_calibration == (self.MARK is not None)


@dataclass(frozen=True)
class CalibrationFolder(RunFolder):
    """The files of one calibration; its config is that of all its replicates."""

    KIND: ClassVar[str] = "calibration"
    MARK: ClassVar[str] = "replicates.jsonl"
    BEGIN: ClassVar[str] = "bwbayes calibrate CONFIG --out {path}"
    RESUME: ClassVar[str] = "bwbayes calibrate --resume {path}"

    @property
    def replicates(self) -> Path:
        """What they are replicates of, how many were requested, and then a line for each."""
        return self.path / self.MARK

    @property
    def summary(self) -> Path:
        """The calibration's numbers."""
        return self.path / "calibration.json"
