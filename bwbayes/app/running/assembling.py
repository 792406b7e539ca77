"""From a chain to a result: draws, remarks, predictions and what came of them.

What is worked out is kept with the run, and read from there; see
:mod:`bwbayes.app.running.fingerprint`.
"""

from __future__ import annotations

import json
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np

from bwbayes.app.problem.problem import Problem
from bwbayes.app.problem.records import generator
from bwbayes.app.running.explaining import explained, lines
from bwbayes.app.running.figure_worker import Artist
from bwbayes.app.running.fingerprint import load, save, state_of, version_remarks, versions
from bwbayes.app.running.predictions import predictions, validate_predictions
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis import conflict, identifiability, innovations
from bwbayes.diagnosis import consistency as agreement
from bwbayes.diagnosis.drive_lock import drive_locks
from bwbayes.diagnosis.explanations import likely_causes
from bwbayes.diagnosis.identifiability import information_gain
from bwbayes.diagnosis.predictive_checks import check_predictions
from bwbayes.diagnosis.validation import Background
from bwbayes.inference.map_estimate import PointFit, distinct
from bwbayes.inference.voltage_noise import path_covariance, widened
from bwbayes.prediction.loops import measure_loops
from bwbayes.prediction.prediction import thinned
from bwbayes.prediction.scores import score
from bwbayes.prediction.steps import measure_steps
from bwbayes.report.result import Result
from bwbayes.sampling.chain import PHASES, constrain_steps, draws, log_densities, thinning
from bwbayes.sampling.diagnostics import Outcome
from bwbayes.sampling.storage import ChainFile
from bwbayes.watching import Watch, WatchSteps, counted, unwatched, watched

# What a chain notes it by: (free, free), in unconstrained coordinates.
VOLTAGE_NOISE = "voltage_noise_covariance"


def assemble(
    problem: Problem,
    chain: ChainFile,
    outcome: Outcome,
    artist: Artist | None = None,
    watch: WatchSteps = unwatched,
) -> Result:
    """Put a result together: draws, remarks and, if the chain has converged, predictions.

    ``artist`` is given each part of it as soon as there is something to draw; ``watch`` is called
    with the name of a step and the share of it that is done.
    """
    posterior, seed, records = problem.posterior, problem.config.seed, problem.records
    artist = artist or Artist()
    result = _read_draws(problem, chain, outcome)
    flat = result.flat_draws
    looked_at = counted(3, partial(watch, "remarks"))
    remarks = [
        *version_remarks(chain.attributes().get("versions"), versions(posterior.engine)),
        *problem.remarks,
        *outcome.remarks,
    ]
    looked_at(1)
    remarks += map(str, conflict.conflicts(posterior.prior, flat, problem.defaults))
    looked_at(1)
    remarks += map(str, identifiability.undetermined(posterior, chain.point))
    looked_at(1)
    result = replace(result, remarks=tuple(remarks))
    artist.draw(result)
    if not outcome.converged:
        return result
    several = len(records) > 1
    subset = thinned(flat, generator(seed, "draws"))
    others = {**(records if several else {}), **problem.others}
    steps = measure_steps(posterior, subset, others)
    bands = predictions(problem, flat, partial(watch, "predictions"))
    result = replace(result, bands=bands, steps=steps)
    artist.draw(result)
    best = flat[[int(np.argmax(result.log_density))]]
    series = {
        name: innovations.innovations(alone, theta[0], records[name].start)
        for name, alone, theta in watched([*posterior.each(best)], partial(watch, "innovations"))
    }
    starts = {name: record.start for name, record in records.items()}
    compared = agreement.agreements(
        posterior, chain.point, starts, partial(watch, "consistency of the records")
    )
    background = Background.of(posterior, flat)
    result = replace(
        result,
        scores={
            band.name: score(band, background.extent)
            for band in watched(bands, partial(watch, "scores"))
            if band.scored(band.measured).any()
        },
        innovations=series,
        loops=measure_loops(posterior, subset, partial(watch, "loops")),
        agreement=compared,
    )
    artist.draw(result)
    locks = drive_locks(posterior, subset, generator(seed, "drive lock"))
    departures = {name: innovations.departures(whitened) for name, whitened in series.items()}
    places = [*posterior.prior.unconstrain(best), *chain.point.optima]
    modes = distinct(places, chain.point.covariance)
    explanations = {
        name: explained(
            problem,
            name,
            modes,
            partial(watch, f"explanations of {name}" if several else "explanations"),
        )
        for name in records
    }
    verdicts = validate_predictions(problem, bands, background, explanations)
    remarks += map(str, agreement.disagreements(compared))
    for said in (
        departures,
        {name: lock.findings for name, lock in locks.items()},
        {name: lines(likely_causes(causes)) for name, causes in explanations.items()},
    ):
        for name, texts in said.items():
            remarks += [f"{name}: {text}" if several else str(text) for text in texts]
    remarks += [f"{name}: {note}" for name, verdict in verdicts.items() for note in verdict.notes]
    source = generator(seed, "checks")
    learned = information_gain(
        posterior.prior,
        result.draws,
        result.log_density,
        source,
        partial(watch, "information gain"),
    )
    return replace(
        result,
        verdicts=verdicts,
        explanations=explanations,
        drive_locks=locks,
        learned=learned,
        replicated={
            dataset.name: check_predictions(
                posterior,
                subset,
                source,
                dataset.name,
                partial(watch, f"checks of {dataset.name}" if several else "posterior checks"),
            )
            for dataset in posterior.datasets
        },
        remarks=tuple(remarks),
    )


def voltage_noise(problem: Problem, point: PointFit, watch: Watch = unwatched) -> dict[str, str]:
    """Return what a chain notes of what noise on the voltages leaves unsure; nothing without."""
    paths = {name: record.path for name, record in problem.records.items()}
    if not any(path.noise_sd for path in paths.values()):
        return {}
    source = generator(problem.config.seed, "voltage noise")
    covariance = path_covariance(problem.posterior, paths, point, source, watch)
    return {VOLTAGE_NOISE: json.dumps(covariance.tolist())}


def run_draws(problem: Problem, chain: ChainFile) -> FloatArray:
    """Return a run's draws in their own units, (steps, ensembles, walkers, free).

    Those of its chain, or wider by what noise on the voltages leaves unsure; where the prior allows
    no such place, as sampled.
    """
    noted = chain.attributes().get(VOLTAGE_NOISE)
    if noted is None:
        return draws(problem.posterior, chain)
    more = np.array(json.loads(str(noted)))
    coordinates = chain.coordinates("sampling", thinning(chain.draws("sampling")))
    wide = widened(coordinates, chain.point.covariance, more)
    _, log_prior = problem.posterior.prior.constrain(wide.reshape(-1, len(more)))
    possible = np.isfinite(log_prior).reshape(*wide.shape[:-1], 1)
    return constrain_steps(problem.posterior, np.where(possible, wide, coordinates))


def _read_draws(problem: Problem, chain: ChainFile, outcome: Outcome) -> Result:
    """Return the draws, and what the problem says of them."""
    plan, steps = problem.plan, ", ".join(f"{chain.steps(p)} steps of {p}" for p in PHASES)
    accepted = {
        phase: ", ".join(f"{n} {count / p:.0%}" for n, (p, count) in chain.moves(phase).items())
        for phase in PHASES
    }
    facts = {
        "sampling": f"{plan.ensembles} ensembles of {plan.walkers} walkers; {steps}",
        "accepted": "; ".join(f"{phase}: {text}" for phase, text in accepted.items() if text),
        "engine": problem.posterior.engine,
    }
    return Result(
        name=problem.config.name or "run",
        outcome=outcome,
        parameters=problem.parameters,
        draws=run_draws(problem, chain),
        log_density=log_densities(chain),
        moves=chain.moves("sampling"),
        facts=problem.facts | facts,
        truth=problem.config.truth,
    )


def save_result(path: Path, problem: Problem, chain: ChainFile, result: Result) -> None:
    """Keep what takes time of a result: all that neither the chain nor the config holds."""
    read = ("name", "parameters", "draws", "log_density", "moves", "facts", "truth")
    names = [field.name for field in fields(result) if field.name not in read]
    save(path, state_of(problem, chain), {name: getattr(result, name) for name in names})


def load_result(path: Path, problem: Problem, chain: ChainFile) -> Result | None:
    """Return the result that was kept of a chain as it is now, if any."""
    values = load(path, state_of(problem, chain))
    if values is None:
        return None
    return replace(_read_draws(problem, chain, values["outcome"]), **values)
