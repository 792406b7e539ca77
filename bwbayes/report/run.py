"""Report of a run: the answer, its validation, and the details.

Failures come first. Without convergence the report contains no parameters or displacement.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from markupsafe import Markup

from bwbayes.inference.parameters import JointPrior
from bwbayes.prediction.bands import Bands
from bwbayes.report import tables
from bwbayes.report.calibration import outcome
from bwbayes.report.figures.pictures import Pictures, pictures as all_pictures
from bwbayes.report.figures.style import title
from bwbayes.report.report import (
    Banner,
    Block,
    Facts,
    Glossary,
    Report,
    Section,
    SideBySide,
    Text,
    remarks_banner,
    standing_banner,
)
from bwbayes.report.result import Result
from bwbayes.report.tables import priors_table
from bwbayes.report.words import circumstances, coverage_text, error_text, length_text, mark


def run_report(result: Result, numbers: Mapping[str, Any]) -> Report:
    """Return the report of a run.

    The report shows ``seed``, ``wall_s``, ``versions`` and ``data_sha256`` of its ``numbers`` if
    they exist, and without convergence ``go_on``, the command that resumes the run.
    """
    if result.validation and all(verdict.training for verdict in result.validation.values()):
        nothing = (
            "no readings are held out: the bands are validated on the training readings alone. "
            "Fix: leave a window out of train, and write it under [validation.held_out], as "
            "`bwbayes init` does"
        )
        result = replace(result, remarks=(nothing, *result.remarks))
    pictures, check = all_pictures(result), result.outcome.check
    if result.outcome.converged:
        note = (
            "The sensor band covers a new reading, the displacement band the actuator's "
            "displacement, 95 times in 100. The parameter band covers the model output only, not "
            "the actuator."
        )
        parameters: list[Block] = [tables.parameters_table(result), Text(note, note=True)]
        loop = [[pictures["loop"]]] if "loop" in pictures else []
        results: list[Block] = [*_results(result)] if result.standing.headline else []
        blocks = [*results, SideBySide([parameters, *loop]), *_evidence(result, pictures)]
    else:
        sampling: list[Block] = [tables.sampling_table(result), *pictures.values()]
        blocks = [Section("Sampling", sampling, folded=False)]
    accepted = ", ".join(
        f"{n} {n_accepted / tried:.0%}" for n, (tried, n_accepted) in result.moves.items()
    )
    cover = "no mixture" if check.pareto_k is None else f"Pareto k {check.pareto_k:.2f}"
    text = f"sampling: {check.steps} steps; acceptance: {accepted}; {cover}"
    moves = [Text(text, on="screen")]
    if result.outcome.converged and result.validation and not result.standing.headline:
        moves.append(Text(f"validation passed {drives_like(result.facts)}", on="screen"))
    shown = ("record", "fitted", "model", "noise")
    about = [f"{s}: {fact}" for s, fact in result.facts.items() if s.partition(" ")[0] in shown]
    held_out = [
        f"{bands.name} ({_span(bands)})" for bands in result.predictions if not bands.training
    ]
    about += [f"predicted: {', '.join(held_out)}"] * bool(held_out)
    return Report(
        title=result.name,
        about="; ".join(about),
        banners=[
            *_verdict_banners(result, numbers),
            *_calibration_banner(numbers),
            *remarks_banner(result.remarks),
        ],
        blocks=[*blocks, *moves, *_details(result, numbers, pictures)],
    )


def _verdict_banners(result: Result, numbers: Mapping[str, Any]) -> list[Banner]:
    """Return the banners with the outcome of the run, for the page and for the screen."""
    standing = result.standing
    if not result.outcome.converged:
        return [_not_converged(result, numbers)]
    if not standing.headline:
        headline = "Converged"
        if result.validation:
            is_held_out = any(not verdict.training for verdict in result.validation.values())
            data = "held-out data" if is_held_out else "the training data"
            headline += f"; validation passed on {data}, {drives_like(result.facts)}"
        return [Banner("good", headline, blocks=_results(result), on="page")]
    meaning = (
        "the readings do not tell whether the bands hold"
        if standing.passed is None
        else "the bands fail validation; the parameters may be biased too"
    )
    open_verdicts = [v for v in result.validation.values() if v.passed is standing.passed]
    explained = []
    for verdict in open_verdicts:
        why = Markup("{}.").format("; ".join(verdict.reasons))
        if verdict.cause is not None:
            cause = Markup("<br>Likely cause: {}.<br>Fix: {}.")
            why += cause.format(verdict.cause.text, verdict.cause.fix)
        explained.append((verdict.where, why))
    glossary = Glossary(explained, note=False)
    blocks: list[Block] = [Text(f"The chain converged, but {meaning}."), glossary]
    (on_screen,) = standing_banner(standing, on="screen")
    return [replace(on_screen, items=(), blocks=blocks, on="page"), on_screen]


def _calibration_banner(numbers: Mapping[str, Any]) -> list[Banner]:
    """Return a banner with the outcome of a calibration around the posterior, if there was one."""
    calibration = numbers.get("calibration")
    if not calibration:
        return []
    kind, headline = outcome(calibration["passed"], calibration["telling"])
    line = (
        f"{calibration['replicates']} records simulated with draws of this posterior and fitted "
        "together with its readings; calibration/calibration.html has the ranks"
    )
    return [Banner(kind, f"Calibration: {headline}", [line], calibration["failures"])]


def drives_like(facts: Mapping[str, str]) -> str:
    """Return the scope of a validation that passed: drives like those of training alone."""
    return f"for drives like the training record's ({facts['drive']})"


def _not_converged(result: Result, numbers: Mapping[str, Any]) -> Banner:
    resume = numbers.get("go_on") or "bwbayes resume FOLDER --steps N"
    return Banner(
        "bad",
        "NOT CONVERGED",
        blocks=[
            Text(f"Stopped: {result.outcome.stop_reason}. {_sampled(result)}"),
            Text(
                "The chain has not converged, so no parameter or displacement intervals are shown. "
                "Fix:"
            ),
        ],
        items=[
            Markup("Resume with more steps (no draws are lost): <code>{}</code>.").format(resume),
            Markup(
                'Look at <a href="#trace">trace</a> and <a href="#ranks">ranks</a> below: '
                "ensembles that stay apart sit in different modes, ensembles that drift need more "
                "steps."
            ),
            "Check the priors: a parameter that is not identifiable wanders as far as "
            "its prior lets it; narrow its prior or fix it.",
        ],
        on="page",
    )


def _sampled(result: Result) -> str:
    check = result.outcome.check
    return f"{check.steps} steps, {100 * check.acceptance:.0f}% of the moves accepted."


def _results(result: Result) -> list[Text]:
    """Return the bands' results on readings that were not fitted, or else on fitted ones."""
    texts = []
    scored = [bands for bands in result.predictions if bands.name in result.scores]
    for bands in [bands for bands in scored if not bands.training] or scored:
        scores, verdict = result.scores[bands.name], result.validation.get(bands.name)
        status = Markup("validation {}. ").format(mark(verdict.status)) if verdict else ""
        texts.append(
            Markup(
                "<b>{}</b>: {}Coverage of the 95% sensor band: <b>{}</b>. Mean width: <b>{}</b>. "
                "NRMSE: {}. Max error: {}."
            ).format(
                f"{title(bands)}, {_span(bands)}",
                status,
                coverage_text(scores, "sensor", 95),
                length_text(scores.width_um[95]),
                error_text(scores),
                length_text(scores.max_error_um),
            )
        )
    if not texts:
        texts.append(Markup("There are no readings to check the bands against."))
    sampling = Markup("Sampling: {}. {}").format(result.outcome.stop_reason, _sampled(result))
    if result.remarks:
        link = Markup(' <a href="#remarks">Remarks: {}</a>.')
        sampling += link.format(len(result.remarks))
    return [Text(text) for text in (*texts, sampling)]


def _evidence(result: Result, pictures: Pictures) -> list[Block]:
    ordered = sorted(result.predictions, key=lambda bands: bands.training)  # held out first
    shown = [pictures[f"bands_{bands.name}"] for bands in ordered]
    # "innovations_NAME" is the figure of one of several records.
    for kind in ("agreement", "coverage", "innovations", "spectrum"):
        shown += [p for name, p in pictures.items() if name.partition("_")[0] == kind]
    validation: list[Block] = []
    if result.scores:
        titles = {bands.name: title(bands) for bands in ordered if bands.name in result.scores}
        scores = {name: result.scores[name] for name in titles}
        records = tables.flat_records({name: result.validation_numbers[name] for name in titles})
        validation = [
            tables.scores_table(scores, result.validation, titles, records),
            *tables.rivals_table(ordered),
            *tables.correction_texts(ordered),
            Section(
                "Other scores",
                [
                    tables.other_scores_table(scores, titles, records),
                    Glossary([*SCORE_TERMS.items()]),
                ],
            ),
        ]
    blocks: list[Block] = [
        Section("Readings against the bands", [*shown[:1], *validation, *shown[1:]], folded=False)
    ]
    if result.loops is not None:
        measured = tables.loops_table(result.loops)
        rows = [row[0] for row in measured.rows]
        terms = [pair for pair in LOOP_TERMS.items() if any(r.startswith(pair[0]) for r in rows)]
        loops: list[Block] = [measured, pictures["loops"], Glossary(terms)]
        blocks.append(Section("Loops", loops, folded=False))
    if result.uncertainty_budgets:
        budget: list[Block] = [tables.budget_table(result.uncertainty_budgets)]
        blocks.append(Section("Uncertainty budget", budget, folded=False))
    if result.step_responses:
        steps: list[Block] = [tables.steps_table(result.step_responses), pictures["steps"]]
        blocks.append(Section("Step responses", steps, folded=False))
    return blocks


def _details(result: Result, numbers: Mapping[str, Any], pictures: Pictures) -> Iterator[Section]:
    priors = priors_table(JointPrior(result.parameters))
    yield Section("Priors and fixed values", [replace(priors, on="page")])
    if result.information_gain is not None:
        remarks = [Text(str(finding)) for finding in result.information_gain.findings]
        table = tables.learned_table(result, result.information_gain)
        yield Section("Information gained from the data", [table, *remarks])
    if result.posterior_checks:
        note = (
            "Each number of the fitted readings, among those of records that posterior draws make "
            "anew with their own noise; p: the part of these that is larger. Extreme: among "
            "the outermost 1%."
        )
        checks = tables.replicated_tables(result)
        yield Section("Posterior predictive checks", [*checks, Text(note, note=True)])
    if result.outcome.converged:
        yield Section("Posterior", [pictures["corner"]])
        chains = [pictures[name] for name in ("trace", "ranks")]
        yield Section("Sampling", [tables.sampling_table(result), *chains])
    yield Section("Moves", [tables.moves_table(result)])
    yield Section("Run details", [Facts([*result.facts.items(), *circumstances(numbers)])])


def _span(bands: Bands) -> str:
    windows = [bands.time[window] for window in bands.windows]
    return ", ".join(f"{time[0]:g} to {time[-1]:g}" for time in windows) + " s"


SCORE_TERMS = {
    "Sensor band": "Where a new sensor reading lies, sensor noise included; the only band that a "
    "measurement can check.",
    "Displacement band": "Where the actuator's displacement lies, model discrepancy included; it "
    "can be checked only where the displacement without noise is known.",
    "Parameter band": "Where the model's displacement lies because its parameters are uncertain; "
    "it makes no promise about the actuator or the sensor.",
    "CRPS and interval score": "They reward bands that are narrow and right; smaller is better.",
}

LOOP_TERMS = {
    "Opening at zero voltage": "Displacement with falling less that with rising voltage, at 0 V.",
    "Widest opening": "The largest such difference at any voltage, as a part of the range: what "
    "data sheets call hysteresis.",
    "Remanence": "Displacement left at 0 V after the highest voltage, against the middle between "
    "the loop's ends.",
    "Coercive voltage": "Half of the loop's width in voltage where the displacement passes that "
    "middle; in a loop that is symmetric about 0 V the voltage that takes the displacement "
    "back to it.",
    "Area": "−∮ x du over one cycle, positive where the displacement lags; times the actuator's "
    "force per volt (N/V) the energy lost in a cycle, in µJ.",
}
