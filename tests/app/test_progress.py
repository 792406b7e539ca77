"""The line that a person watches: its ETA counts down."""

from __future__ import annotations

from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from bwbayes.app.running.progress import Progress, StepProgress
from bwbayes.sampling.diagnostics import Check
from bwbayes.sampling.plan import SamplingPlan


class Watched:
    """The line of a run whose clock goes when it is told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr("time.monotonic", lambda: self.now)
        self.show = Progress(Console(file=StringIO()), SamplingPlan(ess=2000, block=50))

    def block(self, seconds: float, ensembles: int = 4) -> None:
        """Make a block of so many ensembles."""
        for _ in range(ensembles):
            self.now += seconds / 4
            self.show("sampling", None)

    def check(self, steps: int, ess: float, rhat: float = 1.0, stuck: int = 0) -> float:
        """Show a check; return the seconds that are left then."""
        enough = np.full(2, ess)
        rhats, autocorrelation = np.full(2, rhat), np.full(2, 4.0)
        check = Check(steps, rhats, enough, enough, enough, autocorrelation, 0.4, stuck)
        self.show("sampling", check)
        return self.eta

    @property
    def eta(self) -> float:
        """The seconds that the line says are left; infinite if it does not say."""
        text = self.show.line("sampling").split("ETA ")[1].split()[0]
        minutes, _, seconds = text.partition(":")
        return np.inf if text == "unknown" else 60 * int(minutes) + int(seconds)


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Watched:
    return Watched(monkeypatch)


def test_the_eta_counts_down_between_checks_and_does_not_climb_at_them(watched: Watched) -> None:
    """Ten effective draws a step: 400 steps are missing at the first check, then ever fewer."""
    seen = []
    for blocks in range(1, 12):
        watched.block(10.0)
        if blocks in (4, 8):
            watched.check(50 * blocks, 2.5 * 50 * blocks)
        if blocks >= 4:
            seen.append(watched.eta)
    # 200 steps in 40 s; the end is at 800 steps.
    assert [120 - 10 * i for i in range(len(seen))] == seen


def test_each_step_after_the_sampling_counts_down_by_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    console = Console(record=True, width=200, file=StringIO())
    with StepProgress(console) as progress:
        for step, share in (("predictions", 0.25), ("predictions", 1.0), ("explanations", 0.0)):
            now[0] += 30
            progress(step, share)
        now[0] += 60
        progress("explanations", 0.5)
    assert [
        "predictions 25%   ETA 1:30",
        "predictions 100%   ETA 0:00",
        "explanations 0%   ETA unknown",
        "explanations 50%   ETA 1:30",
    ] == console.export_text().splitlines()
