"""A posterior, sampled as a run does it."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from bwbayes.app.running.workers import one_thread, open_executor
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import generator
from bwbayes.sampling.chain import Chain
from bwbayes.sampling.diagnostics import SamplingResult
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.sampler import init_chain, sample


def sampled(
    posterior: Posterior, plan: SamplingPlan, seed: int, workers: int = 1
) -> tuple[SamplingResult, Chain]:
    with one_thread(), open_executor(workers, posterior.engine) as pool:
        point = pointfit.fit(posterior, generator(seed, "point fit"))
        chain = init_chain(posterior, point, plan, generator(seed, "sampling"))
        return sample(posterior, plan, chain, pool), chain


def converged(posterior: Posterior, plan: SamplingPlan, seed: int = 1) -> Chain:
    """Return the chain of a posterior that must converge."""
    source = np.random.default_rng(seed)
    with ThreadPoolExecutor(1) as pool, one_thread():
        chain = init_chain(posterior, pointfit.fit(posterior, source), plan, source)
        outcome = sample(posterior, plan, chain, pool)
    assert outcome.converged, outcome.stop_reason
    return chain
