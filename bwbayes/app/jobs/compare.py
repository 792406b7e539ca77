"""Which model? Fits of the same readings, each judged by what a comparison weighs.

Fits of different readings are refused: their numbers would not be about the same thing.
:mod:`bwbayes.app.jobs.models` runs models for a comparison.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rich.console import Console

from bwbayes.app.problem.model import in_words
from bwbayes.app.problem.problem import Problem, generator
from bwbayes.app.running.predictions import predictions, scoring
from bwbayes.app.running.workers import executor as executor_of
from bwbayes.app.running.workers import one_thread
from bwbayes.comparison.candidates import Candidate, judged
from bwbayes.comparison.compared import Comparison
from bwbayes.comparison.evidence import evidence
from bwbayes.comparison.leave_future_out import bands_part, leave_future_out
from bwbayes.comparison.recommendation import recommend
from bwbayes.errors import InputError
from bwbayes.model.operators.no_hysteresis import NoHysteresis
from bwbayes.results.scores import score
from bwbayes.sampling.chain import draws, log_densities

if TYPE_CHECKING:
    from bwbayes.app.fit.fitted import Fit

__all__ = ["by_name", "candidate", "compare", "comparison_of", "description", "require_same"]


def by_name(named: Iterable[tuple[str, Fit]]) -> dict[str, Fit]:
    """Return fits by their names; those of one name by number too."""
    pairs = list(named)
    if len(dict(pairs)) == len(pairs):
        return dict(pairs)
    return {f"{name} {number}": fit for number, (name, fit) in enumerate(pairs, start=1)}


def require_same(fits: Mapping[str, Fit]) -> None:
    """Refuse a last fit that is not about the same readings as the first.

    Raises
    ------
    InputError
        Records, training windows or what is held out differ.
    """
    first, last = next(iter(fits)), [*fits][-1]
    first_problem, last_problem = fits[first].problem, fits[last].problem
    pair = f"compare: {first} and {last}"
    if first_problem.sha256 != last_problem.sha256:
        raise InputError(
            f"{pair}: fitted to different records, or in different units; compare fits of one "
            "record, with the same readings left out"
        )
    windows = [
        [dataset.training for dataset in p.posterior.datasets]
        for p in (first_problem, last_problem)
    ]
    if windows[0] != windows[1]:
        raise InputError(f"{pair}: fitted to different windows; give both the same record.train")
    held = [_held_out(problem) for problem in (first_problem, last_problem)]
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
            validation.windows,
            None if validation.record is None else validation.record.sha256,
            replace(validation.start, hold=None),
            validation.judged,
            validation.of,
        )
        for name, validation in problem.validations.items()
    }


def compare(
    fits: Mapping[str, Fit],
    console: Console | None = None,
    *,
    future: bool = True,
    workers: int | None = None,
    executor: Any = None,
) -> Comparison:
    """Compare fits of the same readings.

    Parameters
    ----------
    fits
        The fits, of different models, by name.
    console
        Where progress goes, if anywhere.
    future
        Whether to score the later half of the training readings too, given the earlier half, which
        takes a short fit.
    workers
        Ensembles of those side by side; by default one a core.
    executor
        Where they run, as in :func:`bwbayes.fit`.

    Raises
    ------
    InputError
        Fits of different readings.
    """
    require_same(fits)
    candidates = []
    for name, fit in fits.items():
        if console is not None and not console.quiet:
            console.print(f"judging {name} ...", highlight=False)
        with one_thread(), executor_of(workers, fit.problem.posterior.engine, executor) as pool:
            judged_fit = candidate(name, fit, pool, future=future)
        candidates.append(
            replace(judged_fit, standing=fit.standing) if fit.converged else judged_fit
        )
    return comparison_of(next(iter(fits.values())).problem, candidates)


def comparison_of(problem: Problem, candidates: Sequence[Candidate]) -> Comparison:
    """Compare models of the same readings; ``problem`` is that of any of them."""
    return replace(recommend(candidates), facts=_facts(problem, candidates))


def _facts(problem: Problem, candidates: Sequence[Candidate]) -> tuple[tuple[str, str], ...]:
    """Return the models, and the readings that they share."""
    return (
        *((model.name, model.model) for model in candidates),
        *(
            (name, f"{record.origin}: {record.samples} samples every {record.interval:g} s")
            for name, record in problem.records.items()
        ),
        ("readings fitted", str(candidates[0].readings)),
        ("held out", ", ".join(problem.validations) or "nothing"),
    )


def candidate(name: str, fit: Fit, pool: Executor, *, future: bool = True) -> Candidate:
    """Work out all that a comparison knows of a fit, but for its validation."""
    problem, posterior, seed = fit.problem, fit.problem.posterior, fit.problem.config.seed
    plain = description(name, problem, fit.outcome.stop_reason, converged=fit.outcome.converged)
    if not fit.outcome.converged:
        return plain
    sampled, density = draws(posterior, fit.chain), log_densities(fit.chain)
    flat = sampled.reshape(-1, sampled.shape[-1])
    predicted = predictions(problem, flat, training=False)
    bands = tuple(prediction for prediction in predicted if prediction.measured is not None)
    full = max(dataset.extent for dataset in posterior.datasets)
    windows = {record: problem.held_out(record) for record in problem.records}
    rng = generator(seed, "future")
    parts = leave_future_out(posterior, problem.plan, flat, windows, rng, pool, future=future)
    others = {
        prediction.name: bands_part(prediction, judged(prediction))
        for prediction in bands
        if problem.validations[prediction.name].record is not None
    }
    return replace(
        plain,
        held_out=bands,
        scores={
            prediction.name: score(prediction, scoring(seed, prediction), full)
            for prediction in bands
        },
        parts=parts | {part: scores for part, scores in others.items() if scores is not None},
        evidence=evidence(posterior, sampled, density, generator(seed, "evidence")),
    )


def description(name: str, problem: Problem, stop_reason: str, *, converged: bool) -> Candidate:
    """Say what a model is, and how its sampling ended."""
    posterior = problem.posterior
    return Candidate(
        name,
        f"{in_words(problem.config.model)}, {problem.config.model.noise} noise",
        converged,
        stop_reason,
        posterior.prior.dimensions,
        sum(dataset.readings.rows.size for dataset in posterior.datasets),
        not isinstance(posterior.datasets[0].actuator.hysteresis, NoHysteresis),
    )
