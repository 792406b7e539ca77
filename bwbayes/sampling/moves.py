"""Moves of the walkers.

Differential evolution steps along the difference of two other walkers, so it follows any ridge the
ensemble lies on; a snooker step now and then helps between modes. Neither needs tuning, and they
bring the pilot to the posterior, where half of its steps try places of the point fit's own guess.
Once the pilot is there, a mixture of Student-t distributions fitted to its draws, and bent as they
are, proposes places independently of where a walker is, which mixes about ten times faster. The fit
is frozen before the draws that count, and a seventh of the steps remain differential evolution and
snooker, so that walkers reach the places that the fit does not cover, and leave them again.

An ensemble takes some steps by ``emcee.EnsembleSampler`` with these moves: :func:`advance` is a
pure function of the posterior and each :class:`EnsembleState`, random state included. So it does
not matter where, when or in which order ensembles run: a run with two workers, or one that was
interrupted and resumes, gives the same bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import repeat
from typing import Any, NamedTuple

import emcee
import numpy as np
from emcee import moves
from emcee.model import Model
from numpy.typing import NDArray

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.chain import (
    Block,
    EnsembleState,
    pack_random_state,
    unpack_random_state,
)
from bwbayes.sampling.proposals import StudentMixture

# Moves of emcee with their weights, by their name in reports.
WeightedMoves = Mapping[str, tuple[moves.Move, float]]


class SnookerMove(moves.RedBlueMove):  # type: ignore[misc]  # emcee has no types
    """A step along the line through another walker, as long as two more are apart on that line.

    With the unit vector e from walker z to x, and walkers z₁, z₂, all of the half at rest,

        x' = x + 1.7 e (e·z₁ − e·z₂),   log factor (p − 1) log(|x' − z| / |x − z|),

    after ter Braak and Vrugt (2008), Statistics and Computing 18, 435-446. The way back swaps z₁
    and z₂, and is as likely as the way there. It stands in for ``emcee.moves.DESnookerMove``, which
    in emcee up to 3.1.6 takes half of the logarithm and makes a posterior of nine parameters a
    fifth too narrow.
    """

    def get_proposal(
        self, moving: FloatArray, others: list[FloatArray], random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose for ``moving`` (walkers, free), given the walkers of the other half."""
        resting, count = np.concatenate(others), len(moving)
        number, first = random.randint(len(resting), size=(2, count))
        second = (first + random.randint(1, len(resting), size=count)) % len(resting)
        z, z1, z2 = resting[number], resting[first], resting[second]
        away = moving - z
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        direction = away / distance
        along = np.sum(direction * (z1 - z2), axis=1, keepdims=True)
        # On the line through z the new distance is known up to its sign.
        proposed = distance + 1.7 * along
        factor = (moving.shape[1] - 1) * (np.log(np.abs(proposed)) - np.log(distance))
        return z + proposed * direction, factor[:, 0]


class IndependenceMove(moves.Move):  # type: ignore[misc]  # emcee has no types
    """A step to one of several tries that a proposal q draws independently of the walker.

    With w = π/q, tries x₁ … xₙ drawn from q, and the walker at x₀, one of them is chosen with the
    probability wᵢ / (w₁ + … + wₙ), and accepted with

        min(1, (w₁ + … + wₙ) / (w₀ + … + wₙ − wᵢ)),

    after Liu (1996), Biometrika 83, 681-682. A walker where q is too small by a factor leaves n
    times as soon. One try is a Metropolis-Hastings step. It is a move of emcee like any other:
    ``emcee.EnsembleSampler(..., moves=[(IndependenceMove(proposal), 0.9), (DEMove(), 0.1)])``.

    Parameters
    ----------
    proposal
        q.
    tries
        n, for each walker and step.
    ahead
        Number of steps whose tries are drawn at once, since they do not depend on the walkers: on a
        short record a call of the density costs more than the models in it.
    """

    def __init__(self, proposal: StudentMixture, tries: int = 1, ahead: int = 1) -> None:
        self.proposal, self.tries, self.ahead = proposal, tries, ahead
        self._drawn: list[_Tries] = []
        self._left: tuple[FloatArray, FloatArray] | None = None
        self._log_prob_fn: object = None

    def propose(self, model: Model, state: emcee.State) -> tuple[emcee.State, BoolArray]:
        """Propose for all walkers, as the interface of emcee's moves requires."""
        walkers = len(state.coords)
        if model.log_prob_fn is not self._log_prob_fn:
            # Another sampler may have another density, or other walkers.
            self._drawn, self._left, self._log_prob_fn = [], None, model.log_prob_fn
        if not self._drawn:
            self._drawn = [*self._draw(model, walkers)]
        tries = self._drawn.pop(0)
        if self._left is not None and np.array_equal(self._left[0], state.coords):
            here = self._left[1]  # log w₀ of walkers as this move left them
        else:
            here = state.log_prob - self.proposal.log_density(state.coords)
        which, accepted, log_weight = self.choose(
            here, tries.log_weight, model.random.rand(walkers)
        )
        rows = np.arange(walkers)
        proposed = emcee.State(
            tries.coords[which, rows],
            log_prob=tries.log_prob[which, rows],
            blobs=None if tries.blobs is None else tries.blobs[which, rows],
        )
        state = self.update(state, proposed, accepted)
        self._left = state.coords.copy(), np.where(accepted, log_weight, here)
        return state, accepted

    def choose(
        self, here: FloatArray, weight: FloatArray, chance: FloatArray
    ) -> tuple[IntArray, BoolArray, FloatArray]:
        """Choose for each walker, at log w₀ (walkers,), one of log wᵢ (tries, walkers).

        Returns its index, whether it is accepted, and its log weight, each (walkers,). One uniform
        number decides both: it falls into the part of the range that belongs to a try, and its
        position within that part is again uniform.
        """
        rows = np.arange(here.size)
        largest = np.maximum(np.max(weight, axis=0), here)
        parts = np.exp(weight - largest)
        ends = np.cumsum(parts, axis=0)
        point = chance * ends[-1]
        which = np.minimum(np.sum(point >= ends, axis=0), len(weight) - 1)
        share, chosen = parts[which, rows], weight[which, rows]
        others = ends[-1] - share + np.exp(here - largest)
        accepted = (point - (ends[which, rows] - share)) * others < share * ends[-1]
        return which, accepted, chosen

    def _draw(self, model: Model, walkers: int) -> Iterator[_Tries]:
        """Draw the tries of the next steps, and compute their densities at once."""
        count = self.ahead * self.tries * walkers
        coords, log_density = self.proposal.evaluate(self.proposal.draw(model.random, count))
        log_prob, blobs = model.compute_log_prob_fn(coords)
        shape = self.ahead, self.tries, walkers
        yield from map(
            _Tries,
            coords.reshape(*shape, -1),
            log_prob.reshape(shape),
            (log_prob - log_density).reshape(shape),
            repeat(None) if blobs is None else blobs.reshape(*shape, *blobs.shape[1:]),
        )


class _Tries(NamedTuple):
    """Tries of a step: ``coords`` (tries, walkers, free), log π and log w (tries, walkers).

    ``blobs`` (tries, walkers, ...) are what the density returns beside log π, as emcee has it.
    """

    coords: FloatArray
    log_prob: FloatArray
    log_weight: FloatArray
    blobs: NDArray[Any] | None


class Counted(moves.Move):  # type: ignore[misc]
    """Another move, with the numbers of its proposals to walkers and of its acceptances."""

    def __init__(self, move: moves.Move) -> None:
        self.move, self.proposed, self.accepted = move, 0, 0

    def propose(self, model: Model, state: emcee.State) -> tuple[emcee.State, BoolArray]:
        """Make the other move's proposal, and count it."""
        state, accepted = self.move.propose(model, state)
        self.proposed += accepted.size
        self.accepted += int(np.count_nonzero(accepted))
        return state, accepted


def pilot_moves(proposal: StudentMixture | None = None, ahead: int = 1) -> WeightedMoves:
    """Return moves and weights for the pilot: half of its steps use a first guess, if any."""
    share = 0.0 if proposal is None else 0.5
    return _weighted_moves(share, proposal, ahead=ahead)


def sampling_moves(
    proposal: StudentMixture | None, tries: int = 1, ahead: int = 1
) -> WeightedMoves:
    """Return moves and weights for the draws that count; without a proposal, those of the pilot."""
    share = 0.0 if proposal is None else 0.85
    return _weighted_moves(share, proposal, tries, ahead)


def _weighted_moves(
    share: float, proposal: StudentMixture | None, tries: int = 1, ahead: int = 1
) -> WeightedMoves:
    """Return differential evolution and snooker, and a ``share`` of the independence move.

    emcee divides the weights by their sum.
    """
    weighted = {
        "differential evolution": (moves.DEMove(), 0.8 * (1 - share)),
        "snooker": (SnookerMove(), 0.2 * (1 - share)),
    }
    if proposal is not None:
        weighted["mixture"] = IndependenceMove(proposal, tries, ahead), share
    return weighted


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
