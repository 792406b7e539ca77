"""One record of a campaign: fitted as ``bwbayes run`` fits it, wherever an executor likes.

:func:`fit_one` is what a worker does: it makes the run's folder or goes on in it, and leaves beside
the run's files what a population needs of it. A record that cannot be used comes back as a refusal
of one line; it never ends the campaign.
"""

from __future__ import annotations

import os
import shutil
import warnings
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from bwbayes.app.config.config import Config, load, parse
from bwbayes.app.config.proposal import propose
from bwbayes.app.problem.problem import Problem, generator, resolve
from bwbayes.app.running.campaign_folder import digest
from bwbayes.app.running.fingerprint import fingerprint
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import go_on, load_run, numbers_of
from bwbayes.errors import InputError, InputWarning, one_line
from bwbayes.population.specimen import specimen_of
from bwbayes.results.outputs import write_summary

__all__ = ["SPECIMEN", "Ended", "Task", "fit_one"]

# What a population needs of a run, in the run's folder.
SPECIMEN = "specimen.npz"


@dataclass(frozen=True)
class Task:
    """One record to fit.

    Parameters
    ----------
    name
        The record's name.
    file
        Its file.
    config
        The config of all records in TOML, of which the record's file is replaced; empty for one
        that is proposed from the record.
    where
        The folder that the config's other files are relative to.
    run
        The run's folder.
    pictures
        Whether to draw figures and write the report and bands.
    """

    name: str
    file: Path
    config: str
    where: Path
    run: Path
    pictures: bool


@dataclass(frozen=True)
class Ended:
    """What came of a record: the digests of its file and of the run's summary, or a refusal."""

    name: str
    file: str = ""
    summary: str = ""
    converged: bool = False
    refusal: str = ""


def fit_one(task: Task) -> Ended:
    """Fit a record to its end, from wherever its run stands.

    A run of an earlier form of the record or config is replaced.
    """
    with warnings.catch_warnings():
        # They are the run's remarks, and a hundred records of one kind say the same.
        warnings.simplefilter("ignore", InputWarning)
        try:
            return _fitted(task)
        except InputError as error:
            # Of a file in the folder of the records its name says enough.
            return Ended(task.name, refusal=str(error).replace(f"{task.file.parent}{os.sep}", ""))
        # One record must not end the others, whatever is wrong with it.
        except Exception as error:
            return Ended(task.name, refusal=one_line(f"{type(error).__name__}: {error}"))


def _fitted(task: Task) -> Ended:
    file = digest(task.file)
    problem = resolve(_config(task), task.where)
    folder = _folder(task.run, problem)
    run = go_on(folder, Console(quiet=True), workers=1, files=task.pictures)
    if not task.pictures:
        write_summary(folder.summary, numbers_of(folder, run.problem, run.result, run.seconds))
    if run.outcome.converged:
        free = run.result.flat_draws
        source = generator(run.problem.config.seed, "specimen")
        specimen_of(task.name, run.problem.posterior, free, source).save(task.run / SPECIMEN)
    return Ended(task.name, file, digest(folder.summary), run.outcome.converged)


def _config(task: Task) -> Config:
    """Return the config of a record."""
    if task.config:
        config = parse(task.config, "campaign.toml")
        config = config.with_record(task.file)
    else:
        made = propose(task.file, task.where)
        if made.pointless is not None:
            raise InputError(f"{task.file}: {made.pointless}")
        config = made.config
    return config.model_copy(update={"name": task.name})


def _folder(path: Path, problem: Problem) -> RunFolder:
    """Return the run's folder as it stands, if it is of this problem; a new one if not."""
    folder = RunFolder(path)
    if path.exists():
        try:
            begun = RunFolder.open(path)
            # A target or budget that was changed by `bwbayes resume` is kept.
            kept = fingerprint(load(begun.config)) == fingerprint(problem.config)
            if kept and load_run(begun).record.sha256 == problem.record.sha256:
                return begun
        except (InputError, OSError):
            pass  # half a folder, or one of an earlier version
        shutil.rmtree(path, ignore_errors=True)
    return folder.create(path, problem, overwrite=False)
