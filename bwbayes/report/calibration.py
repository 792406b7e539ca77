"""Report of a simulation-based calibration: outcome, tests and their power, numbers, figures."""

from __future__ import annotations

from functools import partial
from itertools import product

from markupsafe import Markup

from bwbayes.calibration.calibration import FAMILY_LEVEL, JUDGED_FROM, RANKED, Calibration
from bwbayes.prediction.bands import KINDS, LEVELS
from bwbayes.report.report import (
    Banner,
    Block,
    Facts,
    Kind,
    Picture,
    Report,
    Section,
    Table,
    TableColumn,
    Text,
    circumstances,
    symbol,
    unit_text,
)

# Names and units of the ranked quantities besides parameters.
EXTRA_WORDS = {
    "log_likelihood": ("log likelihood", "-"),
    "loop_area": ("loop area", "um V"),
    "range": ("displacement range", "um"),
}


def outcome(passed: bool, telling: bool) -> tuple[Kind, str]:
    """Return the banner's kind and headline for a calibration's outcome."""
    if not passed:
        return "bad", "CALIBRATION FAILED"
    return ("good", "Passed") if telling else ("note", "Passed, with too few replicates")


def calibration_report(calibration: Calibration) -> Report:
    """Return a calibration's report: its outcome, the tests, and the facts of the run."""
    bands, unconverged = _bands(calibration), calibration.unconverged
    counts = f"{calibration.replicates} replicates, {len(unconverged)} not converged"
    kind, headline = outcome(calibration.passed, calibration.telling)
    lines = {
        "bad": counts,
        "good": f"{counts}; nothing speaks against the posteriors",
        "note": f"{counts}; low power: more replicates are needed to detect SDs 20% too small",
    }
    banners = [Banner(kind, headline, [lines[kind]], calibration.failures)]
    if unconverged:
        numbers = ", ".join(map(str, unconverged))
        line = f"not converged, and counted with the others: replicates {numbers}"
        banners.append(Banner("note", "Replicates that did not converge", [line]))
    blocks: list[Block] = [_statistics(calibration)]
    if bands.rows:
        blocks.append(Section("Bands on samples that were not fitted", [bands], folded=False))
    facts = [*calibration.facts, *circumstances(calibration.provenance)]
    free = [
        {"name": p.name, "symbol": symbol(p), "prior": p.prior, "unit": unit_text(p.unit)}
        for p in calibration.parameters
        if p.fixed is None
    ]
    columns = {"Parameter": "{name}", "Symbol": Markup("{symbol}"), "Prior": "{prior}"}
    columns["Unit"] = "{unit}"
    return Report(
        quantities=calibration.quantities,
        title=f"{calibration.name}, simulation-based calibration",
        heading=f"Simulation-based calibration: {calibration.name}",
        banners=banners,
        blocks=[
            *blocks,
            Section("Pictures", _pictures(calibration), folded=False),
            Section("Tests", _tests(calibration), folded=False),
            Section("Priors", [Table.of("priors", "Priors", free, columns)]),
            Section("Settings", [Facts(facts)]),
        ],
        numbers=calibration.numbers,
    )


def _statistics(calibration: Calibration) -> Table:
    """Return a table with a row for each statistic, and the limits of the intervals' coverage."""
    words = {p.name: (p.description, p.unit) for p in calibration.parameters} | EXTRA_WORDS
    rows = []
    for name, uniformity in calibration.statistics.items():
        description, unit = words[name]
        ecdf = "leaves band" if uniformity.outside else "inside"
        tests = f"{uniformity.p:.2g}", f"{uniformity.adjusted:.2g}", ecdf
        covered = (f"{uniformity.covered[level]:.1%}" for level in LEVELS)
        rows.append((name, description, unit_text(unit), *tests, *covered))
    limits = ("{:.1%} to {:.1%}".format(*calibration.limits[level]) for level in LEVELS)
    rows.append(("", "99% binomial limits", "", "", "", "", *limits))
    columns: list[str | TableColumn] = [
        TableColumn("Name", on="screen"),
        TableColumn("Statistic", on="page"),
        TableColumn("Unit", on="page"),
    ]
    columns += ["p", "p adjusted", "ECDF", *(f"{level}%" for level in LEVELS)]
    return Table(
        "statistics",
        "Ranks and intervals",
        columns,
        rows,
        note="p: of the smooth test of the ranks; adjusted for the number of statistics, by Holm. "
        "ECDF: whether their distribution leaves its band. Percent: how often the central interval "
        "holds the truth; shown with its limits, judged through the ranks.",
        on="both",
    )


def _bands(calibration: Calibration) -> Table:
    """Return a table with a row for each kind of band of held-out windows and other records."""
    rows = []
    for record, kind in product(calibration.predicted, KINDS):
        coverages = [calibration.bands[f"{record} {kind} {level}".strip()] for level in LEVELS]
        texts = (f"{coverage.mean:.1%} ± {coverage.error:.1%}" for coverage in coverages)
        rows.append((kind, record or "held-out samples", *texts))
    return Table(
        "bands",
        "Coverage of the bands",
        ("Band", "Of", *(f"{level}%" for level in LEVELS)),
        rows,
        note=f"Mean over replicates, and its standard error from the spread between them; from "
        f"{JUDGED_FROM} replicates on, each must be within 3 of what the band promises (by chance, "
        "at most one sound calibration of 40 has one that is not). The parameter band should hold "
        "the model's displacement at the true parameters, the displacement band the simulated "
        "displacement with its discrepancy, the sensor band the simulated reading. Another record "
        "is made with the same truth, and has a start and an offset of its own.",
        on="both",
    )


def _pictures(calibration: Calibration) -> list[Picture]:
    from bwbayes.report.figures import products  # noqa: PLC0415  # slow to load

    return [
        Picture(
            "rank_histograms",
            "Ranks",
            "Where the truth lies among the posterior's draws, over all replicates. Level is "
            "right; a bowl means posteriors that are too narrow, a hump too wide, a slope a bias.",
            partial(products.draw_histograms, calibration),
        ),
        Picture(
            "rank_ecdf",
            "Distribution of the ranks",
            "The ranks' cumulative distribution less that of even ranks, with the band that even "
            "ranks leave anywhere no more often than the stated level allows; p of the smooth "
            "test.",
            partial(products.draw_ecdf, calibration),
        ),
        Picture(
            "coverage",
            "Coverage",
            "Left: how often the posteriors' central intervals hold the truth. Right: how far the "
            "coverage of the bands on held-out samples is off what they promise.",
            partial(products.draw_coverage, calibration),
        ),
    ]


def _tests(calibration: Calibration) -> list[Text]:
    count = len(calibration.statistics)
    power = ", ".join(
        f"{text} with a probability of {power:.2f}" for text, power in calibration.power.items()
    )
    return [
        Text(
            "Each replicate draws parameters from the prior, simulates a record with them, and "
            "fits it as a run does. The truth is then ranked among "
            f"{RANKED} independent draws of the posterior. If prior, model, likelihood and sampler "
            "are right, every rank is as likely as any other."
        ),
        Text(
            f"{2 * count} tests, two for each of {count} statistics, with a false alarm in "
            f"{FAMILY_LEVEL:.0%} of sound calibrations: Neyman's smooth test with two terms, and "
            "that of Kolmogorov and Smirnov, the simultaneous band around the ranks' distribution "
            "function."
        ),
        Text(
            "The power of the smooth test of one statistic, with so many replicates: it finds "
            f"posterior sds that are {power}.",
            on="both",
        ),
    ]
