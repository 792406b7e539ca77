"""From a chain to a result: draws, remarks, predictions and what came of them.

What is worked out is kept with the run (:mod:`bwbayes.app.running.cache`), and read from there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from bwbayes.app.problem.problem import Problem, generator
from bwbayes.app.running.cache import load, save, state_of
from bwbayes.app.running.explaining import explained, lines
from bwbayes.app.running.figure_worker import Beside
from bwbayes.app.running.fingerprint import version_remarks, versions
from bwbayes.app.running.predictions import judged, predictions, scoring
from bwbayes.app.running.run_details import facts_of, stepped
from bwbayes.diagnosis import conflict, identifiability, innovations
from bwbayes.diagnosis import consistency as agreement
from bwbayes.diagnosis.explanations import likely_causes
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.information import learned
from bwbayes.diagnosis.predictive_checks import replicated
from bwbayes.diagnosis.validation import Background
from bwbayes.prediction.loops import measure_loops
from bwbayes.prediction.prediction import thinned
from bwbayes.prediction.scores import score
from bwbayes.prediction.steps import measure_steps
from bwbayes.report.result import Result
from bwbayes.sampling.chain import draws, log_densities
from bwbayes.sampling.diagnostics import Outcome
from bwbayes.sampling.storage import ChainFile

__all__ = ["assemble", "load_result", "save_result"]

# What of a result takes time, and neither the chain nor the config holds.
WORKED_OUT = (
    "outcome",
    "bands",
    "scores",
    "verdicts",
    "innovations",
    "loops",
    "steps",
    "agreement",
    "explanations",
    "learned",
    "replicated",
    "remarks",
)


def assemble(
    problem: Problem,
    chain: ChainFile,
    outcome: Outcome,
    artist: Beside | None = None,
    watch: Callable[[str, float], None] = lambda *_: None,
) -> Result:
    """Put a result together: draws, remarks and, if the chain has converged, predictions.

    ``artist`` is given each part of it as soon as there is something to draw; ``watch`` is called
    with the name of a step and the share of it that is done.
    """
    posterior = problem.posterior
    result = _drawn(problem, chain, outcome)
    sampled = result.draws
    flat = sampled.reshape(-1, sampled.shape[-1])
    remarks: list[Finding | str] = [
        *version_remarks(chain.attributes().get("versions"), versions(posterior.engine)),
        *problem.remarks,
        *outcome.remarks,
        *conflict.conflicts(posterior.prior, flat, problem.defaults),
        *identifiability.undetermined(posterior, chain.point),
    ]
    _, alone, first_draws = next(posterior.each(flat))
    columns = alone.table.columns(alone.prior.theta(first_draws))
    remarks += alone.only.actuator.hysteresis.remarks(columns, alone.names)
    result = replace(result, remarks=tuple(map(str, remarks)))
    if artist is not None:
        artist.draw(result)
    if not outcome.converged:
        return result
    chosen = thinned(flat, generator(problem.config.seed, "draws"))
    steps = measure_steps(posterior, chosen, stepped(problem))
    bands = predictions(problem, flat, partial(watch, "predictions"))
    if artist is not None:
        artist.draw(replace(result, bands=bands, steps=steps))
    best = flat[int(np.argmax(result.log_density))]
    series = {
        name: innovations.innovations(alone, theta[0], problem.records[name].start)
        for name, alone, theta in posterior.each(best[np.newaxis])
    }
    begin = {name: record.start for name, record in problem.records.items()}
    compared = agreement.agreements(
        posterior, chain.point, generator(problem.config.seed, "agreement"), begin
    )
    several = len(problem.records) > 1
    odd = {name: innovations.departures(whitened) for name, whitened in series.items()}
    background = Background.of(posterior, flat)
    failed = any(
        verdict.holds is False for verdict in judged(problem, bands, background, {}).values()
    )
    places = posterior.prior.unconstrain(best[np.newaxis])
    places = np.concatenate([places, chain.point.optima])
    explanations = {
        name: explained(
            problem,
            name,
            places,
            partial(watch, f"explanations of {name}" if several else "explanations"),
            thorough=failed or bool(odd[name]),
        )
        for name in problem.records
    }
    verdicts = judged(problem, bands, background, explanations)
    source = generator(problem.config.seed, "checks")
    return replace(
        result,
        bands=bands,
        scores={
            predicted.name: score(
                predicted, scoring(problem.config.seed, predicted), background.extent
            )
            for predicted in bands
            if predicted.name in verdicts
        },
        verdicts=verdicts,
        innovations=series,
        loops=measure_loops(posterior, chosen),
        steps=steps,
        agreement=compared,
        explanations=explanations,
        learned=learned(posterior.prior, sampled, result.log_density, source),
        replicated={
            dataset.name: replicated(posterior, chosen, source, dataset.name)
            for dataset in posterior.datasets
        },
        remarks=(
            *result.remarks,
            *map(str, agreement.disagreements(compared)),
            *(
                f"{name}: {finding}" if several else str(finding)
                for name, departures in odd.items()
                for finding in departures
            ),
            *(
                f"{name}: {line}" if several else line
                for name, candidates in explanations.items()
                for line in lines(likely_causes(candidates))
            ),
            *(f"{name}: {note}" for name, verdict in verdicts.items() for note in verdict.notes),
        ),
    )


def _drawn(problem: Problem, chain: ChainFile, outcome: Outcome) -> Result:
    """Return the draws, and what the problem says of them."""
    return Result(
        name=problem.config.name or "run",
        outcome=outcome,
        parameters=problem.parameters,
        draws=draws(problem.posterior, chain),
        log_density=log_densities(chain),
        moves=chain.moves("sampling"),
        facts=facts_of(problem, chain),
        truth=problem.config.truth,
    )


def save_result(path: Path, problem: Problem, chain: ChainFile, result: Result) -> None:
    """Keep what was worked out of a chain."""
    values = {name: getattr(result, name) for name in WORKED_OUT}
    save(path, state_of(problem, chain), values)


def load_result(path: Path, problem: Problem, chain: ChainFile) -> Result | None:
    """Return the result that was kept of a chain as it is now, if any."""
    values = load(path, state_of(problem, chain))
    if values is None:
        return None
    return replace(_drawn(problem, chain, values["outcome"]), **values)
