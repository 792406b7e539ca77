"""One ensemble of walkers, some steps further: the unit of work of a sampling.

:func:`advance` is a pure function of the posterior and an :class:`EnsembleState`, random state
included. So it does not matter where, when or in which order ensembles run: a run with two
workers, or one that was interrupted and goes on, gives the same bits.
:func:`advance_together` moves several at once, and makes one call of the density for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from emcee.moves import Move
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.chain import Block, EnsembleState
from bwbayes.sampling.walking import Steps, walk

__all__ = [
    "advance",
    "advance_together",
    "start",
]

# Starts lie this many posterior sds from an optimum, in a cluster of a fraction of one.
FAR = 10.0
TIGHT = 0.2
TRIALS = 100


def start(
    posterior: Posterior,
    point: PointFit,
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
    direction *= FAR / np.linalg.norm(direction)
    for _ in range(TRIALS):
        tight = min(TIGHT, float(np.linalg.norm(direction)))
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
    return EnsembleState(coordinates, log_density, _pack(random.get_state()))


def advance(
    posterior: Posterior, moves: Sequence[tuple[Move, float]], state: EnsembleState, steps: int
) -> Block:
    """Move an ensemble ``steps`` steps on, by emcee's ``moves`` with their weights.

    Each step takes one of the moves at random, for all walkers.
    """
    return advance_together(posterior, [moves], [state], steps)[0]


def advance_together(
    posterior: Posterior,
    moves: Sequence[Sequence[tuple[Move, float]]],
    states: Sequence[EnsembleState],
    steps: int,
) -> list[Block]:
    """Move several ensembles on, each by ``moves`` of its own, with one density call for all.

    Each is moved as :func:`advance` moves it alone, and its random numbers are its own: bit for bit
    where a density does not depend on the others of its batch, to rounding where it does (the
    compiled engine decides for groups of models when their noise has settled). On a short record a
    call costs more than the models in it, so that four ensembles cost little more than one.
    """
    randoms = [_generator(state.random_state) for state in states]
    walks = [
        walk(ensemble_moves, state.coordinates, state.log_density, random, steps)
        for ensemble_moves, state, random in zip(moves, states, randoms, strict=True)
    ]
    finished: dict[int, Steps] = {}
    # Far away a proposal may overflow: such a place has no density.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        proposed = {number: next(walk) for number, walk in enumerate(walks)}
        while proposed:
            density = _log_density(posterior, np.concatenate([*proposed.values()]))
            ends = np.cumsum([len(places) for places in proposed.values()])[:-1]
            answers = zip([*proposed], np.split(density, ends), strict=True)
            proposed = {}
            for number, answer in answers:
                try:
                    proposed[number] = walks[number].send(answer)
                except StopIteration as end:
                    finished[number] = end.value
    return [_block(finished[number], random) for number, random in enumerate(randoms)]


def _log_density(posterior: Posterior, coordinates: FloatArray) -> FloatArray:
    """Log density (models,) at coordinates (models, free), −∞ where they are not finite.

    Without a proper posterior walkers go there sooner or later.
    """
    finite = np.isfinite(coordinates).all(axis=1)
    if finite.all():
        return posterior.log_density(coordinates)
    density: FloatArray = np.full(len(coordinates), -np.inf)
    if finite.any():
        density[finite] = posterior.log_density(coordinates[finite])
    return density


def _block(steps: Steps, random: np.random.RandomState) -> Block:
    end = EnsembleState(
        steps.coordinates[-1].copy(), steps.log_density[-1].copy(), _pack(random.get_state())
    )
    return Block(steps.coordinates, steps.log_density, steps.accepted, steps.moves, end)


def _pack(state: tuple[str, NDArray[np.uint32], int, int, float]) -> NDArray[np.uint32]:
    _, words, position, has_normal, normal = state
    position_and_flag = np.array([position, has_normal], dtype=np.uint32)
    return np.concatenate([words, position_and_flag, np.array([normal]).view(np.uint32)])


def _generator(words: NDArray[np.uint32]) -> np.random.RandomState:
    """Return the generator in that state."""
    normal = float(np.ascontiguousarray(words[626:628]).view(np.float64)[0])
    random = np.random.RandomState(np.random.MT19937(0))
    random.set_state(("MT19937", words[:624], int(words[624]), int(words[625]), normal))
    return random
