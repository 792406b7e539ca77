"""Facts, findings and remarks on records and runs, for people, a line each."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from bwbayes.app.config.config import Config
from bwbayes.app.fit.fitted import Run
from bwbayes.app.running import fingerprint
from bwbayes.diagnosis.consistency import conflicts, disagreements
from bwbayes.diagnosis.defects import DEFECTS
from bwbayes.diagnosis.explanations import TIED, likely_causes
from bwbayes.diagnosis.extrapolation import Drive, beyond_training, unexcited_note
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.identifiability import undetermined_directions
from bwbayes.diagnosis.innovations import departures
from bwbayes.diagnosis.record_checks import UNTOLD, inspect
from bwbayes.diagnosis.residual_analysis import Explanation
from bwbayes.inference.study import Study
from bwbayes.record import Record
from bwbayes.watching import Watch, counted, unwatched


def facts_of(study: Study, config: Config) -> dict[str, str]:
    """Return the fitted model and records, for people: one line each, by subject."""
    facts = {}
    for name, record in study.records.items():
        which = "" if len(study.records) == 1 else f" {name}"
        low, high = record.range_voltage
        clock = f" every {record.interval:g} s" if record.quantities.has_clock else ""
        fact = (
            f"{record.origin}: {record.samples} samples{clock}, "
            f"{low:.4g} to {high:.4g} V ({record.voltage_is}), {record.readings} readings"
        )
        if gap := record.longest_gap:
            fact += f", none from {record.clock(gap[0])} to {record.clock(gap[1])} s"
        if missing := config.records[name].missing:
            fact += f" ({' and '.join(f'{value:g}' for value in missing)} um taken as missing)"
        facts[f"record{which}"] = fact
        facts[f"start{which}"] = _start(study, name)
        facts[f"fitted{which}"] = ", ".join(
            f"{record.time[w.start]:g} to {record.time[w.stop - 1]:g} s"
            for w in study.training[name]
        )
    facts |= study.record.instruments.facts
    drive, noise = str(Drive.of(study.posterior)), config.model.noise
    return facts | {"drive": drive, "model": str(study.spec), "noise": noise}


def _start(study: Study, name: str) -> str:
    """Say what is taken of a record's start, and what declaring it from rest would change."""
    record = study.records[name]
    if name in study.from_rest:
        return f"{record.beginning}, demagnetized and at rest, as from_rest declares"
    if study.spec.history == "demagnetized":
        return (
            f"{record.beginning}; the hysteresis was demagnetized before, as history declares; how "
            "the dynamics move then is estimated"
        )
    unknown = "; the hysteresis's state and how the dynamics move then are estimated"
    hint_from_rest = "; if it was demagnetized and nothing moved, from_rest = true makes them known"
    return f"{record.beginning}{unknown}{hint_from_rest * record.starts_at_zero}"


def extrapolations_of(study: Study) -> dict[str, list[Finding]]:
    """Return in what the drive of each validation leaves the training data, by its name."""
    beyond_by_name = {}
    for name, validation in study.validations.items():
        record, windows = validation.record or study.records[validation.of], validation.windows
        window = slice(windows[0].start, windows[-1].stop) if windows else slice(None)
        beyond = beyond_training(study.posterior, record.inputs, window)
        # A held-out part goes on with the loops of the rest, and its readings test them.
        is_window = validation.record is None
        beyond_by_name[name] = [
            finding for finding in beyond if not (is_window and finding.kind == "reversals")
        ]
    return beyond_by_name


def findings_of(study: Study) -> dict[str, tuple[Finding, ...]]:
    """Return issues of each fitted record that matter to the model, where a window looks at it.

    Several records make up for what one of them does not show, and a model without hysteresis
    needs no loops.
    """
    no_matter: tuple[str, ...] = ()
    if len(study.records) > 1:
        no_matter += UNTOLD
    if study.spec.operator.name == "linear":
        no_matter += tuple(kind for kind in UNTOLD if kind != "few readings")
    followed = _followed_kinds(study, fitted=True)
    findings = {}
    for name, record in study.records.items():
        # Borders that differ by less than half a sample are the same.
        times = [
            record.start + record.interval * np.array([w.start + 0.5, w.stop - 0.5])
            for w in chain(*study.windows(name).values())
        ]
        findings[name] = tuple(
            finding
            for finding in inspect(record)
            if finding.kind not in no_matter
            and not finding.kind.startswith(followed)
            and any(finding.start < stop and start < finding.stop for start, stop in times)
        )
    return findings


def record_remarks(
    config: Config,
    study: Study,
    extrapolations: Mapping[str, Sequence[Finding]],
) -> tuple[str, ...]:
    """Return notes on the records of a study, one line each."""
    sources = config.records
    remarks = [text for source in sources.values() for text in source.remarks or ()]
    measured = {**study.records, **study.others}
    remarks += [f"{n}: {r.path.remark}" for n, r in measured.items() if r.path.remark]
    remarks += [
        f"{name}: {finding}" for name, all_ in findings_of(study).items() for finding in all_
    ]
    remarks += [
        text for name, other in study.others.items() for text in _unlike(name, other, study)
    ]
    remarks += [
        (f"{name}: " if len(study.records) > 1 else "") + _set_aside(source.outliers, record)
        for (name, source), record in zip(sources.items(), study.records.values(), strict=True)
        if source.outliers is not None
    ]
    for name, beyond in extrapolations.items():
        notes = (unexcited_note(beyond), *(finding.note for finding in beyond))
        remarks += [f"{name}: {note}" for note in notes if note]
    return tuple(remarks)


def _followed_kinds(study: Study, *, fitted: bool) -> tuple[str, ...]:
    """Return how kinds of findings begin that a stage of the model takes into account.

    In a ``fitted`` record, or in another: what is foreign to the actuator is that of its record.
    """
    return tuple(
        defect.finding
        for defect in DEFECTS.values()
        if defect.finding and defect.stage in study.spec.chain and (fitted or not defect.foreign)
    )


def _unlike(name: str, record: Record, study: Study) -> Iterator[str]:
    """Yield what is wrong with a record that is predicted."""
    for finding in inspect(record):
        fix = finding.fix
        if finding.kind == "switch-on transient":  # nothing here is fitted
            fix = f"lead_in_start = {record.clock(finding.stop)} under [validation.{name}]"
        if not finding.kind.startswith((*UNTOLD, *_followed_kinds(study, fitted=False))):
            yield f"{name}: {replace(finding, fix=fix)}"


def _set_aside(times: Sequence[float], record: Record) -> str:
    """Say which readings were set aside as outliers, the first ten by their times."""
    if not times:
        return "no reading is an isolated outlier: none was set aside"
    listed = ", ".join(record.clock(time) for time in times[:10])
    more = f" and {len(times) - 10} more" if len(times) > 10 else ""
    plural = "s" if len(times) > 1 else ""
    return f"{len(times)} reading{plural} set aside as isolated outliers, at {listed} s{more}"


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
    remarks += map(str, undetermined_directions(posterior, run.chain.point))
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
        if bands.model_error_note:
            remarks.append(f"{bands.name}: {bands.model_error_note}")
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
