"""Tables on the screen: parameters, priors, scores, and what to know about a run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import product
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bwbayes.app.problem.problem import generator
from bwbayes.app.report.words import digits
from bwbayes.app.running.campaign_folder import CampaignFolder
from bwbayes.app.running.campaign_result import CampaignResult
from bwbayes.app.running.folder import CalibrationFolder, RunFolder
from bwbayes.comparison.choice import Comparison
from bwbayes.comparison.table import COLUMNS as COMPARED
from bwbayes.comparison.table import DIFFERENCE_COLUMNS, differences
from bwbayes.comparison.table import rows as compared
from bwbayes.inference import conflict
from bwbayes.inference.parameters import JointPrior
from bwbayes.results.bands import KINDS, LEVELS
from bwbayes.results.calibration import Calibration
from bwbayes.results.loops import MEASURES, Loops
from bwbayes.results.result import Result, summary
from bwbayes.results.scores import Scores
from bwbayes.results.standing import Standing
from bwbayes.results.verdict import Verdict

__all__ = [
    "PARAMETER_COLUMNS",
    "SCORE_COLUMNS",
    "parameter_rows",
    "score_texts",
    "show_calibration",
    "show_campaign",
    "show_comparison",
    "show_loops",
    "show_priors",
    "show_remarks",
    "show_result",
    "show_scores",
    "show_standing",
]


# Probability by which constraints must move a quantile to be shown: more than draws do.
CHANGED = 0.03

# Columns of a comparison that a terminal has room for: the page has all.
ON_SCREEN = (0, 1, 2, 4, 5, 6, 8)

PARAMETER_COLUMNS = ("Parameter", "Mean", "SD", "95% interval", "Unit", "ESS", "R-hat")
SCORE_COLUMNS = ("NRMSE", "Max error", "Width 95%", f"Coverage {'/'.join(map(str, LEVELS))}%")


def show_result(result: Result, folder: RunFolder | None, console: Console) -> None:
    """Show a finished run; without intervals, if it has not converged.

    The folder, if given, is where its report lies.
    """
    show_standing(result.standing, console)
    rows = list(parameter_rows(result))
    if rows:
        table = _table(*PARAMETER_COLUMNS)
        for row in rows:
            table.add_row(*map(escape, row))
        console.print(table)
        show_scores(result.scores, console, result.verdicts)
        if result.loops is not None:
            show_loops(result.loops, console)
    console.print(_sampling(result), highlight=False, soft_wrap=True)
    show_remarks(result.remarks, console)
    if folder is not None:
        console.print(f"report: {folder.path / 'report.html'}", highlight=False, soft_wrap=True)


def _table(*columns: str) -> Table:
    """Return an empty table that is narrow enough for a terminal of 80 columns."""
    return Table(*columns, box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)


def show_remarks(remarks: Iterable[str], console: Console) -> None:
    """Show what a user should know, a line for each."""
    for remark in remarks:
        console.print(f"note: {escape(remark)}", highlight=False, soft_wrap=True)


def parameter_rows(result: Result) -> Iterator[tuple[str, ...]]:
    """Yield the free parameters' estimates as texts, one for each of ``PARAMETER_COLUMNS``.

    None without convergence.
    """
    numbers = summary(result)["parameters"]
    for name, row in numbers.items() if isinstance(numbers, Mapping) else ():
        yield (
            name,
            digits(row["mean"], row["sd"]),
            digits(row["sd"], row["sd"]),
            f"{digits(row['lower_95'], row['sd'])} to {digits(row['upper_95'], row['sd'])}",
            row["unit"],
            f"{min(row['ess_bulk'], row['ess_tail']):.0f}",
            f"{row['rhat']:.3f}",
        )


def show_standing(standing: Standing, console: Console) -> None:
    """Show first what does not hold, with its cause and fix, or what is open."""
    colour = {True: "green", False: "red", None: "yellow"}[standing.holds]
    for line in standing.lines:
        text = f"[bold {colour}]{standing.headline}[/]: {escape(line)}"
        console.print(text, highlight=False, soft_wrap=True)


def _sampling(result: Result) -> str:
    """Say in one line how the moves did."""
    check = result.outcome.check
    accepted = ", ".join(f"{n} {kept / tried:.0%}" for n, (tried, kept) in result.moves.items())
    cover = "no mixture" if check.pareto_k is None else f"Pareto k {check.pareto_k:.2f}"
    return f"sampling: {check.steps} steps, accepted: {accepted}; {cover}"


def show_scores(
    scores: Mapping[str, Scores], console: Console, verdicts: Mapping[str, Verdict] | None = None
) -> None:
    """Show how predictions turned out."""
    table = _table("Record", *(["Validation"] if verdicts else []), *SCORE_COLUMNS)
    for name, one in scores.items():
        held = [_held(verdicts[name])] if verdicts else []
        table.add_row(name, *held, *score_texts(one))
    console.print(table)


def show_loops(loops: Loops, console: Console) -> None:
    """Show what is measured of the major and of the minor loop."""
    both = loops.major, loops.minor
    columns = (f"{loop.voltage[0]:.4g} to {loop.voltage[-1]:.4g} V" for loop in both)
    table = _table("loop, 95 % interval", *columns, "unit")
    for name, (title, unit) in MEASURES.items():
        estimates = (loop.estimates[name] for loop in both)
        cells = ("-" if e is None else f"{e.lower:.4g} to {e.upper:.4g}" for e in estimates)
        table.add_row(title.lower(), *cells, unit)
    console.print(table)


def score_texts(scores: Scores) -> tuple[str, ...]:
    """Return scores as texts, one for each of ``SCORE_COLUMNS``."""
    covered = scores.coverage["sensor"] or {}
    return (
        f"{100 * scores.nrmse:.2f}%",
        f"{scores.max_error_um:.2f} um",
        f"{scores.width_um[95]:.2f} um",
        "/".join(f"{100 * part:.1f}" for part in covered.values()),
    )


def _held(verdict: Verdict) -> str:
    words = {True: "passed", False: "[bold red]FAILED[/]", None: "[yellow]inconclusive[/]"}
    return words[verdict.holds]


def show_calibration(calibration: Calibration, folder: CalibrationFolder, console: Console) -> None:
    """Show how even the ranks are, and what intervals and bands cover."""
    table = _table("statistic", "p", "p adjusted", "ECDF", *(f"{level} %" for level in LEVELS))
    for name, one in calibration.statistics.items():
        ecdf = "leaves band" if one.outside else "inside"
        covered = (f"{one.covered[level]:.1%}" for level in LEVELS)
        table.add_row(escape(name), f"{one.p:.2g}", f"{one.adjusted:.2g}", ecdf, *covered)
    console.print(table)
    if calibration.bands:
        table = _table("band", "of", *(f"{level} %" for level in LEVELS))
        for other, kind in product(calibration.predicted, KINDS):
            coverages = (calibration.bands[f"{other} {kind} {level}".strip()] for level in LEVELS)
            covered = (f"{one.mean:.1%} ± {one.error:.1%}" for one in coverages)
            table.add_row(kind, escape(other) or "held-out samples", *covered)
        console.print(table)
    for text, power in calibration.power.items():
        console.print(f"power of a smooth test against sds {text}: {power:.2f}", highlight=False)
    if not calibration.telling:
        console.print("note: so few replicates may well miss sds a fifth too small; make more")
    for remark in calibration.shortcomings:
        console.print(f"note: {escape(remark)}", highlight=False, soft_wrap=True)
    console.print(
        f"{calibration.replicates} replicates, {len(calibration.unconverged)} not converged\n"
        f"report: {folder.path / 'calibration.html'}",
        highlight=False,
        soft_wrap=True,
    )


def show_campaign(campaign: CampaignResult, folder: CampaignFolder, console: Console) -> None:
    """Show the population and how many records ended in which way."""
    if campaign.population is not None:
        table = _table("parameter", "unit", "middle", "spread", "next specimen, 95 %", "off it")
        for one in campaign.population.parameters.values():
            low, high = np.quantile(one.new, [0.025, 0.975])
            spread = float(np.median(one.spread))
            table.add_row(
                escape(one.name),
                escape(one.unit),
                f"{np.median(one.mean):.4g}",
                f"{spread:.1%}" if one.logarithmic else f"{spread:.3g}",
                f"{low:.4g} to {high:.4g}",
                escape(", ".join(one.outliers)),
            )
        console.print(table)
    else:
        console.print(f"note: {escape(campaign.untold)}", highlight=False, soft_wrap=True)
    ended = ", ".join(f"{count} {status}" for status, count in campaign.counts.items() if count)
    console.print(
        f"{len(campaign.rows)} records: {ended}\nreport: {folder.page}",
        highlight=False,
        soft_wrap=True,
    )


def show_comparison(comparison: Comparison, folder: Path | None, console: Console) -> None:
    """Show what is recommended, what speaks against it, and the models' numbers."""
    first, *others = comparison.lines
    console.print(f"[bold]{escape(first)}[/]", highlight=False, soft_wrap=True)
    for line in others:
        console.print(escape(line), highlight=False, soft_wrap=True)
    for line in comparison.against:
        console.print(f"against it: {escape(line)}", highlight=False, soft_wrap=True)
    table = _table(*(COMPARED[i] for i in ON_SCREEN))
    for row in compared(comparison):
        table.add_row(*(escape(row[i]) for i in ON_SCREEN))
    console.print(table)
    table = _table(*DIFFERENCE_COLUMNS)
    for row in differences(comparison):
        table.add_row(*map(escape, row))
    if table.row_count:
        console.print(f"less {escape(comparison.best or '')}:", highlight=False)
        console.print(table)
    if folder is not None:
        console.print(f"report: {folder / 'comparison.html'}", highlight=False, soft_wrap=True)


def show_priors(
    prior: JointPrior, console: Console, fitted: Mapping[str, float] | None = None
) -> None:
    """Show every prior and fixed value as numbers, with the point fit if there is one.

    Below a stated prior that the physical constraints change stands what they leave of it: median
    and 95 % interval under the joint prior.
    """
    quantiles = conflict.effective(prior, generator(0, "effective priors"))
    left = dict(zip(prior.free_names, quantiles.T, strict=True))
    table = _table("parameter", "prior", *(["point fit"] if fitted else []), "unit")
    for parameter in prior.parameters:
        if parameter.prior is None:
            known = f"fixed at {parameter.fixed:g}"
        else:
            known = str(parameter.prior)
            low, middle, high = left[parameter.name]
            shares = parameter.prior.frozen.cdf([low, middle, high])
            if max(abs(shares - [0.025, 0.5, 0.975])) > CHANGED:
                known += f"\n  in effect {middle:.3g} ({low:.2g} to {high:.2g})"
        row = [escape(parameter.name), escape(known)]
        if fitted:
            row.append(f"{fitted[parameter.name]:.5g}" if parameter.name in fitted else "")
        table.add_row(*row, escape(parameter.unit))
    console.print(table)
