"""A chain on its way to convergence, judged again and again with more of its blocks each time.

To judge everything costs as much as many steps (:mod:`bwbayes.sampling.diagnostics`). How long the
chain is against its autocorrelation times, whether a walker is stuck, and whether the proposal
covers the draws, costs little: by that a :class:`ConvergenceMonitor` tells first how many blocks
are needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.chain import MOST_DRAWS, Chain, constrain_steps, thinning
from bwbayes.sampling.diagnostics import (
    LARGEST_PARETO_K,
    LENGTH,
    Check,
    check,
    pareto_k,
    stuck,
    times,
)
from bwbayes.shown import brief

__all__ = ["ConvergenceMonitor", "Outcome"]


@dataclass(frozen=True)
class Outcome:
    """How a sampling ended: ``converged`` or not, why, the last check, and what to know of it."""

    __repr__ = brief

    converged: bool
    stop_reason: str
    check: Check
    remarks: tuple[str, ...] = ()


class ConvergenceMonitor:
    """Judges the first blocks that count, each of which it prepares once; more of them each time.

    Of many draws it takes every second step, or every fourth, and so on, to bound its memory. How
    many is a function of the blocks that it judges, so that a run that goes on judges the same.

    Parameters
    ----------
    posterior
        What is sampled.
    chain
        Its chain.
    ess
        How many draws are to be effective.
    """

    def __init__(self, posterior: Posterior, chain: Chain, ess: float) -> None:
        self.posterior, self.chain = posterior, chain
        # Far more draws than are to be effective, so that none is missed.
        self.most = max(MOST_DRAWS, round(4 * ess))
        self.proposal = chain.proposal_in_use("sampling")
        self.prepared, self.thin = 0, 1
        self.draws: list[FloatArray] = []
        self.log_weights: list[FloatArray] = []
        self.times, self.pareto_k = np.empty(0), 0.0

    def blocks_needed(self, blocks: int, fraction: float) -> float:
        """Return how many blocks make a ``part`` of the autocorrelation times that are needed.

        By what the first ``blocks`` blocks say; more than these if a walker is stuck in them. None
        if the proposal does not cover them, because more would not help.
        """
        self._prepare(blocks)
        if not self.pareto_k < LARGEST_PARETO_K:
            return 0.0
        more = blocks + 1.0 if stuck(self._accepted(blocks), self._block, self.times) else 0.0
        return max(more, fraction * LENGTH * float(np.max(self.times)) / self._block)

    def __call__(self, blocks: int) -> Check:
        """ConvergenceMonitor the first ``blocks`` blocks."""
        self._prepare(blocks)
        (draws,) = self.draws
        latest = check(draws, self._accepted(blocks), self._block, self.thin, self.times)
        return replace(latest, pareto_k=None if self.proposal is None else self.pareto_k)

    def _accepted(self, blocks: int) -> IntArray:
        """Return the moves of the first ``blocks`` blocks, (blocks, ensembles, walkers)."""
        return self.chain.accepted("sampling")[:blocks]

    @property
    def _block(self) -> int:
        """Steps in a block."""
        return len(self.chain.block_of("sampling", 0)[0].coordinates)

    def _prepare(self, blocks: int) -> None:
        """Take from the first ``blocks`` blocks what is judged."""
        if blocks == self.prepared:
            return
        first = self.chain.block_of("sampling", 0)
        thin = thinning(blocks * sum(block.log_density.size for block in first), self.most)
        while self.thin < thin:
            self.thin *= 2
            for series in (self.draws, self.log_weights):
                series[:] = [values[1::2] for values in self._joined(series)]
        for number in range(self.prepared, blocks):
            self._add(number)
        self.prepared = blocks
        (draws,) = self.draws = self._joined(self.draws)
        self.times = times(draws, self.thin)
        if self.proposal is not None:
            (weights,) = self.log_weights = self._joined(self.log_weights)
            self.pareto_k = pareto_k(weights.ravel())

    @staticmethod
    def _joined(series: list[FloatArray]) -> list[FloatArray]:
        return [np.concatenate(series)] if series else []

    def _add(self, number: int) -> None:
        blocks = self.chain.block_of("sampling", number)
        steps = slice(-(number * self._block + 1) % self.thin, None, self.thin)
        coordinates = np.stack([block.coordinates[steps] for block in blocks], axis=1)
        self.draws.append(constrain_steps(self.posterior, coordinates))
        if self.proposal is not None:
            flat = coordinates.reshape(-1, coordinates.shape[-1])
            density = np.stack([block.log_density[steps] for block in blocks], axis=1)
            proposed = self.proposal.log_density(flat).reshape(density.shape)
            self.log_weights.append(density - proposed)
