"""The page of a comparison: what is recommended, what speaks against it, and the numbers.

One HTML file that needs nothing else, as the report of a run.
"""

from __future__ import annotations

from bwbayes.app.problem.problem import Problem
from bwbayes.app.report.page import Table, template
from bwbayes.app.report.words import mark
from bwbayes.comparison.choice import Comparison
from bwbayes.comparison.table import COLUMNS, DIFFERENCE_COLUMNS, differences, rows, table

__all__ = ["render"]


def render(comparison: Comparison, problem: Problem) -> str:
    """Return the page of a comparison; ``problem`` is that of any of its runs."""
    less = list(differences(comparison))
    return template("comparison.html.j2").render(
        run_standing=comparison.standing,
        recommended=comparison.recommended,
        lines=comparison.lines,
        against=comparison.against,
        models=Table(
            "models",
            "Models",
            (COLUMNS[0], "validation", *COLUMNS[1:]),
            [
                (row[0], mark(one.standing.status) if one.converged else "-", *row[1:])
                for one, row in zip(comparison.candidates, rows(comparison), strict=True)
            ],
            records=table(comparison),
        ),
        differences=Table(
            "differences", f"Differences to {comparison.best}", DIFFERENCE_COLUMNS, less
        )
        if less
        else None,
        facts=[
            *((one.name, one.model) for one in comparison.candidates),
            *(
                (name, f"{one.origin}: {one.samples} samples every {one.interval:g} s")
                for name, one in problem.records.items()
            ),
            ("readings fitted", str(comparison.candidates[0].readings)),
            ("held out", ", ".join(problem.validations) or "nothing"),
        ],
    )
