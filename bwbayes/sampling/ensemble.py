"""Ensembles of walkers, some steps further: the unit of work of a sampling.

:func:`advance` is a pure function of the posterior and each :class:`EnsembleState`, random state
included. So it does not matter where, when or in which order ensembles run: a run with two
workers, or one that was interrupted and goes on, gives the same bits.

An ensemble walks as a generator: it yields the places whose density it needs next and is sent the
densities, so that one call of the density serves all ensembles that move together. It draws its
random numbers in the order in which emcee does. Where an independence proposal stands does not
depend on where the walkers are, so steps in a row that make one are proposed all together, their
densities are asked for at once, and only then is it decided, step by step, who goes where.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence

import numpy as np
from emcee.moves import RedBlueMove
from numpy.typing import NDArray

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference.map_estimate import PointFit
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.chain import Block, EnsembleState
from bwbayes.sampling.moves import AmongPlaces, Weighted


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
    return EnsembleState(coordinates, log_density, _words(random))


def advance(
    posterior: Posterior,
    moves: Sequence[Weighted],
    states: Sequence[EnsembleState],
    steps: int,
) -> list[Block]:
    """Move ensembles ``steps`` steps on, each by ``moves`` of its own, with one density call.

    Each step takes one of an ensemble's moves at random, with its weight, for all walkers. An
    ensemble moves as it does alone: bit for bit where a density does not depend on the others of
    its batch, to rounding where it does (a record's are worked out for groups of models, whose
    noise settles together). On a short record a call costs more than the models in it, so that
    four ensembles cost little more than one.
    """
    walks = [_walk(weighted, state, steps) for weighted, state in zip(moves, states, strict=True)]
    blocks: dict[int, Block] = {}
    # Far away a proposal may overflow: such a place has no density.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        proposed = {number: next(walk) for number, walk in enumerate(walks)}
        while proposed:
            places = np.concatenate([*proposed.values()])
            # Without a proper posterior walkers come to places that are not finite sooner or later.
            finite = np.isfinite(places).all(axis=1)
            density = np.full(len(places), -np.inf)
            if finite.any():
                density[finite] = posterior.log_density(places[finite])
            ends = np.cumsum([len(proposal) for proposal in proposed.values()])[:-1]
            answers = zip([*proposed], np.split(density, ends), strict=True)
            proposed = {}
            for number, answer in answers:
                try:
                    proposed[number] = walks[number].send(answer)
                except StopIteration as end:
                    blocks[number] = end.value
    return [blocks[number] for number in range(len(walks))]


class _Path:
    """Where the walkers of an ensemble are, and the steps behind them."""

    def __init__(self, state: EnsembleState, steps: int, kinds: int) -> None:
        self.here, self.density = state.coordinates.copy(), state.log_density.copy()
        # The state is as `_words` lays it out.
        words = state.random_state
        normal = float(np.ascontiguousarray(words[626:628]).view(np.float64)[0])
        self.random = np.random.RandomState(np.random.MT19937(0))
        self.random.set_state(("MT19937", words[:624], int(words[624]), int(words[625]), normal))
        walkers, free = self.here.shape
        self.coordinates = np.empty((steps, walkers, free))
        self.log_density = np.empty((steps, walkers))
        self.accepted: IntArray = np.zeros(walkers, dtype=np.int64)
        self.moves: IntArray = np.zeros((kinds, 2), dtype=np.int64)
        self.done = 0

    @property
    def is_complete(self) -> bool:
        return self.done == len(self.coordinates)

    def step(self, kind: int, accepted: BoolArray, places: FloatArray, density: FloatArray) -> None:
        """Let those who accepted go where it was proposed, and add the step."""
        np.copyto(self.here, places, where=accepted[:, np.newaxis])
        np.copyto(self.density, density, where=accepted)
        self.coordinates[self.done], self.log_density[self.done] = self.here, self.density
        self.accepted += accepted
        self.moves[kind] += accepted.size, np.count_nonzero(accepted)
        self.done += 1

    def block(self) -> Block:
        end = EnsembleState(self.here, self.density, _words(self.random))
        return Block(self.coordinates, self.log_density, self.accepted, self.moves, end)


# Yields places (count, free), is sent their log densities (count,).
_Walk = Generator[FloatArray, FloatArray, Block]


def _walk(moves: Weighted, state: EnsembleState, steps: int) -> _Walk:
    """Walk ``steps`` steps on."""
    path = _Path(state, steps, len(moves))
    random = path.random
    ends = np.cumsum([weight for _, weight in moves])
    ends = (ends / ends[-1]).tolist()

    def choose() -> int:
        uniform = random.random_sample()
        return next(kind for kind, end in enumerate(ends) if uniform < end)

    kind = choose()
    while True:
        move = moves[kind][0]
        following = None
        if isinstance(move, AmongPlaces):
            proposed, chances = [], []
            while following in (None, kind):
                proposed.append(move.proposal.draw(random, move.places * len(path.here)))
                chances.append(random.rand(len(path.here)))
                if path.done + len(chances) == steps:
                    break
                following = choose()
            yield from _independent_steps(move, kind, path, proposed, chances)
        else:
            yield from _split_step(move, kind, path)
        if path.is_complete:
            return path.block()
        kind = choose() if following is None else following


def _split_step(
    move: RedBlueMove, kind: int, path: _Path
) -> Generator[FloatArray, FloatArray, None]:
    """Move one split of the walkers after the other."""
    random = path.random
    places, density = path.here.copy(), path.density.copy()
    move.setup(places)
    splits = np.arange(len(places)) % move.nsplits
    if move.randomize_split:
        random.shuffle(splits)
    accepted = np.zeros(len(places), dtype=bool)
    for split in range(move.nsplits):
        movers = np.flatnonzero(splits == split)
        others = [places[splits == other] for other in range(move.nsplits) if other != split]
        proposed, factor = move.get_proposal(places[movers], others, random)
        offered = yield proposed
        moved = factor + offered - density[movers] > np.log(random.rand(movers.size))
        goers = movers[moved]
        places[goers], density[goers], accepted[goers] = proposed[moved], offered[moved], True
    path.step(kind, accepted, places, density)


def _independent_steps(
    move: AmongPlaces,
    kind: int,
    path: _Path,
    proposed: Sequence[FloatArray],
    chances: Sequence[FloatArray],
) -> Generator[FloatArray, FloatArray, None]:
    """Make steps of an independence proposal, whose straight places are known already."""
    walkers, free = path.here.shape
    here = path.density - move.proposal.log_density(path.here)
    places, log_density = move.proposal.evaluate(np.concatenate(proposed))
    offered = yield places
    shape = (len(chances), move.places, walkers)
    weight = (offered - log_density).reshape(shape)
    offered, places = offered.reshape(shape), places.reshape(*shape, free)
    rows = np.arange(walkers)
    for step, chance in enumerate(chances):
        which, accepted, log_weight = move.choose(here, weight[step], chance)
        path.step(kind, accepted, places[step, which, rows], offered[step, which, rows])
        np.copyto(here, log_weight, where=accepted)


def _words(random: np.random.RandomState) -> NDArray[np.uint32]:
    """Return a generator's state, (628,): 624 words, position, and the normal number it kept."""
    _, words, position, has_normal, normal = random.get_state()
    position_and_flag = np.array([position, has_normal], dtype=np.uint32)
    return np.concatenate([words, position_and_flag, np.array([normal]).view(np.uint32)])
