"""The page of a comparison: what is recommended, what speaks against it, and the numbers.

One HTML file that needs nothing else, as the report of a run.
"""

from __future__ import annotations

from bwbayes.app.problem.problem import Problem
from bwbayes.app.report.report import template
from bwbayes.comparison.choice import Comparison
from bwbayes.comparison.table import COLUMNS, DIFFERENCE_COLUMNS, differences, rows

__all__ = ["render"]


def render(comparison: Comparison, problem: Problem) -> str:
    """Return the page of a comparison; ``problem`` is that of any of its runs."""
    record = problem.record
    held_out = [name for name, one in problem.validations.items()]
    return template("comparison.html.j2").render(
        recommended=comparison.recommended,
        lines=comparison.lines,
        against=comparison.against,
        columns=COLUMNS,
        rows=list(rows(comparison)),
        difference_columns=DIFFERENCE_COLUMNS,
        differences=list(differences(comparison)),
        best=comparison.best,
        models=[(one.name, one.model) for one in comparison.candidates],
        facts=[
            ("record", f"{record.origin}: {record.samples} samples every {record.interval:g} s"),
            ("readings fitted", str(problem.posterior.only.readings.rows.size)),
            ("held out", ", ".join(held_out) or "nothing"),
        ],
    )
