"""What the priors and the record disagree on is said by `check` and by a run."""

from __future__ import annotations

import re
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from bwbayes.app.jobs.check import check
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import assemble, finished
from bwbayes.app.screen import show_priors
from bwbayes.data.inspection import Finding
from bwbayes.model.distributions import Distribution
from tests.app import small


def checked(folder: Path, *changes: tuple[str, str]) -> str:
    """Return what `check` prints for the small config."""
    console = Console(file=StringIO(), width=200)
    check(small.config(*changes), folder, folder / "check", console)
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


def test_check_says_that_a_prior_may_be_in_another_unit(tmp_path: Path) -> None:
    prior = 'd = { prior = { distribution = "lognormal", median = 700.0, sigma = 0.5 } }'
    said = checked(tmp_path, ("[parameters]", f"[parameters]\n{prior}"))
    assert "note: d: its prior's median, 700 um/V, is 7e+02 times what the record's" in said


def test_check_says_nothing_of_good_priors(tmp_path: Path) -> None:
    assert "note:" not in checked(tmp_path)


def test_run_says_it_too(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = RunFolder(small.finished(tmp_path_factory))
    problem, chain, outcome = finished(folder)
    outcome = replace(outcome, converged=False)  # no bands are needed
    assert () == assemble(problem, chain, outcome).remarks
    nanometres = Distribution("lognormal", {"median": 1e-3, "sigma": 0.6})
    odd = replace(problem, defaults={**problem.defaults, "d": nanometres})
    (remark,) = assemble(odd, chain, outcome).remarks
    assert "is it in another unit?" in remark


def test_a_transient_in_sight_counts(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second fit without the record's start needs less evidence where a transient is seen."""
    problem, chain, outcome = finished(RunFolder(small.finished(tmp_path_factory)))
    counted = []

    def told(*_: object, record: str, seen: bool) -> None:
        assert record == "record"
        counted.append(seen)

    monkeypatch.setattr("bwbayes.app.running.assembling.swallowed", told)
    transient = Finding("switch-on transient", 0.0, 1.0, "it starts off", "leave it out")
    drift = replace(transient, kind="drift")
    for findings in ((), (drift,), (drift, transient)):
        assemble(replace(problem, findings={"record": findings}), chain, outcome)
    assert [False, False, True] == counted


def test_priors_are_shown_as_the_constraints_leave_them(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """With a fixed gamma, beta is above it: its stated median is 1 / U = 0.01."""
    problem, _, _ = finished(RunFolder(small.finished(tmp_path_factory)))
    console = Console(file=StringIO(), width=200)
    show_priors(problem.posterior.prior, console)
    assert isinstance(console.file, StringIO)
    lines = console.file.getvalue().splitlines()
    (place,) = (i for i, line in enumerate(lines) if "beta" in line)
    numbers = re.findall(r"[\d.]+", lines[place + 1])
    median, low, _ = (float(x) for x in numbers)
    assert low > 0.0172
    assert median > 0.02
    # Nothing cuts that of the offset.
    (place,) = (i for i, line in enumerate(lines) if "offset" in line)
    assert "in effect" not in lines[place + 1]
