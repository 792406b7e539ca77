"""Explanations that describe the readings better than the model: found, shown, and added.

:func:`chosen_noise` takes the noise that the records have evidence for: each is fitted from the
mode of the rough one, and taken if its evidence leads by odds of twenty to one: the rough
discrepancy claims least, because it has white noise as a limit, and corners that a smooth one has
not. What another noise could gain shows in the rough one's innovations, which are cheap to look at.

:func:`improve_model` gives a model the parts for which its record has evidence. Each round fits the
model, explains its readings better in every way there is, and takes the stage that leads, if it is
worth more than chance; then it leaves out again what was added and is not needed any more. None is
added while the fit follows what the actuator did not do: no stage mends a transient.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from bwbayes.app.config.config import Config
from bwbayes.app.problem.parameters import with_model
from bwbayes.app.problem.problem import Problem, resolve_config
from bwbayes.app.problem.records import generator
from bwbayes.app.running.progress import StepProgress
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.explanations import TIED, explain, followed_causes, likely_causes
from bwbayes.diagnosis.innovations import innovations
from bwbayes.diagnosis.laplace import climb
from bwbayes.diagnosis.model import without
from bwbayes.diagnosis.residual_analysis import Explanation, ResidualAnalysis
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.noise import NOISES
from bwbayes.record import Record
from bwbayes.watching import Watch, WatchSteps, part, parts, unwatched

# Stages that a search adds at most if it has found the mechanism.
MAX_STAGES = 3


def explain_record(
    problem: Problem,
    name: str,
    places: FloatArray,
    watch: Watch = unwatched,
) -> tuple[Explanation, ...]:
    """Explain a training record's readings better than its fit does, the best explanation first.

    ``places`` are the posterior's modes (modes, free), coordinates; ``watch`` is called with the
    share that is done.
    """
    return explain(_scene(problem, name, places), watch)


def _scene(problem: Problem, name: str, places: FloatArray) -> ResidualAnalysis:
    """Return a training record as explanations see it."""
    posterior, record = problem.posterior, problem.records[name]
    return ResidualAnalysis.of(
        posterior.for_record(name),
        posterior.select_draws(places, name),
        generator(problem.config.seed, f"explanations {record.sha256}"),
        [window for windows in problem.held_out(name).values() for window in windows],
        record.start,
        # Of several records no other model is built: it would be one of all of them.
        problem.study if len(problem.records) == 1 else None,
    )


def lines(explanations: Sequence[Explanation]) -> Iterator[str]:
    """Write those of the best five explanations whose odds are above twenty to one, a line each.

    Not those with which the model misses more: their evidence is that of the discrepancy, which
    takes it up.
    """
    for explanation in explanations[:5]:
        without, with_it = explanation.rmse
        if explanation.nats > TIED and not with_it > 1.1 * without:
            text = f"{explanation.text} ({explanation.worth})"
            yield f"explained better by: {text}. Fix: {explanation.fix}."


def chosen_noise(problem: Problem, point: MAPEstimate, watch: Watch = unwatched) -> tuple[str, str]:
    """Return the noise of a problem whose ``noise`` is ``auto``, and a line that says why.

    Its posterior, of which ``point`` is the MAP estimate, has the rough discrepancy. White noise is
    always compared; any other has nothing to gain where the innovations are white already. The
    evidence of several records is the sum of what each has alone. ``watch`` is called with the
    share that is done.
    """
    default, posterior = "discrepancy", problem.posterior
    rough = {
        name: climb(
            posterior.for_record(name), posterior.select_draws(point.optima, name), watch=of_record
        )
        for name, of_record in parts([*problem.records], part(watch, 0.0, 1 / len(NOISES)))
    }
    evidence = {default: sum(fit.log_evidence for fit in rough.values())}
    # Innovations less likely than this by chance may be explained by another noise.
    chances = [innovations(fit.posterior, fit.free).octaves()[2] for fit in rough.values()]
    p, colored = min(1.0, len(chances) * min(chances)), 0.05
    # That outliers spoil a record is an explanation, which has its own evidence.
    candidates = {*evidence, "student"}
    others = [n for n in NOISES if n not in candidates and (n == "white" or p < colored)]
    for noise, of_noise in parts(others, part(watch, 1 / len(NOISES), 1.0)):
        other = problem.study.with_model(replace(problem.study.spec, noise=noise)).posterior
        # What only the other noise has starts at its prior's median.
        named = dict(zip(posterior.names, point.optima.T, strict=True))
        nothing = np.zeros(len(point.optima))
        places = np.stack([named.get(name, nothing) for name in other.names], axis=1)
        fits = [
            climb(
                other.for_record(name),
                other.select_draws(places, name),
                least=fit.log_density,
                watch=of_record,
            )
            for (name, fit), of_record in parts([*rough.items()], of_noise)
        ]
        # Not one that takes up the readings, of which it would tell nothing anew.
        if all(fit.follows for fit in fits):
            evidence[noise] = sum(fit.log_evidence for fit in fits)
    watch(1.0)
    best = max(evidence, key=lambda noise: evidence[noise])
    if evidence[best] < evidence[default] + TIED:
        best = default
    against = [
        f"{lead:+.3g} nats against {noise}" if lead > TIED else f"a tie with {noise}"
        for noise, lead in ((noise, evidence[best] - nats) for noise, nats in evidence.items())
        if noise != best
    ]
    if p >= colored:
        against.append(f"innovations are white, p = {p:.2g}")
    return best, f"noise: {best} ({', '.join(against)})"


def find_map(problem: Problem, watch: WatchSteps = unwatched) -> tuple[Problem, MAPEstimate, str]:
    """Return a problem with the noise that it shows, its MAP estimate, and why it has that noise.

    The problem as it is, and no reason, if its config names a noise. ``watch`` is called with the
    name of a step and the share of it that is done.
    """
    point = _fit_point(problem, partial(watch, "MAP estimate"))
    if problem.config.model.noise != "auto":
        return problem, point, ""
    noise, why = chosen_noise(problem, point, partial(watch, "noise model"))
    chosen = problem.with_noise(noise)
    if chosen.posterior is not problem.posterior:
        point = _fit_point(chosen, partial(watch, f"MAP estimate, {noise} noise"))
    return chosen, point, why


def _fit_point(problem: Problem, watch: Watch) -> MAPEstimate:
    source = generator(problem.config.seed, "point fit")
    return map_estimate.fit(problem.posterior, source, watch)


def improve_model(
    config: Config, folder: Path, console: Console, records: Mapping[str, Record] | None = None
) -> Config:
    """Return a config with all stages that pay; progress goes to the console.

    Config, folder and records are as :func:`~bwbayes.app.problem.problem.resolve` takes them.

    Raises InputError: the config cannot be used, or several records are fitted.
    """
    if len(config.records) > 1:
        raise InputError("improve: is for one training record; improve a fit of one of them first")
    notes = dict[str, str]()
    while True:
        problem = resolve_config(config, folder, records)
        (name,) = problem.records
        with StepProgress(console, "searching for missing parts of the model ...") as watch:
            point = _fit_point(problem, partial(watch, "MAP estimate"))
            scene = _scene(problem, name, point.optima)
            found = explain(scene, partial(watch, "explanations"))
            # The last one has just been weighed.
            needless = [removal for removal in without(scene, [*notes][:-1]) if removal.nats >= 0]
        parts = likely_causes([cause for cause in found if cause.spec is not None])
        if needless:
            chosen = max(needless, key=lambda removal: removal.nats)
            del notes[chosen.kind]
            note = f"left out again: {chosen.kind}"
        elif parts and all(cause.spec is not None for cause in followed_causes(found)):
            chosen, chain = parts[0], problem.study.spec.chain
            assert chosen.spec is not None
            added = next((stage for stage in chosen.spec.chain if stage not in chain), chosen.kind)
            notes[added] = f"model improved: {chosen.text} ({chosen.worth})"
            note = f"added: {chosen.text}"
        else:
            break
        console.print(note, highlight=False, soft_wrap=True)
        assert chosen.spec is not None
        config = with_model(config, chosen.spec, problem.records, chosen.stated)
    if not notes:
        return config
    remarks = [*notes.values()]
    if len(notes) > MAX_STAGES:
        remarks.append(
            f"{len(notes)} stages were added: many gains are no proof of a mechanism, and a drive "
            "unlike the training record's may be missed"
        )
    record = config.records[name]
    noted = record.model_copy(update={"remarks": [*(record.remarks or []), *remarks]})
    return config.model_copy(update={"record": noted})
