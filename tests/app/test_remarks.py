"""What the priors and the record disagree on is said by `check` and by a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bwbayes.app.fit.fitted import finished
from bwbayes.app.running.assembling import assemble
from bwbayes.app.running.folder import RunFolder
from bwbayes.model.distributions import Distribution


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
