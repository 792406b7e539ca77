"""Models that are run for a comparison, or runs that are there.

:func:`compare_models` runs a config with several models side by side, each into a folder of its
own, and goes on with those that are there already. All are screened by their MAP estimates first;
only what is within reach is sampled. :func:`open_runs` takes the runs in folders.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from bwbayes.app.config.config import Config, ModelConfig, dump
from bwbayes.app.config.models import slug
from bwbayes.app.fit.opening import finished
from bwbayes.app.jobs.compare import candidate, comparison_of, description, require_same
from bwbayes.app.problem.continued import joined
from bwbayes.app.problem.model import actuator_of
from bwbayes.app.problem.problem import Problem, generator, resolve
from bwbayes.app.problem.records import training_records
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import begin, draw, resume
from bwbayes.app.running.workers import executor as executor_of
from bwbayes.app.running.workers import one_thread, side_by_side
from bwbayes.comparison.candidates import Candidate
from bwbayes.comparison.compared import Comparison
from bwbayes.comparison.evidence import screening_evidence
from bwbayes.data import Record
from bwbayes.errors import InputError, InputWarning
from bwbayes.inference.noise import noise_model
from bwbayes.inference.table import ParameterTable
from bwbayes.results.replicates import as_done
from bwbayes.results.standing import Standing

if TYPE_CHECKING:
    from bwbayes.app.fit.fitted import Fit

__all__ = ["compare_models", "open_runs"]

# Nats of evidence and of likelihood by which a model may be behind at its MAP estimate.
REACH = 30.0


def open_runs(folders: Sequence[Path]) -> dict[str, Fit]:
    """Return the fits of the runs in folders, by the folders' names.

    Raises
    ------
    InputError
        No such run, or runs of different readings.
    """
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise InputError("compare: the same run is there twice; leave one out")
    names = [folder.name for folder in folders]
    if len(set(names)) < len(names):
        names = [str(folder) for folder in folders]
    runs: dict[str, Fit] = {}
    for name, path in zip(names, folders, strict=True):
        runs[name] = finished(RunFolder.open(path))
        require_same(runs)
    return runs


def compare_models(
    config: Config,
    where: Path,
    models: Mapping[str, ModelConfig],
    out: Path,
    console: Console,
    *,
    in_memory: Mapping[str, Record] | None = None,
    overwrite: bool = False,
    screen: bool = True,
    future: bool = True,
    files: bool = True,
    workers: int | None = None,
    executor: Any = None,
) -> Comparison:
    """Run a config with each of the models, in folders below ``out``, and compare them.

    The config's files are relative to the folder ``where``; ``in_memory`` are its records that are
    not in files. Runs that are there already, of the same config, are resumed, and those that are
    finished are taken as they are. Only the recommended model's run is validated and gets its
    report; ``bwbayes resume FOLDER`` does the same for another one.

    Parameters
    ----------
    config, where, models, out, console, in_memory, overwrite
        See above.
    screen
        Whether to leave out what is out of :data:`REACH` by Laplace's evidence at the MAP estimate,
        and by the likelihood there: by both, so that no prior's width decides.
    future
        As in :func:`~bwbayes.app.jobs.compare.compare`.
    files
        Whether to write the files of the recommended model's run.
    workers
        Models side by side, in processes if more than one; by default as many as cores.
    executor
        Where they run, as in :func:`bwbayes.fit`. The machines of a cluster must all see the folder
        ``out`` by the same path.

    Raises
    ------
    InputError
        The config, its records or a folder cannot be used, or a folder has another run.
    """
    _, wholes = joined(config, training_records(config, where, in_memory or {})[0])
    records = list(wholes.values())
    folders: dict[str, RunFolder] = {}
    for name, model in models.items():
        problem = resolve(_with_model(config, model, name, records), where, in_memory)
        folders[name] = _folder(out / slug(name), problem, overwrite)
    count = min(workers or os.cpu_count() or 1, len(models))
    with one_thread(), executor_of(count, backend=executor) as pool:
        together = side_by_side(pool, workers, len(models))
        if not console.quiet:
            console.print(f"screening {len(models)} models ...", highlight=False)
        screened = as_done(pool, together, _screened, folders.items())
        candidates = {screening.name: screening for screening in screened}
        criteria = {
            name: np.array([candidate.log_evidence, candidate.log_likelihood], dtype=np.float64)
            for name, candidate in candidates.items()
        }
        within_reach = np.max([*criteria.values()], axis=0) - REACH
        sampled = [
            name
            for name, values in criteria.items()
            if not screen or folders[name].summary.is_file() or np.any(values >= within_reach)
        ]
        runs = ((name, folders[name], future) for name in sampled)
        for candidate in as_done(pool, together, _sampled, runs):
            candidates[candidate.name] = candidate
            if not console.quiet:
                console.print(f"{candidate.name}: {candidate.stop_reason}", highlight=False)
        problem = next(iter(folders.values())).problem()
        comparison = comparison_of(problem, [candidates[name] for name in folders])
        best = comparison.recommended
        if best is None or comparison[best].standing is not None:
            return comparison
        standing = pool.submit(_standing, folders[best], files).result()
    candidates[best] = replace(candidates[best], standing=standing)
    return comparison_of(problem, [candidates[name] for name in folders])


def _screened(name: str, folder: RunFolder) -> Candidate:
    """Say what a model is worth by its MAP estimate."""
    problem, point = begin(folder)
    rng = generator(problem.config.seed, "evidence")
    return replace(
        description(name, problem, "only screened", converged=False),
        evidence=screening_evidence(problem.posterior, point, rng),
        screened=True,
    )


def _sampled(name: str, folder: RunFolder, future: bool) -> Candidate:
    """Sample a model to its end, from wherever it stands, and say what it is worth."""
    fit = finished(folder) if folder.summary.is_file() else draw(folder)
    with executor_of(1, fit.problem.posterior.engine) as pool:
        result = candidate(name, fit, pool, future=future)
    return replace(result, standing=folder.standing()) if folder.summary.is_file() else result


def _standing(folder: RunFolder, files: bool) -> Standing:
    """Finish a run, and say whether its bands hold."""
    with warnings.catch_warnings():
        # What is wrong with a model is among what speaks against it.
        warnings.simplefilter("ignore", InputWarning)
        return resume(folder, Console(quiet=True), workers=1, files=files).standing


def _with_model(config: Config, model: ModelConfig, name: str, records: Sequence[Record]) -> Config:
    """Return the config with another model, and of what it says of parameters what that has."""
    actuator = actuator_of(model, records[0], records)
    names = ParameterTable(
        actuator, noise_model(model.noise_until_chosen, records[0].interval)
    ).names
    # A parameter of one record is called name[record].
    applicable = {
        key: {p: value for p, value in getattr(config, key).items() if p.partition("[")[0] in names}
        for key in ("parameters", "truth")
    }
    scopes = {
        key: [p for p in getattr(model, key) if p in names] for key in ("per_record", "shared")
    }
    changes = {"model": model.model_copy(update=scopes), "name": name, **applicable}
    return config.model_copy(update=changes)


def _folder(path: Path, problem: Problem, overwrite: bool) -> RunFolder:
    """Make a model's folder, or take the one that is there, if it is the same run's."""
    if path.exists() and not overwrite:
        folder = RunFolder.open(path)
        if folder.config.read_text(encoding="utf-8") != dump(problem.config):
            raise InputError(
                f"{path}: holds another run; choose another folder, or give `overwrite=True`"
            )
        return folder
    path.parent.mkdir(parents=True, exist_ok=True)
    return RunFolder.create(path, problem, overwrite)
