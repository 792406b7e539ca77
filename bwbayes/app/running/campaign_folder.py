"""The folder of a campaign: its config, a run's folder for each record, and what is finished.

``records/NAME/`` is the run of the record ``NAME.csv`` (or another suffix), as ``bwbayes run``
leaves it. ``campaign.jsonl`` says which folder of records it is about, and then has a line for each
run that came to its end: the digests of the record's file and of the run's summary. So a campaign
can be continued from any moment on; a record that was changed is fitted again, and a run that was
resumed by itself is looked at again.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, ValidationError

from bwbayes.app.running.lock import only_writer
from bwbayes.data.io.formats import SUFFIXES
from bwbayes.errors import InputError

__all__ = ["CampaignFolder", "Finished", "Origin", "digest", "records_in"]


class Origin(BaseModel):
    """The first line: the folder of the records, the folder that the config's files are in.

    ``pictures`` tells whether every run draws its figures.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    records: str
    where: str
    pictures: bool


class Finished(BaseModel):
    """A run that came to its end, of a record's file with this digest, with this summary."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    file: str
    summary: str


@dataclass(frozen=True)
class CampaignFolder:
    """The files of one campaign, by what they are."""

    path: Path

    @property
    def config(self) -> Path:
        """The config of all records as it was given; empty if each record is to propose its own."""
        return self.path / "campaign.toml"

    @property
    def journal(self) -> Path:
        """What was begun, and a line for each finished run."""
        return self.path / "campaign.jsonl"

    @property
    def summary(self) -> Path:
        """The campaign's numbers."""
        return self.path / "campaign.json"

    @property
    def table(self) -> Path:
        """A line for each record."""
        return self.path / "campaign.csv"

    @property
    def page(self) -> Path:
        """The page over all."""
        return self.path / "campaign.html"

    def run(self, name: str) -> Path:
        """Return the folder of a record's run."""
        return self.path / "records" / name

    @classmethod
    def create(cls, path: Path, config: str, origin: Origin, *, overwrite: bool) -> Self:
        """Make the folder of a new campaign, whole or not at all; or return one of the same begun.

        Parameters
        ----------
        path
            The folder.
        config
            The config's text, empty for none.
        origin
            Where records and config's files are.
        overwrite
            Replace a campaign that is there already, with all its runs.

        Raises
        ------
        InputError
            Something else is there, or a campaign of another config or of other records.
        """
        folder = cls(path)
        if path.exists() and not overwrite:
            begun = cls.open(path)
            if begun.config.read_text(encoding="utf-8") != config or begun.origin() != origin:
                raise InputError(
                    f"{path}: is a campaign of another config or other records; choose another "
                    "folder, or give `overwrite=True`"
                )
            return begun
        if path.exists() and any(path.iterdir()) and not folder.journal.is_file():
            raise InputError(f"{path}: is not a campaign's folder; choose another")
        draft = path.absolute().with_name(f".{path.name}.partial")
        try:
            shutil.rmtree(draft, ignore_errors=True)
            (draft / "records").mkdir(parents=True)
            made = cls(draft)
            made.config.write_text(config, encoding="utf-8")
            made.journal.write_text(origin.model_dump_json() + "\n", encoding="utf-8")
            if path.exists():
                shutil.rmtree(path)
            draft.rename(path)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"{path}: {reason}; choose another folder") from None
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        return folder

    @classmethod
    def open(cls, path: Path) -> Self:
        """Return the folder of a campaign that exists.

        Raises
        ------
        InputError
            There is no campaign.
        """
        folder = cls(path)
        if not (folder.journal.is_file() and folder.config.is_file()):
            raise InputError(f"{path}: no campaign here; give the folder of one")
        return folder

    def origin(self) -> Origin:
        """Return what was begun.

        Raises
        ------
        InputError
            The journal does not say it.
        """
        first, *_ = self.journal.read_bytes().splitlines() or [b""]
        try:
            return Origin.model_validate_json(first)
        except ValidationError:
            raise InputError(
                f"{self.journal}: does not say which records it is about; start again with "
                "`overwrite=True`"
            ) from None

    def finished(self) -> dict[str, Finished]:
        """Return the runs that came to their end, by record; cut off half a line.

        Raises
        ------
        InputError
            A line does not tell of such a run.
        """
        content = self.journal.read_bytes()
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            os.truncate(self.journal, whole)
        every: dict[str, Finished] = {}
        for number, line in enumerate(content[:whole].splitlines()[1:], start=2):
            try:
                one = Finished.model_validate_json(line)
            except ValidationError:
                raise InputError(
                    f"{self.journal}:{number}: is not a finished run; delete this line"
                ) from None
            every[one.name] = one
        return every

    def note(self, one: Finished) -> None:
        """Write a line so that it survives a crash."""
        with self.journal.open("ab") as file:
            file.write(one.model_dump_json().encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())

    def is_done(self, file: Path, finished: Mapping[str, Finished]) -> bool:
        """Tell whether a record's run has ended, and is about the file as it is now."""
        one, summary = finished.get(file.stem), self.run(file.stem) / "summary.json"
        return (
            one is not None
            and summary.is_file()
            and digest(summary) == one.summary
            and digest(file) == one.file
        )

    def locked(self) -> AbstractContextManager[None]:
        """Hold the folder as its only writer, as :func:`only_writer` does."""
        return only_writer(self.path, "campaign")


def records_in(folder: Path) -> list[Path]:
    """Return the files of a folder that may be records, by name.

    Hidden ones do not count, nor does the truth (``NAME.truth.csv``) beside a simulated record.

    Raises
    ------
    InputError
        No such folder, or no such file in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; give the one that the records are in")
    files = [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in SUFFIXES
        and not path.name.startswith(".")
        and not path.stem.endswith(".truth")
    ]
    if not files:
        raise InputError(f"{folder}: has no record; records end in {', '.join(SUFFIXES)}")
    return files


def digest(file: Path) -> str:
    """Return the SHA-256 of a file; of one that cannot be read, nothing."""
    try:
        return sha256(file.read_bytes()).hexdigest()
    except OSError:
        return ""
