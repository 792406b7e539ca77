"""One ensemble of walkers, some steps further: the unit of work of a sampling.

:func:`advance` is a pure function of the posterior and an :class:`EnsembleState`, random state
included. So it does not matter where, when or in which order ensembles run: a run with two
workers, or one that was interrupted and goes on, gives the same bits. Only this module and the
moves know emcee.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import emcee
import numpy as np
from emcee.moves import Move
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.posterior import Posterior

__all__ = [
    "RANDOM_STATE_WORDS",
    "Block",
    "EnsembleState",
    "advance",
    "autocorrelation_time",
    "start",
]

# Mersenne twister: 624 words, position, whether a normal number is left over, and that number.
RANDOM_STATE_WORDS = 628

# Starts lie this many posterior sds from an optimum, in a cluster of a fraction of one.
FAR = 10.0
TIGHT = 0.2


@dataclass(frozen=True)
class EnsembleState:
    """Where an ensemble stands.

    ``coordinates`` (walkers, free), ``log_density`` (walkers,) and ``random_state`` (628,), the
    words of emcee's generator.
    """

    coordinates: FloatArray
    log_density: FloatArray
    random_state: NDArray[np.uint32]


@dataclass(frozen=True)
class Block:
    """What an ensemble did.

    ``coordinates`` (steps, walkers, free), ``log_density`` (steps, walkers), ``accepted``
    (walkers,) moves, and the ``end`` it goes on from.
    """

    coordinates: FloatArray
    log_density: FloatArray
    accepted: IntArray
    end: EnsembleState


def start(
    posterior: Posterior,
    point: PointFit,
    number: int,
    walkers: int,
    generator: np.random.Generator,
) -> EnsembleState:
    """Start an ensemble as a tight cluster at its own far point.

    The optima of the point fit take turns; from there the point lies ten posterior sds off in a
    random direction (nearer where the density is zero), so that ensembles agree only after they
    have found the same posterior.
    """
    axes = np.linalg.cholesky(point.covariance)
    optimum = point.optima[number % len(point.optima)]
    direction = generator.standard_normal(optimum.size)
    direction *= FAR / np.linalg.norm(direction)
    while True:
        cluster = direction + TIGHT * generator.standard_normal((walkers, optimum.size))
        coordinates = optimum + cluster @ axes.T
        log_density = posterior.log_density(coordinates)
        if np.isfinite(log_density).all():
            break
        direction /= 2
    random = np.random.RandomState(np.random.MT19937(generator.integers(2**63)))
    return EnsembleState(coordinates, log_density, _pack(random.get_state()))


def advance(
    posterior: Posterior, moves: Sequence[tuple[Move, float]], state: EnsembleState, steps: int
) -> Block:
    """Move an ensemble ``steps`` steps on, by emcee's ``moves`` with their weights."""
    walkers, free = state.coordinates.shape
    sampler = emcee.EnsembleSampler(
        walkers, free, posterior.log_density, vectorize=True, moves=list(moves)
    )
    begin = emcee.State(
        state.coordinates,
        log_prob=state.log_density,
        random_state=_unpack(state.random_state),
        copy=True,
    )
    # Clusters are tight at first: emcee's check of their spread would refuse them.
    last = sampler.run_mcmc(begin, steps, skip_initial_state_check=True)
    return Block(
        sampler.get_chain(),
        sampler.get_log_prob(),
        sampler.backend.accepted.astype(np.int64),
        EnsembleState(last.coords, last.log_prob, _pack(last.random_state)),
    )


def autocorrelation_time(draws: FloatArray) -> FloatArray:
    """Integrated autocorrelation time (free,) in steps of draws (steps, walkers, free).

    It is nan where it cannot be told, for instance where nothing moves.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        time: FloatArray = emcee.autocorr.integrated_time(draws, tol=0, quiet=True)
    return time


def _pack(state: tuple[str, NDArray[np.uint32], int, int, float]) -> NDArray[np.uint32]:
    _, words, position, has_normal, normal = state
    rest = np.array([position, has_normal], dtype=np.uint32)
    return np.concatenate([words, rest, np.array([normal]).view(np.uint32)])


def _unpack(words: NDArray[np.uint32]) -> tuple[str, NDArray[np.uint32], int, int, float]:
    normal = float(np.ascontiguousarray(words[626:628]).view(np.float64)[0])
    return "MT19937", words[:624], int(words[624]), int(words[625]), normal
