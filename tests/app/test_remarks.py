"""What the priors and the record disagree on is said by `check` and by a run."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from bwbayes.app.fit.fitted import finished
from bwbayes.app.running.assembling import assemble
from bwbayes.app.running.folder import RunFolder
from bwbayes.model.distributions import Distribution
from bwbayes.report.priors import priors_table
from bwbayes.report.report import Report
from bwbayes.report.screen import as_text


def test_run_says_it_too(run: Path) -> None:
    folder = RunFolder(run)
    fit = finished(folder)
    problem, chain, outcome = fit.problem, fit.chain, fit.outcome
    outcome = replace(outcome, converged=False)  # no bands are needed
    assert () == assemble(problem, chain, outcome).remarks
    nanometres = Distribution("lognormal", {"median": 1e-3, "sigma": 0.6})
    odd = replace(problem, defaults={**problem.defaults, "d": nanometres})
    (remark,) = assemble(odd, chain, outcome).remarks
    assert "Fix: check its unit" in remark


def test_priors_are_shown_as_the_constraints_leave_them(
    run: Path,
) -> None:
    """With a fixed gamma, beta is above it: its stated median is 1 / U = 0.01."""
    problem = RunFolder(run).problem()
    table = priors_table(problem.posterior.prior)
    lines = as_text(Report(title="", blocks=[table]), width=200).splitlines()
    (place,) = (i for i, line in enumerate(lines) if "beta" in line)
    numbers = re.findall(r"[\d.]+", lines[place + 1])
    median, low, _ = (float(x) for x in numbers)
    assert low > 0.0172
    assert median > 0.02
    # Nothing cuts that of the offset.
    (place,) = (i for i, line in enumerate(lines) if "offset" in line)
    assert "effective" not in lines[place + 1]
