"""A campaign: one posterior for each record of a folder, and what they say together.

:func:`start` makes the folder; :func:`resume` fits the records whose runs have not ended, side by
side and each as ``bwbayes run`` fits it, and writes table and page over all of them. One that
cannot be used comes back as a refusal of one line. A record's run depends on the config, the seed
and the record alone, and the tables on the runs alone. So pieces and workers do not matter, and
records that come later are fitted by themselves.
"""

from __future__ import annotations

import os
import shutil
import warnings
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from bwbayes.app.config.config import dump, parse, read_toml, validated_config
from bwbayes.app.config.proposal import draft_config
from bwbayes.app.problem.problem import Problem, resolve_config
from bwbayes.app.problem.records import generator
from bwbayes.app.running.campaign import SPECIMEN, Campaign
from bwbayes.app.running.fingerprint import fingerprint
from bwbayes.app.running.folder import ENDED, CampaignFolder, Origin, RunFolder, ended
from bwbayes.app.running.progress import StepProgress, batch
from bwbayes.app.running.run import resume as resume_run
from bwbayes.app.running.workers import one_thread
from bwbayes.errors import InputError, InputWarning, one_line
from bwbayes.population.specimen import specimen_of
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.formats import SUFFIXES
from bwbayes.report.outputs import save, write_summary


def config_text(path: Path) -> str:
    """Return the config of all records as TOML, every default explicit; it need name no record."""
    table = read_toml(path)
    record = table.setdefault("record", {})
    if isinstance(record, dict) and not {"file", "signal"} & set(record):
        record["file"] = "each"
    return dump(validated_config(table, str(path)))


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


def start(
    records: Path,
    config: str,
    where: Path,
    out: Path,
    *,
    pictures: bool = True,
    overwrite: bool = False,
    reading: Mapping[str, Any] | None = None,
) -> CampaignFolder:
    """Make the folder ``out`` of a campaign, or open the same one that was begun.

    ``config`` is that of all ``records``, as TOML, its files relative to the folder ``where``;
    empty lets each record propose its own, read as ``reading`` says, keyword arguments of
    ``read_record``. With ``pictures`` every run has figures and report.

    Raises InputError: no records, or a folder of something else.
    """
    records_in(records)
    stated = {key: value for key, value in (reading or {}).items() if value not in (None, {})}
    Naming.stated(**stated)  # what cannot be is refused before any record is
    origin = Origin(str(records.absolute()), str(where.absolute()), pictures, stated)
    return CampaignFolder.create(out, config, origin, overwrite=overwrite)


def resume(
    folder: CampaignFolder,
    console: Console,
    *,
    workers: int | None = None,
    executor: str | Executor | None = None,
) -> Campaign:
    """Fit the records that are missing, and write table and page over all; options as Python's.

    Raises InputError: the folder's files do not fit together, or another process is writing them.
    """
    with folder.locked(), one_thread():
        files = records_in(Path(folder.origin().records))
        stems = Counter(file.stem.lower() for file in files)
        refused = {
            file.name: f"{file}: shares its name with another record; rename one of them"
            for file in files
            if stems[file.stem.lower()] > 1
        }
        fitted = [file for file in files if file.name not in refused]
        anywhere = CampaignFolder(folder.path.absolute())
        tasks = [(file, anywhere) for file in fitted if not folder.is_done(file)]
        folder.summary.unlink(missing_ok=True)
        outcome: Ended
        for outcome in batch(
            fit_record,
            tasks,
            lambda outcome: "refused" if outcome.refused else outcome.short,
            console=console,
            kind="record",
            done=len(fitted) - len(tasks),
            short={"not converged": 0, "refused": 0},
            workers=workers,
            executor=executor,
        ):
            if outcome.refused:
                refused[outcome.file.name] = outcome.short
        with StepProgress(console, "combining the records ...") as watch:
            campaign = Campaign.of(folder, files, refused, watch).said_in(folder.quantities())
            # Nothing in its files depends on when or how it was computed.
            figures = partial(watch, "figures")
            save(campaign.full_report(), folder.path, "campaign", pictures="figures", watch=figures)
    return campaign


class Ended(NamedTuple):
    """The outcome of a record: ``short`` says why it was refused, or that it did not converge."""

    file: Path
    short: str = ""
    refused: bool = False


def fit_record(file: Path, campaign: CampaignFolder) -> Ended:
    """Fit a record of a campaign to its end, from wherever its run stands.

    A run of an earlier form of the record or config is replaced. Figures, report and bands are
    written if the campaign has pictures.
    """
    origin, run = campaign.origin(), campaign.run(file.stem)
    with warnings.catch_warnings():
        # They are the run's remarks, and a hundred records of one kind say the same.
        warnings.simplefilter("ignore", InputWarning)
        try:
            digests = campaign.digests(file)
            folder, problem = _run_folder(file, campaign)
            console, files = Console(quiet=True), origin.pictures
            fit = resume_run(folder, console, workers=1, files=files, problem=problem)
            if not origin.pictures:
                write_summary(folder.summary, fit.numbers)
            if fit.converged:
                source = generator(fit.problem.config.seed, "specimen")
                specimen = specimen_of(file.stem, fit.problem.posterior, fit.flat_draws, source)
                specimen.save(run / SPECIMEN)
            (run / ENDED).write_text(ended(digests, run), encoding="utf-8")
            return Ended(file, "" if fit.converged else "not converged")
        except InputError as error:
            # The name of a file in the folder of the records is enough.
            return Ended(file, str(error).replace(f"{file.parent}{os.sep}", ""), True)
        # One record must not end the others, whatever is wrong with it.
        except Exception as error:
            return Ended(file, one_line(f"{type(error).__name__}: {error}"), True)


def _run_folder(file: Path, campaign: CampaignFolder) -> tuple[RunFolder, Problem]:
    """Return a record's run as it stands, if it is of this record and config; a new one if not."""
    origin = campaign.origin()
    where = Path(origin.where)
    if text := campaign.config.read_text(encoding="utf-8"):
        config = parse(text, "campaign.toml").with_record(file)
    else:
        proposal = draft_config(file, where, Naming.stated(**origin.reading))
        if proposal.blocking_issue is not None:
            raise InputError(f"{file}: {proposal.blocking_issue.error}")
        config = proposal.config
    # All have the same model.
    model = config.model.model_copy(update={"search": "none"})
    problem = resolve_config(config.model_copy(update={"name": file.stem, "model": model}), where)
    path = campaign.run(file.stem)
    if path.exists():
        try:
            existing = RunFolder.open(path)
            # A target or budget that was changed by `bwbayes resume` is kept.
            problem_found = existing.problem()
            expected = problem.with_noise(problem_found.config.model.noise)
            same_posterior = fingerprint(problem_found) == fingerprint(expected)
            if same_posterior and problem_found.digests == problem.digests:
                return existing, problem_found
        except (InputError, OSError):
            pass  # half a folder, or one of an earlier version
        shutil.rmtree(path, ignore_errors=True)
    return RunFolder.create(path, problem, overwrite=False), problem
