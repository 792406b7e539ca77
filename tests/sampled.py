"""A problem's posterior, sampled as a run does it."""

from __future__ import annotations

from bwbayes.app.problem.problem import Problem, generator
from bwbayes.app.running.workers import executor, one_thread
from bwbayes.inference import map_estimate as pointfit
from bwbayes.sampling.chain import Chain
from bwbayes.sampling.diagnostics import Outcome
from bwbayes.sampling.sampler import first_chain, sample


def sampled(problem: Problem, workers: int = 1) -> tuple[Outcome, Chain]:
    """Return how the sampling ended, and the chain."""
    posterior, seed = problem.posterior, problem.config.seed
    with one_thread(), executor(workers, posterior.engine) as pool:
        point = pointfit.fit(posterior, generator(seed, "point fit"))
        chain = first_chain(posterior, point, problem.plan, generator(seed, "sampling"))
        return sample(posterior, problem.plan, chain, pool), chain
