"""The folder of a campaign: its config, a run's folder for each record, and what is finished.

``records/NAME/`` is the run of the record ``NAME.csv`` (or another suffix), as ``bwbayes run``
leaves it, with the digests of the record's file and of the run's summary in ``ended.json`` once it
came to its end. ``origin.json`` says which folder of records the campaign is about. So it can be
continued from any moment on; a record that was changed is fitted again, and a run that was resumed
by itself is looked at again.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import ClassVar, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from bwbayes.app.running.folder import FileOf, Folder
from bwbayes.errors import InputError
from bwbayes.record.io.formats import SUFFIXES

# What a run's folder has once it came to its end.
ENDED = "ended.json"


class Origin(BaseModel):
    """Where it began: the folder of the records, the folder that the config's files are in.

    ``pictures`` tells whether every run draws its figures.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    records: str
    where: str
    pictures: bool


@dataclass(frozen=True)
class CampaignFolder(Folder):
    """The files of one campaign, by what they are."""

    KIND: ClassVar[str] = "campaign"
    BEGIN: ClassVar[str] = "bwbayes campaign RECORDS --out {path}"
    RESUME: ClassVar[str] = "bwbayes campaign --resume {path}"

    config = FileOf("campaign.toml")  # as it was given; empty if each record proposes its own
    mark = FileOf("origin.json")
    summary = FileOf("campaign.json")
    page = FileOf("campaign.html")

    def run(self, name: str) -> Path:
        """Return the folder of a record's run."""
        return self.path / "records" / name

    @classmethod
    def create(cls, path: Path, config: str, origin: Origin, *, overwrite: bool) -> Self:
        """Make the folder of a new campaign, whole or not at all; or return one of the same begun.

        ``config`` is its text, empty for none; ``origin`` says where records and the files of the
        config are; ``overwrite`` replaces a campaign that is there already, with all its runs.

        Raises InputError: something else is there, or a campaign of another config or of other
        records.
        """
        if path.exists() and not overwrite:
            existing = cls.open(path)
            if existing.config.read_text(encoding="utf-8") != config or existing.origin() != origin:
                raise InputError(
                    f"{path}: is a campaign of another config or other records; choose another "
                    "folder, or give `overwrite=True`"
                )
            return existing
        cls.require_free(path, overwrite)
        folder = cls(path)
        with folder.drafted() as draft:
            draft.config.write_text(config, encoding="utf-8")
            draft.mark.write_text(origin.model_dump_json(), encoding="utf-8")
        return folder

    def is_of_its_kind(self) -> bool:
        """Tell a campaign's folder from any other."""
        return self.mark.is_file() and self.config.is_file()

    def origin(self) -> Origin:
        """Return where it began.

        Raises InputError: the folder does not say it.
        """
        try:
            return Origin.model_validate_json(self.mark.read_bytes())
        except ValidationError:
            raise InputError(
                f"{self.mark}: does not say which records it is about; start again with "
                "`overwrite=True`"
            ) from None

    def is_done(self, file: Path) -> bool:
        """Tell whether a record's run has ended, and is about the file as it is now."""
        run = self.run(file.stem)
        try:
            return (run / ENDED).read_text(encoding="utf-8") == ended(digest(file), run)
        except (OSError, UnicodeError):
            return False


def records_in(folder: Path) -> list[Path]:
    """Return the files of a folder that may be records, by name.

    Hidden ones do not count, nor does the truth (``NAME.truth.csv``) beside a simulated record.

    Raises InputError: no such folder, or no such file in it.
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
    """Return the SHA-256 of a file."""
    return sha256(file.read_bytes()).hexdigest()


def ended(record: str, run: Path) -> str:
    """Return what the folder of a run that ended says: digests of its record and summary, JSON."""
    return json.dumps({"record": record, "summary": digest(run / "summary.json")})
