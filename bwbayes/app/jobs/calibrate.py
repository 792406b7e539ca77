"""Simulation-based calibration of a config or a run, from first replicate to last file.

:func:`start` makes the folder: the config with every prior an explicit number, the same for all
replicates. :func:`resume` makes whatever replicates are missing, side by side, writes a line for
each, and judges them all. Each replicate depends on the config, the seed and its number alone, so
it does not matter in how many pieces or with how many workers a calibration is done. Replicates of
another config or record are refused. :func:`calibrate` does the same around the posterior of a run,
whose folder keeps it.
"""

from __future__ import annotations

import json
import os
import shutil
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from hashlib import sha256
from itertools import chain
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, PositiveInt, TypeAdapter
from rich.console import Console

from bwbayes.app.config.config import Config, dump
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.fit_methods import console_of
from bwbayes.app.running.fingerprint import state_of, versions
from bwbayes.app.running.folder import CalibrationFolder, RunFolder
from bwbayes.app.running.progress import StepProgress, batch
from bwbayes.app.running.run import redraw
from bwbayes.app.running.workers import one_thread
from bwbayes.app.study.resolve import resolve_config
from bwbayes.calibration.calibration import (
    RANKED,
    Calibration,
    CalibrationSetup,
    Entry,
    evaluate_calibration,
    replicate,
)
from bwbayes.errors import InputError
from bwbayes.prediction.prediction import thin_draws
from bwbayes.record.instruments import EXACT
from bwbayes.report.calibration import calibration_report
from bwbayes.report.result import save
from bwbayes.sampling.chain import draws


class _Request(BaseModel):
    """A line that says how many replicates were requested, of what."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    replicates: PositiveInt
    of: str


def start(
    config: Config, where: Path, out: Path, count: int | None = None, *, overwrite: bool = False
) -> CalibrationFolder:
    """Make the folder of a new calibration with ``count`` replicates, by default 500.

    The config's files are relative to the folder ``where``.

    Raises InputError: the config, its records or the folder cannot be used.
    """
    run = resolve_config(config, where)
    experiment(run)
    request = _Request(replicates=count or 500, of=_identity(run))
    line = f"{request.model_dump_json()}\n".encode()
    return CalibrationFolder.create(out, run, overwrite, line)


def experiment(run: Run) -> CalibrationSetup:
    """Return what the replicates of a run have in common.

    Held out are the validation windows of its own record; other records are made again with each
    replicate's truth, at the times and with the voltage that they have. Refused (InputError) are a
    voltage that shows no loop, and a prior that leaves hardly anything.
    """
    study = run.study
    # Refused is a prior of which no draw is possible.
    study.posterior.prior.draw(np.random.default_rng(0), 64)
    windows = {
        record: [*chain(*held_out.values())]
        for record in study.records
        if (held_out := study.held_out(record))
    }
    others = {
        name: replace(v, record=replace(v.record, instruments=EXACT))
        for name, v in study.validations.items()
        if v.record is not None
    }
    return CalibrationSetup(study.posterior, run.plan, windows, others)


def resume(
    folder: CalibrationFolder,
    console: Console,
    *,
    replicates: int | None = None,
    workers: int | None = None,
    executor: str | Executor | None = None,
) -> Calibration:
    """Make the missing replicates, judge all, and write the calibration's files.

    Parameters
    ----------
    folder, console
        The calibration's folder, and where progress goes.
    replicates
        How many; default: 500, or as begun. None is thrown away.
    workers
        Replicates side by side; default: all cores. The result does not depend on it.
    executor
        local (default), threads, processes, dask, or dask://HOST:PORT. In Python any executor, as
        in :func:`~bwbayes.app.running.workers.open_executor`.

    Raises InputError: the folder's files do not fit together, or another process is writing them.
    """
    with folder.locked(), one_thread():
        run = Run(folder)
        common, identity = experiment(run), _identity(run)
        return _finish(run, common, identity, console, replicates, workers, executor)


def calibrate(
    fit: Run,
    *,
    replicates: int | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    executor: str | Executor | None = None,
    progress: bool = True,
) -> Calibration:
    """Calibrate a run's posterior, to tell whether its intervals are right for its record.

    Each replicate is made with a draw of the posterior, along the run's voltage, and fitted
    together with the run's readings. It is kept in the run's folder, and called again it goes on.
    Report and summary of the run, where it has these files, are written again.

    Parameters
    ----------
    fit
        The fit to use.
    replicates
        How many; default: 200, or as begun.
    overwrite
        Replace an existing calibration.
    workers
        Replicates side by side; default: all cores. The result does not depend on it.
    executor
        local (default), threads, processes, dask, or dask://HOST:PORT. In Python as in
        :func:`bwbayes.fit`.
    progress
        Show how far it is.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        The folder has the replicates of another run, or another process is writing it.

    Warns
    -----
    InputWarning
        Why the calibration has failed.

    Examples
    --------
    ``fit.calibrate(replicates=200).passed`` is what this says::

        bwbayes calibrate results/my
    """
    console = console_of(progress)
    posterior, folder, state = fit.study.posterior, fit.folder.calibration, state_of(fit)
    flat = draws(posterior, fit.chain).reshape(-1, len(posterior.names))
    flat = thin_draws(flat, fit.study.generator("truths"))
    # A rank among 199 draws needs no more.
    plan = replace(fit.plan, ess=min(fit.plan.ess, 2.0 * RANKED))
    common = CalibrationSetup(posterior, plan, around=(flat, fit.chain.point))
    with fit.folder.locked(), one_thread():
        if overwrite or not folder.replicates.exists():
            shutil.rmtree(folder.path, ignore_errors=True)
            folder.path.mkdir()
            request = _Request(replicates=replicates or 200, of=state)
            _append(folder, request.model_dump_json())
        calibration = _finish(
            fit.with_cache(folder=folder), common, state, console, replicates, workers, executor
        )
    if fit.folder.summary.exists():
        with StepProgress(console, "writing the run's report ...") as watch:
            redraw(fit.folder, watch)
    return calibration


def _finish(
    run: Run,
    common: CalibrationSetup,
    identity: str,
    console: Console,
    replicates: int | None,
    workers: int | None,
    executor: str | Executor | None,
) -> Calibration:
    """Make the missing replicates, judge all, and write the files of the run's folder."""
    folder, study, seed, plan = run.folder, run.study, run.study.seed, common.plan
    requested, entries = _read_replicates(folder, common, identity)
    if replicates not in (None, requested):
        requested = replicates or requested
        _append(folder, _Request(replicates=requested, of=identity).model_dump_json())
    # The summary is the sign that all is done; now there is more to do.
    for path in (folder.summary, folder.path / "calibration.html"):
        path.unlink(missing_ok=True)
    shutil.rmtree(folder.path / "figures", ignore_errors=True)
    unconverged = sum(not entry["converged"] for entry in entries.values())
    for result in batch(
        replicate,
        [(common, seed, number) for number in range(requested) if number not in entries],
        lambda result: "" if result.entry["converged"] else "not converged",
        console=console,
        kind="replicate",
        done=len(entries),
        short={"not converged": unconverged},
        workers=workers,
        executor=executor,
    ):
        entries[result.entry["number"]] = result.entry
        _append(folder, json.dumps(result.entry))
    with StepProgress(console, "judging and drawing ...") as watch:
        ordered = [entries[number] for number in sorted(entries)]
        packages = versions(study.engine)
        truths = "the prior's draws"
        if common.around is not None:
            truths = "draws of the posterior; each record is fitted together with the run's own "
            truths += "readings"
        calibration = replace(
            evaluate_calibration(ordered, study.generator("ranks")),
            name=run.config.name or "calibration",
            parameters=study.parameters,
            quantities=study.quantities,
            facts=[
                *run.facts.items(),
                ("truths", truths),
                ("held out", ", ".join(common.bands and study.validations) or "nothing"),
                (
                    "sampling",
                    f"{plan.ensembles} ensembles of {plan.walkers} walkers, to ESS "
                    f"{plan.ess:g}, at most {plan.max_steps} steps",
                ),
            ],
            provenance={
                "seed": seed,
                "data_sha256": study.sha256,
                "versions": packages,
                "of": identity,
            },
        )
        # Nothing in its files depends on when or how it was computed.
        save(
            calibration_report(calibration),
            folder.path,
            "calibration",
            pictures="figures",
            watch=partial(watch, "figures"),
        )
    return calibration


def _identity(run: Run) -> str:
    """Return a digest of everything that replicates depend on."""
    return sha256((dump(run.config) + run.study.sha256).encode()).hexdigest()


def _append(folder: RunFolder, line: str) -> None:
    """Write a line so that it survives a crash."""
    with folder.replicates.open("ab") as file:
        file.write(f"{line}\n".encode())
        file.flush()
        os.fsync(file.fileno())


def _read_replicates(
    folder: RunFolder, common: CalibrationSetup, identity: str
) -> tuple[int, dict[int, Entry]]:
    """Read how many replicates were requested, and those that are written; cut off half a line."""
    content = folder.replicates.read_bytes()
    end = content.rfind(b"\n") + 1
    if end < len(content):
        os.truncate(folder.replicates, end)
    line_of = TypeAdapter[_Request | Entry](_Request | Entry)
    statistics = [*common.statistics], [*common.bands]
    request, entries = None, dict[int, Entry]()
    for number, line in enumerate(content[:end].splitlines(), start=1):
        try:
            entry = line_of.validate_json(line)
            if isinstance(entry, _Request):
                request = entry
                continue
            if (
                entry["number"] in entries
                or ([*entry["ranks"]], [*entry["covered"]]) not in (statistics, ([], []))
                or not all(0 <= rank <= RANKED for rank in entry["ranks"].values())
            ):
                raise ValueError
        except ValueError:
            raise InputError(
                f"{folder.replicates}:{number}: is not one of these replicates; delete this line"
            ) from None
        entries[entry["number"]] = entry
    if request is None:
        raise InputError(
            f"{folder.replicates}: does not say how many replicates were requested; "
            "start again with `overwrite=True`"
        )
    if request.of != identity:
        raise InputError(
            f"{folder.replicates}: these are replicates of another config or record than the "
            "folder's; restore that, or start again with `overwrite=True`"
        )
    return request.replicates, entries
