"""Check of a record and its config before a run, on the screen and as a page with figures.

:func:`check` resolves the config, looks at the record, and finds the MAP estimate with the noise
that a run would take. It names the record's issues, each with the line of config that deals with
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

from markupsafe import Markup

from bwbayes.app.config.config import Config
from bwbayes.app.running.explaining import choose_model, explain_record
from bwbayes.app.study.about import findings_of, lines
from bwbayes.app.study.resolve import resolve_config
from bwbayes.diagnosis import consistency, identifiability
from bwbayes.record import Record
from bwbayes.report.report import Banner, Picture, Report, Section, Text, remarks_banner
from bwbayes.report.result import save
from bwbayes.report.run import priors_table
from bwbayes.watching import WatchSteps, unwatched


def check(
    config: Config,
    folder: Path,
    out: Path,
    watch: WatchSteps = unwatched,
    in_memory: Mapping[str, Record] | None = None,
) -> Report:
    """Check a config and its record, fit a point, write ``out/check.html``; return its report.

    The config's files are relative to `folder`, but for records in memory; an existing page is
    replaced. ``watch`` is called with the name of a step and the share of it that is done.

    Raises InputError: the config or its record cannot be used.
    """
    from bwbayes.report.figures.series import record_pictures  # noqa: PLC0415  # slow to load

    chosen = choose_model(resolve_config(config, folder, in_memory), watch)
    run, point, steps, explained = chosen.run, chosen.point, chosen.steps, chosen.explanations
    study, posterior = run.study, run.study.posterior
    free, _ = posterior.prior.constrain(point.mode[None])
    likely = consistency.around(posterior.prior, point, study.generator("around"))
    # The findings are remarks too, but here they come with what to do.
    findings = findings_of(study)
    shown = {f"{name}: {issue}" for name, issues in findings.items() for issue in issues}
    remarks = [remark for remark in run.record_remarks if remark not in shown]
    remarks += map(str, consistency.conflicts(posterior.prior, likely, study.defaults))
    remarks += map(str, identifiability.undetermined_directions(posterior, point))
    if explained is None:
        explaining = partial(watch, "explanations")
        explained = {n: explain_record(study, n, point.optima, explaining) for n in study.records}
    for explanations in explained.values():
        remarks += lines(explanations)
    item = Markup("<b>{}</b>: {}. Fix: <code>{}</code>")
    problems = [
        item.format(finding.kind, finding.text, finding.fix)
        for issues in findings.values()
        for finding in issues
    ]
    nothing = "the record by itself shows no transient, spike, jump, clipping, drift or the like"
    title = "No issues of the record" if remarks else "No issues found"
    several = len(study.records) > 1
    about = [fact for subject, fact in run.facts.items() if subject.startswith(("record", "start"))]
    about += steps
    pictures: list[Picture] = []
    for name, record in study.records.items():
        of, issues = name if several else "", findings[name]
        drawn = record_pictures(record, study.training[name], issues, of)
        pictures += drawn.values()
    name = config.name or study.record.origin
    priors = priors_table(posterior.prior, dict(zip(posterior.names, free[0], strict=True)))
    meaning = Markup(
        "The MAP estimate is the most probable set of parameters, without intervals; these take "
        "sampling: <code>bwbayes run</code>."
    )
    report = Report(
        title=f"{name}, check",
        quantities=study.quantities,
        heading=f"Check: {name}",
        about="; ".join(about),
        banners=[
            Banner("note", "Problems of the record", (), problems, (), "problem", name="findings")
            if problems
            else Banner("good", title, [nothing]),
            *remarks_banner(remarks),
        ],
        blocks=[
            Text("; ".join(about), on="screen"),
            *pictures,
            Section("Priors and MAP estimate", [priors, Text(meaning, note=True)], folded=False),
        ],
    )
    save(report, out, "check", pictures="figures", watch=partial(watch, "figures"))
    return report
