"""The folder of a run or a calibration: what is in it, who may write it, and how it comes to be.

The folder appears in one step, with the resolved config and the records in it, so that its work can
be continued from any moment on. It is never overwritten unless that is asked for, and a lock
refuses a second writer.
"""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

from bwbayes.app.config.config import dump, load
from bwbayes.app.problem.problem import Problem, resolve
from bwbayes.app.running.lock import drafted, only_writer
from bwbayes.data import write_record
from bwbayes.errors import InputError
from bwbayes.results.standing import Standing

__all__ = ["CalibrationFolder", "RunFolder"]


@dataclass(frozen=True)
class RunFolder:
    """The files of one run, by what they are."""

    path: Path

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
        """The chain, appended block by block."""
        return self.path / "chain.h5"

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
        with drafted(path, cls.KIND) as draft:
            for name, record in {**problem.records, **problem.others}.items():
                write_record(record, draft / f"records/{name}.h5")
            (draft / "config.toml").write_text(dump(problem.config), encoding="utf-8")
            if cls.MARK:
                (draft / cls.MARK).write_bytes(mark)
        return cls(path)

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

    def locked(self) -> AbstractContextManager[None]:
        """Hold the folder as its only writer, as :func:`only_writer` does."""
        return only_writer(self.path, self.KIND)


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
