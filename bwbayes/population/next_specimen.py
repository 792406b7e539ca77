"""A specimen that was not measured: draws of all its parameters, to be predicted as any other's.

The actuator's parameters are those of the population, drawn independently of each other; noise and
what belongs to one record are as in a specimen that was measured.
"""

from __future__ import annotations

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.population.population import Population

__all__ = ["next_specimen"]

# Part of the draws that the model's constraints must leave.
LEAST = 0.1


def next_specimen(
    population: Population, posterior: Posterior, draws: FloatArray, generator: np.random.Generator
) -> FloatArray:
    """Return draws of a specimen not measured yet, (draws, free), in their own units.

    Parameters
    ----------
    population
        What the specimens have shown.
    posterior
        That of one of them, for the order of the parameters and the model's constraints; draws
        that break these are left out.
    draws
        (draws, free) of its parameters: noise and all that belongs to one record comes from there.
    generator
        Pairs them.

    Raises
    ------
    InputError
        The constraints leave hardly a draw.
    """
    prior = posterior.prior
    count = next(iter(population.parameters.values())).new.size
    specimens = draws[generator.choice(len(draws), count, replace=len(draws) < count)].copy()
    for column, parameter in enumerate(prior.free):
        if parameter.name in population.parameters:
            specimens[:, column] = population.parameters[parameter.name].new
    possible = specimens[np.isfinite(prior.log_density(specimens))]
    if len(possible) < LEAST * count:
        raise InputError("population: hardly a draw of it is a model; look at outliers and priors")
    return possible
