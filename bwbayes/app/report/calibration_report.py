"""The page of a simulation-based calibration: verdict, tests and their power, numbers, pictures.

One HTML file that needs nothing else, as the report of a run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

from bwbayes.app.figures.style import unit_text
from bwbayes.app.problem.model import in_words
from bwbayes.app.problem.problem import Problem
from bwbayes.app.report.page import Table, picture, template
from bwbayes.app.report.words import symbol
from bwbayes.results.bands import KINDS, LEVELS
from bwbayes.results.calibration import FAMILY_LEVEL, JUDGED_FROM, Calibration
from bwbayes.results.replicates import EXTRA, RANKED

__all__ = ["render"]

CAPTIONS = {
    "rank_histograms": (
        "Ranks",
        "Where the truth lies among the posterior's draws, over all replicates. Level is right; a "
        "bowl means posteriors that are too narrow, a hump too wide, a slope a bias.",
    ),
    "rank_ecdf": (
        "Distribution of the ranks",
        "The ranks' cumulative distribution less that of even ranks, with the band that even ranks "
        "leave anywhere no more often than the stated level allows; p of the smooth test.",
    ),
    "coverage": (
        "Coverage",
        "Left: how often the posteriors' central intervals hold the truth. Right: how far the "
        "coverage of the bands on held-out samples is off what they promise.",
    ),
}

EXTRA_WORDS = {
    "log_likelihood": ("log likelihood", "-"),
    "opening": ("loop opening", "um"),
    "range": ("displacement range", "um"),
}


def render(
    problem: Problem,
    calibration: Calibration,
    numbers: Mapping[str, Any],
    pictures: Mapping[str, bytes],
) -> str:
    """Return the page.

    Parameters
    ----------
    problem
        What was calibrated.
    calibration
        How it turned out; ``numbers`` are those of ``calibration.json``.
    pictures
        PNG files by the name of their figure, in their order.
    """
    return template("calibration.html.j2").render(
        name=problem.config.name or "calibration",
        passed=calibration.passed,
        telling=calibration.telling,
        shortcomings=calibration.shortcomings,
        replicates=calibration.replicates,
        unconverged=[str(number) for number in calibration.unconverged],
        statistics=_statistics(problem, calibration),
        bands=_bands(calibration),
        priors=Table(
            "priors",
            "Priors",
            ("Parameter", "Symbol", "Prior", "Unit"),
            [
                (p.name, symbol(p).html, str(p.prior), unit_text(p.unit))
                for p in problem.parameters
                if p.fixed is None
            ],
        ),
        power=calibration.power,
        tests=2 * len(calibration.statistics),
        family_level=f"{FAMILY_LEVEL:.0%}",
        judged_from=JUDGED_FROM,
        ranked=RANKED,
        pictures=[picture(png, name, *CAPTIONS[name]) for name, png in pictures.items()],
        known=_facts(problem, numbers),
    )


def _statistics(problem: Problem, calibration: Calibration) -> Table:
    """Return a row for each statistic, and the limits of its intervals' coverage."""
    known = {p.name: (p.description, unit_text(p.unit)) for p in problem.parameters}
    known |= {name: (EXTRA_WORDS[name][0], unit_text(EXTRA_WORDS[name][1])) for name in EXTRA}
    rows = [
        (
            *known[name],
            f"{one.p:.2g}",
            f"{one.adjusted:.2g}",
            "leaves the band" if one.outside else "inside",
            *(f"{one.covered[level]:.1%}" for level in LEVELS),
        )
        for name, one in calibration.statistics.items()
    ]
    limits = [_percent(calibration.limits[level]) for level in LEVELS]
    rows.append(("99 % binomial limits", "", "", "", "", *limits))
    tests = ("Statistic", "Unit", "p, smooth test", "p, adjusted", "ECDF of ranks")
    titles = (*tests, *(f"{level} % interval" for level in LEVELS))
    return Table("statistics", "Ranks and intervals", titles, rows)


def _bands(calibration: Calibration) -> Table:
    """Return a row for each kind of band of held-out windows and of other records, if any."""
    rows = []
    for other, kind in product(calibration.predicted, KINDS):
        coverages = [calibration.bands[f"{other} {kind} {level}".strip()] for level in LEVELS]
        covered = [f"{c.mean:.1%} ± {c.error:.1%}" for c in coverages]
        rows.append((kind, other or "held-out samples", *covered))
    titles = ("Band", "of", *(f"{level} %" for level in LEVELS))
    return Table("bands", "Coverage of the bands", titles, rows)


def _percent(pair: Sequence[float]) -> str:
    return f"{pair[0]:.1%} to {pair[1]:.1%}"


def _facts(problem: Problem, numbers: Mapping[str, Any]) -> list[tuple[str, str]]:
    model, plan = problem.config.model, problem.plan
    held_out = [window for v in problem.validations.values() for window in v.windows]
    judged = sum(window.stop - window.start for window in held_out)
    windows = [window for one in problem.posterior.datasets for window in one.training]
    fitted = sum(window.stop - window.start for window in windows)
    return [
        *(
            (
                "voltage" if len(problem.records) == 1 else f"voltage, {name}",
                f"{record.origin}: {record.samples} samples every {record.interval:g} s",
            )
            for name, record in problem.records.items()
        ),
        ("fitted, held out", f"{fitted} samples, {judged} samples"),
        ("model", in_words(model)),
        ("noise", model.noise),
        (
            "sampling",
            f"{plan.ensembles} ensembles of {plan.walkers} walkers, to ESS {plan.ess:g}, "
            f"at most {plan.most_steps} steps",
        ),
        ("seed", str(numbers["seed"])),
        ("data, SHA-256", str(numbers["data_sha256"])),
        ("versions", ", ".join(f"{name} {text}" for name, text in numbers["versions"].items())),
    ]
