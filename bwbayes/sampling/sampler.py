"""Sampling: several independent ensembles, run until the chain has converged.

The ensembles start far apart. A pilot brings them to the posterior, by differential evolution and
by a first guess of it from the point fit; a short tuning with a first fit of the proposal gives the
draws for its last fit. If walkers accept few of the proposed places, the tuning continues a little,
each time with a new fit and twice as long. Every fit keeps a share for each mode of the point fit,
whether the draws contain it or not. Pilot and tuning are discarded. Then draws count, and the chain
is checked (:mod:`bwbayes.sampling.diagnostics`) until two checks in a row pass, the first on half
of the required draws, the second on all of them and at least a fifth more than the first; or until
the budget of steps is used up, or a tenth of it shows that walkers differ so much that four times
the budget would not suffice. A check costs as much as many steps, so each one predicts the
necessary length of the chain, and the next one waits for it, and until the chain is long compared
with its autocorrelation times.

A proposal that covers the posterior badly leaves walkers at places that it hardly proposes, or
keeps them away from there. It is tested on the draws that it made: by Pareto k, and by the growth
of effective draws with the steps. If k is above 0.7, or if the rest would take longer than a new
start at the best rate so far, the draws are set aside. The sampling then starts again from the
present states of the ensembles with another proposal, fitted to all draws that were set aside,
because they include places that the first one hardly proposes. If k is above 0.7 after half of the
budget, differential evolution continues alone, which needs about ten times the steps. So all draws
that count come from one kernel, fixed before the first of them.

All decisions are functions of the chain alone, and an interrupted run takes them again from its
beginning when it resumes: it has the same result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.map_estimate import MAPEstimate, mode_weights
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling import chain as chains
from bwbayes.sampling.chain import Block, Chain, Phase, constrain_steps, thinning
from bwbayes.sampling.curvature import TotalRatioMap
from bwbayes.sampling.diagnostics import (
    LENGTH,
    MAX_PARETO_K,
    ConvergenceDiagnostics,
    SamplingResult,
    check,
    nested_rhat,
    pareto_k,
    times,
)
from bwbayes.sampling.moves import advance, pilot_moves, sampling_moves, start
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.proposals import StudentMixture
from bwbayes.sampling.secant import SecantMap, linear

# Blocks before the first check; the largest growth of the chain up to the next one; and its growth
# if it is not draws that are missing, which is also the least before a proposal is fitted again.
FIRST_CHECK = 2
MAX_STRETCH = 3.0
LEAST_STRETCH = 1.2

# Draws are given up for another proposal if the rest takes this much longer, at the present growth
# of effective draws, than everything at the best rate so far; or if more draws raise the estimate
# of the number of blocks that are needed by this factor.
MAX_SLOWDOWN = 1.2

# A chain must pass two checks. The first needs this part of the required draws; the second comes
# when the chain is longer by this factor, because checks of nearly the same draws would be one.
FIRST_PART = 0.5
MIN_CHECK_GROWTH = 1.2

# Called after each block of one ensemble (phase, None) and after each check (phase, check).
ProgressCallback = Callable[[Phase, ConvergenceDiagnostics | None], None]


def init_chain(
    posterior: Posterior, point: MAPEstimate, plan: SamplingPlan, generator: np.random.Generator
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
    totals = TotalRatioMap.of_prior(posterior.prior)
    chain.freeze(
        "pilot", StudentMixture.around(point.optima, *mode_weights(posterior, point), totals)
    )
    return chain


def sample(
    posterior: Posterior,
    plan: SamplingPlan,
    chain: Chain,
    executor: Executor,
    watcher: ProgressCallback = lambda *_: None,
) -> SamplingResult:
    """Extend ``chain`` until it has converged or the budget is used up.

    The executor may be any of ``concurrent.futures``; its kind and size do not change a bit of
    the result.
    """
    return _Sampling(posterior, plan, chain, executor, watcher).run()


@dataclass(frozen=True)
class _Sampling:
    """A chain on its way to convergence."""

    posterior: Posterior
    plan: SamplingPlan
    chain: Chain
    executor: Executor
    watcher: ProgressCallback

    def run(self) -> SamplingResult:
        chain = self.chain
        while not chain.blocks("tuning") and not self._pilot_is_done():
            self._extend("pilot")
        if not chain.history("sampling"):
            self._tune()
        while (outcome := self._sample_or_fall_back()) is None:
            history, proposal = chain.history("sampling"), None
            if self._is_early:
                # Fit to all blocks of the sampling, whether they count or not.
                fitted_to = Chain(chain.starts)
                fitted_to.freeze("pilot", chain.proposals["pilot"])
                for blocks in history:
                    fitted_to.append("sampling", blocks)
                thin = thinning(fitted_to.draws("sampling"))
                before = chain.proposal_in_use("sampling")
                proposal = self._fit_proposal(fitted_to, "sampling", slice(None), thin, before)
            chain.fall_back(len(history), proposal)
        return replace(outcome, remarks=_remarks(chain))

    @property
    def _is_early(self) -> bool:
        """True if the rest of the budget is enough for one more proposal."""
        return len(self.chain.history("sampling")) * self.plan.block <= self.plan.max_steps / 2

    def _extend(self, phase: Phase) -> None:
        """Advance every ensemble by a block, in the executor's workers."""
        plan, chain = self.plan, self.chain
        proposal = _in_use(chain, phase, self.posterior)
        # A step has several tries only in the phase whose draws count.
        tries = plan.tries if phase == "sampling" else 1
        futures, ends = [], chain.ends
        size = plan.ensembles_per_task
        for group in (ends[i : i + size] for i in range(0, len(ends), size)):
            # Each ensemble gets separate moves, because moves keep the tries that they have drawn.
            moves = [
                pilot_moves(proposal, plan.ahead)
                if phase == "pilot"
                else sampling_moves(proposal, tries, plan.ahead)
                for _ in group
            ]
            futures.append(self.executor.submit(advance, self.posterior, group, moves, plan.block))
        blocks: list[Block] = []
        for future in futures:
            for block in future.result():
                blocks.append(block)
                self.watcher(phase, None)
        chain.append(phase, blocks)

    def _pilot_is_done(self) -> bool:
        """Tell whether the ensembles agree.

        After 500 steps it is enough if each one is stationary: differential evolution would keep
        them in distant modes for ever, but a proposal fitted to all of them will not.
        """
        plan, steps = self.plan, self.chain.steps("pilot")
        if steps < plan.min_pilot_steps or steps >= plan.max_pilot_steps:
            return steps >= plan.max_pilot_steps
        half = constrain_steps(self.posterior, self.chain.coordinates("pilot")[steps // 2 :])
        if _agree(half):
            return True
        middle = len(half) // 2
        return steps >= 500 and all(
            _agree(np.stack([draws[:middle], draws[len(draws) - middle :]], axis=1))
            for draws in np.moveaxis(half, 1, 0)
        )

    def _tune(self) -> None:
        """Tune in rounds, each with a fit to the draws of the last one; freeze the last fit.

        The first round is one block; others follow until walkers accept half of the proposed
        places, with four blocks at most in all: if these do not suffice, the sampling shows it. A
        run that resumes within a round repeats the fit with which that round began.
        """
        plan, chain = self.plan, self.chain
        proposal = self._fit_proposal(chain, "pilot", slice(chain.steps("pilot") // 2, None))
        begin, end, rate = 0, 1, 0.0
        while rate < 0.5 and end <= 4:
            if chain.blocks("tuning") < end:
                chain.freeze("tuning", proposal)
            while chain.blocks("tuning") < end:
                self._extend("tuning")
            now = slice(begin * plan.block, end * plan.block)
            proposal = self._fit_proposal(chain, "tuning", now, before=chain.proposals["tuning"])
            rate = _acceptance_rate(chain.history("tuning")[begin:end], "mixture")
            begin, end = end, 2 * end
        chain.freeze("sampling", proposal)

    def _fit_proposal(
        self,
        chain: Chain,
        phase: Phase,
        steps: slice,
        thin: int = 1,
        before: StudentMixture | None = None,
    ) -> StudentMixture | None:
        """Fit a proposal to the draws of these steps of a phase, if they span the space.

        If walkers accept fewer places of the proposal ``before`` it than of differential evolution,
        whose steps are small, slope and level become coordinates of this fit and of later ones.
        """
        draws = chain.coordinates(phase, thin)[steps]
        log_density = chain.log_density(phase, thin)[steps].ravel()
        flat, guess = draws.reshape(-1, draws.shape[-1]), chain.proposals["pilot"]
        made = chain.history(phase)[-(-steps.start // self.plan.block) if steps.start else 0 :]
        lags = _acceptance_rate(made, "mixture") < _acceptance_rate(made, "differential evolution")
        try:
            if before and guess and linear(self.posterior) and (before.has_secant or lags):
                place = flat[np.argmax(log_density)]
                guess = guess.behind(SecantMap(place, self.posterior))
            return StudentMixture.fitted(flat, log_density, guess)
        except np.linalg.LinAlgError:
            return None

    def _sample_or_fall_back(self) -> SamplingResult | None:
        """Sample to the end, or until the proposal turns out not to cover the draws: then None.

        A chain that already has blocks is checked at the lengths at which a new one would be.
        """
        plan, chain = self.plan, self.chain
        # A chain may be longer than its budget, if the budget was reduced.
        budget = max(-(-plan.max_steps // plan.block), chain.blocks("sampling"))
        fitted_to = chain.set_aside if chain.refit else 0
        blocks, passed = FIRST_CHECK, 0  # blocks at the first of the checks in a row that passed
        needed, best = math.inf, 0.0  # estimated blocks, most effective draws of a block so far
        judged = 0, 0.0  # blocks and effective draws of the last check
        while True:
            blocks = min(blocks, budget)
            while chain.blocks("sampling") < blocks:
                self._extend("sampling")
            at_end = blocks == chain.blocks("sampling")
            drawn = chain.set_aside + blocks
            may_refit = at_end and drawn >= 2 * fitted_to and self._is_early
            judgment = _Judgment(self.posterior, plan, chain, blocks)
            required = judgment.blocks_needed(1.0 if passed else FIRST_PART)
            # A tenth of the budget allows several proposals, and shows whether all may suffice.
            is_early = drawn < budget / 10
            if required > blocks and is_early:
                if may_refit and not passed and required > MAX_SLOWDOWN * needed:
                    return None
                needed = required
                blocks = math.ceil(min(required, MAX_STRETCH * blocks))
                continue
            latest = judgment.check()
            if at_end:
                chain.publish()
            self.watcher("sampling", latest)
            missing = latest.failures(plan.ess)
            # A chain whose target was reduced may have converged before its end.
            done = not missing and 0 < MIN_CHECK_GROWTH * passed <= blocks
            if done and at_end:
                return SamplingResult(True, "converged (two consecutive checks)", latest)
            if blocks == budget:
                why = "; ".join(missing) or "only the last check passed"
                return SamplingResult(False, f"step limit {plan.max_steps} reached: {why}", latest)
            if not latest.covered and at_end and drawn >= LEAST_STRETCH * fitted_to:
                return None
            is_hopeless = latest.covered and latest.steps_needed > 4 * budget * plan.block
            if is_hopeless and at_end and not is_early:
                most, steps = 100 * plan.max_steps, latest.steps_needed
                about = f"about {steps:.0f}" if steps < most else f"more than {most}"
                why = f"{about} steps are needed: {'; '.join(missing)}"
                return SamplingResult(
                    False, f"step limit {plan.max_steps} out of reach: {why}", latest
                )
            first = not latest.failures(plan.ess, FIRST_PART)
            ess = latest.lowest_ess
            growth, best = (ess - judged[1]) / (blocks - judged[0]), max(best, ess / blocks)
            lags = (plan.ess - ess) * best > MAX_SLOWDOWN * plan.ess * growth
            if may_refit and judged[0] and lags:
                return None
            judged = blocks, ess
            passed = (passed or blocks) if first else 0
            blocks = chain.blocks("sampling") if done else _next_check(plan, blocks, passed, latest)


class _Judgment:
    """Check of the first ``blocks`` blocks that count; the cheap part is worked out at once.

    Long chains are thinned by powers of two to bound the memory, but keep several times the target
    of effective draws, so that none is lost.
    """

    def __init__(self, posterior: Posterior, plan: SamplingPlan, chain: Chain, blocks: int) -> None:
        self.blocks, self.block = blocks, plan.block
        max_draws = max(chains.MOST_DRAWS, round(4 * plan.ess))
        self.thin = thinning(chain.draws("sampling", blocks), max_draws)
        coordinates = chain.coordinates("sampling", self.thin, blocks)
        self.accepted = chain.accepted("sampling")[:blocks]
        self.draws = constrain_steps(posterior, coordinates)
        self.times = times(self.draws, self.thin)
        self.pareto_k: float | None = None
        if (proposal := _in_use(chain, "sampling", posterior)) is not None:
            density = chain.log_density("sampling", self.thin, blocks)
            self.pareto_k = pareto_k((density - proposal.log_density(coordinates)).ravel())

    def blocks_needed(self, fraction: float) -> float:
        """Return the number of blocks for a ``fraction`` of the required autocorrelation times.

        This is mostly the last requirement, and cheap to test. It is 0 if the proposal does not
        cover the draws, because more would not help.
        """
        if self.pareto_k is not None and not self.pareto_k < MAX_PARETO_K:
            return 0.0
        return fraction * LENGTH * float(np.max(self.times)) / self.block

    def check(self) -> ConvergenceDiagnostics:
        """Compute all diagnostics, which costs as much as many steps."""
        return check(self.draws, self.accepted, self.block, self.thin, self.times, self.pareto_k)


def _next_check(
    plan: SamplingPlan, blocks: int, passed: int, latest: ConvergenceDiagnostics
) -> int:
    """Predict the number of blocks at which a chain, checked at ``blocks``, is long enough.

    Effective draws grow with the steps. If they are enough already, a fifth more blocks may satisfy
    the other requirements. The second check follows the first one that ``passed``, at so many
    blocks.
    """
    fraction = 1.0 if passed else FIRST_PART
    steps = latest.steps_for(plan.ess)
    following = max(fraction * steps / plan.block, MIN_CHECK_GROWTH * passed)
    if not following > blocks:  # nan too
        following = LEAST_STRETCH * blocks
    return int(max(np.ceil(min(following, MAX_STRETCH * blocks)), blocks + 1))


def _agree(draws: FloatArray) -> bool:
    """Tell whether ensembles of a pilot (steps, ensembles, walkers, free) agree."""
    return bool((nested_rhat(draws) < 1.1).all())


def _acceptance_rate(history: Sequence[Sequence[Block]], move: str) -> float:
    """Return the acceptance rate of a move in blocks; 1 without proposals."""
    counts = [block.moves.get(move, (0, 0)) for blocks in history for block in blocks]
    proposed, accepted = np.sum(counts, axis=0) if counts else (0, 0)
    return float(accepted / proposed) if proposed else 1.0


def _in_use(chain: Chain, phase: Phase, posterior: Posterior) -> StudentMixture | None:
    """Return the proposal that a phase goes on with, with the posterior set in its maps."""
    proposal = chain.proposal_in_use(phase)
    return None if proposal is None else proposal.of_posterior(posterior)


def _remarks(chain: Chain) -> tuple[str, ...]:
    """Return remarks for the user: on the moves, and on the thinning of a long chain."""
    remarks = []
    if chain.proposal_in_use("sampling") is None:
        remarks.append(
            "no proposal covers the posterior: differential evolution and snooker moves alone made "
            "the draws that count, which takes ten times the steps"
        )
    thin = thinning(chain.draws("sampling"))
    if thin > 1:
        steps = chain.steps("sampling")
        remarks.append(f"of {steps} steps one in {thin} is reported, to limit the memory")
    return tuple(remarks)
