"""The tables of a run; the CSV of each holds what ``summary.json`` holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from bwbayes.diagnosis.predictive_checks import STATISTICS
from bwbayes.diagnosis.validation import Verdict
from bwbayes.inference.parameters import Parameter
from bwbayes.prediction.bands import LEVELS
from bwbayes.prediction.loops import MEASURES, Estimate
from bwbayes.prediction.scores import Scores
from bwbayes.prediction.steps import STEP_MEASURES
from bwbayes.report.report import Table, TableColumn
from bwbayes.report.result import Result
from bwbayes.report.words import covered, digits, error_text, mark, symbol, unit_text

__all__ = [
    "flat_records",
    "learned_table",
    "loops_table",
    "moves_table",
    "name_columns",
    "other_scores_table",
    "parameter_words",
    "parameters_table",
    "replicated_tables",
    "sampling_table",
    "scores_table",
    "steps_table",
]

Summary = Mapping[str, Any]

UNKNOWN = "–"


def parameters_table(result: Result, numbers: Summary) -> Table:
    """Return the estimate of each free parameter."""
    estimates = numbers["parameters"]
    rows = []
    for parameter in result.free:
        estimate = estimates[parameter.name]
        mean, sd, lower, upper = (
            digits(estimate[key], estimate["sd"]) for key in ("mean", "sd", "lower_95", "upper_95")
        )
        rows.append(
            (
                parameter_words(parameter),
                parameter.name,
                f"{mean} ± {sd}",
                mean,
                sd,
                f"{lower} to {upper}",
                unit_text(parameter.unit),
                f"{estimate['truth']:.6g}" if "truth" in estimate else UNKNOWN,
                f"{min(estimate['ess_bulk'], estimate['ess_tail']):.0f}",
                f"{estimate['rhat']:.3f}",
            )
        )
    has_truth = any("truth" in estimates[parameter.name] for parameter in result.free)
    columns = (
        *name_columns("Parameter"),
        TableColumn("Mean ± SD", on="page"),
        TableColumn("Mean", on="screen"),
        TableColumn("SD", on="screen"),
        "95% interval",
        "Unit",
        TableColumn("Truth", on="page" if has_truth else "nowhere"),
        TableColumn("ESS", on="screen"),
        TableColumn("R-hat", on="screen"),
    )
    records = [{"parameter": p.name, **estimates[p.name]} for p in result.free]
    return Table("parameters", "Parameters", columns, rows, records=records, on="both")


def sampling_table(result: Result, numbers: Summary) -> Table:
    """Return how well each free parameter was sampled; without convergence that alone."""
    check, estimates = result.outcome.check, numbers["parameters"]
    rows = []
    for i, parameter in enumerate(result.free):
        row = [
            parameter_words(parameter),
            f"{check.ess_bulk[i]:.0f}",
            f"{check.ess_tail[i]:.0f}",
            f"{check.rhat[i]:.4f}",
        ]
        if estimates:
            estimate = estimates[parameter.name]
            row += [f"{estimate['mcse_mean']:.2g}", digits(estimate["median"], estimate["sd"])]
            row.append(unit_text(parameter.unit))
        rows.append(row)
    columns = ["Parameter", "ESS bulk", "ESS tail", "R\N{COMBINING CIRCUMFLEX ACCENT}"]
    note = (
        "ESS: effective number of draws, in the bulk and in the tails; "
        "R\N{COMBINING CIRCUMFLEX ACCENT}: agreement of the ensembles, 1 when they agree"
    )
    return Table(
        "sampling",
        "Sampling of each parameter",
        [*columns, "MCSE", "Median", "Unit"] if estimates else columns,
        rows,
        note=f"{note}; MCSE: Monte Carlo standard error of the mean." if estimates else f"{note}.",
    )


def moves_table(result: Result) -> Table:
    """Return how often each kind of move was proposed, and accepted."""
    rows = [
        (name, str(proposed), f"{100 * accepted / proposed:.1f} %")
        for name, (proposed, accepted) in result.moves.items()
    ]
    pareto_k = result.outcome.check.pareto_k
    note = "No mixture proposed these draws, so there is no Pareto k."
    if pareto_k is not None:
        note = (
            f"Pareto k of the mixture at the draws: {pareto_k:.2f}; below 0.7 the mixture covers "
            "them."
        )
    return Table("moves", "Moves", ("Move", "Proposed to a walker", "Accepted"), rows, note=note)


def learned_table(result: Result) -> Table | None:
    """Return how far the record narrowed each parameter, and what its posterior depends on."""
    if result.learned is None:
        return None
    rows = []
    for parameter in result.free:
        learned = result.learned.parameters[parameter.name]
        rows.append(
            (
                parameter_words(parameter),
                f"{learned.contraction:.2f}",
                f"{learned.prior:.2f}",
                f"{learned.likelihood:.2f}",
                "the prior" if learned.prior_decides else "the readings",
            )
        )
    columns = ("Parameter", "Contraction", "To the prior", "To the readings", "Decided by")
    return Table(
        "taught",
        "What the record taught",
        columns,
        rows,
        note="Contraction: 1 - (posterior SD / prior SD)², in the prior's normal scores; near 1 "
        "the record decided, near 0 it told nothing. Sensitivity of the posterior to a small "
        "change in the weight of the prior, and of the readings; above 0.05 it is not small.",
    )


def replicated_tables(result: Result) -> list[Table]:
    """Return the numbers of each fitted record among those of replicated records."""
    columns = ("Number", "Observed", "95 % of replicated", "Unit", "p", "Odd")
    tables = []
    for name, checked in result.replicated.items():
        rows = []
        for key, statistic in checked.statistics.items():
            words, unit = STATISTICS[key]
            rows.append(
                (
                    words,
                    f"{statistic.observed:.4g}",
                    f"{statistic.lower:.4g} to {statistic.upper:.4g}",
                    unit_text(unit),
                    f"{statistic.p:.3f}",
                    "odd" if statistic.odd else "",
                )
            )
        record = f" of {name}" if len(result.replicated) > 1 else ""
        caption = f"Posterior predictive checks{record}"
        tables.append(Table(f"replicated-{name}", caption, columns, rows))
    return tables


def scores_table(
    scores: Mapping[str, Scores],
    verdicts: Mapping[str, Verdict],
    titles: Mapping[str, str],
    records: Sequence[Mapping[str, object]] = (),
) -> Table:
    """Return how the bands turned out on readings: a row for each of the bands.

    Parameters
    ----------
    scores, verdicts
        By the bands' names, in their order.
    titles
        The bands' titles on the page.
    records
        The rows of the CSV.
    """
    rows = []
    for name, score in scores.items():
        coverage = [covered(score, "sensor", level).removesuffix(" %") for level in LEVELS]
        plain = (score.coverage["sensor"] or {}).values()
        rows.append(
            (
                titles[name],
                name,
                mark(verdicts[name].status) if name in verdicts else UNKNOWN,
                error_text(score),
                f"{100 * score.nrmse:.2f}%",
                f"{score.max_error_um:.2f} µm",
                f"{score.width_um[95]:.2f} µm",
                f"{', '.join(coverage)}%",
                "/".join(f"{100 * share:.1f}" for share in plain),
            )
        )
    levels = ", ".join(map(str, LEVELS))
    return Table(
        "validation",
        "Band validation",
        (
            *name_columns("Record"),
            "Validation",
            TableColumn("NRMSE", on="page"),
            TableColumn("NRMSE", on="screen"),
            "Max error",
            "Width 95%",
            TableColumn(f"Coverage of the {levels}% sensor bands", on="page"),
            TableColumn(f"Coverage {'/'.join(map(str, LEVELS))}%", on="screen"),
        ),
        rows,
        records=records,
        note="NRMSE: root mean square of measured minus mean, over the range of the measured "
        "displacement. ±: one standard error from a block bootstrap, because neighboring samples "
        "err together.",
        on="both",
    )


def other_scores_table(
    scores: Mapping[str, Scores], titles: Mapping[str, str], records: Sequence[Mapping[str, object]]
) -> Table:
    """Return the other scores: a column for each of the bands, rows where anything is known."""
    columns = [_other_scores(score) for score in scores.values()]
    rows = [
        [row[0][0], *(text or UNKNOWN for _, text in row)]
        for row in zip(*columns, strict=True)
        if any(text for _, text in row)
    ]
    titled = ["Quantity", *(titles[name] for name in scores)]
    return Table("scores", "Other scores", titled, rows, records=records)


def loops_table(result: Result, numbers: Summary) -> Table | None:
    """Return what was measured of the loops, if anything."""
    if not result.outcome.converged or result.loops is None:
        return None
    loops = {"Major": result.loops.major, "Minor": result.loops.minor}
    estimates = {
        f"{name} loop, {loop.voltage[0]:.4g} to {loop.voltage[-1]:.4g} V": loop.estimates
        for name, loop in loops.items()
    }
    note = (
        "Of the model driven slowly from turn to turn until the loop closes, without dynamics, "
        "creep and offset; from the posterior of the parameters alone, without the model's "
        "discrepancy."
    )
    if not all(loop.closed for loop in loops.values()):
        note += (
            " Some of the models' loops had not closed after a thousand cycles and are taken as "
            "they were."
        )
    records = flat_records({name: numbers["loops"][name] for name in ("major", "minor")})
    return _measured("loops", "Measured loops", MEASURES, estimates, records, note)


def steps_table(result: Result, numbers: Summary) -> Table | None:
    """Return what was measured of the steps, if anything."""
    if not result.outcome.converged or not result.steps:
        return None
    estimates = {
        f"{name}: {response.step.height:.4g} V for {response.step.held:.4g} s": response.estimates
        for name, response in result.steps.items()
    }
    note = (
        "To an ideal step from zero, demagnetized and at rest, from the posterior of the "
        "parameters alone. The rise goes from 10 to 90 % of where the displacement settles without "
        "creep; overshoot is what goes beyond that. Creep is the growth from 0.1 s to the end of "
        "the step, of the displacement at 0.1 s, a decade of time."
    )
    records = flat_records(numbers["step_responses"])
    return _measured("steps", "Measured step responses", STEP_MEASURES, estimates, records, note)


def _measured(
    name: str,
    caption: str,
    measures: Mapping[str, tuple[str, str]],
    estimates: Mapping[str, Mapping[str, Estimate | None]],
    records: Sequence[Mapping[str, object]],
    note: str,
) -> Table:
    """Return mean ± SD and interval of each measure of every loop or step."""
    columns: list[str | TableColumn] = ["Quantity"]
    for title in estimates:
        columns += [TableColumn("Mean ± SD", title, on="page"), TableColumn("95% interval", title)]
    rows = []
    for measure, (words, unit) in measures.items():
        row = [words]
        for estimated in estimates.values():
            row += _estimate_texts(estimated[measure])
        rows.append([*row, unit_text(unit)])
    return Table(name, caption, [*columns, "Unit"], rows, records=records, note=note, on="both")


def _estimate_texts(estimate: Estimate | None) -> tuple[str, str]:
    if estimate is None:
        return UNKNOWN, UNKNOWN
    numbers = estimate.mean, estimate.sd, estimate.lower, estimate.upper
    mean, sd, lower, upper = (digits(number, estimate.sd) for number in numbers)
    return f"{mean} ± {sd}", f"{lower} to {upper}"


def flat_records(numbers: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return nested numbers as rows, a column for each key of ``numbers``."""
    import pandas as pd  # noqa: PLC0415  # slow to load

    columns = {
        name: pd.json_normalize(dict(nested), sep=" ").iloc[0] for name, nested in numbers.items()
    }
    frame = pd.DataFrame(columns).rename_axis("quantity").reset_index()
    return [{str(key): value for key, value in row.items()} for row in frame.to_dict("records")]


def name_columns(title: str) -> tuple[TableColumn, TableColumn]:
    """Return the column of the row headers: in words on a page, a bare name on a screen."""
    return TableColumn(title, on="page"), TableColumn(title, on="screen")


def parameter_words(parameter: Parameter) -> Markup:
    """Return a parameter in words, with its symbol."""
    return Markup("{}, {}").format(parameter.description, symbol(parameter).html)


def _other_scores(scores: Scores) -> Iterator[tuple[str, str]]:
    """Yield titles and texts, the levels from the widest band."""
    yield "CRPS", f"{scores.crps_um:.3f} µm"
    for level in sorted(LEVELS, reverse=True):
        displacement = covered(scores, "displacement", level)
        yield f"{level} % displacement band covers displacement", displacement
        yield f"{level} % sensor band: worst second", f"{100 * scores.worst_second[level]:.1f} %"
        yield f"{level} % sensor band: mean width", f"{scores.width_um[level]:.2f} µm"
        yield f"{level} % sensor band: interval score", f"{scores.interval_score_um[level]:.2f} µm"
