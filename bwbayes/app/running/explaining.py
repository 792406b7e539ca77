"""Explanations that describe the readings better than the model: found, and added.

:func:`chosen_noise` takes the noise that the records have evidence for: each is fitted from the
mode of the rough one, and taken if its evidence leads by odds of twenty to one: the rough
discrepancy claims least, because it has white noise as a limit, and corners that a smooth one has
not. The rough one's innovations, which are cheap to compute, show what another noise could gain.

:func:`choose_model` gives a model the noise and the stages for which its record has evidence. None
is added while the fit follows what the actuator did not do: no stage mends a transient.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from bwbayes.app.fit.fitted import Run
from bwbayes.app.running.fingerprint import fingerprint, load, save
from bwbayes.app.study.resolve import with_model
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.averaging import Alternative, alternatives, remarks
from bwbayes.diagnosis.explanations import (
    TIED,
    corners,
    explain,
    followed_causes,
    likely_causes,
    without,
)
from bwbayes.diagnosis.finding import TELLING_DRIVE
from bwbayes.diagnosis.innovations import innovations
from bwbayes.diagnosis.laplace import climb
from bwbayes.diagnosis.residual_analysis import Explanation, ResidualAnalysis
from bwbayes.diagnosis.rivals import Rival, fit_rivals
from bwbayes.inference import map_estimate, stopwatch
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.noise import NOISES
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Study
from bwbayes.model.spec import ModelSpec
from bwbayes.shown import rounded
from bwbayes.watching import Watch, WatchSteps, part, parts, unwatched

# A search that has found the mechanism adds no more stages, and leaves no more discrepancy, in sds
# of the sensor.
MAX_STAGES = 3
MAX_DISCREPANCY = 0.25

# Noises of the sensor alone, beside any discrepancy.
SENSOR_NOISES = ("student", "paced")


def explain_record(
    study: Study,
    name: str,
    places: FloatArray,
    watch: Watch = unwatched,
) -> tuple[Explanation, ...]:
    """Explain a training record's readings better than its fit does, the best explanation first.

    ``places`` are the posterior's modes (modes, free), coordinates; ``watch`` is called with the
    share that is done.
    """
    return explain(_analysis(study, name, places), watch)


def fitted_rivals(
    run: Run, of: str, specs: tuple[ModelSpec, ...], watch: Watch = unwatched
) -> tuple[Rival, ...]:
    """Return models fitted to a training record, by its name, as the run's folder keeps them.

    ``watch`` is called with the share that is done.
    """
    study, path, state = run.study, run.folder.rivals, fingerprint(run)
    fitted = load(path, state) or {}
    of_record = fitted.setdefault(of, {})
    if specs not in of_record:
        rng = study.generator(f"rivals of {study.records[of].sha256}")
        of_record[specs] = fit_rivals(study.for_record(of), specs, rng, watch)
        # A process that predicts elsewhere may have no right to write to the folder.
        with suppress(OSError):
            save(path, state, fitted)
    rivals: tuple[Rival, ...] = of_record[specs]
    return rivals


def _analysis(study: Study, name: str, places: FloatArray) -> ResidualAnalysis:
    """Return a training record as explanations see it."""
    posterior, record = study.posterior, study.records[name]
    return ResidualAnalysis.of(
        posterior.for_record(name),
        posterior.select_draws(places, name),
        study.generator(f"explanations {record.sha256}"),
        study.for_record(name),
        [window for windows in study.held_out(name).values() for window in windows],
        record.start,
        alone=len(study.records) == 1,
    )


def chosen_noise(study: Study, point: MAPEstimate, watch: Watch = unwatched) -> tuple[str, str]:
    """Return the noise of a study whose ``noise`` is ``auto``, and a line that says why.

    Its posterior, of which ``point`` is the MAP estimate, has the rough discrepancy. White noise is
    always compared; any other has nothing to gain where the innovations are white already. A sensor
    whose noise has heavy tails or grows stays one beside each. The evidence of several records is
    the sum of what each has alone. ``watch`` is called with the share that is done.
    """
    default, posterior = "discrepancy", study.posterior
    sensor = study.spec.noise.split(" + ")[1:]
    rough = {
        name: climb(
            posterior.for_record(name), posterior.select_draws(point.optima, name), watch=of_record
        )
        for name, of_record in parts([*study.records], part(watch, 0.0, 1 / len(NOISES)))
    }
    evidence = {default: sum(fit.log_evidence for fit in rough.values())}
    # Innovations less likely than this by chance may be explained by another noise.
    chances = [innovations(fit.posterior, fit.free).octaves()[2] for fit in rough.values()]
    p, colored = min(1.0, len(chances) * min(chances)), 0.05
    # That outliers spoil a record, or speed does, is an explanation, which has its own evidence.
    candidates = {*evidence, *SENSOR_NOISES}
    others = [n for n in NOISES if n not in candidates and (n == "white" or p < colored)]
    for noise, of_noise in parts(others, part(watch, 1 / len(NOISES), 1.0)):
        spec = replace(study.spec, noise=_beside(noise, sensor))
        other = study.with_model(spec).posterior
        places = _optima_by_name(posterior, point, other)
        fits = [
            climb(
                other.for_record(name),
                other.select_draws(places, name),
                least=fit.log_density,
                watch=of_record,
            )
            for (name, fit), of_record in parts([*rough.items()], of_noise)
        ]
        # A noise that takes up the readings itself is no explanation of them.
        if all(fit.follows for fit in fits):
            evidence[noise] = sum(fit.log_evidence for fit in fits)
    watch(1.0)
    best = max(evidence, key=lambda noise: evidence[noise])
    if evidence[best] < evidence[default] + TIED:
        best = default
    against = [
        f"+{rounded(lead)} nats against {noise}" if lead > TIED else f"a tie with {noise}"
        for noise, lead in ((noise, evidence[best] - nats) for noise, nats in evidence.items())
        if noise != best
    ]
    if p >= colored:
        against.append(f"innovations are white, p = {p:.2g}")
    why = ", ".join(against) or "with no other does the model follow the readings"
    chosen = _beside(best, sensor)
    return chosen, f"noise: {chosen} ({why})"


def _optima_by_name(posterior: Posterior, point: MAPEstimate, other: Posterior) -> FloatArray:
    """Return places (optima, free) of another posterior at the optima of a posterior.

    Parameters that only the other one has are at their priors' medians.
    """
    named = dict(zip(posterior.names, point.optima.T, strict=True))
    nothing = np.zeros(len(point.optima))
    return np.stack([named.get(name, nothing) for name in other.names], axis=1)


def _beside(noise: str, sensor: Sequence[str]) -> str:
    """Return a noise beside what is known of the sensor's, which is white by itself."""
    return " + ".join([*sensor] if noise == "white" and sensor else [noise, *sensor])


class ChosenModel(NamedTuple):
    """A run with the model that its records have evidence for, and its MAP estimate.

    ``steps`` say what was chosen, a line each; ``explanations`` are what would still explain each
    record's readings better, by its name, or None if that was not looked for to the end.
    ``alternatives`` are models that were not chosen, and that the record does not rule out.
    """

    run: Run
    point: MAPEstimate
    steps: tuple[str, ...]
    explanations: dict[str, tuple[Explanation, ...]] | None
    alternatives: Sequence[Alternative] = ()


def choose_model(run: Run, watch: WatchSteps = unwatched) -> ChosenModel:
    """Choose what a run's config leaves open: its noise, and all the stages that pay.

    Each round fits the model, chooses the noise for it, explains its readings better in every way
    there is, and takes the stage that leads; then it leaves out again what was added and is not
    needed any more. So noise and stages cannot keep each other from being found, and the search
    ends with a model that no stage would explain better. The voltage's corners between its samples
    come before any stage, which might make up for them. No stage is added with which the error on
    readings that were held out grows by a tenth, whatever its evidence. Several records have none
    added: an explanation is one of a single record. Time is CPU time without that of compiling, so
    that a busy or a new machine finds the same. A search that adds three stages and leaves a model
    error all the same has not found the mechanism: the config says so (``unexplained``), and the
    run is inconclusive. With fewer, the error may be a disturbance, and that is a remark.

    A config that names stages or noise keeps them. ``watch`` is called with the name of a step and
    the share of it that is done.
    """
    with stopwatch(run.study.engine) as clock:
        return _search(run, clock, watch)


def _search(open_run: Run, clock: Callable[[], float], watch: WatchSteps) -> ChosenModel:
    """Search as :func:`choose_model`; ``clock`` tells the time, s, since the search began."""
    seconds = open_run.config.model.search_seconds
    is_open = open_run.config.model.noise == "auto"
    run, point, why = _fitted(open_run, is_open, watch)
    if not seconds or len(run.study.records) > 1:
        return ChosenModel(run, point, why, None)
    (name,) = run.study.records
    notes, steps = dict[str, str](), list[str]()
    ties, is_over = dict[str, tuple[ModelSpec, list[Explanation]]](), False
    while not is_over:
        step = partial(watch, f"stages, round {len(steps) + 1}")
        analysis = _analysis(run.study, name, point.optima)
        # The course of the voltage comes first: stages that smooth it would make up for corners.
        corner_causes = _corner_causes(analysis)
        explanations = corner_causes or explain(analysis, step, lambda: clock() > seconds)
        is_over = clock() > seconds
        # The last one has just been weighed.
        before = [] if is_over else [*notes][:-1]
        needless = [removal for removal in without(analysis, before) if removal.nats >= 0]
        # So has another discrepancy, if the noise is open.
        models = [
            cause
            for cause in explanations
            if cause.spec
            and not (is_open and not cause.stated and _reopened(cause.spec) == open_run.study.spec)
        ]
        parts = corner_causes or likely_causes([cause for cause in models if not cause.misleads])
        if needless:
            chosen = max(needless, key=lambda removal: removal.nats)
            del notes[chosen.kind], ties[chosen.kind]
            note = f"left out again: {chosen.kind}"
        elif parts and all(cause.spec is not None for cause in followed_causes(explanations)):
            # A tie goes to a stage before another hold, then to the fewest parameters.
            chosen = min(parts, key=partial(_size, run.study))
            assert chosen.spec is not None
            chain = run.study.spec.chain
            added = next((new for new in chosen.spec.chain if new not in chain), chosen.kind)
            gain = f"{' or '.join(cause.text for cause in parts)} ({chosen.worth})"
            notes[added], note = f"stage added: {gain}{_fix(parts)}", f"added: {gain}"
            ties[added] = chosen.spec, [cause for cause in parts if cause is not chosen]
        else:
            break
        steps.append(f"{note}, {clock():.0f} s")
        assert chosen.spec is not None
        spec = _reopened(chosen.spec) if is_open else chosen.spec
        open_run = with_model(open_run, spec, chosen.stated)
        run, point, why = _fitted(open_run, is_open, watch)
        explanations = ()  # they were another model's
    refused = [cause for cause in likely_causes(models) if cause.misleads]
    steps += [f"not added: {cause.text} ({cause.worth})" for cause in refused]
    ended = [f"the search for stages ended after {seconds:g} s, before it was complete"] * is_over
    unexplained, alarms = _unexplained(
        len({*notes} - {"corners"}), _relative_discrepancy(run.study.posterior, point)
    )
    spec = run.study.spec
    # A hold that was chosen later has no corners.
    said = [note for kind, note in notes.items() if kind != "corners" or spec.hold == kind]
    tied = [*_tied(spec, ties.values())]
    weigh = partial(watch, "models that were not chosen")
    others = alternatives(run.study, point.optima, (*explanations, *tied), weigh)
    steps += [*ended, *remarks(others)]
    run = with_model(
        run,
        spec,
        remarks=[*said, *ended, *alarms, *remarks(others)],
        stages=spec.keys["stages"],
        unexplained=unexplained,
        tied=[spec.changes_to(other.spec) for other in tied if other.spec],
    )
    found = None if is_over else {name: explanations}
    return ChosenModel(run, point, (*steps, *why), found, others)


def _corner_causes(analysis: ResidualAnalysis) -> tuple[Explanation, ...]:
    """Return the voltage's corners between samples, if all readings have evidence for them."""
    found = (analysis.confirmed(cause) for cause in corners(analysis))
    return tuple(cause for cause in found if cause.nats > TIED)


def _unexplained(added: int, discrepancy: float) -> tuple[float | None, list[str]]:
    """Tell whether a search found the mechanism: else return the discrepancy, or a remark on it.

    It has ``added`` stages, and leaves a ``discrepancy``, sds of the sensor.
    """
    if added >= MAX_STAGES and discrepancy > MAX_DISCREPANCY:
        return float(f"{discrepancy:.2g}"), []
    if added > MAX_STAGES or (added and discrepancy > MAX_DISCREPANCY):
        remark = (
            "the search for stages may not have found the mechanism: the model error is still "
            f"{discrepancy:.2g} times the sensor's noise, with {added} added; a drive unlike "
            f"the training record's may be missed. Fix: {TELLING_DRIVE}."
        )
        return None, [remark]
    return None, []


def _fix(causes: Sequence[Explanation]) -> str:
    """Return what to do on the test stand about causes, as the end of a note on them."""
    advice = "; or ".join(dict.fromkeys(cause.advice for cause in causes if cause.advice))
    return f". Fix: {advice}." if advice else ""


def _fitted(run: Run, is_open: bool, watch: WatchSteps) -> tuple[Run, MAPEstimate, tuple[str, ...]]:
    """Fit a run, with the noise that it has evidence for if that is open, and say why it has it."""
    point = _fit_point(run.study, partial(watch, "MAP estimate"))
    if not is_open:
        return run, point, ()
    noise, why = chosen_noise(run.study, point, partial(watch, "noise model"))
    chosen = with_model(run, replace(run.study.spec, noise=noise), noise=noise)
    if chosen.study is not run.study:
        # A long record's noise has further modes, and its beginning may show one that is not the
        # best: here is the one that the noise was chosen for.
        places = _optima_by_name(run.study.posterior, point, chosen.study.posterior)
        step = partial(watch, f"MAP estimate, {noise} noise")
        point = _fit_point(chosen.study, step, places)
    return chosen, point, (why,)


def _fit_point(study: Study, watch: Watch, further: Iterable[FloatArray] = ()) -> MAPEstimate:
    return map_estimate.fit(study.posterior, study.generator("point fit"), watch, further)


def _reopened(spec: ModelSpec) -> ModelSpec:
    """Return a model with the rough discrepancy beside what is known of its sensor's noise."""
    sensor = [noise for noise in spec.noise.split(" + ") if noise in SENSOR_NOISES]
    return replace(spec, noise=_beside("discrepancy", sensor))


def _tied(
    spec: ModelSpec, ties: Iterable[tuple[ModelSpec, Sequence[Explanation]]]
) -> Iterator[Explanation]:
    """Yield explanations that tied with one that was chosen, beside all later changes.

    ``ties`` are models that were chosen, and what tied with them. A model with the same stages
    predicts the same.
    """
    for chosen, others in ties:
        later = [stage for stage in spec.stages if stage not in chosen.stages]
        gone = {stage.name for stage in chosen.stages if stage not in spec.stages}
        for other in others:
            assert other.spec is not None
            tied = other.spec.without(
                *gone.intersection(other.spec.chain) - {other.spec.operator.name}
            )
            tied = replace(tied.with_stages(*later), hold=spec.hold, noise=spec.noise)
            if tied.chain != spec.chain:
                yield replace(other, spec=tied)


def _size(study: Study, cause: Explanation) -> tuple[bool, int]:
    """Return whether the model of a cause has the same stages, and how many free parameters."""
    assert cause.spec is not None
    other = study.with_model(cause.spec, cause.stated)
    return cause.spec.chain == study.spec.chain, other.posterior.prior.dimensions


def _relative_discrepancy(posterior: Posterior, point: MAPEstimate) -> float:
    """Return the sd of the discrepancy at a MAP estimate, in sds of the sensor; 0 without one."""
    theta = posterior.prior.theta(posterior.prior.constrain(point.mode[np.newaxis])[0])
    discrepancy, sensor = posterior.single_record.noise.marginal_sd(
        posterior.single_record.table.noise(theta)
    )
    return float(discrepancy[0] / sensor[0])
