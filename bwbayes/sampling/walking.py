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

    def add(
        self, kind: int, coordinates: FloatArray, density: FloatArray, accepted: BoolArray
    ) -> None:
        """Add the step after which the walkers are here."""
        self.coordinates[self.done] = coordinates
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
    path = Steps(
        np.empty((steps, walkers, free)),
        np.empty((steps, walkers)),
        np.zeros(walkers, dtype=np.int64),
        np.zeros((len(moves), 2), dtype=np.int64),
    )
    here, density = coordinates.copy(), log_density.copy()
    chosen = _MoveChooser([weight for _, weight in moves], random)
    while path.done < steps:
        kind = chosen.next()
        move = moves[kind][0]
        if isinstance(move, RedBlueMove):
            accepted = yield from _split_step(move, here, density, random)
            path.add(kind, here, density, accepted)
        elif not isinstance(move, MHMove):
            raise InputError(f"moves: {type(move).__name__} is neither a RedBlueMove nor an MHMove")
        elif isinstance(move.get_proposal, Proposal):
            yield from _independent_steps(move, kind, chosen, here, density, path)
        else:
            proposed, factor = move.get_proposal(here, random)
            offered = yield proposed
            accepted = np.log(random.rand(walkers)) < offered - density + factor
            _move_accepted(here, density, accepted, proposed, offered)
            path.add(kind, here, density, accepted)
    return path


class _MoveChooser:
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
    move: RedBlueMove, here: FloatArray, density: FloatArray, random: np.random.RandomState
) -> Generator[FloatArray, FloatArray, BoolArray]:
    """Move one split of the walkers after the other, in place; return who has moved."""
    walkers = len(here)
    move.setup(here)
    splits = np.arange(walkers) % move.nsplits
    if move.randomize_split:
        random.shuffle(splits)
    rows = [np.flatnonzero(splits == split) for split in range(move.nsplits)]
    accepted = np.zeros(walkers, dtype=bool)
    for split, movers in enumerate(rows):
        others = [here[rows[other]] for other in range(move.nsplits) if other != split]
        proposed, factor = move.get_proposal(here[movers], others, random)
        offered = yield proposed
        moved = factor + offered - density[movers] > np.log(random.rand(movers.size))
        goers = movers[moved]
        here[goers], density[goers] = proposed[moved], offered[moved]
        accepted[goers] = True
    return accepted


def _independent_steps(
    move: MHMove,
    kind: int,
    chosen: _MoveChooser,
    coordinates: FloatArray,
    density: FloatArray,
    path: Steps,
) -> _Step:
    """Make a step of an independence proposal, and all further ones that follow at once."""
    (walkers, free), random, proposal = coordinates.shape, chosen.random, move.get_proposal
    among = move if isinstance(move, AmongPlaces) else AmongPlaces(proposal)
    proposed, chances = [], []
    while True:
        proposed.append(proposal.draw(random, among.places * walkers))
        chances.append(random.rand(walkers))
        if path.done + len(chances) == len(path.coordinates) or not chosen.is_next(kind):
            break
    places = np.concatenate([coordinates, *proposed])
    weight = -proposal.log_density(places)
    offered = yield places[walkers:]
    here = density + weight[:walkers]
    weight = (offered + weight[walkers:]).reshape(-1, among.places, walkers)
    offered = offered.reshape(weight.shape)
    places = places[walkers:].reshape(*weight.shape, free)
    rows = np.arange(walkers)
    for step, chance in enumerate(chances):
        which, accepted, log_weight = among.choose(here, weight[step], chance)
        _move_accepted(
            coordinates, density, accepted, places[step, which, rows], offered[step, which, rows]
        )
        np.copyto(here, log_weight, where=accepted)
        path.add(kind, coordinates, density, accepted)


def _move_accepted(
    here: FloatArray,
    density: FloatArray,
    accepted: BoolArray | NDArray[np.bool_],
    proposed: FloatArray,
    offered: FloatArray,
) -> None:
    """Let those who accepted go where it was proposed."""
    np.copyto(here, proposed, where=accepted[:, np.newaxis])
    np.copyto(density, offered, where=accepted)
