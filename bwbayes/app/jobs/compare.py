"""``bwbayes compare``: which model? Finished runs, or models that are run for it.

:func:`compare_runs` compares the runs in folders, :func:`compare_models` runs a config with one
model after the other first, each into a folder of its own, and goes on with those that are there
already. Both leave a page, a JSON and a CSV file. Runs of different readings are refused: their
numbers would not be about the same thing.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from bwbayes.app.config.config import Config, ModelConfig, dump
from bwbayes.app.config.models import slug
from bwbayes.app.problem.continued import joined
from bwbayes.app.problem.model import actuator_of, in_words
from bwbayes.app.problem.problem import Problem, generator, resolve
from bwbayes.app.problem.records import training_records
from bwbayes.app.report.comparison_report import render
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.predictions import scoring
from bwbayes.app.running.run import finished, go_on
from bwbayes.app.running.workers import executor, one_thread
from bwbayes.arrays import FloatArray
from bwbayes.comparison.candidates import Candidate
from bwbayes.comparison.choice import Comparison, choose
from bwbayes.comparison.evidence import evidence
from bwbayes.comparison.future import future, joint_log_score
from bwbayes.comparison.table import numbers, table
from bwbayes.data import Record
from bwbayes.errors import InputError
from bwbayes.inference.noise import noise_model
from bwbayes.inference.table import ParameterTable
from bwbayes.model.operators.no_hysteresis import NoHysteresis
from bwbayes.results.bands import Bands
from bwbayes.results.outputs import write_summary
from bwbayes.results.prediction import predict_record, predict_windows, thinned
from bwbayes.results.scores import score
from bwbayes.results.standing import Standing
from bwbayes.sampling.sampler import Outcome, draws, log_densities
from bwbayes.sampling.storage import ChainFile

__all__ = [
    "Fitted",
    "compare",
    "compare_models",
    "compare_runs",
    "require_free",
    "require_same",
    "run_models",
    "write",
]


@dataclass(frozen=True)
class Fitted:
    """A run to compare: its name, problem, chain and outcome, and whether its bands hold."""

    name: str
    problem: Problem
    chain: ChainFile
    outcome: Outcome
    standing: Standing = field(default_factory=Standing)


def compare_runs(
    folders: Sequence[Path],
    out: Path,
    console: Console,
    *,
    workers: int | None = None,
    how: str | Executor | None = None,
    with_future: bool = True,
    overwrite: bool = False,
) -> Comparison:
    """Compare the runs in folders, and write what comes of it to the folder ``out``.

    Raises
    ------
    InputError
        No such run, runs of different readings, or files that are there already.
    """
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise InputError("compare: the same run is there twice; leave one out")
    require_free(out, overwrite)
    names = [folder.name for folder in folders]
    if len(set(names)) < len(names):
        names = [str(folder) for folder in folders]
    runs = []
    for name, path in zip(names, folders, strict=True):
        folder = RunFolder.open(path)
        runs.append(Fitted(name, *finished(folder), folder.standing()))
        require_same(runs[0], runs[-1])
    made = compare(runs, console, workers=workers, how=how, with_future=with_future)
    write(made, runs, out)
    return made


def compare_models(
    config: Config,
    where: Path,
    models: Mapping[str, ModelConfig],
    out: Path,
    console: Console,
    *,
    workers: int | None = None,
    how: str | Executor | None = None,
    with_future: bool = True,
    overwrite: bool = False,
) -> Comparison:
    """Run a config with each of the models, in folders below ``out``, and compare them.

    All is as of :func:`run_models`; page, table and numbers go to ``out``.
    """
    require_free(out, overwrite)
    runs = run_models(config, where, models, out, console, workers, how, overwrite=overwrite)
    made = compare(runs, console, workers=workers, how=how, with_future=with_future)
    write(made, runs, out)
    return made


def run_models(
    config: Config,
    where: Path,
    models: Mapping[str, ModelConfig],
    out: Path,
    console: Console,
    workers: int | None = None,
    how: Any = None,
    *,
    given: Mapping[str, Record] | None = None,
    overwrite: bool = False,
) -> list[Fitted]:
    """Run a config with each of the models, in folders below ``out``.

    The config's files are relative to the folder ``where``, and ``given`` are its records that are
    in memory. Runs that are there already, of the same config, are gone on with.

    Raises
    ------
    InputError
        The config, its records or a folder cannot be used, or a folder has another run.
    """
    _, wholes = joined(config, training_records(config, where, given or {})[0])
    records = list(wholes.values())
    problems = {
        name: resolve(_with_model(config, model, name, records), where, given)
        for name, model in models.items()
    }
    runs = []
    for name, problem in problems.items():
        folder = _folder(out / slug(name), problem, overwrite)
        console.print(f"{name} ...", highlight=False)
        if not folder.summary.is_file():
            go_on(folder, console, workers=workers, how=how)
        runs.append(Fitted(name, *finished(folder), folder.standing()))
        require_same(runs[0], runs[-1])
    return runs


def _with_model(config: Config, model: ModelConfig, name: str, records: Sequence[Record]) -> Config:
    """Return the config with another model, and of what it says of parameters what that has."""
    actuator = actuator_of(model, records[0], records)
    names = ParameterTable(actuator, noise_model(model.noise, records[0].interval)).names
    known = {
        key: {p: given for p, given in getattr(config, key).items() if _plain(p) in names}
        for key in ("parameters", "truth")
    }
    scopes = {
        key: [p for p in getattr(model, key) if p in names] for key in ("per_record", "shared")
    }
    changes = {"model": model.model_copy(update=scopes), "name": name, **known}
    return config.model_copy(update=changes)


def _plain(name: str) -> str:
    """Return a parameter's name without the record that it is of."""
    return name.partition("[")[0]


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


def require_free(out: Path, overwrite: bool) -> None:
    """Refuse a folder that has a comparison, unless it may be replaced.

    Raises
    ------
    InputError
        It has one.
    """
    target = out / "comparison.json"
    if target.exists() and not overwrite:
        raise InputError(f"{target}: exists; choose another folder, or give `overwrite=True`")


def require_same(one: Fitted, other: Fitted) -> None:
    """Refuse runs that are not about the same readings.

    Raises
    ------
    InputError
        Records, training windows or what is held out differ.
    """
    ours, theirs = one.problem, other.problem
    pair = f"compare: {one.name} and {other.name}"
    if ours.sha256 != theirs.sha256:
        raise InputError(
            f"{pair}: fitted to different records, or in different units; compare fits of one "
            "record, with the same readings left out"
        )
    windows = [[one.training for one in p.posterior.datasets] for p in (ours, theirs)]
    if windows[0] != windows[1]:
        raise InputError(f"{pair}: fitted to different windows; give both the same record.train")
    held = [_held_out(problem) for problem in (ours, theirs)]
    if held[0] != held[1]:
        names = [key for key in {**held[0], **held[1]} if held[0].get(key) != held[1].get(key)]
        raise InputError(
            f"{pair}: differ in what is held out ({', '.join(names)}); give both the same "
            "[validation]"
        )


def _held_out(problem: Problem) -> dict[str, object]:
    """Return what is held out, by name, so that it can be compared."""
    return {
        name: (
            one.windows,
            None if one.record is None else one.record.sha256,
            replace(one.start, hold=None),
            one.judged,
            one.of,
        )
        for name, one in problem.validations.items()
    }


def compare(
    runs: Sequence[Fitted],
    console: Console,
    *,
    workers: int | None = None,
    how: str | Executor | None = None,
    with_future: bool = True,
) -> Comparison:
    """Compare runs of the same readings."""
    seed = runs[0].problem.config.seed
    candidates = []
    for run in runs:
        if not console.quiet:
            console.print(f"judging {run.name} ...", highlight=False)
        with one_thread(), executor(workers, run.problem.posterior.engine, how) as pool:
            candidates.append(candidate(run, pool, with_future=with_future))
    return choose(candidates, generator(seed, "comparison"))


def candidate(run: Fitted, pool: Executor, *, with_future: bool = True) -> Candidate:
    """Work out all that a comparison knows of a run."""
    problem, posterior, seed = run.problem, run.problem.posterior, run.problem.config.seed
    plain = Candidate(
        run.name,
        f"{in_words(problem.config.model)}, {problem.config.model.noise} noise",
        run.outcome.converged,
        run.outcome.stop_reason,
        posterior.prior.dimensions,
        sum(one.readings.rows.size for one in posterior.datasets),
        not isinstance(posterior.datasets[0].actuator.hysteresis, NoHysteresis),
    )
    if not run.outcome.converged:
        return plain
    sampled, density = draws(posterior, run.chain), log_densities(run.chain)
    flat = sampled.reshape(-1, sampled.shape[-1])
    bands = tuple(one for one in held_out(problem, flat) if one.measured is not None)
    full = max(one.extent for one in posterior.datasets)
    windows = {name: list(chain(*problem.held_out(name).values())) for name in problem.records}
    log_prior = posterior.prior.constrain(posterior.prior.unconstrain(flat))[1]
    return replace(
        plain,
        held_out=bands,
        scores={one.name: score(one, scoring(seed, one), full) for one in bands},
        standing=run.standing,
        joint=joint_log_score(posterior, flat, windows, generator(seed, "joint"))
        if any(windows.values())
        else None,
        future=future(posterior, problem.plan, problem.records, generator(seed, "future"), pool)
        if with_future
        else None,
        evidence=evidence(posterior, sampled, density, generator(seed, "evidence")),
        log_likelihood=float(np.max(density.ravel() - log_prior)),
    )


def held_out(problem: Problem, flat: FloatArray) -> list[Bands]:
    """Predict all that was held out, as a run does."""
    posterior, seed = problem.posterior, problem.config.seed
    chosen = thinned(flat, generator(seed, "draws"))
    bands: list[Bands] = []
    for name, alone, its in posterior.each(chosen):
        windows = problem.held_out(name)
        if windows:
            record = problem.records[name]
            source = generator(seed, f"predict {record.sha256}")
            bands += predict_windows(alone, its, record, windows, source)
    for name, one in problem.validations.items():
        if one.record is not None:
            source = generator(seed, f"predict {one.record.sha256}")
            of = posterior.alone(one.of), posterior.its(chosen, one.of), one.record, one.start
            bands.append(predict_record(*of, source, name, one.judged))
    return bands


def write(comparison: Comparison, runs: Sequence[Fitted], out: Path) -> None:
    """Write page, table and numbers; the numbers last, as the sign that all is there.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        page = render(comparison, runs[0].problem)
        (out / "comparison.html").write_text(page, encoding="utf-8")
        flat = table(comparison)
        with (out / "comparison.csv").open("w", newline="", encoding="utf-8") as file:
            columns = list(dict.fromkeys(key for row in flat for key in row))
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(flat)
        write_summary(out / "comparison.json", numbers(comparison))
    except OSError as error:
        raise InputError(f"{out}: {error.strerror}; choose another folder") from None
