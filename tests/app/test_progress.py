"""The line that a person watches: its ETA counts down, and it is there whatever takes its time."""

import re
import time
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from bwbayes.app.fit.calls import open_converged
from bwbayes.app.fit.fitted import open_finished
from bwbayes.app.jobs.check import check
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.progress import LastLine, Progress, ProgressLine, StepProgress, batch
from bwbayes.app.running.run import redraw
from bwbayes.inference import map_estimate
from bwbayes.sampling.diagnostics import ConvergenceDiagnostics
from bwbayes.sampling.plan import SamplingPlan
from tests.app import small
from tests.app.conftest import Type
from tests.app.steps import Steps
from tests.inference.problems import short_posterior


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
        check = ConvergenceDiagnostics(
            steps, rhats, enough, enough, enough, autocorrelation, 0.4, stuck
        )
        self.show("sampling", check)
        return self.eta

    @property
    def eta(self) -> float:
        """The seconds that the line says are left; infinite if it does not say."""
        text = self.show.line("sampling").split("ETA ")[1].removeprefix("at most ").split()[0]
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


def test_until_an_end_is_in_sight_the_eta_is_that_of_a_limit(watched: Watched) -> None:
    """The burn-in's; then the budget's while draws disagree, or where the end is beyond it."""
    plan = watched.show.plan
    watched.block(10.0)
    assert "burn-in 2% of at most 3000 steps   ETA at most 9:50" in watched.show.line("pilot")
    for rhat, is_limit in ((1.3, True), (1.0, False)):
        seconds = watched.check(100, 500.0, rhat)
        assert is_limit is ("ETA at most" in watched.show.line("sampling"))
        assert seconds == (0.2 * (plan.max_steps - 100) if is_limit else 0.2 * 300)
    watched.check(100, 1.0)
    assert "ETA at most" in watched.show.line("sampling")


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


def test_a_terminal_says_for_how_long_a_step_takes_by_itself() -> None:
    """Once a second brings nothing new, and not before; a moment later the line is gone."""
    screen = StringIO()
    console = Console(force_terminal=True, width=100, file=screen)
    with ProgressLine(console, "judging ring ..."):
        time.sleep(2.4)
    shown = re.findall(r"judging ring \.\.\.(?: *elapsed (\d:\d\d))?", screen.getvalue())
    assert ["", "0:01", "0:02"] == list(dict.fromkeys(shown))
    assert screen.getvalue().rstrip().endswith("\x1b[2K")


@pytest.mark.parametrize("seconds", [0.5, 30.0])
def test_what_says_more_than_how_long_says_that_alone(
    monkeypatch: pytest.MonkeyPatch, seconds: float
) -> None:
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    line = ProgressLine(Console(force_terminal=True, file=StringIO()), "judging ...")
    now[0] += 10
    line.show("judging 10%   ETA 1:30")
    now[0] += seconds
    elapsed = "   elapsed 0:40" if seconds > 1 else ""
    assert f"judging 10%   ETA 1:30{elapsed}" == line.get_renderable().plain


def test_a_log_has_each_step_once() -> None:
    log = StringIO()
    console = Console(width=100, file=log)
    with ProgressLine(console, "judging ring ..."):
        time.sleep(1.2)
    assert "judging ring ...\n" == log.getvalue()


@pytest.mark.parametrize("quiet", [True, False])
def test_what_others_print_goes_where_it_belongs(
    capsys: pytest.CaptureFixture[str], quiet: bool
) -> None:
    """Whether the line is there or not; what is printed into a file does not go to the terminal."""
    with ProgressLine(Console(force_terminal=True, quiet=quiet, file=StringIO()), "judging ..."):
        print("printed")
    assert "printed\n" == capsys.readouterr().out


@pytest.mark.parametrize("terminal", [True, False])
def test_of_many_calls_it_says_how_many_before_the_first_is_done(terminal: bool) -> None:
    screen = StringIO()
    console = Console(force_terminal=terminal, width=100, file=screen)
    options: dict[str, Any] = {
        "kind": "models judged",
        "done": 0,
        "short": {},
        "workers": 1,
        "executor": "threads",
    }
    for _ in batch(time.sleep, [(0.6,)], lambda _: "", console=console, **options):
        pass
    assert "models judged 0 of 1   ETA unknown" in screen.getvalue()


def test_of_many_calls_it_says_what_is_being_done_before_the_first_is_done(tmp_path: Path) -> None:
    """As the first call keeps it in a file; nothing of it is said of the second."""
    screen, note = StringIO(), tmp_path / "note"

    def work(number: int) -> int:
        with StepProgress(LastLine(note), f"record {number} ...") as watch:
            time.sleep(1.2)
            watch("MAP estimate", 0.25)
            time.sleep(1.2)
        return number

    done = batch(
        work,
        [(1,), (2,)],
        lambda _: "",
        console=Console(force_terminal=True, width=100, file=screen),
        kind="record",
        done=0,
        short={},
        workers=1,
        executor="threads",
        doing=note.read_text,
    )
    assert [1, 2] == list(done)
    assert "record 0 of 2   record 1 ..." in screen.getvalue()
    assert re.search(r"record 0 of 2   MAP estimate 25%   ETA 0:0[345]", screen.getvalue())
    assert "record 2 ..." not in screen.getvalue()


COMMANDS = {
    "simulate": ("new.csv", "--rate", "50", "--signal", "step50"),
    "init": ("record.csv",),
    "check": ("small.toml",),
    "report": ("copy",),
    "predict": ("copy", "--signal", "step50", "--from-rest"),
    "compensate": ("copy", "sine", "--amplitude", "20", "--frequency", "1", "--from-rest"),
    "export": ("copy",),
}


@pytest.mark.usefixtures("copy", "_without_pictures", "_without_explanations")
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_that_takes_its_time_has_a_line_on_a_terminal(
    bwbayes: Type, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    (tmp_path / "small.toml").write_text(small.TEXT)
    rows = [f"{i / 100},{5 * (i % 7)},{2 * (i % 7)}" for i in range(60)]
    (tmp_path / "record.csv").write_text("\n".join(["time_s,voltage_V,displacement_um", *rows]))
    silent = bwbayes(command, *COMMANDS[command])
    assert f"{command} ..." not in silent.err
    (tmp_path / "record.toml").unlink(missing_ok=True)
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes it for a terminal
    said = bwbayes(command, *COMMANDS[command], *again(command))
    assert said.status == silent.status
    assert re.search(rf"{command} \.\.\.|\d%   ETA", said.err)
    if command == "compensate":
        assert "" == bwbayes(command, *COMMANDS[command], *again(command), "--quiet").err


def again(command: str) -> tuple[str, ...]:
    return () if command in ("init", "check", "report") else ("--overwrite",)


JOBS: dict[str, tuple[str, tuple[object, ...], dict[str, object], tuple[str, ...]]] = {
    "predict": ("predict:predict", (), {"signal": "step50", "from_rest": True}, ("predictions",)),
    "predict after": ("predict:predict", (), {"signal": "step50", "after": True}, ("predictions",)),
    "compensate": (
        "control:compensate",
        ("sine",),
        {"amplitude": 20.0, "frequency": 1.0, "from_rest": True},
        ("predicted error",),
    ),
    "design": ("design:design", ("beta",), {}, ("candidates",)),
    "track": (
        "control:track",
        (),
        {"frequencies": (5.0, 10.0), "draws": 3, "rate": 100.0},
        ("feed-forward", "closed loops"),
    ),
}


@pytest.mark.parametrize("job", JOBS)
def test_every_job_tells_what_share_of_its_steps_is_done(copy: RunFolder, job: str) -> None:
    where, arguments, options, names = JOBS[job]
    module, _, name = where.partition(":")
    steps = Steps()
    call = getattr(import_module(f"bwbayes.app.jobs.{module}"), name)
    call(open_converged(copy.path), *arguments, **options, watch=steps)
    steps.require(*names)


@pytest.mark.usefixtures("_without_pictures")
def test_a_check_tells_what_share_of_its_steps_is_done(tmp_path: Path) -> None:
    steps = Steps()
    check(small.config(), tmp_path, tmp_path / "out", steps)
    chosen = "MAP estimate", "noise model", "stages, round 1", "models that were not chosen"
    steps.require(*chosen, "figures")


@pytest.mark.usefixtures("_without_pictures")
def test_a_run_tells_what_share_is_done_until_its_last_file(copy: RunFolder) -> None:
    copy.result.unlink()
    copy.search.unlink(missing_ok=True)  # else the explanations are there already
    steps = Steps()
    open_finished(copy).compute(steps)
    steps.require(
        "predictions",
        "innovations",
        "loops",
        "explanations",
        "information gain",
        "posterior checks",
        "remarks",
    )
    written = Steps()
    redraw(copy, written)
    written.require("files", "figures")


@pytest.mark.parametrize("samples", [100, 100_000], ids=["thinned", "whole"])
def test_a_map_estimate_tells_what_share_is_done(
    monkeypatch: pytest.MonkeyPatch, samples: int
) -> None:
    monkeypatch.setattr(map_estimate, "SAMPLES", samples)
    shares: list[float] = []
    map_estimate.fit(short_posterior(samples=400), np.random.default_rng(1), shares.append)
    assert shares == sorted(shares)
    assert 1.0 == shares[-1]
    # It moves before all is done, and from its first steps on.
    assert 4 <= len({share for share in shares if share < 1.0})
    assert 4 <= len({share for share in shares if share < 0.5})
