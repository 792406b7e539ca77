"""What a person sees while a run samples: how far, how fast, how long still, how well.

On a terminal one line is kept up to date; elsewhere (a log file, a pipe) a line is printed now and
then. Quiet means nothing at all.
"""

from __future__ import annotations

import time
from collections import Counter
from typing import Self

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.text import Text

from bwbayes.sampling.chain import Phase
from bwbayes.sampling.diagnostics import LENGTH, Check
from bwbayes.sampling.plan import SamplingPlan

__all__ = ["CampaignProgress", "Progress", "ReplicateProgress"]

# Seconds between lines where there is no terminal.
PAUSE = 10.0


class _Line:
    """A line that is kept up to date on a terminal, and printed now and then elsewhere."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.begun = self.printed = time.monotonic()
        self.live = Live(console=console, transient=True) if console.is_terminal else None

    def __enter__(self) -> Self:
        if self.live:
            self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.live:
            self.live.stop()

    def show(self, line: str, *, printed: bool = True) -> None:
        """Show a line; without a terminal only if it may be ``printed`` and the time has come."""
        now = time.monotonic()
        if self.live:
            self.live.update(Text(line))
        elif printed and now - self.printed >= PAUSE:
            self.printed = now
            self.console.print(line, highlight=False, soft_wrap=True)


class ReplicateProgress(_Line):
    """Watches the replicates of a calibration, of which ``done`` are there and some missing."""

    def __init__(self, console: Console, done: int, missing: int, unconverged: int = 0) -> None:
        super().__init__(console)
        self.before = self.done = done
        self.total = done + missing
        self.unconverged = unconverged

    def __call__(self, converged: bool) -> None:
        """Take note of a finished replicate."""
        self.done += 1
        self.unconverged += not converged
        rate = (self.done - self.before) / max(time.monotonic() - self.begun, 1e-9)
        self.show(
            f"replicate {self.done} of {self.total}   {60 * rate:.1f} a minute   "
            f"ETA {_minutes((self.total - self.done) / rate)}   "
            f"not converged {self.unconverged}"
        )


class CampaignProgress(_Line):
    """Watches the records of a campaign, of which ``done`` are there and some missing."""

    def __init__(self, console: Console, done: int, missing: int) -> None:
        super().__init__(console)
        self.before = self.done = done
        self.total = done + missing
        self.short = Counter[str]()

    def __call__(self, short: str) -> None:
        """Take note of a record that came to its end, and of what it is short of, if anything."""
        self.done += 1
        self.short[short] += 1
        rate = (self.done - self.before) / max(time.monotonic() - self.begun, 1e-9)
        self.show(
            f"record {self.done} of {self.total}   {60 * rate:.1f} a minute   "
            f"ETA {_minutes((self.total - self.done) / rate)}   "
            f"not converged {self.short['not converged']}   refused {self.short['refused']}"
        )


class Progress(_Line):
    """Watches a sampling; use it as a context manager and as the sampler's watcher."""

    def __init__(self, console: Console, plan: SamplingPlan) -> None:
        super().__init__(console)
        self.plan = plan
        self.done = 0
        self.check: Check | None = None
        self.since = 0  # blocks of ensembles since the check
        self.end: float | None = None  # when it will be done, by the check; of a monotonic clock

    def __call__(self, phase: Phase, check: Check | None) -> None:
        """Take note of a finished block of one ensemble, or of a check."""
        self.done += check is None
        self.since += check is None
        if check is not None:
            self.check, self.since, self.end = check, 0, None
        if self.end is None:
            self.end = self._forecast()
        self.show(self.line(phase), printed=check is not None)

    def line(self, phase: Phase) -> str:
        """Return the line that is shown."""
        elapsed = max(time.monotonic() - self.begun, 1e-9)
        steps = self.done * self.plan.block / self.plan.ensembles
        rate = steps * self.plan.ensembles * self.plan.walkers / elapsed
        if self.check is None:
            return f"{phase:9} {steps:6.0f} steps   {rate:6.0f} models/s   ensembles are converging"
        check = self.check
        fewest = float(np.min([check.ess_bulk, check.ess_tail]))
        cover = "no mixture" if check.pareto_k is None else f"Pareto k {check.pareto_k:.2f}"
        return (
            f"sampling  {check.steps:6d} steps   {rate:6.0f} models/s   "
            f"ETA {self._remaining()}   acceptance {check.acceptance:.2f}   "
            f"R-hat {np.max(check.rhat):.3f}   ESS {fewest:.0f} of {self.plan.ess:.0f}   "
            f"{cover}"
        )

    def _remaining(self) -> str:
        """Count down to the end that was forecast at the last check."""
        return "unknown" if self.end is None else _minutes(self.end - time.monotonic())

    def _forecast(self) -> float | None:
        """Guess the end from the effective draws per step so far and the autocorrelation time.

        There is none while the draws disagree, which more of them may or may not cure; and a run
        that goes on is judged before its first step.
        """
        if self.check is None or not self.done or self.check.disagreements():
            return None
        fewest = float(np.min([self.check.ess_bulk, self.check.ess_tail]))
        needed = self.check.steps * self.plan.ess / fewest if fewest > 0 else np.inf
        needed = max(needed, LENGTH * float(np.max(self.check.autocorrelation)))
        if not np.isfinite(needed):
            return None
        each = self.plan.block / self.plan.ensembles
        left = min(needed, self.plan.most_steps) - self.check.steps - self.since * each
        now = time.monotonic()
        return now + max(left, 0) * (now - self.begun) / (self.done * each)


def _minutes(seconds: float) -> str:
    minutes, rest = divmod(max(round(seconds), 0), 60)
    return f"{minutes}:{rest:02d}"
