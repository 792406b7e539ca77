"""Sampling: several independent ensembles, run until the chain says that it has converged.

The ensembles start far apart. A pilot brings them to the posterior, by differential evolution and
by a first guess of it, the point fit's; a short tuning with a first fit of the proposal gives the
draws for its last one. Where walkers take few of the places that it proposes, the tuning goes on,
each time with a new fit and twice as long, and with steps that go part of the way to such places: a
long, curved posterior needs more draws to be seen whole, and walkers that spread. Pilot and tuning
are thrown away. Then draws count, and the chain is judged
(:mod:`bwbayes.sampling.diagnostics`), until two judgments in a row find nothing wrong, the first
on half the draws that are to be reached, the second on all of them and a fifth more than the first
at least; or the budget of steps is used up.
To judge costs as much as many steps, so each judgment predicts how long the chain must become,
and the next one waits until then, and until the chain is long against its autocorrelation times.

A proposal that covers the posterior badly leaves walkers where it hardly goes, or keeps them away
from there. It is judged on the draws that it made, by Pareto k. Above 0.7 they are set aside, and
the sampling starts again from where the ensembles are with another proposal, which is fitted to all
that was set aside, for that has been where the first hardly goes. After half of the budget
differential evolution goes on alone, which needs about ten times the steps. So all draws that count
come from one kernel, fixed before the first of them.

All decisions are functions of the chain alone, and are taken again from its beginning when a run
that was interrupted goes on: it comes to the same end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.pointfit import PointFit, peaks
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling.chain import MOVES, Block, Chain, Phase, constrain_steps, thinning
from bwbayes.sampling.diagnostics import (
    LENGTH,
    Check,
    nested_rhat,
    pareto_k,
)
from bwbayes.sampling.ensemble import advance_together, start
from bwbayes.sampling.monitor import ConvergenceMonitor, Outcome
from bwbayes.sampling.moves import pilot_moves, sampling_moves, spreading_moves
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.proposals import StudentMixture

__all__ = [
    "Watcher",
    "first_chain",
    "sample",
]

# Nested R-hat of the pilot's second half below which its ensembles have met. After so
# many steps it is enough if each stays where it is: in modes far apart differential evolution would
# keep them for ever, and a proposal fitted to all of them will not.
PILOT_RHAT = 1.1
APART_STEPS = 500

# Blocks of the tuning, and how many it may become while walkers take less than this part of the
# places that are proposed to them: four times as many where they hardly take any.
TUNING_BLOCKS = 2
MOST_TUNING_BLOCKS = 16
TAKEN = 0.5
HARDLY_TAKEN = 0.25

# The part of the budget in which a proposal that does not cover its draws is followed by another.
REFITTING = 0.5

# Blocks before the first check, and how much longer the chain is at the next one at most, or at
# least if it is not draws that are missing. A proposal is fitted again to so many more at least.
FIRST_CHECK = 3
LARGEST_STRETCH = 3.0
LEAST_STRETCH = 1.2

# How much longer a chain is at the second of the two checks that it must pass: checks of nearly
# the same draws would be one. For the first, a part of the draws that are to be reached is enough:
# so that they are reached at the second.
APART = 1.2
FIRST_PART = 0.5

# Called after each block of one ensemble (phase, None) and after each check (phase, check).
Watcher = Callable[[Phase, Check | None], None]


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
    chain = Chain([start(posterior, point, e, plan.walkers, g) for e, g in enumerate(seeds)])
    chain.freeze("pilot", StudentMixture.around(point.optima, *peaks(posterior, point)))
    return chain


def sample(
    posterior: Posterior,
    plan: SamplingPlan,
    chain: Chain,
    executor: Executor,
    watcher: Watcher = lambda *_: None,
) -> Outcome:
    """Extend ``chain`` until it has converged or the budget is used up.

    The executor may be any of ``concurrent.futures``; its kind and size do not change a bit of
    the result.
    """
    while not chain.blocks("tuning") and not _pilot_done(posterior, plan, chain):
        _extend(posterior, plan, chain, "pilot", executor, watcher)
    if not chain.history("sampling"):
        _tune(posterior, plan, chain, executor, watcher)
    elif chain.refitted and chain.refit is None:
        chain.refit = _refit(chain, chain.refitted)  # that of a file
    while (outcome := _sampled(posterior, plan, chain, executor, watcher)) is None:
        blocks = len(chain.history("sampling"))
        early = blocks * plan.block <= REFITTING * plan.most_steps
        chain.fall_back(blocks, _refit(chain, blocks) if early else None)
    return replace(outcome, remarks=(*_remarks(chain), *_thinned(chain)))


def _sampled(
    posterior: Posterior, plan: SamplingPlan, chain: Chain, executor: Executor, watcher: Watcher
) -> Outcome | None:
    """Sample to the end, or until the proposal turns out not to cover the draws: then None.

    A chain that has blocks already is judged where it was, or would have been, on its way.
    """
    monitor = ConvergenceMonitor(posterior, chain, plan.ess)
    # A chain may be longer than its budget, if that was made smaller.
    budget = max(-(-plan.most_steps // plan.block), chain.blocks("sampling"))
    blocks, passed = FIRST_CHECK, 0  # blocks at the first of the checks in a row that passed
    while True:
        blocks = min(blocks, budget)
        while chain.blocks("sampling") < blocks:
            _extend(posterior, plan, chain, "sampling", executor, watcher)
        # Mostly the last thing that is missing, and cheap to see.
        required = monitor.blocks_needed(blocks, 1.0 if passed else FIRST_PART)
        if required > blocks and blocks < budget:
            blocks = math.ceil(min(required, LARGEST_STRETCH * blocks))
            continue
        now = monitor(blocks)
        watcher("sampling", now)
        missing = now.shortcomings(plan.ess)
        at_end = blocks == chain.blocks("sampling")
        # One whose target was made smaller has converged before its end.
        done = not missing and 0 < APART * passed <= blocks
        if done and at_end:
            return Outcome(True, "converged on two checks in a row", now)
        if blocks == budget:
            why = "; ".join(missing) or "only the last check passed"
            return Outcome(False, f"budget of {plan.most_steps} steps used up: {why}", now)
        if (
            not now.covered
            and at_end
            and chain.set_aside + blocks >= LEAST_STRETCH * chain.refitted
        ):
            return None
        first = not now.shortcomings(plan.ess, FIRST_PART)
        passed = (passed or blocks) if first else 0
        blocks = chain.blocks("sampling") if done else _next_check(plan, blocks, passed, now)


def _next_check(plan: SamplingPlan, blocks: int, passed: int, latest: Check) -> int:
    """Predict the blocks at which a chain, judged at ``blocks``, will be long enough.

    Effective draws grow with the steps. Once there are enough by that, a fifth more may bring what
    else is missing. After the first check that ``passed``, at so many blocks, comes the second.
    """
    fraction = 1.0 if passed else FIRST_PART
    fewest = np.min([latest.ess_bulk, latest.ess_tail])
    with np.errstate(divide="ignore"):
        steps = np.maximum(
            latest.steps * plan.ess / fewest, LENGTH * np.max(latest.autocorrelation)
        )
    following = max(fraction * steps / plan.block, APART * passed)
    if not following > blocks:  # nan too
        following = LEAST_STRETCH * blocks
    return int(max(np.ceil(min(following, LARGEST_STRETCH * blocks)), blocks + 1))


def _refit(chain: Chain, blocks: int) -> StudentMixture | None:
    """Fit a proposal to the first blocks of the sampling, whether they count or not."""
    fitted_to = Chain(chain.starts)
    for block in chain.history("sampling")[:blocks]:
        fitted_to.append("sampling", block)
    return _fitted(fitted_to, "sampling", slice(None), thinning(fitted_to.draws("sampling")))


def _remarks(chain: Chain) -> tuple[str, ...]:
    """Say what a user should know of the moves."""
    alone = "differential evolution and snooker moves alone made the draws that count"
    first = chain.proposals["sampling"]
    if first is None:
        return (f"no proposal could be fitted to the draws of the tuning: {alone}",)
    if not chain.set_aside:
        return ()
    aside = chain.history("sampling")[: chain.set_aside]
    flat = [block for blocks in aside for block in blocks]
    coordinates = np.concatenate([b.coordinates.reshape(-1, b.coordinates.shape[-1]) for b in flat])
    density = np.concatenate([b.log_density.ravel() for b in flat])
    shape = pareto_k(density - first.log_density(coordinates))
    steps = sum(blocks[0].log_density.shape[0] for blocks in aside)
    followed = "one that was fitted to them made the draws that count"
    return (
        f"the proposal did not cover the first {steps} steps (Pareto k {shape:.2f}): they are set "
        f"aside, and {followed if chain.refitted == chain.set_aside else alone}",
    )


def _thinned(chain: Chain) -> tuple[str, ...]:
    """Say that a long chain is not used as a whole."""
    thin = thinning(chain.draws("sampling"))
    if thin == 1:
        return ()
    return (f"of {chain.steps('sampling')} steps one in {thin} is reported, to limit the memory",)


def _extend(
    posterior: Posterior,
    plan: SamplingPlan,
    chain: Chain,
    phase: Phase,
    executor: Executor,
    watcher: Watcher,
) -> None:
    """Advance every ensemble by a block, wherever the executor likes."""
    proposal, ends = chain.proposal_in_use(phase), chain.ends
    spreads = phase == "tuning" and chain.blocks(phase) >= TUNING_BLOCKS
    make = pilot_moves if phase == "pilot" else spreading_moves if spreads else sampling_moves
    futures = []
    for group in (ends[i : i + plan.together] for i in range(0, len(ends), plan.together)):
        # Moves of its own for each: some of emcee's write to themselves.
        moves = [make(proposal, plan.places) for _ in group]
        futures.append(executor.submit(advance_together, posterior, moves, group, plan.block))
    blocks: list[Block] = []
    for future in futures:
        for block in future.result():
            blocks.append(block)
            watcher(phase, None)
    chain.append(phase, blocks)


def _pilot_done(posterior: Posterior, plan: SamplingPlan, chain: Chain) -> bool:
    steps = chain.steps("pilot")
    if steps < plan.least_pilot_steps or steps >= plan.most_pilot_steps:
        return steps >= plan.most_pilot_steps
    second_half = constrain_steps(posterior, chain.coordinates("pilot")[steps // 2 :])
    if (nested_rhat(second_half) < PILOT_RHAT).all():
        return True
    return steps >= APART_STEPS and all(
        _is_stationary(draws) for draws in np.moveaxis(second_half, 1, 0)
    )


def _is_stationary(draws: FloatArray) -> bool:
    """Tell whether the halves of an ensemble's draws (steps, walkers, free) agree."""
    half = len(draws) // 2
    halves = np.stack([draws[:half], draws[len(draws) - half :]], axis=1)
    return bool((nested_rhat(halves) < PILOT_RHAT).all())


def _tune(
    posterior: Posterior, plan: SamplingPlan, chain: Chain, executor: Executor, watcher: Watcher
) -> None:
    """Tune in rounds, each with a fit to the last one's draws; freeze the fit to the last of all.

    A run that goes on within a round fits again to what that round had begun with.
    """
    proposal = _fitted(chain, "pilot", slice(chain.steps("pilot") // 2, None))
    begin, end, rate = 0, TUNING_BLOCKS, 0.0
    while rate < TAKEN and end <= (1 if rate > HARDLY_TAKEN else 4) * MOST_TUNING_BLOCKS:
        if chain.blocks("tuning") < end:
            chain.freeze("tuning", proposal)
        while chain.blocks("tuning") < end:
            _extend(posterior, plan, chain, "tuning", executor, watcher)
        proposal = _fitted(chain, "tuning", slice(begin * plan.block, end * plan.block))
        rate = _taken(chain.history("tuning")[begin:end])
        begin, end = end, 2 * end
    chain.freeze("sampling", proposal)


def _taken(blocks: Sequence[Sequence[Block]]) -> float:
    """Return which part of the places that the proposal proposed was taken; 1 without one."""
    independent = MOVES.index("mixture")
    # Blocks count the moves that were offered to them, and blocks from a file all that there are.
    counts = [block.moves[independent:][:1] for ensembles in blocks for block in ensembles]
    proposed, accepted = np.sum(np.concatenate(counts), axis=0)
    return float(accepted / proposed) if proposed else 1.0


def _fitted(chain: Chain, phase: Phase, steps: slice, thin: int = 1) -> StudentMixture | None:
    """Fit a proposal to the draws of these steps of a phase, if they span the space."""
    draws = chain.coordinates(phase, thin)[steps]
    log_density = chain.log_density(phase, thin)[steps]
    try:
        return StudentMixture.fitted(draws.reshape(-1, draws.shape[-1]), log_density.ravel())
    except np.linalg.LinAlgError:
        return None
