"""Progress lines: the current step, its share, the time left and the state of the sampling.

On a terminal one line is kept up to date, which says for how long where nothing else is new;
elsewhere (a log file, a pipe) a line is printed now and then. Quiet means nothing at all.
:func:`batch` makes many calls side by side, with such a line.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Self

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.text import Text

from bwbayes.app.running.workers import open_executor, side_by_side
from bwbayes.sampling.chain import Phase
from bwbayes.sampling.diagnostics import LENGTH, ConvergenceDiagnostics
from bwbayes.sampling.plan import SamplingPlan


class LastLine(Console):
    """A console of which a file has the last line, for another process to show."""

    def __init__(self, path: Path) -> None:
        super().__init__(quiet=True)
        self.path = path

    def print(self, *objects: object, **_: object) -> None:
        """Keep a line; a disk that is full stops nothing."""
        with suppress(OSError):
            self.path.write_text(" ".join(map(str, objects)), encoding="utf-8")


class ProgressLine(Live):
    """A line that is kept up to date on a terminal, and printed every ten seconds elsewhere.

    It begins with the ``step`` that it is about, which is printed at once elsewhere if that is
    ``announced``. A terminal says for how long it has been at it wherever a second brings nothing
    new.
    """

    def __init__(self, console: Console, step: str = "", *, announced: bool = True) -> None:
        self.shown, self.step, self.announced = step, step, announced
        self.started_at = self.printed = self.shown_at = time.monotonic()
        redrawn = console.is_terminal and not console.quiet
        self.every = 1.0 if isinstance(console, LastLine) else 10.0  # s
        super().__init__(
            console=console,
            transient=True,
            auto_refresh=redrawn,
            # Other output goes above the line, unless there is no line or the output is a file.
            redirect_stdout=redrawn and sys.stdout.isatty(),
            redirect_stderr=redrawn,
        )

    def __enter__(self) -> Self:
        """Begin with the step."""
        if self.step and self.announced and not self.console.is_terminal:
            self.console.print(self.step, highlight=False, soft_wrap=True)
        return super().__enter__()

    def show(self, line: str, *, printed: bool = True) -> None:
        """Show a line; without a terminal only if it may be ``printed`` and the time has come."""
        now = time.monotonic()
        self.shown, self.shown_at = line, now
        if not self.console.is_terminal and printed and now - self.printed >= self.every:
            self.printed = now
            self.console.print(line, highlight=False, soft_wrap=True)

    def get_renderable(self) -> Text:
        """Return the line as it is now."""
        now = time.monotonic()
        elapsed = f"   elapsed {_minutes(now - self.started_at)}"
        return Text(self.shown + elapsed * bool(self.shown and now - self.shown_at >= 1.0))


class StepProgress(ProgressLine):
    """Watches steps, one after the other, of which the share that is done is known."""

    def __init__(self, console: Console, step: str = "", *, announced: bool = True) -> None:
        super().__init__(console, step, announced=announced)
        self.latest = self.started_at

    def __call__(self, step: str, share: float) -> None:
        """Take note of how much of a step is done, from 0 to 1."""
        if step != self.step:
            self.step, self.started_at = step, self.latest
        self.latest = time.monotonic()
        elapsed = self.latest - self.started_at
        remaining = _minutes(elapsed * (1 - share) / share) if share else "unknown"
        self.show(f"{step} {share:.0%}   ETA {remaining}")


class Progress(ProgressLine):
    """Watches a sampling; use it as a context manager and as the sampler's watcher."""

    def __init__(self, console: Console, plan: SamplingPlan) -> None:
        super().__init__(console, "sampling ...", announced=False)
        self.plan = plan
        self.steps = 0.0  # of all ensembles together, since this was made
        self.check: ConvergenceDiagnostics | None = None
        self.end: float | None = None  # when it will be done, by the check; of a monotonic clock
        self.is_latest = False  # whether that is when its budget ends

    def __call__(self, phase: Phase, check: ConvergenceDiagnostics | None) -> None:
        """Take note of a finished block of one ensemble, or of a check."""
        if check is None:
            self.steps += self.plan.block / self.plan.ensembles
        else:
            self.check, self.end = check, None
            # No end but the budget's is in sight while the draws disagree, which more of them may
            # or may not cure.
            needed = np.inf
            if not check.disagreements() and check.lowest_ess > 0:
                needed = check.steps * self.plan.ess / check.lowest_ess
                needed = max(needed, LENGTH * float(np.max(check.autocorrelation)))
            self.is_latest = not needed < self.plan.max_steps
            if self.steps:  # a run that goes on is checked before its first step
                remaining = max(min(needed, self.plan.max_steps) - check.steps, 0)
                now = time.monotonic()
                self.end = now + remaining * (now - self.started_at) / self.steps
        self.show(self.line(phase), printed=check is not None)

    def line(self, phase: Phase) -> str:
        """Return the line that is shown."""
        elapsed = max(time.monotonic() - self.started_at, 1e-9)
        rate = self.steps * self.plan.ensembles * self.plan.walkers / elapsed
        if self.check is None:
            limit = self.plan.max_pilot_steps
            share = min(self.steps / limit, 1.0)
            remaining = _minutes(elapsed * (1 - share) / share) if share else "unknown"
            return (
                f"{phase:9} {self.steps:6.0f} steps   {rate:6.0f} evaluations/s   "
                f"burn-in {share:.0%} of at most {limit} steps   ETA at most {remaining}"
            )
        check = self.check
        # It counts down to the end that was forecast at the last check.
        remaining = "unknown" if self.end is None else _minutes(self.end - time.monotonic())
        remaining = f"{'at most ' * self.is_latest}{remaining}"
        cover = "no mixture" if check.pareto_k is None else f"Pareto k {check.pareto_k:.2f}"
        return (
            f"sampling  {check.steps:6d} steps   {rate:6.0f} evaluations/s   "
            f"ETA {remaining}   acceptance {check.acceptance:.2f}   "
            f"R-hat {np.max(check.rhat):.3f}   ESS {check.lowest_ess:.0f} of {self.plan.ess:.0f}   "
            f"{cover}"
        )


def _minutes(seconds: float) -> str:
    minutes, remainder = divmod(max(round(seconds), 0), 60)
    return f"{minutes}:{remainder:02d}"


def batch[T](
    call: Callable[..., T],
    arguments: Sequence[tuple[object, ...]],
    label: Callable[[T], str],
    *,
    console: Console,
    kind: str,
    done: int,
    short: Mapping[str, int],
    workers: int | None,
    executor: str | Executor | None,
    doing: Callable[[], str] = lambda: "",
) -> Iterator[T]:
    """Call a function with each of the arguments, and yield each result as soon as it is there.

    ``label`` says what a result is short of, if anything; ``done`` and ``short`` count those of
    this ``kind`` that were there before. Until the first result, ``doing`` says every second what
    is being done. They go into processes, also with the compiled engine: most of their time goes
    into Python.
    """
    if not arguments:
        return
    count, total = min(workers or os.cpu_count() or 1, len(arguments)), done + len(arguments)
    short = dict(short)
    begin, fresh = f"{kind} {done} of {total}", 0
    unknown = f"{begin}   ETA unknown"
    with open_executor(count, executor=executor) as pool, ProgressLine(console, unknown) as line:

        def show() -> None:
            if not fresh and (text := doing()):
                line.show(f"{begin}   {text}")

        together = side_by_side(pool, workers, len(arguments))
        for result in _as_done(pool, together, call, arguments, show):
            fresh += 1
            yield result
            if label(result):
                short[label(result)] += 1
            rate = fresh / max(time.monotonic() - line.started_at, 1e-9)
            counts = "   ".join(f"{name} {number}" for name, number in short.items())
            line.show(
                f"{kind} {done + fresh} of {total}   {60 * rate:.1f} a minute   "
                f"ETA {_minutes((len(arguments) - fresh) / rate)}   {counts}"
            )


def _as_done[T](
    executor: Executor,
    together: int,
    call: Callable[..., T],
    arguments: Iterable[tuple[object, ...]],
    show: Callable[[], None],
) -> Iterator[T]:
    """Yield each result as soon as it is there; ``show`` is called each second without any.

    Only so many ``together`` are under way, so that whoever stops waits for those alone.
    """
    waiting = iter(arguments)
    running: set[Future[T]] = set()
    while True:
        running |= {executor.submit(call, *a) for a in islice(waiting, together - len(running))}
        if not running:
            return
        done, running = wait(running, timeout=1.0, return_when=FIRST_COMPLETED)
        yield from (future.result() for future in done)
        if not done:
            show()
