"""Which model? Fits of the same readings, each judged by what a comparison weighs.

:func:`compare` takes fits and runs that exist. :func:`compare_models` runs a config with several
models side by side, each into a folder of its own, and goes on with those that are there already.
All are screened by their MAP estimates first; only what is within reach is sampled. Their options
are those of :func:`bwbayes.compare`.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from bwbayes.app.config.config import Config, ModelConfig
from bwbayes.app.fit.fitted import Run, open_finished
from bwbayes.app.jobs.predict import predictions
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.progress import ProgressLine, StepProgress, batch
from bwbayes.app.running.run import begin, resume
from bwbayes.app.running.workers import one_thread, open_executor
from bwbayes.app.study.resolve import resolve_models, with_noise
from bwbayes.comparison.comparison import Candidate, Comparison, recommend
from bwbayes.comparison.evidence import bands_part, evidence, leave_future_out, screening_evidence
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.errors import InputError, InputWarning
from bwbayes.inference.study import Study
from bwbayes.model.operators.no_hysteresis import NoHysteresis
from bwbayes.record import Record
from bwbayes.sampling.chain import draws, log_densities
from bwbayes.watching import WatchSteps, unwatched


def fits_of(runs: Iterable[Any]) -> dict[str, Run]:
    """Return fits by their names, and the runs in folders by the folders'.

    Where two would have the same name, folders go by their path, and fits by number too.

    Raises InputError: neither a fit nor the folder of a run, or a folder that is there twice.
    """
    fits, names, runs = [], [], list(runs)
    folders = [Path(run).resolve() for run in runs if isinstance(run, str | Path)]
    if len(set(folders)) < len(folders):
        raise InputError("compare: the same run is there twice; leave one out")
    for number, run in enumerate(runs, start=1):
        if isinstance(run, Run):
            fits.append(run)
            names.append((run.name, f"{run.name} {number}"))
        elif isinstance(run, str | Path):
            fits.append(open_finished(RunFolder.open(Path(run))))
            names.append((Path(run).name, str(run)))
        else:
            raise InputError(
                f"compare: {type(run).__name__}: is neither a fit nor the folder of a run; give a "
                "list of those alone, or records alone"
            )
    by_name, longer = (dict(zip(column, fits, strict=True)) for column in zip(*names, strict=True))
    return by_name if len(by_name) == len(fits) else longer


def compare(
    fits: Mapping[str, Run],
    console: Console | None = None,
    *,
    future: bool = True,
    workers: int | None = None,
    executor: Any = None,
) -> Comparison:
    """Compare fits of the same readings, of different models, by name.

    Raises InputError: fits of different readings: their numbers would not be about the same thing.
    """
    console = console or Console(quiet=True)
    first, *others = fits
    for name in others:
        _require_same(f"compare: {first} and {name}", fits[first].study, fits[name].study)
    candidates = []
    for name, fit in fits.items():
        with (
            StepProgress(console, f"judging {name} ...") as watch,
            one_thread(),
            open_executor(workers, fit.study.engine, executor) as pool,
        ):
            candidate = _candidate(name, fit, pool, watch, future=future)
            standing = fit.standing if fit.converged else None
        candidates.append(replace(candidate, standing=standing))
    with ProgressLine(console, "comparing ..."):
        return _comparison(fits[first], candidates)


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
    reach: float = 30.0,
) -> Comparison:
    """Run a config with each of the models, in folders below ``out``, and compare them.

    The config's files are relative to the folder ``where``; ``in_memory`` are its records that are
    not in files. Runs that are there already, of the same config, are resumed, and those that are
    finished are taken as they are. A model is not sampled that is behind at its MAP estimate by
    more than ``reach``, nats, in evidence and in likelihood: in both, so that no prior's width
    decides. Only the recommended model's run is validated and gets its report (and its ``files``);
    ``bwbayes resume FOLDER`` does the same for another one. The machines of a cluster must all see
    the folder ``out`` by the same path.

    Raises InputError: the config, its records or a folder cannot be used, or a folder has another
    run.
    """
    folders: dict[str, RunFolder] = {}
    with ProgressLine(console, f"reading records for {len(models)} models ...", announced=False):
        runs = resolve_models(config, where, models, in_memory or {})
        first, *others = runs
        for name in others:
            _require_same(f"compare: {first} and {name}", runs[first].study, runs[name].study)
        for name, run in runs.items():
            folder = re.sub(r"[^A-Za-z0-9_.-]+", "-", name).strip("-.")
            folders[name] = _folder(out / folder, run, overwrite)
    count = min(workers or os.cpu_count() or 1, len(models))
    with one_thread(), open_executor(count, executor=executor) as pool:
        together: dict[str, Any] = {
            "label": lambda _: "",
            "console": console,
            "done": 0,
            "short": {},
            "workers": workers,
            "executor": pool,
        }
        screened = batch(_screen_model, [*folders.items()], kind="models screened", **together)
        candidates = {candidate.name: candidate for candidate in screened}
        criteria = {
            name: np.array([candidate.log_evidence, candidate.log_likelihood], dtype=np.float64)
            for name, candidate in candidates.items()
        }
        within_reach = np.max([*criteria.values()], axis=0) - reach
        sampled = [
            (name, folders[name], future)
            for name, values in criteria.items()
            if not screen or folders[name].numbers() or np.any(values >= within_reach)
        ]
        for candidate in batch(_sample_model, sampled, kind="models sampled", **together):
            candidates[candidate.name] = candidate
            console.print(f"{candidate.name}: {candidate.stop_reason}", highlight=False)
        with ProgressLine(console, "comparing ..."):
            run = next(iter(runs.values()))
            comparison = _comparison(run, [candidates[name] for name in folders])
        best = comparison.recommended
        if best is None or comparison[best].standing is not None:
            return comparison
        with ProgressLine(console, f"validating {best} ..."):
            standing = pool.submit(_standing, folders[best], files).result()
            candidates[best] = replace(candidates[best], standing=standing)
            return _comparison(run, [candidates[name] for name in folders])


def _require_same(pair: str, first: Study, other: Study) -> None:
    """Refuse a fit that is not about the same readings as another."""
    if first.sha256 != other.sha256:
        raise InputError(
            f"{pair}: fitted to different records, or in different units; compare fits of one "
            "record, with the same readings left out"
        )
    if "corners" in {first.spec.hold, other.spec.hold} and first.spec.hold != other.spec.hold:
        raise InputError(
            f"{pair}: the voltage of one alone reaches the corners between its samples, where "
            'readings are left out; give both the same hold, "corners" or another, in [model]'
        )
    windows, held_out = [], []
    for study in (first, other):
        windows.append([*study.training.values()])
        starts = {name: replace(v.start, hold=None) for name, v in study.validations.items()}
        held_out.append(
            {
                (name, v.windows, v.record and v.record.sha256, starts[name], v.judged, v.of)
                for name, v in study.validations.items()
            }
        )
    if windows[0] != windows[1]:
        raise InputError(f"{pair}: fitted to different windows; give both the same record.train")
    different = ", ".join(sorted({name for name, *_ in held_out[0] ^ held_out[1]}))
    if different:
        raise InputError(
            f"{pair}: differ in what is held out ({different}); give both the same [validation]"
        )


def _comparison(run: Run, candidates: Sequence[Candidate]) -> Comparison:
    """Compare models of the same readings; ``run`` is that of any of them."""
    facts = [(model.name, model.model) for model in candidates]
    about = ("record", "fitted")
    facts += [item for item in run.facts.items() if item[0].partition(" ")[0] in about]
    facts.append(("readings fitted", str(candidates[0].readings)))
    facts.append(("held out", ", ".join(run.study.validations) or "nothing"))
    return recommend(candidates, facts).said_in(run.quantities)


def _candidate(
    name: str, fit: Run, pool: Executor, watch: WatchSteps = unwatched, *, future: bool
) -> Candidate:
    """Work out all that a comparison knows of a fit, but for its validation."""
    study, posterior = fit.study, fit.study.posterior
    plain = _description(name, study, fit.outcome.stop_reason, converged=fit.converged)
    if not fit.converged:
        return plain
    sampled, density = draws(posterior, fit.chain), log_densities(fit.chain)
    flat = fit.flat_draws
    bands = [
        prediction
        for prediction in predictions(fit, partial(watch, f"{name}: predictions"), training=False)
        if prediction.scores is not None
    ]
    windows = {record: study.held_out(record) for record in study.records}
    rng = study.generator("future")

    def of_this(step: str, share: float) -> None:
        watch(f"{name}: {step}", share)

    parts = leave_future_out(
        posterior, fit.plan, flat, windows, rng, pool, future=future, watch=of_this
    )
    for prediction in bands:
        scores = bands_part(prediction)
        if scores is not None and study.validations[prediction.name].record is not None:
            parts[prediction.name] = scores
    return replace(
        plain,
        held_out=tuple(bands),
        parts=parts,
        evidence=evidence(
            posterior,
            sampled,
            density,
            study.generator("evidence"),
            partial(of_this, "evidence"),
        ),
    )


def _description(name: str, study: Study, stop_reason: str, *, converged: bool) -> Candidate:
    """Say what a model is, and how its sampling ended."""
    posterior = study.posterior
    return Candidate(
        name,
        f"{study.spec}, {study.spec.noise} noise",
        converged,
        stop_reason,
        posterior.prior.dimensions,
        sum(dataset.readings.rows.size for dataset in posterior.datasets),
        not isinstance(posterior.datasets[0].actuator.hysteresis, NoHysteresis),
    )


def _screen_model(name: str, folder: RunFolder) -> Candidate:
    """Say what a model is worth by its MAP estimate."""
    run = begin(folder)
    study, rng = run.study, run.study.generator("evidence")
    return replace(
        _description(name, study, "only screened", converged=False),
        evidence=screening_evidence(study.posterior, run.chain.point, rng),
        screened=True,
    )


def _sample_model(name: str, folder: RunFolder, future: bool) -> Candidate:
    """Sample a model to its end, from wherever it stands, and say what it is worth."""
    is_finished = bool(folder.numbers())
    quiet = Console(quiet=True)
    fit = open_finished(folder) if is_finished else resume(folder, quiet, workers=1, predict=False)
    with open_executor(1, fit.study.engine) as pool:
        result = _candidate(name, fit, pool, future=future)
    return replace(result, standing=fit.standing) if is_finished else result


def _standing(folder: RunFolder, files: bool) -> ValidationSummary:
    """Finish a run, and say whether its bands hold."""
    with warnings.catch_warnings():
        # A model's faults are among its caveats.
        warnings.simplefilter("ignore", InputWarning)
        return resume(folder, Console(quiet=True), workers=1, files=files).standing


def _folder(path: Path, run: Run, overwrite: bool) -> RunFolder:
    """Make a model's folder, or take the one that is there, if it is the same run's."""
    if path.exists() and not overwrite:
        folder = RunFolder.open(path)
        stored = Run(folder)
        expected = with_noise(run, stored.config.model.noise)
        # A config has no more of its records than their ranges and names.
        same_digests = stored.study.digests == expected.study.digests
        if stored.config != expected.config or not same_digests:
            raise InputError(
                f"{path}: holds another run; choose another folder, or give `overwrite=True`"
            )
        return folder
    return RunFolder.create(path, run, overwrite)
