"""The tables of a run; the CSV of each holds what ``summary.json`` holds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from bwbayes.diagnosis.conflict import effective
from bwbayes.diagnosis.identifiability import Learned
from bwbayes.diagnosis.predictive_checks import STATISTICS
from bwbayes.diagnosis.validation import Verdict
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.prediction.bands import LEVELS
from bwbayes.prediction.loops import MEASURES, Estimate, Loops
from bwbayes.prediction.scores import Scores
from bwbayes.prediction.steps import STEP_MEASURES, StepResponse
from bwbayes.report.report import Table, TableColumn, Target
from bwbayes.report.result import Result
from bwbayes.report.words import (
    covered,
    digits,
    error_text,
    length_text,
    mark,
    symbol,
    unit_text,
)

Summary = Mapping[str, Any]

UNKNOWN = "–"


def parameters_table(result: Result, numbers: Summary) -> Table:
    """Return the estimate of each free parameter."""
    estimates = numbers["parameters"]
    truth_on: Target = "nowhere"
    if any("truth" in estimate for estimate in estimates.values()):
        truth_on = "page"

    def number(key: str) -> Callable[[Parameter], str]:
        """Return what writes a number as exactly as it is known."""
        return lambda p: digits(estimates[p.name][key], estimates[p.name]["sd"])

    def truth(parameter: Parameter) -> str:
        value = estimates[parameter.name].get("truth")
        return UNKNOWN if value is None else f"{value:.6g}"

    def ess(parameter: Parameter) -> str:
        estimate = estimates[parameter.name]
        return f"{min(estimate['ess_bulk'], estimate['ess_tail']):.0f}"

    mean, sd, lower, upper = map(number, ("mean", "sd", "lower_95", "upper_95"))
    columns = (
        *name_columns("Parameter"),
        TableColumn("Mean ± SD", on="page", text=lambda p: f"{mean(p)} ± {sd(p)}"),
        TableColumn("Mean", on="screen", text=mean),
        TableColumn("SD", on="screen", text=sd),
        TableColumn("95% interval", text=lambda p: f"{lower(p)} to {upper(p)}"),
        TableColumn("Unit", text=lambda p: unit_text(p.unit)),
        TableColumn("Truth", on=truth_on, text=truth),
        TableColumn("ESS", on="screen", text=ess),
        TableColumn("R-hat", on="screen", text=lambda p: f"{estimates[p.name]['rhat']:.3f}"),
    )
    records = [{"parameter": p.name, **estimates[p.name]} for p in result.free]
    return Table.of("parameters", "Parameters", result.free, columns, records=records, on="both")


def sampling_table(result: Result, numbers: Summary) -> Table:
    """Return how well each free parameter was sampled; without convergence that alone."""
    check, estimates = result.outcome.check, numbers["parameters"] or {}
    agreement = "R\N{COMBINING CIRCUMFLEX ACCENT}"
    note = (
        "ESS: effective number of draws, in the bulk and in the tails; "
        f"{agreement}: agreement of the ensembles, 1 when they agree"
    )
    columns = ["Parameter", "ESS bulk", "ESS tail", agreement]
    if estimates:
        columns += ["MCSE", "Median", "Unit"]
        note += "; MCSE: Monte Carlo standard error of the mean"
    rows = []
    for i, parameter in enumerate(result.free):
        sizes = f"{check.ess_bulk[i]:.0f}", f"{check.ess_tail[i]:.0f}"
        row = [parameter_words(parameter), *sizes, f"{check.rhat[i]:.4f}"]
        if estimates:
            estimate = estimates[parameter.name]
            median = digits(estimate["median"], estimate["sd"])
            row += [f"{estimate['mcse_mean']:.2g}", median, unit_text(parameter.unit)]
        rows.append(row)
    return Table("sampling", "Sampling of each parameter", columns, rows, note=f"{note}.")


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


def learned_table(result: Result, learned: Learned) -> Table:
    """Return how far the record narrowed each parameter, and what its posterior depends on."""
    rows = []
    for parameter in result.free:
        about = learned.parameters[parameter.name]
        shares = (f"{share:.2f}" for share in (about.contraction, about.prior, about.likelihood))
        decided = "the prior" if about.prior_decides else "the readings"
        rows.append((parameter_words(parameter), *shares, decided))
    return Table(
        "taught",
        "Information gained from the data",
        ("Parameter", "Contraction", "Prior sensitivity", "Likelihood sensitivity", "Dominated by"),
        rows,
        note="Contraction: 1 - (posterior SD / prior SD)², in the prior's normal scores; near 1 "
        "the data dominate, near 0 the prior. Sensitivity of the posterior to a small "
        "change in the weight of the prior, and of the readings; above 0.05 it is not small.",
    )


def replicated_tables(result: Result) -> list[Table]:
    """Return the numbers of each fitted record among those of replicated records."""
    columns = (
        TableColumn("Number", text=lambda item: STATISTICS[item[0]][0]),
        TableColumn("Observed", text=lambda item: f"{item[1].observed:.4g}"),
        TableColumn(
            "95 % of replicated", text=lambda item: f"{item[1].lower:.4g} to {item[1].upper:.4g}"
        ),
        TableColumn("Unit", text=lambda item: unit_text(STATISTICS[item[0]][1])),
        TableColumn("p", text=lambda item: f"{item[1].p:.3f}"),
        TableColumn("Extreme", text=lambda item: "extreme" if item[1].odd else ""),
    )
    return [
        Table.of(
            f"replicated-{name}",
            f"Posterior predictive checks{f' of {name}' if len(result.replicated) > 1 else ''}",
            checked.statistics.items(),
            columns,
        )
        for name, checked in result.replicated.items()
    ]


def scores_table(
    scores: Mapping[str, Scores],
    verdicts: Mapping[str, Verdict],
    titles: Mapping[str, str],
    records: Sequence[Mapping[str, object]] = (),
) -> Table:
    """Return how the bands turned out on readings: a row for each of the bands.

    Parameters
    ----------
    scores, verdicts, titles
        By the bands' names, in their order; the titles are for the page.
    records
        The rows of the CSV.
    """

    def coverage(name: str) -> str:
        texts = (covered(scores[name], "sensor", level).removesuffix(" %") for level in LEVELS)
        return f"{', '.join(texts)}%"

    def plain_coverage(name: str) -> str:
        shares = (scores[name].coverage["sensor"] or {}).values()
        return "/".join(f"{100 * share:.1f}" for share in shares)

    def status(name: str) -> str:
        return mark(verdicts[name].status) if name in verdicts else UNKNOWN

    levels = [str(level) for level in LEVELS]
    return Table.of(
        "validation",
        "Band validation",
        scores,
        (
            TableColumn("Record", on="page", text=titles.__getitem__),
            TableColumn("Record", on="screen"),
            TableColumn("Validation", text=status),
            TableColumn("NRMSE", on="page", text=lambda n: error_text(scores[n])),
            TableColumn("NRMSE", on="screen", text=lambda n: f"{100 * scores[n].nrmse:.2f}%"),
            TableColumn("Max error", text=lambda n: length_text(scores[n].max_error_um)),
            TableColumn("Width 95%", text=lambda n: length_text(scores[n].width_um[95])),
            TableColumn(
                f"Coverage of the {', '.join(levels)}% sensor bands", on="page", text=coverage
            ),
            TableColumn(f"Coverage {'/'.join(levels)}%", on="screen", text=plain_coverage),
        ),
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
    columns_of = [_other_scores(score) for score in scores.values()]
    rows = [
        [row[0][0], *(text or UNKNOWN for _, text in row)]
        for row in zip(*columns_of, strict=True)
        if any(text for _, text in row)
    ]
    columns = ["Quantity", *(titles[name] for name in scores)]
    return Table("scores", "Other scores", columns, rows, records=records)


def loops_table(loops: Loops, numbers: Summary) -> Table:
    """Return what was measured of the loops."""
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
    records = flat_records({name: numbers["loops"][name] for name in ("major", "minor")})
    return _measured("loops", "Measured loops", MEASURES, estimates, records, note)


def steps_table(steps: Mapping[str, StepResponse], numbers: Summary) -> Table:
    """Return what was measured of the steps."""
    estimates = {
        f"{name}: {response.step.height:.4g} V for {response.step.held:.4g} s": response.estimates
        for name, response in steps.items()
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
    """Return the columns of parameters' names: in words on a page, bare on a screen."""
    bare = TableColumn(title, on="screen", text=lambda parameter: parameter.name)
    return TableColumn(title, on="page", text=parameter_words), bare


def parameter_words(parameter: Parameter) -> Markup:
    """Return a parameter in words, with its symbol."""
    return Markup("{}, {}").format(parameter.description, symbol(parameter))


def _other_scores(scores: Scores) -> Iterator[tuple[str, str]]:
    """Yield titles and texts, the levels from the widest band."""
    yield "CRPS", length_text(scores.crps_um)
    for level in sorted(LEVELS, reverse=True):
        displacement = covered(scores, "displacement", level)
        yield f"{level} % displacement band covers displacement", displacement
        yield f"{level} % sensor band: worst second", f"{100 * scores.worst_second[level]:.1f} %"
        yield f"{level} % sensor band: mean width", length_text(scores.width_um[level])
        yield f"{level} % sensor band: interval score", length_text(scores.interval_score_um[level])


def priors_table(prior: JointPrior, point: Mapping[str, float] | None = None) -> Table:
    """Return each parameter's prior, stated and in effect, or its fixed value.

    The prior in effect is what the physical constraints leave of the stated one: median and 95 %
    interval under the joint prior. On the screen it stands below the stated one where it differs.
    ``point`` has the parameters of a point fit, if there is one.
    """
    quantiles = effective(prior, np.random.default_rng(0))
    in_effect = dict(zip(prior.free_names, quantiles.T, strict=True))

    def effect(parameter: Parameter) -> str:
        if parameter.prior is None:
            return ""
        low, median, high = in_effect[parameter.name]
        return f"{median:.3g} ({low:.2g} to {high:.2g})"

    def short(parameter: Parameter) -> str:
        if parameter.prior is None:
            return f"fixed at {parameter.fixed:g}"
        probabilities = parameter.prior.frozen.cdf(in_effect[parameter.name])
        # Constraints that move a quantile by less are not told from the draws' own error.
        is_cut = max(abs(probabilities - [0.025, 0.5, 0.975])) > 0.03
        return f"{parameter.prior}" + (f"\n  effective: {effect(parameter)}" if is_cut else "")

    def estimate(parameter: Parameter) -> str:
        return f"{point[parameter.name]:.5g}" if point and parameter.name in point else ""

    bounds = [
        parameter.declared.stated_bounds
        for parameter in prior.parameters
        if parameter.declared is not None and parameter.declared.stated_bounds
    ]
    cut = Markup("bounds of the parameters have cut it")
    if bounds:
        cut = Markup(
            'model\'s own constraints (<span id="constraints">{}</span>) have cut the joint prior'
        ).format("; ".join(bounds))
    return Table.of(
        "priors",
        "Priors and fixed values",
        prior.parameters,
        (
            *name_columns("Parameter"),
            TableColumn("Prior or value", on="page", text=_stated),
            TableColumn("Prior", on="screen", text=short),
            TableColumn("Effective", on="page", text=effect),
            TableColumn("MAP estimate", on="both" if point else "nowhere", text=estimate),
            TableColumn("Unit", text=lambda parameter: unit_text(parameter.unit)),
        ),
        note=Markup(
            "Effective: median, with the 2.5 % and 97.5 % quantiles, of each prior once the {}. "
            "The scales of default priors come from the training data's ranges of voltage and "
            "displacement and from the drive's times."
        ).format(cut),
        on="both",
    )


def _stated(parameter: Parameter) -> str:
    """Return a prior in words, with the bounds that cut it, or a fixed value."""
    if parameter.fixed is not None:
        return f"fixed at {parameter.fixed:.6g}"
    text = str(parameter.prior)
    if math.isfinite(parameter.lower):
        text += f", at least {parameter.lower:.6g}"
    if math.isfinite(parameter.upper):
        text += f", at most {parameter.upper:.6g}"
    return text
