"""Remarks on a run: on its record and priors, its sampling, and what the model may miss."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence

from bwbayes.app.fit.fitted import Run
from bwbayes.app.running import fingerprint
from bwbayes.diagnosis.conflict import conflicts
from bwbayes.diagnosis.consistency import disagreements
from bwbayes.diagnosis.explanations import TIED, likely_causes
from bwbayes.diagnosis.identifiability import undetermined
from bwbayes.diagnosis.innovations import departures
from bwbayes.diagnosis.residual_analysis import Explanation
from bwbayes.watching import Watch, counted, unwatched


def run_remarks(run: Run, watch: Watch = unwatched) -> list[str]:
    """Return what to know of a run's record, priors and fit, one line each.

    ``watch`` is called with the share that is done.
    """
    study, posterior = run.study, run.study.posterior
    now = fingerprint.versions(posterior.engine)
    looked_at = counted(3, watch)
    remarks = [
        *version_remarks(run.chain.attributes().get("versions"), now),
        *run.record_remarks,
        *run.outcome.remarks,
    ]
    looked_at(1)
    remarks += map(str, conflicts(posterior.prior, run.flat_draws, study.defaults))
    looked_at(1)
    remarks += map(str, undetermined(posterior, run.chain.point))
    looked_at(1)
    if not run.converged:
        return remarks
    remarks += map(str, disagreements(run.consistency))
    of = {name: f"{name}: " if len(study.records) > 1 else "" for name in study.records}
    for name, whitened in run.innovations.items():
        remarks += [f"{of[name]}{finding}" for finding in departures(whitened)]
    for name, lock in run.drive_locks.items():
        remarks += [f"{of[name]}{finding}" for finding in lock.findings]
    for name, explanations in run.explanations.items():
        remarks += [of[name] + line for line in lines(likely_causes(explanations))]
    for bands in run.predictions:
        remarks += [f"{bands.name}: {bands.model_error_note}"] * bool(bands.model_error_note)
    for name, verdict in run.validation.items():
        remarks += [f"{name}: {note}" for note in verdict.notes]
    return remarks


def lines(explanations: Sequence[Explanation]) -> Iterator[str]:
    """Write those of the best five explanations whose odds are above twenty to one, a line each.

    Explanations with which the model misses more are left out: their evidence is that of the
    discrepancy, which takes the error up.
    """
    for explanation in explanations[:5]:
        without, with_it = explanation.rmse
        worse = with_it > 1.1 * without or explanation.misleads
        if explanation.nats > TIED and not worse:
            text = f"{explanation.text} ({explanation.worth})"
            yield f"explained better by: {text}. Fix: {explanation.fix}."


def version_remarks(noted: object, now: Mapping[str, str]) -> tuple[str, ...]:
    """Say, in one remark, which packages have other versions than when the chain was begun."""
    before: dict[str, str] = json.loads(str(noted)) if noted else {}
    changed = [
        f"{name} {before[name]}, now {now[name]}"
        for name in now
        if before.get(name, now[name]) != now[name]
    ]
    return (f"the chain was begun with other versions: {'; '.join(changed)}",) if changed else ()
