"""One record of a campaign: fitted as ``bwbayes run`` fits it, wherever an executor likes.

Beside the run's files it leaves what a population needs of the record. One that cannot be used
comes back as a refusal of one line; it never ends the campaign.
"""

from __future__ import annotations

import os
import shutil
import warnings
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from bwbayes.app.config.config import Config, load, parse
from bwbayes.app.config.proposal import propose
from bwbayes.app.problem.problem import Problem, generator, resolve
from bwbayes.app.running.campaign_folder import ENDED, digest, ended
from bwbayes.app.running.fingerprint import fingerprint
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.errors import InputError, InputWarning, one_line
from bwbayes.population.specimen import specimen_of
from bwbayes.report.outputs import write_summary

__all__ = ["SPECIMEN", "Ended", "fit_record"]

# What a population needs of a run, in the run's folder.
SPECIMEN = "specimen.npz"


class Ended(NamedTuple):
    """What came of a record: ``short`` says why it was refused, or that it did not converge."""

    file: Path
    short: str = ""
    refused: bool = False


def fit_record(file: Path, config: str, where: Path, run: Path, pictures: bool) -> Ended:
    """Fit a record to its end, from wherever its run stands.

    A run of an earlier form of the record or config is replaced.

    Parameters
    ----------
    file
        The record's file; its stem is the record's name.
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
    with warnings.catch_warnings():
        # They are the run's remarks, and a hundred records of one kind say the same.
        warnings.simplefilter("ignore", InputWarning)
        try:
            record = digest(file)
            problem = resolve(_config(file, config, where), where)
            folder = _folder(run, problem)
            fit = resume(folder, Console(quiet=True), workers=1, files=pictures)
            if not pictures:
                write_summary(folder.summary, fit.numbers)
            if fit.converged:
                source = generator(fit.problem.config.seed, "specimen")
                specimen = specimen_of(file.stem, fit.problem.posterior, fit.flat_draws, source)
                specimen.save(run / SPECIMEN)
            (run / ENDED).write_text(ended(record, run), encoding="utf-8")
            return Ended(file, "" if fit.converged else "not converged")
        except InputError as error:
            # Of a file in the folder of the records its name says enough.
            return Ended(file, str(error).replace(f"{file.parent}{os.sep}", ""), True)
        # One record must not end the others, whatever is wrong with it.
        except Exception as error:
            return Ended(file, one_line(f"{type(error).__name__}: {error}"), True)


def _config(file: Path, text: str, where: Path) -> Config:
    """Return the config of a record."""
    if text:
        config = parse(text, "campaign.toml").with_record(file)
    else:
        proposal = propose(file, where)
        if proposal.pointless is not None:
            raise InputError(f"{file}: {proposal.pointless.error}")
        config = proposal.config
    return config.model_copy(update={"name": file.stem})


def _folder(path: Path, problem: Problem) -> RunFolder:
    """Return the run's folder as it stands, if it is of this problem; a new one if not."""
    if path.exists():
        try:
            existing = RunFolder.open(path)
            # A target or budget that was changed by `bwbayes resume` is kept.
            same_posterior = fingerprint(load(existing.config)) == fingerprint(problem.config)
            if same_posterior and existing.problem().record.sha256 == problem.record.sha256:
                return existing
        except (InputError, OSError):
            pass  # half a folder, or one of an earlier version
        shutil.rmtree(path, ignore_errors=True)
    return RunFolder.create(path, problem, overwrite=False)
