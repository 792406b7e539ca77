"""The tables of a run's report; the CSV of each holds what ``summary.json`` holds.

Each function takes the run and its summary, as :func:`bwbayes.results.result.summary` returns it or
as it was stored.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from bwbayes.app.figures.style import title, unit_text
from bwbayes.app.report.page import Table
from bwbayes.app.report.words import covered, digits, error_text, mark, symbol
from bwbayes.inference.conflict import effective
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.results.bands import LEVELS, Bands
from bwbayes.results.loops import MEASURES, Estimate
from bwbayes.results.replicated import STATISTICS
from bwbayes.results.result import Result
from bwbayes.results.scores import Scores
from bwbayes.results.steps import STEP_MEASURES

__all__ = [
    "loops",
    "moves",
    "parameters",
    "priors",
    "replicated",
    "sampling",
    "scores",
    "steps",
    "taught",
    "validation",
]

Summary = Mapping[str, Any]

UNKNOWN = "–"
MEASURED_TITLES = ("Mean ± sd", "95 % interval")


def parameters(result: Result, summary: Summary) -> Table:
    """Return what is known of each free parameter."""
    known = summary["parameters"]
    of_truth = any("truth" in known[p.name] for p in result.free)
    rows = []
    for parameter in result.free:
        one = known[parameter.name]
        mean, sd, lower, upper = (
            digits(one[key], one["sd"]) for key in ("mean", "sd", "lower_95", "upper_95")
        )
        row = [_words(parameter), f"{mean} ± {sd}", unit_text(parameter.unit)]
        row.append(f"{lower} to {upper}")
        if of_truth:
            row.append(f"{one['truth']:.6g}" if "truth" in one else UNKNOWN)
        rows.append(row)
    titles = ["Parameter", "Mean ± sd", "Unit", "95 % interval"]
    return Table(
        "parameters",
        "Parameters",
        [*titles, "Truth"] if of_truth else titles,
        rows,
        records=[{"parameter": p.name, **known[p.name]} for p in result.free],
    )


def sampling(result: Result, summary: Summary) -> Table:
    """Return how well each free parameter was sampled; without convergence that alone."""
    check, known = result.outcome.check, summary["parameters"]
    rows = []
    for i, parameter in enumerate(result.free):
        row = [
            _words(parameter),
            f"{check.ess_bulk[i]:.0f}",
            f"{check.ess_tail[i]:.0f}",
            f"{check.rhat[i]:.4f}",
        ]
        if known:
            one = known[parameter.name]
            row += [f"{one['mcse_mean']:.2g}", digits(one["median"], one["sd"])]
            row.append(unit_text(parameter.unit))
        rows.append(row)
    titles = ["Parameter", "ESS bulk", "ESS tail", "R\N{COMBINING CIRCUMFLEX ACCENT}"]
    return Table(
        "sampling",
        "Sampling of each parameter",
        [*titles, "MCSE", "Median", "Unit"] if known else titles,
        rows,
    )


def moves(result: Result) -> Table:
    """Return how often each kind of move was proposed, and accepted."""
    rows = [
        (name, str(proposed), f"{100 * kept / proposed:.1f} %")
        for name, (proposed, kept) in result.moves.items()
    ]
    return Table("moves", "Moves", ("Move", "Proposed to a walker", "Accepted"), rows)


def priors(result: Result) -> Table:
    """Return each parameter's prior in words, stated and in effect, or its fixed value."""
    prior = JointPrior(result.parameters)
    quantiles = effective(prior, np.random.default_rng(0))
    left = dict(zip(prior.free_names, quantiles.T, strict=True))
    rows = []
    for parameter in result.parameters:
        effect = ""
        if parameter.name in left:
            low, middle, high = left[parameter.name]
            effect = f"{middle:.3g} ({low:.2g} to {high:.2g})"
        rows.append((_words(parameter), _stated(parameter), effect, unit_text(parameter.unit)))
    titles = ("Parameter", "Prior or value", "In effect", "Unit")
    return Table("priors", "Priors and fixed values", titles, rows)


def taught(result: Result) -> Table | None:
    """Return how far the record narrowed each parameter, and what its posterior hangs on."""
    if result.learned is None:
        return None
    rows = [
        (
            _words(parameter),
            f"{one.contraction:.2f}",
            f"{one.prior:.2f}",
            f"{one.likelihood:.2f}",
            "the prior" if one.prior_decides else "the readings",
        )
        for parameter in result.free
        for one in (result.learned.parameters[parameter.name],)
    ]
    titles = ("Parameter", "Contraction", "To the prior", "To the readings", "Decided by")
    return Table("taught", "What the record taught", titles, rows)


def replicated(result: Result) -> list[Table]:
    """Return the numbers of each fitted record among those of replicated records."""
    titles = ("Number", "Observed", "95 % of replicated", "Unit", "p", "Odd")
    tables = []
    for name, checked in result.replicated.items():
        rows = [
            (
                STATISTICS[which][0],
                f"{one.observed:.4g}",
                f"{one.lower:.4g} to {one.upper:.4g}",
                unit_text(STATISTICS[which][1]),
                f"{one.p:.3f}",
                "odd" if one.odd else "",
            )
            for which, one in checked.statistics.items()
        ]
        of = f" of {name}" if len(result.replicated) > 1 else ""
        tables.append(Table(f"replicated-{name}", f"Posterior predictive checks{of}", titles, rows))
    return tables


def validation(result: Result, summary: Summary) -> Table:
    """Return the scores that matter most: a column for each of the bands, held-out ones first."""
    columns = [list(_main_scores(result.scores[bands.name])) for bands in _judged(result)]
    return _of_scores(result, summary, "validation", "Band validation", columns)


def scores(result: Result, summary: Summary) -> Table:
    """Return the verdicts and the other scores, as :func:`validation` has them."""
    columns = [
        [("Validation", _held(result, bands.name)), *_scores(result.scores[bands.name])]
        for bands in _judged(result)
    ]
    return _of_scores(result, summary, "scores", "Other scores", columns)


def _judged(result: Result) -> list[Bands]:
    judged = [bands for bands in result.bands if bands.name in result.scores]
    return sorted(judged, key=lambda bands: bands.training)


def _of_scores(
    result: Result,
    summary: Summary,
    name: str,
    caption: str,
    columns: Sequence[Sequence[tuple[str, str]]],
) -> Table:
    """Return columns of titles and texts as a table, without rows of which nothing is known."""
    judged = _judged(result)
    rows = [
        [row[0][0], *(text or UNKNOWN for _, text in row)]
        for row in zip(*columns, strict=True)
        if any(text for _, text in row)
    ]
    kept = {bands.name: summary["validation"][bands.name] for bands in judged}
    titles = ["Quantity", *(title(bands) for bands in judged)]
    return Table(name, caption, titles, rows, records=_flat(kept))


def loops(result: Result, summary: Summary) -> Table | None:
    """Return what was measured of the loops, if anything."""
    if not result.outcome.converged or result.loops is None:
        return None
    both = result.loops.major, result.loops.minor
    titles = [
        f"{name} loop, {loop.voltage[0]:.4g} to {loop.voltage[-1]:.4g} V"
        for name, loop in zip(("Major", "Minor"), both, strict=True)
    ]
    kept = {name: summary["loops"][name] for name in ("major", "minor")}
    estimates = [loop.estimates for loop in both]
    return _measured("loops", "Measured loops", titles, MEASURES, estimates, kept)


def steps(result: Result, summary: Summary) -> Table | None:
    """Return what was measured of the steps, if anything."""
    if not result.outcome.converged or not result.steps:
        return None
    titles = [
        f"{name}: {one.step.height:.4g} V for {one.step.held:.4g} s"
        for name, one in result.steps.items()
    ]
    estimates = [one.estimates for one in result.steps.values()]
    kept = summary["step_responses"]
    return _measured("steps", "Measured step responses", titles, STEP_MEASURES, estimates, kept)


def _measured(
    name: str,
    caption: str,
    titles: Sequence[str],
    measures: Mapping[str, tuple[str, str]],
    every: Sequence[Mapping[str, Estimate | None]],
    kept: Mapping[str, Any],
) -> Table:
    """Return mean ± sd and interval of each measure of every loop or step."""
    rows = [
        [words, *(text for one in every for text in _texts(one[measure])), unit_text(unit)]
        for measure, (words, unit) in measures.items()
    ]
    return Table(
        name,
        caption,
        ["Quantity", *len(every) * MEASURED_TITLES, "Unit"],
        rows,
        groups=[*((one, len(MEASURED_TITLES)) for one in titles), ("", 1)],
        records=_flat(kept),
    )


def _texts(one: Estimate | None) -> tuple[str, str]:
    if one is None:
        return UNKNOWN, UNKNOWN
    mean, sd, lower, upper = (digits(x, one.sd) for x in (one.mean, one.sd, one.lower, one.upper))
    return f"{mean} ± {sd}", f"{lower} to {upper}"


def _flat(kept: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return nested numbers as rows, a column for each key of ``kept``."""
    columns = {name: pd.json_normalize(dict(one), sep=" ").iloc[0] for name, one in kept.items()}
    frame = pd.DataFrame(columns).rename_axis("quantity").reset_index()
    return [{str(key): value for key, value in row.items()} for row in frame.to_dict("records")]


def _words(parameter: Parameter) -> Markup:
    return Markup("{}, {}").format(parameter.description, symbol(parameter).html)


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


def _held(result: Result, name: str) -> str:
    verdict = result.verdicts.get(name)
    return "" if verdict is None else mark(verdict.status)


def _main_scores(scores: Scores) -> Iterator[tuple[str, str]]:
    """Yield titles and texts of the three rows that are always seen."""
    yield "NRMSE", error_text(scores)
    yield "Max error", f"{scores.max_error_um:.2f} µm"
    levels = ", ".join(f"{level}" for level in LEVELS)
    shares = [covered(scores, "sensor", level).removesuffix(" %") for level in LEVELS]
    yield f"Coverage of the {levels}% sensor bands", f"{', '.join(shares)}%"


def _scores(scores: Scores) -> Iterator[tuple[str, str]]:
    """Yield titles and texts of the other rows, the levels from the widest band."""
    yield "CRPS", f"{scores.crps_um:.3f} µm"
    for level in sorted(LEVELS, reverse=True):
        yield (
            f"{level} % displacement band covers displacement",
            covered(scores, "displacement", level),
        )
        yield f"{level} % sensor band: worst second", f"{100 * scores.worst_second[level]:.1f} %"
        yield f"{level} % sensor band: mean width", f"{scores.width_um[level]:.2f} µm"
        yield f"{level} % sensor band: interval score", f"{scores.interval_score_um[level]:.2f} µm"
