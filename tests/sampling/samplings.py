"""A sampling of a small Gaussian to its end, to be interrupted, watched and compared."""

from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.chain import Chain, Phase
from bwbayes.sampling.diagnostics import ConvergenceDiagnostics, SamplingResult
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.sampler import ProgressCallback, init_chain, sample
from tests.sampling.targets import gaussian

PLAN = SamplingPlan(
    ess=400, walkers=12, block=20, min_pilot_steps=100, max_pilot_steps=400, max_steps=1000
)
LONG = replace(PLAN, max_steps=4_000)
POSTERIOR, POINT = gaussian(3)


def new_chain(plan: SamplingPlan = PLAN) -> Chain:
    return init_chain(POSTERIOR, POINT, plan, np.random.default_rng(1))


def run(
    plan: SamplingPlan = PLAN,
    seed: int = 1,
    posterior: Posterior = POSTERIOR,
    point: MAPEstimate = POINT,
    watcher: ProgressCallback = lambda *_: None,
) -> tuple[Chain, SamplingResult]:
    chain = init_chain(posterior, point, plan, np.random.default_rng(seed))
    with ThreadPoolExecutor(1) as executor:
        return chain, sample(posterior, plan, chain, executor, watcher)


class Watched:
    """The calls of a watch."""

    def __init__(self) -> None:
        self.blocks: list[Phase] = []
        self.checks: list[ConvergenceDiagnostics] = []

    def __call__(self, phase: Phase, result: ConvergenceDiagnostics | None) -> None:
        """Hear of a block, or of a check."""
        if result is None:
            self.blocks.append(phase)
        else:
            assert "sampling" == phase
            self.checks.append(result)


class InterruptedRunError(Exception):
    """Somebody pulled the plug."""


class PluggedExecutor(Executor):
    """Runs calls at once, a given number of them, and then fails."""

    def __init__(self, calls: int) -> None:
        self.left = calls

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run, or fail."""
        if self.left == 0:
            raise InterruptedRunError
        self.left -= 1
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future
