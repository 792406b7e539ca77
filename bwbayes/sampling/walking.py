"""How an ensemble walks: emcee's moves, one step after the other, asking for densities as it goes.

A walk is a generator. It yields the places whose density it needs next and is sent the densities,
so whoever drives several walks can work out in one call what all of them ask for. A walk draws its
random numbers from its own generator in the order in which emcee does, and is the same walk whether
it is alone or not.

Where an independence proposal stands does not depend on where the walkers are. So steps in a row
that make one are proposed all together, their densities are asked for at once, and only then is it
decided, step by step, who goes where.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np
from emcee.moves import MHMove, Move, RedBlueMove
from numpy.typing import NDArray

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.sampling.moves import AmongPlaces
from bwbayes.sampling.proposals import Proposal

__all__ = ["Steps", "Walk", "walk"]

# Yields places (count, free), is sent their log densities (count,).
Walk = Generator[FloatArray, FloatArray, "Steps"]
_Step = Generator[FloatArray, FloatArray, None]


@dataclass
class Steps:
    """Steps that are made: places (steps, walkers, free), log densities (steps, walkers).

    ``accepted`` counts each walker's moves, ``moves`` (kinds, 2) how often each kind was proposed
    to a walker and accepted; ``done`` are the steps so far.
    """

    coordinates: FloatArray
    log_density: FloatArray
    accepted: IntArray
    moves: IntArray
    done: int = 0

    def add(self, kind: int, place: FloatArray, density: FloatArray, accepted: BoolArray) -> None:
        """Add the step after which the walkers are here."""
        self.coordinates[self.done] = place
        self.log_density[self.done] = density
        self.accepted += accepted
        self.moves[kind] += accepted.size, np.count_nonzero(accepted)
        self.done += 1


def walk(
    moves: Sequence[tuple[Move, float]],
    coordinates: FloatArray,
    log_density: FloatArray,
    random: np.random.RandomState,
    steps: int,
) -> Walk:
    """Walk ``steps`` steps on from coordinates (walkers, free) with log densities (walkers,).

    Each step takes one of the moves at random, with its weight, for all walkers.

    Raises
    ------
    InputError
        A move that is neither emcee's ``RedBlueMove`` nor its ``MHMove``.
    """
    walkers, free = coordinates.shape
    made = Steps(
        np.empty((steps, walkers, free)),
        np.empty((steps, walkers)),
        np.zeros(walkers, dtype=np.int64),
        np.zeros((len(moves), 2), dtype=np.int64),
    )
    place, density = coordinates.copy(), log_density.copy()
    chosen = _Choice([weight for _, weight in moves], random)
    while made.done < steps:
        kind = chosen.next()
        move = moves[kind][0]
        if isinstance(move, RedBlueMove):
            accepted = yield from _split_step(move, place, density, random)
            made.add(kind, place, density, accepted)
        elif not isinstance(move, MHMove):
            raise InputError(f"moves: {type(move).__name__} is neither a RedBlueMove nor an MHMove")
        elif isinstance(move.get_proposal, Proposal):
            yield from _independent_steps(move, kind, chosen, place, density, made)
        else:
            proposed, factor = move.get_proposal(place, random)
            offered = yield proposed
            accepted = np.log(random.rand(walkers)) < offered - density + factor
            _go(place, density, accepted, proposed, offered)
            made.add(kind, place, density, accepted)
    return made


class _Choice:
    """Draws which kind of move comes next, as emcee does, and can look one step ahead."""

    def __init__(self, weights: Sequence[float], random: np.random.RandomState) -> None:
        parts = np.cumsum(np.asarray(weights, dtype=np.float64) / np.sum(weights))
        self.parts, self.random = (parts / parts[-1]).tolist(), random
        self.ahead: int | None = None

    def next(self) -> int:
        """Return the kind of the next step."""
        kind, self.ahead = self.ahead, None
        return self._drawn() if kind is None else kind

    def is_next(self, kind: int) -> bool:
        """Tell whether the next step is of that kind; if so, it is taken."""
        self.ahead = self._drawn()
        if self.ahead != kind:
            return False
        self.ahead = None
        return True

    def _drawn(self) -> int:
        uniform = self.random.random_sample()
        return next(kind for kind, end in enumerate(self.parts) if uniform < end)


def _split_step(
    move: RedBlueMove, place: FloatArray, density: FloatArray, random: np.random.RandomState
) -> Generator[FloatArray, FloatArray, BoolArray]:
    """Move one split of the walkers after the other, in place; return who has moved."""
    walkers = len(place)
    move.setup(place)
    splits = np.arange(walkers) % move.nsplits
    if move.randomize_split:
        random.shuffle(splits)
    rows = [np.flatnonzero(splits == split) for split in range(move.nsplits)]
    accepted = np.zeros(walkers, dtype=bool)
    for split, mine in enumerate(rows):
        others = [place[rows[other]] for other in range(move.nsplits) if other != split]
        proposed, factor = move.get_proposal(place[mine], others, random)
        offered = yield proposed
        moved = factor + offered - density[mine] > np.log(random.rand(mine.size))
        goers = mine[moved]
        place[goers], density[goers] = proposed[moved], offered[moved]
        accepted[goers] = True
    return accepted


def _independent_steps(
    move: MHMove, kind: int, chosen: _Choice, place: FloatArray, density: FloatArray, made: Steps
) -> _Step:
    """Make a step of an independence proposal, and all further ones that follow at once."""
    (walkers, free), random, proposal = place.shape, chosen.random, move.get_proposal
    among = move if isinstance(move, AmongPlaces) else AmongPlaces(proposal)
    proposed, chances = [], []
    while True:
        proposed.append(proposal.draw(random, among.places * walkers))
        chances.append(random.rand(walkers))
        if made.done + len(chances) == len(made.coordinates) or not chosen.is_next(kind):
            break
    every = np.concatenate([place, *proposed])
    weight = -proposal.log_density(every)
    offered = yield every[walkers:]
    here = density + weight[:walkers]
    weight = (offered + weight[walkers:]).reshape(-1, among.places, walkers)
    offered = offered.reshape(weight.shape)
    every = every[walkers:].reshape(*weight.shape, free)
    rows = np.arange(walkers)
    for step, chance in enumerate(chances):
        one, accepted, taken = among.choose(here, weight[step], chance)
        _go(place, density, accepted, every[step, one, rows], offered[step, one, rows])
        np.copyto(here, taken, where=accepted)
        made.add(kind, place, density, accepted)


def _go(
    place: FloatArray,
    density: FloatArray,
    accepted: BoolArray | NDArray[np.bool_],
    proposed: FloatArray,
    offered: FloatArray,
) -> None:
    """Let those who accepted go where it was proposed."""
    np.copyto(place, proposed, where=accepted[:, np.newaxis])
    np.copyto(density, offered, where=accepted)
