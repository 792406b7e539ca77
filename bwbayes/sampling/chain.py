"""The chain of a sampling: the steps of every ensemble, block by block.

A :class:`Chain` keeps it in memory; :class:`~bwbayes.sampling.storage.ChainFile` writes it to files
as well. The blocks of the pilot and the tuning are kept apart from those that count, and so are
blocks of the sampling whose proposal turned out not to cover the posterior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.sampling.proposals import StudentMixture
from bwbayes.shown import brief

if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior

# Largest number of draws of all walkers in checks and reports; longer chains are thinned by powers
# of two. Chains get that long because their steps are highly correlated.
MOST_DRAWS = 2**19

Phase = Literal["pilot", "tuning", "sampling"]
PHASES: tuple[Phase, ...] = ("pilot", "tuning", "sampling")


# A generator's state in emcee's form: kind, 624 words, position, flag and value of a kept normal.
RandomState = tuple[str, NDArray[np.uint32], int, int, float]


def unpack_random_state(words: NDArray[np.uint32]) -> RandomState:
    """Return the state of a generator that :func:`pack_random_state` has packed."""
    normal = float(np.ascontiguousarray(words[626:628]).view(np.float64)[0])
    return "MT19937", words[:624], int(words[624]), int(words[625]), normal


def pack_random_state(state: RandomState) -> NDArray[np.uint32]:
    """Return a generator's state, (628,): 624 words, position, flag and value of a kept normal."""
    _, words, position, has_normal, normal = state
    position_and_flag = np.array([position, has_normal], dtype=np.uint32)
    return np.concatenate([words, position_and_flag, np.array([normal]).view(np.uint32)])


@dataclass(frozen=True)
class EnsembleState:
    """State of an ensemble.

    ``coordinates`` (walkers, free), ``log_density`` (walkers,) and ``random_state`` (628,), the
    words of emcee's generator.
    """

    __repr__ = brief

    coordinates: FloatArray
    log_density: FloatArray
    random_state: NDArray[np.uint32]


@dataclass(frozen=True)
class Block:
    """A block of steps of an ensemble.

    ``coordinates`` (steps, walkers, free), ``log_density`` (steps, walkers), the number of
    ``accepted`` moves (walkers,), ``moves`` with the numbers of proposals to a walker and of
    acceptances by the move's name, and the ``end`` state, from which the ensemble goes on.
    """

    coordinates: FloatArray
    log_density: FloatArray
    accepted: IntArray
    moves: Mapping[str, tuple[int, int]]
    end: EnsembleState


class Chain:
    """Blocks of all ensembles, in three phases.

    Parameters
    ----------
    starts
        The state that each ensemble starts from.

    Attributes
    ----------
    proposals
        The proposal that was fitted for each phase, if any.
    set_aside
        Blocks at the beginning of the sampling that do not count, because their proposal turned
        out not to cover the posterior.
    refit
        The proposal that was then fitted to them, if any.
    """

    __repr__ = brief

    def __init__(self, starts: Sequence[EnsembleState]) -> None:
        self.starts = tuple(starts)
        self.proposals: dict[Phase, StudentMixture | None] = dict.fromkeys(PHASES)
        self.set_aside = 0
        self.refit: StudentMixture | None = None
        self._blocks: dict[Phase, list[tuple[Block, ...]]] = {phase: [] for phase in PHASES}

    def freeze(self, phase: Phase, proposal: StudentMixture | None) -> None:
        """Fix the proposal of a phase, before its first block."""
        self.proposals[phase] = proposal

    def fall_back(self, blocks: int, refit: StudentMixture | None = None) -> None:
        """Set the first blocks of the sampling aside: they count no longer.

        The sampling goes on with a proposal fitted to them, or without any.
        """
        self.set_aside, self.refit = blocks, refit

    def proposal_in_use(self, phase: Phase) -> StudentMixture | None:
        """Return the proposal that a phase goes on with."""
        return self.refit if phase == "sampling" and self.set_aside else self.proposals[phase]

    def append(self, phase: Phase, blocks: Sequence[Block]) -> None:
        """Add the next block of every ensemble."""
        self._blocks[phase].append(tuple(blocks))

    def publish(self) -> None:
        """Let others read the draws that count so far; a chain in memory does nothing."""

    def blocks(self, phase: Phase) -> int:
        """Return the number of blocks of each ensemble, without those that were set aside."""
        return len(self._counting(phase))

    def history(self, phase: Phase) -> tuple[tuple[Block, ...], ...]:
        """Return all blocks of a phase, those that were set aside first."""
        return tuple(self._blocks[phase])

    def steps(self, phase: Phase) -> int:
        """Return the number of steps of each ensemble."""
        return sum(len(blocks[0].coordinates) for blocks in self._counting(phase))

    @property
    def ends(self) -> tuple[EnsembleState, ...]:
        """The state that each ensemble goes on from."""
        done = [blocks for phase in PHASES for blocks in self._blocks[phase]]
        return tuple(block.end for block in done[-1]) if done else self.starts

    def draws(self, phase: Phase, blocks: int | None = None) -> int:
        """Return the number of draws of all walkers, in the first ``blocks`` blocks or in all."""
        return sum(b.log_density.size for row in self._counting(phase)[:blocks] for b in row)

    def coordinates(self, phase: Phase, thin: int = 1, blocks: int | None = None) -> FloatArray:
        """Return unconstrained draws (steps, ensembles, walkers, free), every ``thin``-th step.

        The draws are those of the first ``blocks`` blocks that count, or of all.
        """
        return self._joined(phase, "coordinates", thin, blocks)

    def log_density(self, phase: Phase, thin: int = 1, blocks: int | None = None) -> FloatArray:
        """Return the log density (steps, ensembles, walkers), nats, of :meth:`coordinates`."""
        return self._joined(phase, "log_density", thin, blocks)

    def accepted(self, phase: Phase) -> IntArray:
        """Return the accepted moves of each block, (blocks, ensembles, walkers)."""
        return np.array([[block.accepted for block in blocks] for blocks in self._counting(phase)])

    def moves(self, phase: Phase) -> dict[str, tuple[int, int]]:
        """Return the numbers of proposals to a walker and of acceptances by kind of move.

        Kinds that were never proposed are left out.
        """
        totals: dict[str, tuple[int, int]] = {}
        for blocks in self._counting(phase):
            for block in blocks:
                for name, (proposed, accepted) in block.moves.items():
                    before = totals.get(name, (0, 0))
                    totals[name] = before[0] + proposed, before[1] + accepted
        return {name: counts for name, counts in totals.items() if counts[0]}

    def _counting(self, phase: Phase) -> list[tuple[Block, ...]]:
        """Return the blocks that count."""
        return self._blocks[phase][self.set_aside if phase == "sampling" else 0 :]

    def _joined(self, phase: Phase, name: str, thin: int, count: int | None) -> FloatArray:
        parts, done = [], 0
        for blocks in self._counting(phase)[:count]:
            arrays = [getattr(block, name) for block in blocks]
            first = -(done + 1) % thin  # take steps, counted from one, that thin divides
            parts.append(np.stack([values[first::thin] for values in arrays], axis=1))
            done += len(arrays[0])
        return np.concatenate(parts)


def thinning(draws: int, limit: int | None = None) -> int:
    """Return the thinning of so many draws: a power of two.

    At most ``limit`` draws remain, ``MOST_DRAWS`` by default.
    """
    thin = 1
    while draws > (limit or MOST_DRAWS) * thin:
        thin *= 2
    return thin


def draws(
    posterior: Posterior,
    chain: Chain,
    phase: Phase = "sampling",
    covariances: tuple[FloatArray, FloatArray] | None = None,
) -> FloatArray:
    """Return a chain's draws in their own units, (steps, ensembles, walkers, free).

    Long chains are thinned by powers of two, to ``MOST_DRAWS`` draws at most. With ``covariances``
    (free, free), of the posterior and a larger one, the draws are widened, see
    :func:`~bwbayes.inference.voltage_noise.widen_draws`; a draw that the prior would exclude then
    stays as sampled.
    """
    coordinates = chain.coordinates(phase, thinning(chain.draws(phase)))
    if covariances is not None:
        from bwbayes.inference.voltage_noise import widen_draws  # noqa: PLC0415  # slow to load

        wide = widen_draws(coordinates, *covariances)
        _, log_prior = posterior.prior.constrain(wide.reshape(-1, wide.shape[-1]))
        possible = np.isfinite(log_prior).reshape(*wide.shape[:-1], 1)
        coordinates = np.where(possible, wide, coordinates)
    return constrain_steps(posterior, coordinates)


def log_densities(chain: Chain, phase: Phase = "sampling") -> FloatArray:
    """Return the log density of :func:`draws`, (steps, ensembles, walkers), nats."""
    return chain.log_density(phase, thinning(chain.draws(phase)))


def constrain_steps(posterior: Posterior, coordinates: FloatArray) -> FloatArray:
    """Return coordinates (steps, ensembles, walkers, free) in their own units."""
    flat, _ = posterior.prior.constrain(coordinates.reshape(-1, coordinates.shape[-1]))
    return flat.reshape(coordinates.shape)
