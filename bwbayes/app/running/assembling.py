"""From a chain to a result: draws, remarks, predictions and what came of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bwbayes.app.problem.problem import Problem, generator
from bwbayes.app.running.drawing import Beside
from bwbayes.app.running.facts import facts_of, stepped
from bwbayes.app.running.fingerprint import version_remarks, versions
from bwbayes.app.running.predictions import Swallowed, judged, predictions, scoring
from bwbayes.inference import conflict
from bwbayes.results import agreement, identifiability, innovations
from bwbayes.results.drift import drifted
from bwbayes.results.learned import learned
from bwbayes.results.loops import measure_loops
from bwbayes.results.prediction import thinned
from bwbayes.results.replicated import replicated
from bwbayes.results.result import Result
from bwbayes.results.scores import score
from bwbayes.results.steps import measure_steps
from bwbayes.results.transient import swallowed
from bwbayes.results.verdict import Background
from bwbayes.sampling.sampler import Outcome, draws, log_densities
from bwbayes.sampling.storage import ChainFile

__all__ = ["assemble"]


def assemble(
    problem: Problem, chain: ChainFile, outcome: Outcome, artist: Beside | None = None
) -> Result:
    """Put a result together: draws, remarks and, if the chain has converged, predictions.

    ``artist`` is given each part of it as soon as there is something to draw.
    """
    posterior = problem.posterior
    sampled = draws(posterior, chain)
    flat = sampled.reshape(-1, sampled.shape[-1])
    remarks = [
        *version_remarks(chain.attributes().get("versions"), versions(posterior.engine)),
        *problem.remarks,
        *outcome.remarks,
        *conflict.conflicts(posterior.prior, flat, problem.defaults),
        *identifiability.remarks(posterior, chain.point, flat),
    ]
    _, alone, its = next(posterior.each(flat))
    columns = alone.table.columns(alone.prior.theta(its))
    remarks += alone.only.actuator.hysteresis.remarks(columns, alone.names)
    result = Result(
        name=problem.config.name or "run",
        outcome=outcome,
        parameters=problem.parameters,
        draws=sampled,
        log_density=log_densities(chain),
        moves=chain.moves("sampling"),
        facts=facts_of(problem, chain),
        remarks=tuple(remarks),
        truth=problem.config.truth,
    )
    if artist is not None:
        artist.draw(result)
    if not outcome.converged:
        return result
    chosen = thinned(flat, generator(problem.config.seed, "draws"))
    steps = measure_steps(posterior, chosen, stepped(problem))
    bands = predictions(problem, result)
    if artist is not None:
        artist.draw(replace(result, bands=bands, steps=steps))
    best = flat[int(np.argmax(result.log_density))]
    series = {
        name: innovations.innovations(alone, one[0], problem.records[name].start)
        for name, alone, one in posterior.each(best[np.newaxis])
    }
    # By further point fits, without a record's start, and without its drift.
    source = generator(problem.config.seed, "without start")
    some = thinned(flat, source)
    followed = {
        name: Swallowed(
            swallowed(
                posterior,
                some,
                source,
                record.start,
                record=name,
                seen=any(one.kind == "switch-on transient" for one in problem.findings[name]),
            ),
            drifted(posterior, some, source, record=name),
        )
        for name, record in problem.records.items()
    }
    begin = {name: record.start for name, record in problem.records.items()}
    compared = agreement.agreements(
        posterior, chain.point, generator(problem.config.seed, "agreement"), begin
    )
    several = len(problem.records) > 1
    odd = [
        f"{name}: {remark}" if several else remark
        for name, one in series.items()
        for remark in innovations.remarks(one)
    ]
    background = Background.of(posterior, flat)
    verdicts = judged(problem, bands, background, series, followed)
    return replace(
        result,
        bands=bands,
        scores={
            one.name: score(one, scoring(problem.config.seed, one), background.extent)
            for one in bands
            if one.name in verdicts
        },
        verdicts=verdicts,
        innovations=series,
        loops=measure_loops(posterior, chosen),
        steps=steps,
        agreement=compared,
        learned=learned(posterior.prior, sampled, result.log_density, source),
        replicated={
            one.name: replicated(posterior, chosen, source, one.name) for one in posterior.datasets
        },
        remarks=(
            *result.remarks,
            *agreement.remarks(compared),
            *odd,
            *(f"{name}: {note}" for name, verdict in verdicts.items() for note in verdict.notes),
        ),
    )
