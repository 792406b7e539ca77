"""Report of a run: the answer, its validation, the details, and the tables of all these.

Failures come first. Without convergence the report contains no parameters or displacement. The CSV
of a table holds what ``summary.json`` holds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from markupsafe import Markup

from bwbayes.diagnosis.consistency import effective
from bwbayes.diagnosis.identifiability import InformationGain
from bwbayes.diagnosis.innovations import STATISTICS
from bwbayes.diagnosis.validation import BandValidation
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.prediction.bands import LEVELS, Bands, Scores
from bwbayes.prediction.budget import TYPES, Budget
from bwbayes.prediction.loops import MEASURES, STEP_MEASURES, Estimate, Loops, StepResponse
from bwbayes.report.calibration import outcome
from bwbayes.report.figures import Pictures, pictures as all_pictures
from bwbayes.report.report import (
    UNKNOWN,
    Banner,
    Block,
    Facts,
    Report,
    Section,
    SideBySide,
    Table,
    TableColumn,
    Target,
    Text,
    circumstances,
    coverage_text,
    digits,
    error_text,
    length_text,
    mark,
    remarks_banner,
    standing_banner,
    symbol,
    unit_text,
)
from bwbayes.report.result import Result


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
        parameters: list[Block] = [parameters_table(result), Text(note, note=True)]
        loop = [[pictures["loop"]]] if "loop" in pictures else []
        results: list[Block] = [*_results(result)] if result.standing.headline else []
        blocks = [*results, SideBySide([parameters, *loop]), *_evidence(result, pictures)]
    else:
        sampling: list[Block] = [sampling_table(result), *pictures.values()]
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
    if held_out:
        about.append(f"predicted: {', '.join(held_out)}")
    return Report(
        title=result.name,
        about="; ".join(about),
        banners=[
            *_validation_banners(result, numbers),
            *_calibration_banner(numbers),
            *remarks_banner(result.remarks),
        ],
        blocks=[*blocks, *moves, *_details(result, numbers, pictures)],
    )


def _validation_banners(result: Result, numbers: Mapping[str, Any]) -> list[Banner]:
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
    terms = Facts(explained, "terms")
    blocks: list[Block] = [Text(f"The chain converged, but {meaning}."), terms]
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
            Text(f"Stopped: {result.outcome.stop_reason}. {_chain_facts(result)}"),
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


def _chain_facts(result: Result) -> str:
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
                f"{bands.title}, {_span(bands)}",
                status,
                coverage_text(scores, "sensor", 95),
                length_text(scores.width_um[95]),
                error_text(scores),
                length_text(scores.max_error_um),
            )
        )
    if not texts:
        texts.append(Markup("There are no readings to check the bands against."))
    sampling = Markup("Sampling: {}. {}").format(result.outcome.stop_reason, _chain_facts(result))
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
        titles = {bands.name: bands.title for bands in ordered if bands.name in result.scores}
        scores = {name: result.scores[name] for name in titles}
        records = flat_records({name: result.validation_numbers[name] for name in titles})
        validation = [
            scores_table(scores, result.validation, titles, records),
            *rivals_table(ordered),
            *correction_texts(ordered),
            Section(
                "Other scores",
                [
                    other_scores_table(scores, titles, records),
                    Facts([*SCORE_TERMS.items()], "notes"),
                ],
            ),
        ]
    blocks: list[Block] = [
        Section("Readings against the bands", [*shown[:1], *validation, *shown[1:]], folded=False)
    ]
    if result.loops is not None:
        measured = loops_table(result.loops)
        rows = [row[0] for row in measured.rows]
        terms = [pair for pair in LOOP_TERMS.items() if any(r.startswith(pair[0]) for r in rows)]
        loops: list[Block] = [measured, pictures["loops"], Facts(terms, "notes")]
        blocks.append(Section("Loops", loops, folded=False))
    if result.uncertainty_budgets:
        budget: list[Block] = [budget_table(result.uncertainty_budgets)]
        blocks.append(Section("Uncertainty budget", budget, folded=False))
    if result.step_responses:
        steps: list[Block] = [steps_table(result.step_responses), pictures["steps"]]
        blocks.append(Section("Step responses", steps, folded=False))
    return blocks


def _details(result: Result, numbers: Mapping[str, Any], pictures: Pictures) -> Iterator[Section]:
    priors = priors_table(JointPrior(result.parameters))
    yield Section("Priors and fixed values", [replace(priors, on="page")])
    if result.information_gain is not None:
        remarks = [Text(str(finding)) for finding in result.information_gain.findings]
        table = learned_table(result, result.information_gain)
        yield Section("Information gained from the data", [table, *remarks])
    if result.posterior_checks:
        note = (
            "Each number of the fitted readings, among those of records that posterior draws make "
            "anew with their own noise; p: the part of these that is larger. Extreme: among "
            "the outermost 1%."
        )
        checks = replicated_tables(result)
        yield Section("Posterior predictive checks", [*checks, Text(note, note=True)])
    if result.outcome.converged:
        yield Section("Posterior", [pictures["corner"]])
        chains = [pictures[name] for name in ("trace", "ranks")]
        yield Section("Sampling", [sampling_table(result), *chains])
    yield Section("Moves", [moves_table(result)])
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
    "Loop width at zero voltage": "Displacement with falling minus that with rising voltage.",
    "Hysteresis (max loop width)": "The largest such difference at any voltage, as a part of the "
    "range, as in data sheets.",
    "Remanence": "Displacement left at 0 V after the highest voltage, against the middle between "
    "the loop's ends.",
    "Coercive voltage": "Half of the loop's width in voltage where the displacement passes that "
    "middle; in a loop that is symmetric about 0 V the voltage that takes the displacement "
    "back to it.",
    "Area": "−∮ x du over one cycle, positive where the displacement lags; times the actuator's "
    "force per volt (N/V) the energy lost in a cycle, in µJ.",
}


# A parameter in words, with its symbol; and the columns of names, without them on a screen.
WORDS = Markup("{words}")
NAME = (
    TableColumn("Parameter", on="page", text=WORDS),
    TableColumn("Parameter", on="screen", text="{name}"),
)


def parameters_table(result: Result) -> Table:
    """Return a table with the estimate of each free parameter."""
    estimates = result.estimates
    is_simulated = any("truth" in estimate for estimate in estimates.values())
    columns = (
        *NAME,
        TableColumn("Mean ± SD", on="page", text="{mean} ± {sd}"),
        TableColumn("Mean", on="screen", text="{mean}"),
        TableColumn("SD", on="screen", text="{sd}"),
        TableColumn("95% interval", text="{lower_95} to {upper_95}"),
        TableColumn("Unit", text="{unit}"),
        TableColumn("Truth", on="page" if is_simulated else "nowhere", text="{truth:.6g}"),
        TableColumn("ESS", on="screen", text="{ess:.0f}"),
        TableColumn("R-hat", on="screen", text="{rhat:.3f}"),
    )
    rows = []
    for parameter in result.free:
        row = parameter_row(parameter, estimates[parameter.name])
        rows.append(row | {"ess": min(row["ess_bulk"], row["ess_tail"])})
    records = [{"parameter": p.name, **estimates[p.name]} for p in result.free]
    return Table.of("parameters", "Parameters", rows, columns, records=records, on="both")


def sampling_table(result: Result) -> Table:
    """Return a table of each free parameter's diagnostics, and of its estimates if converged."""
    check = result.outcome.check
    estimates = result.estimates if result.outcome.converged else {}
    agreement = "R\N{COMBINING CIRCUMFLEX ACCENT}"
    note = (
        "ESS: effective number of draws, in the bulk and in the tails; "
        f"{agreement}: agreement of the ensembles, 1 when they agree"
    )
    columns = {"ESS bulk": "{ess_bulk:.0f}", "ESS tail": "{ess_tail:.0f}", agreement: "{rhat:.4f}"}
    if estimates:
        columns |= {"MCSE": "{mcse_mean:.2g}", "Median": "{median}", "Unit": "{unit}"}
        note += "; MCSE: Monte Carlo standard error of the mean"
    rows = []
    for i, parameter in enumerate(result.free):
        row = parameter_row(parameter, estimates.get(parameter.name, {}))
        sizes = {"ess_bulk": check.ess_bulk[i], "ess_tail": check.ess_tail[i]}
        rows.append(row | sizes | {"rhat": check.rhat[i]})
    columns = {"Parameter": WORDS, **columns}
    return Table.of("sampling", "Sampling of each parameter", rows, columns, note=f"{note}.")


def moves_table(result: Result) -> Table:
    """Return a table with the numbers of proposals and acceptances for each kind of move."""
    rows = [
        {"name": name, "proposed": proposed, "share": accepted / proposed}
        for name, (proposed, accepted) in result.moves.items()
    ]
    columns = {"Move": "{name}", "Proposed to a walker": "{proposed}", "Accepted": "{share:.1%}"}
    note = "No mixture proposed these draws, so there is no Pareto k."
    if (pareto_k := result.outcome.check.pareto_k) is not None:
        note = f"Pareto k of the mixture at the draws: {pareto_k:.2f}; below 0.7 it covers them."
    return Table.of("moves", "Moves", rows, columns, note=note)


def learned_table(result: Result, learned: InformationGain) -> Table:
    """Return a table of each parameter's contraction, and of the dependence on its prior."""
    rows = []
    for parameter in result.free:
        about = learned.parameters[parameter.name]
        decides = "the prior" if about.prior_decides else "the readings"
        rows.append(parameter_row(parameter, vars(about)) | {"decides": decides})
    return Table.of(
        "taught",
        "Information gained from the data",
        rows,
        {
            "Parameter": WORDS,
            "Contraction": "{contraction:.2f}",
            "Prior sensitivity": "{prior:.2f}",
            "Likelihood sensitivity": "{likelihood:.2f}",
            "Dominated by": "{decides}",
        },
        note="Contraction: 1 - (posterior SD / prior SD)², in the prior's normal scores; near 1 "
        "the data dominate, near 0 the prior. Sensitivity of the posterior to a small "
        "change in the weight of the prior, and of the readings; above 0.05 it is not small.",
    )


def replicated_tables(result: Result) -> list[Table]:
    """Return a table for each fitted record, with its statistics among those of replicated ones."""
    columns = {
        "Number": "{words}",
        "Observed": "{observed:.4g}",
        "95% of replicated": "{lower:.4g} to {upper:.4g}",
        "Unit": "{unit}",
        "p": "{p:.3f}",
        "Extreme": "{extreme}",
    }
    tables = []
    for name, checked in result.posterior_checks.items():
        rows = []
        for kind, statistic in checked.statistics.items():
            words, unit = STATISTICS[kind]
            row = {"words": words, "unit": unit_text(unit), **vars(statistic)}
            rows.append(row | {"extreme": "extreme" if statistic.extreme else ""})
        of = f" of {name}" if len(result.posterior_checks) > 1 else ""
        caption = f"Posterior predictive checks{of}"
        tables.append(Table.of(f"replicated-{name}", caption, rows, columns))
    return tables


def scores_table(
    scores: Mapping[str, Scores],
    validation: Mapping[str, BandValidation],
    titles: Mapping[str, str],
    records: Sequence[Mapping[str, object]] = (),
) -> Table:
    """Return a table of the bands' scores on readings: a row for each of the bands.

    Scores, validation and titles are by the bands' names, in their order; the titles are for the
    page. ``records`` are the rows of the CSV.
    """
    rows = []
    for name, judged in scores.items():
        covers = [coverage_text(judged, "sensor", level).removesuffix("%") for level in LEVELS]
        shares = (judged.coverage["sensor"] or {}).values()
        row = {
            "title": titles[name],
            "name": name,
            "status": mark(validation[name].status) if name in validation else UNKNOWN,
            "nrmse": judged.nrmse,
            "error": error_text(judged),
            "largest": length_text(judged.max_error_um),
            "width": length_text(judged.width_um[95]),
            "covers": ", ".join(covers),
            "shares": "/".join(f"{100 * share:.1f}" for share in shares),
        }
        rows.append(row)
    levels = [str(level) for level in LEVELS]
    bands = f"Coverage of the {', '.join(levels)}% sensor bands"
    columns = (
        TableColumn("Record", on="page", text="{title}"),
        TableColumn("Record", on="screen", text="{name}"),
        TableColumn("Validation", text=Markup("{status}")),
        TableColumn("NRMSE", on="page", text="{error}"),
        TableColumn("NRMSE", on="screen", text="{nrmse:.2%}"),
        TableColumn("Max error", text="{largest}"),
        TableColumn("Width 95%", text="{width}"),
        TableColumn(bands, on="page", text="{covers}%"),
        TableColumn(f"Coverage {'/'.join(levels)}%", on="screen", text="{shares}"),
    )
    note = (
        "NRMSE: root mean square of measured minus mean, over the range of the measured "
        "displacement. ±: one standard error from a block bootstrap, because neighboring samples "
        "err together."
    )
    return Table.of(
        "validation", "Band validation", rows, columns, records=records, note=note, on="both"
    )


def rivals_table(predictions: Iterable[Bands]) -> list[Table]:
    """Return a table of the bands that rivals widen, with and without them, if there are any."""
    rows = []
    for bands in predictions:
        if not bands.model_error_sd:
            continue
        both, shares = (bands, bands.without_rivals), ["–", "–"]
        if (scored := bands.scored(bands.measured)).any():
            assert bands.measured is not None
            inside = [each.covers("sensor", 95, bands.measured)[scored] for each in both]
            shares = [f"{np.mean(covered):.1%}" for covered in inside]
        wide, narrow = both[0].width(), both[1].width()
        widths = [length_text(wide), length_text(narrow), f"{wide / narrow:.2g}"]
        rows.append((bands.name, *widths, *shares))
    columns = ("Record", "Width 95%", "Without rivals", "Times", "Coverage", "Without rivals")
    note = (
        "These drives are unlike the training record's: there the sensor band has in it how much "
        "other models of the training record differ."
    )
    if not rows:
        return []
    return [Table("rivals", "Bands with and without rivals", columns, rows, note=note, on="both")]


def correction_texts(predictions: Iterable[Bands]) -> list[Text]:
    """Return a line for each of the bands that failed: the width it needs, if that is known."""
    corrected = [(bands.name, bands.correction) for bands in predictions]
    return [Text(f"{name}: {c}", on="both") for name, c in corrected if c is not None]


def other_scores_table(
    scores: Mapping[str, Scores], titles: Mapping[str, str], records: Sequence[Mapping[str, object]]
) -> Table:
    """Return a table of the other scores: a column for each of the bands, rows of known scores."""
    judged = scores.values()
    rows = [["CRPS", *(length_text(score.crps_um) for score in judged)]]
    for level in sorted(LEVELS, reverse=True):
        covers = [coverage_text(score, "displacement", level) for score in judged]
        if any(covers):
            title = f"{level}% displacement band covers displacement"
            rows.append([title, *(text or UNKNOWN for text in covers)])
        sensor = f"{level}% sensor band:"
        rows += [
            [f"{sensor} worst second", *(f"{100 * s.worst_second[level]:.1f}%" for s in judged)],
            [f"{sensor} mean width", *(length_text(s.width_um[level]) for s in judged)],
            [
                f"{sensor} interval score",
                *(length_text(s.interval_score_um[level]) for s in judged),
            ],
        ]
    columns = ["Quantity", *(titles[name] for name in scores)]
    return Table("scores", "Other scores", columns, rows, records=records)


def budget_table(budgets: Sequence[Budget], on: Target = "page", *, totals: bool = True) -> Table:
    """Return a table of the sources' shares in the variance of some quantities, by columns.

    Rows of ``totals``, mean, uncertainty and interval, stand below.
    """
    rows = [
        [
            source,
            kind,
            *(f"{100 * b.shares[source]:.1f}%" if source in b.shares else "0" for b in budgets),
        ]
        for source, kind in TYPES.items()
        if any(source in budget.shares for budget in budgets)
    ]
    if totals:
        for words, value in (("Mean", "mean"), ("Standard uncertainty", "sd")):
            values = [f"{digits(getattr(b, value), b.sd)} {unit_text(b.unit)}" for b in budgets]
            rows.append([words, "", *values])
        intervals = [f"{digits(b.lower, b.sd)} to {digits(b.upper, b.sd)}" for b in budgets]
        rows.append(["95% interval", "", *intervals])
    records = [
        {"quantity": b.name, "source": s, "share": v} for b in budgets for s, v in b.shares.items()
    ]
    note = (
        "Shares of the variance, which add up. A: from the readings; B: from what else is known. "
        "Voltages are as the monitor reads them, a displacement is beyond the sensor's zero."
    )
    columns = ["Source", "Type", *(budget.name for budget in budgets)]
    return Table("budget", "Uncertainty budget", columns, rows, records=records, note=note, on=on)


def loops_table(loops: Loops) -> Table:
    """Return a table of the measures of the loops."""
    estimates = {
        f"{name} loop, {loop.voltage[0]:.4g} to {loop.voltage[-1]:.4g} V": loop.estimates
        for name, loop in (("Major", loops.major), ("Minor", loops.minor))
    }
    note = (
        "Of the model driven slowly from turn to turn until the loop closes, without dynamics, "
        "creep and offset; from the posterior of the parameters alone, without the model's "
        "discrepancy."
    )
    if not (loops.major.closed and loops.minor.closed):
        note += (
            " Some of the models' loops had not closed after a thousand cycles and are taken as "
            "they were."
        )
    records = flat_records({"major": loops.major.numbers, "minor": loops.minor.numbers})
    return _table_of("loops", "Measured loops", MEASURES, estimates, records, note)


def steps_table(steps: Mapping[str, StepResponse]) -> Table:
    """Return a table of the measures of the steps."""
    estimates = {
        f"{name}: {response.height:.4g} V for {response.held:.4g} s": response.estimates
        for name, response in steps.items()
    }
    note = (
        "To an ideal step from zero, demagnetized and at rest, from the posterior of the "
        "parameters alone. The rise goes from 10 to 90% of where the displacement settles without "
        "creep; overshoot is what goes beyond that. Creep is the growth from 0.1 s to the end of "
        "the step, of the displacement at 0.1 s, a decade of time."
    )
    records = flat_records({name: response.numbers for name, response in steps.items()})
    return _table_of("steps", "Measured step responses", STEP_MEASURES, estimates, records, note)


def _table_of(
    name: str,
    caption: str,
    measures: Mapping[str, tuple[str, str]],
    estimates: Mapping[str, Mapping[str, Estimate | None]],
    records: Sequence[Mapping[str, object]],
    note: str,
) -> Table:
    """Return a table with mean ± SD and interval of each measure that any loop or step has."""
    columns: list[str | TableColumn] = ["Quantity"]
    for group in estimates:
        columns += [TableColumn("Mean ± SD", group, on="page"), TableColumn("95% interval", group)]
    rows = []
    for measure, (words, unit) in measures.items():
        if all(estimated[measure] is None for estimated in estimates.values()):
            continue
        row = [words]
        for estimated in estimates.values():
            if (estimate := estimated[measure]) is None:
                row += [UNKNOWN, UNKNOWN]
                continue
            values = estimate.mean, estimate.sd, estimate.lower, estimate.upper
            mean, sd, lower, upper = (digits(value, estimate.sd) for value in values)
            row += [f"{mean} ± {sd}", f"{lower} to {upper}"]
        rows.append([*row, unit_text(unit)])
    return Table(name, caption, [*columns, "Unit"], rows, records=records, note=note, on="both")


def flat_records(numbers: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return nested numbers as rows, a column for each key of ``numbers``."""
    import pandas as pd  # noqa: PLC0415  # slow to load

    columns = {
        name: pd.json_normalize(dict(nested), sep=" ").iloc[0] for name, nested in numbers.items()
    }
    frame = pd.DataFrame(columns).rename_axis("quantity").reset_index()
    return [{str(key): value for key, value in row.items()} for row in frame.to_dict("records")]


def parameter_row(parameter: Parameter, numbers: Mapping[str, Any]) -> dict[str, Any]:
    """Return a parameter's entries for tables: its names, its unit, and the known estimates."""
    row = dict(numbers)
    for key in {"mean", "sd", "median", "lower_95", "upper_95"} & numbers.keys():
        row[key] = digits(numbers[key], numbers["sd"])
    words = Markup("{}, {}").format(parameter.description, symbol(parameter))
    return row | {"name": parameter.name, "words": words, "unit": unit_text(parameter.unit)}


def priors_table(prior: JointPrior, point: Mapping[str, float] | None = None) -> Table:
    """Return a table of each parameter's stated and effective prior, or its fixed value.

    The effective prior is the stated one after the physical constraints: median and 95% interval
    under the joint prior. On the screen it stands below the stated one if it differs. ``point`` has
    the parameters of a point fit, if there is one.
    """
    in_effect = dict(
        zip(prior.free_names, effective(prior, np.random.default_rng(0)).T, strict=True)
    )
    rows = []
    for parameter in prior.parameters:
        row = parameter_row(parameter, {}) | {"effect": "", "point": ""}
        if parameter.prior is None:
            row["stated"] = row["short"] = f"fixed at {parameter.fixed:.6g}"
        else:
            low, median, high = at = in_effect[parameter.name]
            row["effect"] = f"{median:.3g} ({low:.2g} to {high:.2g})"
            edges = {"at least": parameter.lower, "at most": parameter.upper}
            cuts = (f", {words} {x:.6g}" for words, x in edges.items() if math.isfinite(x))
            row["stated"] = "".join([str(parameter.prior), *cuts])
            # A smaller move of a quantile cannot be distinguished from the draws' own error.
            moved = np.abs(parameter.prior.frozen.cdf(at) - [0.025, 0.5, 0.975]).max()
            effect = f"\n  effective: {row['effect']}" if moved > 0.03 else ""
            row["short"] = f"{parameter.prior}{effect}"
        if point and parameter.name in point:
            row["point"] = f"{point[parameter.name]:.5g}"
        rows.append(row)
    bounds = [
        parameter.declared.stated_bounds
        for parameter in prior.parameters
        if parameter.declared.stated_bounds
    ]
    cut = Markup("bounds of the parameters have cut it")
    if bounds:
        cut = Markup(
            'model\'s own constraints (<span id="constraints">{}</span>) have cut the joint prior'
        ).format("; ".join(bounds))
    columns = (
        *NAME,
        TableColumn("Prior or value", on="page", text="{stated}"),
        TableColumn("Prior", on="screen", text="{short}"),
        TableColumn("Effective", on="page", text="{effect}"),
        TableColumn("MAP estimate", on="both" if point else "nowhere", text="{point}"),
        TableColumn("Unit", text="{unit}"),
    )
    note = Markup(
        "Effective: median, with the 2.5% and 97.5% quantiles, of each prior once the {}. The "
        "scales of default priors come from the training data's ranges of voltage and displacement "
        "and from the drive's times."
    ).format(cut)
    return Table.of("priors", "Priors and fixed values", rows, columns, note=note, on="both")
