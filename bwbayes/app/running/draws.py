"""A run's draws, and what noise on the voltages adds to them."""

from __future__ import annotations

import json

import numpy as np

from bwbayes.app.problem.problem import Problem
from bwbayes.app.problem.records import generator
from bwbayes.arrays import FloatArray
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.voltage_noise import path_covariance, widen_draws
from bwbayes.sampling.chain import constrain_steps, draws, thinning
from bwbayes.sampling.storage import ChainFile
from bwbayes.watching import Watch, unwatched

# What a chain notes it by: (free, free), in unconstrained coordinates.
VOLTAGE_NOISE = "voltage_noise_covariance"


def voltage_noise(problem: Problem, point: MAPEstimate, watch: Watch = unwatched) -> dict[str, str]:
    """Return what a chain notes of what noise on the voltages leaves unsure; nothing without."""
    paths = {name: record.path for name, record in problem.records.items()}
    if not any(path.noise_sd for path in paths.values()):
        return {}
    source = generator(problem.config.seed, "voltage noise")
    covariance = path_covariance(problem.posterior, paths, point, source, watch)
    return {VOLTAGE_NOISE: json.dumps(covariance.tolist())}


def run_draws(problem: Problem, chain: ChainFile) -> FloatArray:
    """Return a run's draws in their own units, (steps, ensembles, walkers, free).

    Those of its chain, or wider by what noise on the voltages leaves unsure; where the prior allows
    no such place, as sampled.
    """
    noted = chain.attributes().get(VOLTAGE_NOISE)
    if noted is None:
        return draws(problem.posterior, chain)
    more = np.array(json.loads(str(noted)))
    coordinates = chain.coordinates("sampling", thinning(chain.draws("sampling")))
    wide = widen_draws(coordinates, chain.point.covariance, more)
    _, log_prior = problem.posterior.prior.constrain(wide.reshape(-1, len(more)))
    possible = np.isfinite(log_prior).reshape(*wide.shape[:-1], 1)
    return constrain_steps(problem.posterior, np.where(possible, wide, coordinates))
