"""The page of a compensation: what is promised, beside what a linear command would do; pictures.

One HTML file that needs nothing else, as the report of a run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bwbayes.app.report.page import Table, picture, template
from bwbayes.results.bands import LEVELS

if TYPE_CHECKING:
    from bwbayes.control.predicted import Compensation

__all__ = ["render"]

# How an actuator starts of which nothing is known.
ANYHOW = "waited at zero volts, after any drive"

CAPTIONS = {
    "tracking": (
        "Reference and prediction",
        "The command, the displacement that it will give with its 95 % bands, and the error; "
        "beside it what a linear command would do.",
    ),
    "error": (
        "Error",
        "Left: the tracking error, to the reference as requested, with its 95 % bands; dotted, the "
        "limit. Right: what its rms may be, with the discrepancy, over the draws.",
    ),
    "loops": (
        "Before and after",
        "What is predicted against what is asked for: without compensation the loop is open.",
    ),
}


def render(made: Compensation, pictures: Mapping[str, bytes]) -> str:
    """Return the page; ``pictures`` are PNG files by the name of their figure."""
    summary = made.summary
    both = ("compensated", "uncompensated")
    rows = [("Voltage", *(_span(summary[one]["voltage_V"]) for one in both), "V")]
    for key, title in (("rms_um", "Rms of the error"), ("largest_um", "Largest error")):
        values = [summary[one][key] for one in both]
        rows.append((f"{title}, mean", *(f"{one['mean']:.3g}" for one in values), "µm"))
        rows += [
            (f"{title}, {level} % interval", *(_span(one[str(level)]) for one in values), "µm")
            for level in LEVELS
        ]
    if made.limit is not None:
        texts = [f"{summary[one]['probability_below_limit']:.3f}" for one in both]
        rows.append((f"Probability that the error stays below {made.limit:g} µm", *texts, ""))
    if made.reference.moved > 0:
        for key, title in (("rms_um", "Rms of the error"), ("largest_um", "Largest error")):
            values = [summary[one]["to_smoothed_reference"][key] for one in both]
            texts = [f"{one['mean']:.3g}" for one in values]
            rows.append((f"{title} to the smoothed reference, mean", *texts, "µm"))
            texts = [_span(one["95"]) for one in values]
            rows.append((f"{title} to the smoothed reference, 95 % interval", *texts, "µm"))
    return template("compensation.html.j2").render(
        name=made.reference.name,
        run_standing=made.standing,
        summary=summary,
        error=Table("error", "Error", ("Quantity", "Compensated", "Uncompensated", "Unit"), rows),
        known=_facts(made, summary),
        remarks=made.remarks,
        pictures=[picture(png, name, *CAPTIONS[name]) for name, png in pictures.items()],
    )


def _facts(made: Compensation, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    other = summary["other_command"]
    chosen = {"mean": "inverse of the mean model", "expected": "least expected squared error"}
    rest = {"mean": "expected", "expected": "mean"}[made.command]
    between = {
        "zero": "held until the next sample, as a DAC does (zero-order hold)",
        "first": "straight lines (first-order hold)",
    }[made.hold]
    return [
        (
            "Reference",
            f"{summary['from_um']:.4g} to {summary['to_um']:.4g} µm, "
            f"{summary['samples']} samples every {summary['interval_s']:g} s",
        ),
        ("Command", chosen[made.command]),
        (
            "The other command",
            f"{chosen[rest]}: differs by up to {other['largest_difference_V']:.3g} V, and leaves "
            f"{made.other:.4g} µm (rms expected over the draws, without the discrepancy, to the "
            "reference as smoothed) where this one leaves "
            f"{made.compensated.smoothed.expected:.4g} µm",
        ),
        ("Voltage between samples", between),
        (
            "Displacement between samples",
            f"up to {made.between:.3g} µm from a straight line; errors are those at the samples, "
            "just before the voltage changes",
        ),
        ("Start", "demagnetized at zero volts" if made.from_rest else ANYHOW),
        ("0 µm", "where the actuator stands at zero volts as the command begins"),
    ]


def _span(edges: list[float]) -> str:
    return f"{edges[0]:.4g} to {edges[1]:.4g}"
