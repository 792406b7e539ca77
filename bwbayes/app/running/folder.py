"""The folders of runs, calibrations and campaigns: what is in them, and who may write them.

A folder appears in one step, with the resolved config and the records in it, so that its work can
be continued from any moment on. It is never overwritten unless that is asked for, and a lock
refuses a second writer.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

from filelock import FileLock, Timeout

from bwbayes.errors import InputError, refuse_unwritable
from bwbayes.quantities import Quantities

if TYPE_CHECKING:
    from bwbayes.app.fit.fitted import Run


class FileOf:
    """A file that a folder has, or may have, as an attribute: its path."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, folder: Folder, _: object = None) -> Path:
        """Return its path in a folder."""
        return folder.path / self.name


@dataclass(frozen=True)
class Folder:
    """A folder of work that comes whole or not at all, and that one process at a time writes."""

    path: Path

    # Its content, patterns of files it has and lacks, and commands that begin and resume it.
    KIND: ClassVar[str]
    HAS: ClassVar[tuple[str, ...]]
    LACKS: ClassVar[tuple[str, ...]] = ()
    BEGIN: ClassVar[str]
    RESUME: ClassVar[str]

    @property
    def resuming(self) -> str:
        """The command that resumes it, for messages."""
        return f"`{self.RESUME.format(path=str(self.path))}`"

    def is_of_its_kind(self) -> bool:
        """Tell whether this is a folder that was made, and not another one."""

        def has(pattern: str) -> bool:
            return any(self.path.glob(pattern))

        return all(map(has, self.HAS)) and not any(map(has, self.LACKS))

    @classmethod
    def open(cls, path: Path) -> Self:
        """Return the folder of what exists.

        Raises InputError: there is none of this kind.
        """
        folder = cls(path)
        if folder.is_of_its_kind():
            return folder
        where = f"{path}: no {cls.KIND} here"
        if path.is_file():
            raise InputError(f"{where}, but a file; give the folder that a {cls.KIND} has made")
        if any(kind(path).is_of_its_kind() for kind in (RunFolder, CalibrationFolder)):
            raise InputError(f"{where}, but something else's folder; give a {cls.KIND}'s folder")
        raise InputError(f"{where}; start one with `{cls.BEGIN.format(path=str(path))}`")

    @classmethod
    def require_free(cls, path: Path, overwrite: bool) -> None:
        """Refuse a place where a new folder cannot be made.

        Raises InputError: it exists and ``overwrite`` is not given, or it is not one of this kind.
        """
        if path.name == "..":
            raise InputError(f"{path}: is not a valid folder name; choose another")
        if path.exists():
            if not overwrite:
                raise InputError(
                    f"{path}: exists; resume with {cls(path).resuming}, choose another folder, "
                    "or give `overwrite=True`"
                )
            empty = path.is_dir() and not any(path.iterdir())
            if not (empty or cls(path).is_of_its_kind()):
                raise InputError(f"{path}: is not a {cls.KIND}'s folder; choose another")

    @classmethod
    @contextmanager
    def drafted(cls, path: Path, overwrite: bool) -> Iterator[Self]:
        """Give a draft of a new folder, with ``records`` in it, that takes its place when whole.

        Raises InputError: as :meth:`require_free`; it cannot be written, or another process is
        writing the one that it replaces.
        """
        cls.require_free(path, overwrite)
        draft = path.absolute().with_name(f".{path.name}.partial")
        try:
            with refuse_unwritable(path, "choose another folder"):
                shutil.rmtree(draft, ignore_errors=True)
                (draft / "records").mkdir(parents=True)
                yield cls(draft)
                if path.exists():
                    with cls(path).locked():
                        shutil.rmtree(path)
                draft.rename(path)
        finally:
            shutil.rmtree(draft, ignore_errors=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder as its only writer.

        Raises InputError: another process holds it, or it cannot be written.
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


@dataclass(frozen=True)
class RunFolder(Folder):
    """The files of one run, by what they are."""

    KIND: ClassVar[str] = "run"
    HAS: ClassVar[tuple[str, ...]] = ("config.toml", "records/*.h5")
    LACKS: ClassVar[tuple[str, ...]] = ("replicates.jsonl",)
    BEGIN: ClassVar[str] = "bwbayes.fit(RECORD, folder={path!r})"
    RESUME: ClassVar[str] = "bwbayes.resume({path!r})"

    config = FileOf("config.toml")  # every choice an explicit number
    chain = FileOf("chain")  # a folder, which grows by a file a block
    backend = FileOf("chain.h5")  # the same as emcee stores it
    search = FileOf("search.npz")  # what explains the readings better than the chosen model
    rivals = FileOf("rivals.npz")  # other models of the same readings, once they were needed
    result = FileOf("result.npz")  # what was worked out of the chain
    summary = FileOf("summary.json")  # the numbers, written last of all
    replicates = FileOf("replicates.jsonl")  # of a calibration alone

    @classmethod
    def create(cls, path: Path, run: Run, overwrite: bool = False, mark: bytes = b"") -> Self:
        """Make a new folder for a run, whole or not at all; ``mark`` is of a calibration's file.

        Raises InputError: it exists and ``overwrite`` is not given, it is not a run's, or cannot be
        written.
        """
        from bwbayes.app.config.config import dump
        from bwbayes.record import write_record

        with cls.drafted(path, overwrite) as draft:
            for name, record in {**run.study.records, **run.study.others}.items():
                write_record(record, draft.path / f"records/{name}.h5")
            draft.config.write_text(dump(run.config), encoding="utf-8")
            if mark:
                draft.replicates.write_bytes(mark)
        return cls(path)

    @property
    def calibration(self) -> CalibrationFolder:
        """The files of the calibration around its posterior, if there was one."""
        return CalibrationFolder(self.path / "calibration")

    def numbers(self) -> dict[str, Any]:
        """Return the numbers of its summary; none as long as it is not finished.

        A summary that is cut off, as on a full disk, is none.
        """
        try:
            numbers = json.loads(self.summary.read_bytes())
        except (FileNotFoundError, ValueError):
            return {}
        return numbers if isinstance(numbers, dict) else {}

    def require_finished(self) -> None:
        """Raise an InputError if the run is not finished."""
        if not self.numbers():
            raise InputError(f"{self.path}: is not finished; resume with {self.resuming}")


@dataclass(frozen=True)
class CalibrationFolder(RunFolder):
    """The files of one calibration; its config is that of all its replicates.

    ``replicates`` says what they are replicates of, how many were requested, and then has a line
    for each.
    """

    KIND: ClassVar[str] = "calibration"
    HAS: ClassVar[tuple[str, ...]] = (*RunFolder.HAS, *RunFolder.LACKS)
    LACKS: ClassVar[tuple[str, ...]] = ()
    BEGIN: ClassVar[str] = "bwbayes calibrate CONFIG --out {path}"
    RESUME: ClassVar[str] = "bwbayes calibrate --resume {path}"

    summary = FileOf("calibration.json")


class Origin(NamedTuple):
    """Where a campaign began: the folder of its records, the folder that its config's files are in.

    ``pictures`` tells whether every run draws its figures; ``reading`` how files are read where no
    config says it, as keyword arguments of ``read_record``.
    """

    records: str
    where: str
    pictures: bool
    reading: Mapping[str, Any] = {}


@dataclass(frozen=True)
class CampaignFolder(Folder):
    """The files of one campaign: a run's folder for each record, and what is finished.

    ``records/NAME/`` is the run of the record ``NAME.csv`` (or another suffix), as ``bwbayes run``
    leaves it, with the digests of the record's file, of those that the config predicts and of the
    run's summary in ``ended.json`` once it came to its end. So a record that was changed, or what
    it is validated on, is fitted again, and a run that was resumed by itself is looked at again.
    """

    KIND: ClassVar[str] = "campaign"
    HAS: ClassVar[tuple[str, ...]] = ("origin.json", "campaign.toml")
    BEGIN: ClassVar[str] = "bwbayes campaign RECORDS --out {path}"
    RESUME: ClassVar[str] = "bwbayes campaign --resume {path}"

    config = FileOf("campaign.toml")  # as it was given; empty if each record proposes its own
    mark = FileOf("origin.json")
    summary = FileOf("campaign.json")
    page = FileOf("campaign.html")

    def run(self, name: str) -> Path:
        """Return the folder of a record's run."""
        return self.path / "records" / name

    def specimen(self, name: str) -> Path:
        """Return the file with the numbers of a record's run that a population needs."""
        return self.run(name) / "specimen.npz"

    def progress(self, name: str) -> Path:
        """Return the file that says what a record's run is at, as long as it is fitted."""
        return self.path / f".{name}.progress"

    def first_progress(self) -> str:
        """Say what the first of the records that are being fitted is at, as its run says it."""
        for path in sorted(self.path.glob(self.progress("*").name)):
            with suppress(OSError):
                line = path.read_text(encoding="utf-8")
                if line:
                    return f"{path.stem[1:]}: {line}"
        return ""

    @classmethod
    def create(cls, path: Path, config: str, origin: Origin, *, overwrite: bool) -> Self:
        """Make the folder of a new campaign, whole or not at all; or return one of the same begun.

        ``config`` is its text, empty for none; ``overwrite`` replaces a campaign that is there
        already, with all its runs.

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
        with cls.drafted(path, overwrite) as draft:
            draft.config.write_text(config, encoding="utf-8")
            draft.mark.write_text(json.dumps(origin._asdict()), encoding="utf-8")
        return cls(path)

    def origin(self) -> Origin:
        """Return where it began.

        Raises InputError: the folder does not say it.
        """
        try:
            noted = json.loads(self.mark.read_bytes())
            reading = dict(noted.get("reading", {}))
            where = str(noted["records"]), str(noted["where"])
            return Origin(*where, bool(noted["pictures"]), reading)
        except (KeyError, TypeError, ValueError):
            raise InputError(
                f"{self.mark}: does not say which records it is about; start again with "
                "`overwrite=True`"
            ) from None

    def quantities(self) -> Quantities:
        """Return what its records are of, as its config or else the command says."""
        from bwbayes.app.config.config import parse

        reading = self.origin().reading
        stated = reading.get("input"), reading.get("output")
        if text := self.config.read_text(encoding="utf-8"):
            first = next(iter(parse(text, str(self.config)).records.values()))
            stated = first.input, first.output
        return Quantities.of(*stated)

    def digests(self, file: Path) -> dict[str, str]:
        """Return the SHA-256 of a record's file, and of all files that the config predicts."""
        from bwbayes.app.config.config import parse

        files = {"record": file}
        if text := self.config.read_text(encoding="utf-8"):
            where = Path(self.origin().where)
            for name, validation in parse(text, str(self.config)).validation.items():
                if validation.file is not None:
                    files[f"validation.{name}"] = where / validation.file
                if validation.displacement_file is not None:
                    files[f"validation.{name}.displacement"] = where / validation.displacement_file
        return {name: sha256(path.read_bytes()).hexdigest() for name, path in files.items()}

    def is_done(self, file: Path) -> bool:
        """Tell whether a record's run has ended, and is about the files as they are now."""
        try:
            mark = (self.run(file.stem) / "ended.json").read_text(encoding="utf-8")
            return mark == self._ended_digests(file.stem, self.digests(file))
        except (OSError, UnicodeError):
            return False

    def mark_done(self, name: str, digests: Mapping[str, str]) -> None:
        """Note that a record's run has ended, and the digests of the files that it is about."""
        mark = self._ended_digests(name, digests)
        (self.run(name) / "ended.json").write_text(mark, encoding="utf-8")

    def _ended_digests(self, name: str, digests: Mapping[str, str]) -> str:
        """Return the digests of a run that ended with that of its summary, JSON."""
        summary = sha256((self.run(name) / "summary.json").read_bytes()).hexdigest()
        return json.dumps({**digests, "summary": summary})
