"""Sampling: several independent ensembles, run until the chain says that it has converged.

The ensembles start far apart. A pilot of differential evolution brings them to the posterior; a
short tuning with a first fit of the proposal gives the draws for its last one. Both are thrown
away. Then draws count, and after each block of steps the chain is judged
(:mod:`bwbayes.inference.diagnostics`), until two judgements in a row find nothing missing, or the
budget of steps is used up. All decisions are functions of the chain alone, so a run that was
interrupted goes on to the same end.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.chain import Chain, Phase
from bwbayes.inference.diagnostics import Check, check, nested_rhat, pareto_k
from bwbayes.inference.ensemble import Block, advance, start
from bwbayes.inference.moves import sampling_moves
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.proposals import StudentMixture

__all__ = ["Outcome", "SamplingPlan", "Watcher", "draws", "first_chain", "sample"]

# Nested R-hat of the pilot's second half below which its ensembles have found each other.
PILOT_RHAT = 1.1

# Above this the proposal does not cover the draws, and differential evolution goes on alone.
LARGEST_PARETO_K = 0.7

TUNING_BLOCKS = 4

# Called after each block of one ensemble (phase, None) and after each check (phase, check).
Watcher = Callable[[Phase, Check | None], None]


def _unwatched(phase: Phase, found: Check | None) -> None:
    """Watch nothing."""


@dataclass(frozen=True)
class SamplingPlan:
    """How to sample, and when to stop.

    Parameters
    ----------
    ess
        Effective draws of every parameter, bulk and tail, to reach.
    ensembles
        Independent ensembles, at least four: R-hat compares them.
    walkers
        Walkers of one ensemble, even, at least twice the free parameters.
    block
        Steps between two checks.
    most_steps, most_pilot_steps
        The budget: steps of each ensemble that count, and before.
    least_pilot_steps
        Steps of the pilot in any case.
    """

    ess: float = 2000.0
    ensembles: int = 4
    walkers: int = 24
    block: int = 50
    most_steps: int = 20_000
    least_pilot_steps: int = 200
    most_pilot_steps: int = 3_000

    def __post_init__(self) -> None:
        if self.ensembles < 4:
            raise InputError("sampling.ensembles: needs at least 4; R-hat compares them")
        if self.walkers % 2:
            raise InputError("sampling.walkers: must be even; emcee moves one half at a time")


@dataclass(frozen=True)
class Outcome:
    """How a sampling ended: ``converged`` or not, why, and the last check."""

    converged: bool
    stop_reason: str
    check: Check


def first_chain(
    posterior: Posterior, point: PointFit, plan: SamplingPlan, generator: np.random.Generator
) -> Chain:
    """Return a chain without blocks, its ensembles at their starts.

    Raises
    ------
    InputError
        Fewer walkers than twice the free parameters.
    """
    if plan.walkers < 2 * posterior.prior.dimensions:
        raise InputError(
            f"sampling.walkers: {plan.walkers} are too few for {posterior.prior.dimensions} free "
            f"parameters; use at least {2 * posterior.prior.dimensions}"
        )
    seeds = generator.spawn(plan.ensembles)
    return Chain([start(posterior, point, e, plan.walkers, g) for e, g in enumerate(seeds)])


def sample(
    posterior: Posterior,
    plan: SamplingPlan,
    chain: Chain,
    executor: Executor,
    watcher: Watcher = _unwatched,
) -> Outcome:
    """Extend ``chain`` until it has converged or the budget is used up.

    The executor may be any of ``concurrent.futures``; its kind and size do not change a bit of
    the result.
    """
    while not chain.blocks("tuning") and not _pilot_done(posterior, plan, chain):
        _extend(posterior, plan, chain, "pilot", executor, watcher)
    while not chain.blocks("sampling") and chain.blocks("tuning") < TUNING_BLOCKS:
        if not chain.blocks("tuning"):
            chain.freeze("tuning", _fitted(chain, "pilot"))
        _extend(posterior, plan, chain, "tuning", executor, watcher)
    if not chain.blocks("sampling"):
        chain.freeze("sampling", _trusted(chain, _fitted(chain, "tuning")))
        _extend(posterior, plan, chain, "sampling", executor, watcher)
    before = _check(posterior, plan, chain, chain.blocks("sampling") - 1)
    while True:
        now = _check(posterior, plan, chain, chain.blocks("sampling"))
        assert now is not None
        watcher("sampling", now)
        missing = now.shortcomings(plan.ess)
        if not missing and before is not None and not before.shortcomings(plan.ess):
            return Outcome(True, "converged on two checks in a row", now)
        if chain.steps("sampling") >= plan.most_steps:
            why = "; ".join(missing) or "only the last check passed"
            return Outcome(False, f"budget of {plan.most_steps} steps used up: {why}", now)
        before = now
        _extend(posterior, plan, chain, "sampling", executor, watcher)


def draws(posterior: Posterior, chain: Chain, phase: Phase = "sampling") -> FloatArray:
    """Return a chain's draws in their own units, (steps, ensembles, walkers, free)."""
    coordinates = chain.coordinates(phase)
    flat, _ = posterior.prior.constrain(coordinates.reshape(-1, coordinates.shape[-1]))
    return flat.reshape(coordinates.shape)


def _extend(
    posterior: Posterior,
    plan: SamplingPlan,
    chain: Chain,
    phase: Phase,
    executor: Executor,
    watcher: Watcher,
) -> None:
    """Advance every ensemble by a block, wherever the executor likes."""
    moves = sampling_moves(chain.proposals[phase])
    futures = [executor.submit(advance, posterior, moves, end, plan.block) for end in chain.ends]
    blocks: list[Block] = []
    for future in futures:
        blocks.append(future.result())
        watcher(phase, None)
    chain.append(phase, blocks)


def _pilot_done(posterior: Posterior, plan: SamplingPlan, chain: Chain) -> bool:
    steps = chain.steps("pilot")
    if steps < plan.least_pilot_steps or steps >= plan.most_pilot_steps:
        return steps >= plan.most_pilot_steps
    second_half = draws(posterior, chain, "pilot")[steps // 2 :]
    return bool((nested_rhat(second_half) < PILOT_RHAT).all())


def _second_half(chain: Chain, phase: Phase) -> tuple[FloatArray, FloatArray]:
    """Return coordinates (draws, free) and log density (draws,) of the later half of a phase."""
    first = chain.steps(phase) // 2
    kept = chain.coordinates(phase)[first:]
    return kept.reshape(-1, kept.shape[-1]), chain.log_density(phase)[first:].ravel()


def _fitted(chain: Chain, phase: Phase) -> StudentMixture | None:
    """Fit a proposal to a phase's draws, if they span the space."""
    try:
        return StudentMixture.fitted(_second_half(chain, phase)[0])
    except np.linalg.LinAlgError:
        return None


def _trusted(chain: Chain, proposal: StudentMixture | None) -> StudentMixture | None:
    """Keep a proposal only if it covers the tuning's draws."""
    if proposal is None:
        return None
    coordinates, log_density = _second_half(chain, "tuning")
    shape = pareto_k(log_density - proposal.log_density(coordinates))
    return proposal if shape < LARGEST_PARETO_K else None


def _check(posterior: Posterior, plan: SamplingPlan, chain: Chain, blocks: int) -> Check | None:
    """Judge the first ``blocks`` blocks."""
    if blocks < 1:
        return None
    kept = draws(posterior, chain)[: blocks * plan.block]
    return check(kept, chain.accepted("sampling")[:blocks], plan.block)
