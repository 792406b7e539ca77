"""What a person sees while a run samples: how far, how fast, how long still, how well.

On a terminal one line is kept up to date; elsewhere (a log file, a pipe) a line is printed now and
then. Quiet means nothing at all.
"""

from __future__ import annotations

import time

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.text import Text

from bwbayes.inference.chain import Phase
from bwbayes.inference.diagnostics import LENGTH, Check
from bwbayes.inference.sampling import SamplingPlan

__all__ = ["Progress"]

# Seconds between lines where there is no terminal.
PAUSE = 10.0


class Progress:
    """Watches a sampling; use it as a context manager and as the sampler's watcher."""

    def __init__(self, console: Console, plan: SamplingPlan) -> None:
        self.console, self.plan = console, plan
        self.begun = self.printed = time.monotonic()
        self.done = 0
        self.check: Check | None = None
        self.live = Live(console=console, transient=True) if console.is_terminal else None

    def __enter__(self) -> Progress:
        if self.live:
            self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.live:
            self.live.stop()

    def __call__(self, phase: Phase, found: Check | None) -> None:
        """Take note of a finished block of one ensemble, or of a check."""
        self.check = found or self.check
        self.done += found is None
        line = self.line(phase)
        now = time.monotonic()
        if self.live:
            self.live.update(Text(line))
        elif found is not None and now - self.printed >= PAUSE:
            self.printed = now
            self.console.print(line, highlight=False, soft_wrap=True)

    def line(self, phase: Phase) -> str:
        """Return the line that is shown."""
        elapsed = max(time.monotonic() - self.begun, 1e-9)
        steps = self.done * self.plan.block / self.plan.ensembles
        rate = steps * self.plan.ensembles * self.plan.walkers / elapsed
        if self.check is None:
            return f"{phase:9} {steps:6.0f} steps   {rate:6.0f} models/s   ensembles are converging"
        check = self.check
        fewest = float(np.min([check.ess_bulk, check.ess_tail]))
        return (
            f"sampling  {check.steps:6d} steps   {rate:6.0f} models/s   "
            f"ETA {self._remaining(steps / elapsed)}   acceptance {check.acceptance:.2f}   "
            f"R-hat {np.max(check.rhat):.3f}   ESS {fewest:.0f} of {self.plan.ess:.0f}"
        )

    def _remaining(self, steps_per_second: float) -> str:
        """Guess from the effective draws per step so far, and from the autocorrelation time."""
        assert self.check is not None
        fewest = float(np.min([self.check.ess_bulk, self.check.ess_tail]))
        wanted = self.check.steps * self.plan.ess / fewest if fewest > 0 else np.inf
        wanted = max(wanted, LENGTH * float(np.max(self.check.autocorrelation)))
        left = min(wanted, self.plan.most_steps) - self.check.steps
        # A run that goes on is judged before its first step.
        if not (np.isfinite(left) and steps_per_second > 0):
            return "unknown"
        seconds = left / steps_per_second
        minutes, rest = divmod(max(round(seconds), 0), 60)
        return f"{minutes}:{rest:02d}"
