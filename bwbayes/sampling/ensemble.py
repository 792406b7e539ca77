"""Ensembles of walkers, some steps further: the unit of work of a sampling.

:func:`advance` is a pure function of the posterior and each :class:`EnsembleState`, random state
included. So it does not matter where, when or in which order ensembles run: a run with two
workers, or one that was interrupted and resumes, gives the same bits. The steps themselves are
those of ``emcee.EnsembleSampler`` with the given emcee moves.
"""

from __future__ import annotations

from collections.abc import Sequence

import emcee
import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.chain import (
    Block,
    EnsembleState,
    pack_random_state,
    unpack_random_state,
)
from bwbayes.sampling.moves import Counted, WeightedMoves


def start(
    posterior: Posterior,
    point: MAPEstimate,
    number: int,
    walkers: int,
    generator: np.random.Generator,
) -> EnsembleState:
    """Start an ensemble as a tight cluster at its own far point.

    The optima of the point fit take turns; from there the point lies ten posterior sds off in a
    random direction (nearer where the density is zero, and at last tighter), so that ensembles
    agree only after they have reached the same posterior.

    Raises
    ------
    InputError
        There is no place for a cluster, however near.
    """
    axes = np.linalg.cholesky(point.covariance)
    optimum = point.optima[number % len(point.optima)]
    direction = generator.standard_normal(optimum.size)
    direction *= 10.0 / np.linalg.norm(direction)
    for _ in range(100):
        tight = min(0.2, float(np.linalg.norm(direction)))
        cluster = direction + tight * generator.standard_normal((walkers, optimum.size))
        coordinates = optimum + cluster @ axes.T
        log_density = posterior.log_density(coordinates)
        if np.isfinite(log_density).all():
            break
        direction /= 2
    else:
        raise InputError(
            "sampling: no place for walkers around the point fit, where the posterior density must "
            "be finite; check priors and record"
        )
    random = np.random.RandomState(np.random.MT19937(generator.integers(2**63)))
    return EnsembleState(coordinates, log_density, pack_random_state(random.get_state()))


def advance(
    posterior: Posterior,
    states: Sequence[EnsembleState],
    moves: Sequence[WeightedMoves],
    steps: int,
) -> list[Block]:
    """Advance ensembles by ``steps`` steps, one after the other, each by its item of ``moves``.

    Each step takes one of an ensemble's moves at random, with its weight, for all walkers.
    """
    return [
        _run(posterior, state, weighted, steps)
        for state, weighted in zip(states, moves, strict=True)
    ]


class _Sampler(emcee.EnsembleSampler):  # type: ignore[misc]  # emcee has no types
    """emcee's sampler; it gives a place that is not finite no density, where emcee would end.

    A proposal far away may overflow. Without a proper posterior walkers get there in the end.
    """

    def compute_log_prob(self, coords: FloatArray) -> tuple[FloatArray, None]:
        """Return the log density of coordinates (walkers, free)."""
        finite = np.isfinite(coords).all(axis=1)
        log_prob = np.full(len(coords), -np.inf)
        if finite.any():
            log_prob[finite], _ = super().compute_log_prob(coords[finite])
        return log_prob, None


def _run(posterior: Posterior, state: EnsembleState, moves: WeightedMoves, steps: int) -> Block:
    walkers, free = state.coordinates.shape
    counted = {name: (Counted(move), weight) for name, (move, weight) in moves.items()}
    sampler = _Sampler(
        walkers, free, posterior.log_density, moves=[*counted.values()], vectorize=True
    )
    begin = emcee.State(
        state.coordinates,
        log_prob=state.log_density,
        random_state=unpack_random_state(state.random_state),
    )
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        end = sampler.run_mcmc(begin, steps, skip_initial_state_check=True)
    return Block(
        sampler.get_chain(),
        sampler.get_log_prob(),
        sampler.backend.accepted.astype(np.int64),
        {name: (move.proposed, move.accepted) for name, (move, _) in counted.items()},
        EnsembleState(end.coords, end.log_prob, pack_random_state(end.random_state)),
    )
