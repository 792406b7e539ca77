"""The line that a person watches: its ETA counts down."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from bwbayes.app.running.progress import Progress
from bwbayes.sampling.diagnostics import Check
from bwbayes.sampling.plan import SamplingPlan

PLAN = SamplingPlan(ess=2000, block=50)


class Clock:
    """A clock that goes when it is told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr("time.monotonic", lambda: self.now)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def check(steps: int, ess: float, rhat: float = 1.0) -> Check:
    enough = np.full(2, ess)
    return Check(steps, np.full(2, rhat), enough, enough, enough, np.full(2, 4.0), 0.4, 0)


def progress() -> Progress:
    return Progress(Console(file=StringIO()), PLAN)


def remaining(shown: Progress) -> float:
    """Return the seconds that the line says are left; infinite if it does not say."""
    text = shown.line("sampling").split("ETA ")[1].split()[0]
    if text == "unknown":
        return np.inf
    minutes, seconds = text.split(":")
    return 60 * int(minutes) + int(seconds)


def block(shown: Progress, clock: Clock, seconds: float) -> None:
    """Make a block of every ensemble."""
    for _ in range(PLAN.ensembles):
        clock.now += seconds / PLAN.ensembles
        shown("sampling", None)


def test_the_eta_counts_down_between_checks_and_does_not_climb_at_them(clock: Clock) -> None:
    """Ten effective draws a step: 400 steps are missing at the first check, then ever fewer."""
    shown, seen = progress(), []
    for blocks in range(1, 12):
        block(shown, clock, 10.0)
        if blocks in (4, 8):
            shown("sampling", check(50 * blocks, 2.5 * 50 * blocks))
        if blocks >= 4:
            seen.append(remaining(shown))
    # 200 steps in 40 s; the end is at 800 steps.
    assert [120 - 10 * i for i in range(len(seen))] == seen


def test_blocks_that_become_slower_do_not_make_it_climb_before_the_next_check(clock: Clock) -> None:
    shown = progress()
    for _ in range(4):
        block(shown, clock, 10.0)
    shown("sampling", check(200, 500))
    seen = [remaining(shown)]
    for _ in range(4):
        block(shown, clock, 25.0)
        seen.append(remaining(shown))
    assert sorted(seen, reverse=True) == seen
    assert 20 == seen[-1]


def test_while_ensembles_disagree_there_is_no_eta(clock: Clock) -> None:
    """More draws may not cure that: a time that is put off at each check would climb."""
    shown = progress()
    for _ in range(4):
        block(shown, clock, 10.0)
    shown("sampling", check(200, 2500, rhat=1.2))
    assert np.inf == remaining(shown)
    shown("sampling", check(200, 500))
    assert 120 == remaining(shown)
    stuck = replace(check(200, 500), stuck=1)
    shown("sampling", stuck)
    assert np.inf == remaining(shown)


def test_a_run_that_goes_on_has_an_eta_after_its_first_block(clock: Clock) -> None:
    shown = progress()
    shown("sampling", check(200, 500))
    assert np.inf == remaining(shown)
    clock.now += 2.5
    shown("sampling", None)
    # A quarter of a block of 50 steps in 2.5 s, and 600 steps less that to go.
    assert round(2.5 / 12.5 * (600 - 12.5)) == pytest.approx(remaining(shown), abs=1)
