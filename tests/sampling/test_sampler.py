"""A sampling ends for a reason that it tells, with the same bits wherever and however it ran."""

from __future__ import annotations

import copy
import itertools
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest
from scipy import stats

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.pointfit import PointFit, fit
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling import sampler
from bwbayes.sampling.chain import PHASES, Chain, Phase
from bwbayes.sampling.diagnostics import pareto_k
from bwbayes.sampling.moves import MOVES
from bwbayes.sampling.proposals import StudentMixture
from bwbayes.sampling.sampler import (
    FIRST_CHECK,
    MOST_TUNING_BLOCKS,
    TUNING_BLOCKS,
    Outcome,
    draws,
    first_chain,
    sample,
)
from tests.inference.problems import TARGETS, short_posterior, target
from tests.sampling.samplings import (
    LONG,
    PLAN,
    POINT,
    POSTERIOR,
    InterruptedRunError,
    PluggedExecutor,
    Watched,
    assert_same_chain,
    assert_same_outcome,
    assert_same_proposal,
    new_chain,
    run,
)

# Calls of the executor, four a block: in the first block of the pilot, later there and at its end,
# in the tuning and at its end, and in the sampling.
INTERRUPTIONS = (0, 9, 20, 24, 28, 34)


@pytest.fixture(scope="module")
def watched() -> Watched:
    return Watched()


@pytest.fixture(scope="module")
def finished(watched: Watched) -> tuple[Chain, Outcome]:
    chain = new_chain()
    with ThreadPoolExecutor(1) as executor:
        return chain, sample(POSTERIOR, PLAN, chain, executor, watched)


def test_a_cheap_posterior_converges(finished: tuple[Chain, Outcome]) -> None:
    chain, outcome = finished
    assert outcome.converged
    assert "converged on two checks in a row" == outcome.stop_reason
    assert [] == outcome.check.shortcomings(PLAN.ess)
    assert chain.steps("sampling") == outcome.check.steps
    assert chain.proposals["sampling"] is not None


@pytest.mark.parametrize(("phase", "before"), [("tuning", "pilot"), ("sampling", "tuning")])
def test_a_proposal_is_fitted_to_the_phase_before(
    finished: tuple[Chain, Outcome], phase: Phase, before: Phase
) -> None:
    """Of the pilot the later half. It stays frozen: a function of draws that do not count."""
    chain, _ = finished
    part = 2 if before == "pilot" else 1
    later = chain.coordinates(before)[-(chain.steps(before) // part) :]
    assert_same_proposal(StudentMixture.fitted(later.reshape(-1, 3)), chain.proposals[phase])


def test_the_pilots_proposal_is_the_point_fits_own_guess(finished: tuple[Chain, Outcome]) -> None:
    guess = StudentMixture.around(POINT.optima, POINT.covariance[np.newaxis], np.ones(1))
    assert_same_proposal(guess, finished[0].proposals["pilot"])


def test_the_tuning_has_its_length(finished: tuple[Chain, Outcome]) -> None:
    assert TUNING_BLOCKS == finished[0].blocks("tuning")


@pytest.mark.parametrize(("part", "blocks"), [(0.99, TUNING_BLOCKS), (1.01, 2 * TUNING_BLOCKS)])
def test_the_tuning_goes_on_while_few_places_are_taken(
    finished: tuple[Chain, Outcome], monkeypatch: pytest.MonkeyPatch, part: float, blocks: int
) -> None:
    """With a limit a little below and above the part that was taken in its first round."""
    proposed, accepted = finished[0].moves("tuning")["mixture"]
    monkeypatch.setattr(sampler, "TAKEN", part * accepted / proposed)
    monkeypatch.setattr(sampler, "MOST_TUNING_BLOCKS", 2 * TUNING_BLOCKS)
    chain, _ = run()
    assert blocks == chain.blocks("tuning")


def test_walkers_spread_by_nearby_steps_while_a_tuning_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not in its first round, nor in the draws that count; those come from one kernel."""
    monkeypatch.setattr(sampler, "TAKEN", 1.1)
    chain, _ = run()
    nearby = MOVES.index("nearby")
    blocks = [block for each in chain.history("tuning") for block in each]
    rows = [len(block.moves) for block in blocks]
    first = TUNING_BLOCKS * PLAN.ensembles
    assert {nearby} == set(rows[:first])
    assert {nearby + 1} == set(rows[first:])
    assert sum(block.moves[nearby, 1] for block in blocks[first:]) > 0
    assert "nearby" not in chain.moves("sampling")


@pytest.mark.parametrize(("hardly", "times"), [(0.0, 1), (1.0, 4)])
def test_the_tuning_may_be_longer_where_hardly_any_place_is_taken(
    monkeypatch: pytest.MonkeyPatch, hardly: float, times: int
) -> None:
    monkeypatch.setattr(sampler, "TAKEN", 1.1)
    monkeypatch.setattr(sampler, "HARDLY_TAKEN", hardly)
    monkeypatch.setattr(sampler, "MOST_TUNING_BLOCKS", 2 * TUNING_BLOCKS)
    chain, _ = run()
    assert times * 2 * TUNING_BLOCKS == chain.blocks("tuning")


@pytest.mark.parametrize("blocks", [3, 5, MOST_TUNING_BLOCKS])
def test_a_long_tuning_is_fitted_to_its_last_round_and_goes_on_in_any(
    monkeypatch: pytest.MonkeyPatch, blocks: int
) -> None:
    """Each is twice as long; interrupted in one or after the last, it comes to the same end."""
    monkeypatch.setattr(sampler, "TAKEN", 1.1)
    expected, outcome = run()
    assert MOST_TUNING_BLOCKS == expected.blocks("tuning")
    *_, third, fourth = np.split(expected.coordinates("tuning"), [40, 80, 160])
    proposals = expected.proposals["tuning"], expected.proposals["sampling"]
    for last, fitted in zip((third, fourth), proposals, strict=True):
        assert_same_proposal(StudentMixture.fitted(last.reshape(-1, 3)), fitted)
    chain, calls = new_chain(), PLAN.ensembles * (expected.blocks("pilot") + blocks)
    with pytest.raises(InterruptedRunError):
        sample(POSTERIOR, PLAN, chain, PluggedExecutor(calls))
    with ThreadPoolExecutor(1) as executor:
        again = sample(POSTERIOR, PLAN, chain, executor)
    assert_same_chain(expected, chain)
    assert_same_outcome(outcome, again)


def test_its_draws_are_the_posteriors(finished: tuple[Chain, Outcome]) -> None:
    """Mean and variance within four standard errors of the effective draws it claims."""
    chain, outcome = finished
    result = draws(POSTERIOR, chain)
    error = 4 / np.sqrt(outcome.check.ess_bulk)
    assert (np.abs(np.mean(result, axis=(0, 1, 2))) < error).all()
    assert (np.abs(np.var(result, axis=(0, 1, 2)) - 1) < np.sqrt(2) * error).all()


@pytest.mark.usefixtures("finished")
def test_it_stops_at_the_first_two_checks_that_find_nothing_missing(watched: Watched) -> None:
    """The second on a fifth more draws at least; for the first half the draws are enough."""
    *_, first, second = watched.checks
    assert [] == first.shortcomings(PLAN.ess, 0.5)
    assert [] == second.shortcomings(PLAN.ess)
    assert second.steps >= 1.2 * first.steps
    passed = [not result.shortcomings(PLAN.ess) for result in watched.checks]
    assert not any(one and two for one, two in itertools.pairwise(passed[:-1]))


def test_two_checks_of_nearly_the_same_draws_are_one() -> None:
    """Whose chain is long: a block more is a small part of it."""
    plan = replace(LONG, ess=20_000)
    watched = Watched()
    with ThreadPoolExecutor(1) as executor:
        outcome = sample(POSTERIOR, plan, new_chain(plan), executor, watched)
    assert outcome.converged
    *before, last = watched.checks
    # The checks in a row, up to the end, that half of the draws are enough for.
    missing = [bool(each.shortcomings(plan.ess, 0.5)) for each in reversed(before)]
    first = before[-missing.index(True)] if True in missing else before[0]
    assert last.steps >= 600
    assert last.steps >= 1.2 * first.steps


def test_the_watcher_hears_of_every_block_of_every_ensemble(
    finished: tuple[Chain, Outcome], watched: Watched
) -> None:
    chain, _ = finished
    expected = [phase for phase in PHASES for _ in range(chain.blocks(phase) * PLAN.ensembles)]
    assert expected == watched.blocks


def test_two_threads_give_the_same_bits(finished: tuple[Chain, Outcome]) -> None:
    chain, outcome = run(workers=2)
    assert_same_chain(finished[0], chain)
    assert_same_outcome(finished[1], outcome)


def test_processes_give_the_same_bits(finished: tuple[Chain, Outcome]) -> None:
    chain = new_chain()
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        outcome = sample(POSTERIOR, PLAN, chain, executor)
    assert_same_chain(finished[0], chain)
    assert_same_outcome(finished[1], outcome)


def test_another_seed_gives_other_draws(finished: tuple[Chain, Outcome]) -> None:
    chain, _ = run(seed=2)
    first = finished[0].coordinates("pilot")[0]
    assert not np.array_equal(first, chain.coordinates("pilot")[0])


def test_a_used_up_budget_is_told_with_what_is_missing() -> None:
    chain, outcome = run(replace(PLAN, most_steps=60, ess=1e6))
    assert not outcome.converged
    assert outcome.stop_reason.startswith("budget of 60 steps used up: ")
    assert "ESS" in outcome.stop_reason
    assert 60 == chain.steps("sampling")


def test_a_budget_that_ends_with_the_first_good_check_is_told() -> None:
    plan = replace(PLAN, block=40, most_steps=40 * FIRST_CHECK)
    _, outcome = run(plan)
    assert [] == outcome.check.shortcomings(plan.ess)
    assert not outcome.converged
    assert outcome.stop_reason.endswith("only the last check passed")


def test_the_pilot_has_a_budget_of_its_own() -> None:
    """Ensembles that never find each other go on after it, and do not converge."""

    def islands(x: FloatArray) -> FloatArray:
        return np.where(np.max(np.abs(x % 100 - 50), axis=1) < 20, 0.0, -np.inf)

    plan = replace(PLAN, most_pilot_steps=140, most_steps=100, walkers=4)
    posterior = target(islands, 2)
    optima = np.array([[100 * i + 50.0, 50.0] for i in range(4)])
    covariance = np.eye(2)
    point = PointFit(optima[0], covariance, 0.0, optima, covariance)
    chain = first_chain(posterior, point, plan, np.random.default_rng(3))
    with ThreadPoolExecutor(1) as executor:
        outcome = sample(posterior, plan, chain, executor)
    assert 140 == chain.steps("pilot")
    assert not outcome.converged
    assert "R-hat" in outcome.stop_reason


def test_ensembles_in_modes_far_apart_meet_by_the_proposal() -> None:
    """Twenty sds apart, weighing 0.3 and 0.7: the pilot does not wait, and the draws have them."""
    known = TARGETS["far modes"]
    modes = np.array([[-10.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    near = 0.01 * np.eye(3)
    point = PointFit(modes[1], near, 0.0, modes, near)
    plan = replace(PLAN, most_pilot_steps=3000, most_steps=3000, walkers=24, ess=1000)
    posterior = target(known.log_density, 3)
    chain = first_chain(posterior, point, plan, np.random.default_rng(4))
    with ThreadPoolExecutor(1) as executor:
        outcome = sample(posterior, plan, chain, executor)
    assert outcome.converged
    assert chain.steps("pilot") < 1000
    lower = float(np.mean(draws(posterior, chain)[..., 0] < 0))
    assert 0.3 == pytest.approx(lower, abs=4 * np.sqrt(0.21 / 1000))


@pytest.mark.parametrize("calls", INTERRUPTIONS)
def test_an_interrupted_chain_goes_on_to_the_same_end(
    finished: tuple[Chain, Outcome], calls: int
) -> None:
    chain = new_chain()
    with pytest.raises(InterruptedRunError):
        sample(POSTERIOR, PLAN, chain, PluggedExecutor(calls))
    assert calls // PLAN.ensembles == sum(chain.blocks(phase) for phase in PHASES)
    with ThreadPoolExecutor(2) as executor:
        outcome = sample(POSTERIOR, PLAN, chain, executor)
    assert_same_chain(finished[0], chain)
    assert_same_outcome(finished[1], outcome)


def test_the_interruptions_meet_every_phase(finished: tuple[Chain, Outcome]) -> None:
    chain, _ = finished
    ends = PLAN.ensembles * np.cumsum([chain.blocks(phase) for phase in PHASES])
    inside = np.searchsorted(ends, INTERRUPTIONS, side="right")
    assert {0, 1, 2} == set(inside.tolist())
    assert {*ends[:2].tolist()} <= set(INTERRUPTIONS)


def test_pareto_k_is_that_of_the_draws_that_count(finished: tuple[Chain, Outcome]) -> None:
    chain, outcome = finished
    proposal = chain.proposals["sampling"]
    assert proposal is not None
    density = proposal.log_density(chain.coordinates("sampling").reshape(-1, 3))
    expected = pareto_k(chain.log_density("sampling").ravel() - density)
    assert expected == outcome.check.pareto_k
    assert expected < 0.7
    assert () == outcome.remarks


def test_every_move_is_counted_in_every_phase(finished: tuple[Chain, Outcome]) -> None:
    chain, _ = finished
    names = ["differential evolution", "snooker", "mixture"]
    for phase in PHASES:
        moves = chain.moves(phase)
        assert names == list(moves)
        proposed, accepted = np.sum(list(moves.values()), axis=0)
        assert chain.steps(phase) * PLAN.ensembles * PLAN.walkers == proposed
        assert np.sum(chain.accepted(phase)) == accepted


def checked(watched: Watched) -> list[int]:
    return [result.steps for result in watched.checks]


def test_checks_wait_until_the_chain_is_predicted_to_be_long_enough() -> None:
    """The first of the two that must pass needs half the draws, the second a fifth more."""
    plan, watched = replace(LONG, ess=20_000), Watched()
    with ThreadPoolExecutor(1) as executor:
        sample(POSTERIOR, plan, new_chain(plan), executor, watched)
    assert FIRST_CHECK * plan.block == checked(watched)[0]
    passed = 0.0
    for before, after in itertools.pairwise(watched.checks):
        if not before.shortcomings(plan.ess, 0.5):
            passed = passed or before.steps
        fewest = np.min([before.ess_bulk, before.ess_tail])
        required = max(before.steps * plan.ess / fewest, 50 * np.max(before.autocorrelation))
        required = max(required, 1.2 * passed) if passed else 0.5 * required
        assert required > before.steps
        steps = min(required, 3 * before.steps)
        assert plan.block * np.ceil(steps / plan.block) == after.steps


def test_no_check_comes_before_its_autocorrelation_times() -> None:
    """Half of fifty before the first that may pass, all of them before the second.

    With differential evolution alone, whose times are long.
    """
    plan, watched = replace(LONG, ess=1), Watched()
    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(1) as executor:
        patch.setattr(StudentMixture, "fitted", flat)
        sample(POSTERIOR, plan, new_chain(plan), executor, watched)
    times = [each.steps / np.max(each.autocorrelation) for each in watched.checks]
    assert min(times) >= 25
    assert times[-1] >= 50
    assert 2 == sum(not each.shortcomings(1, 0.5) for each in watched.checks)


def test_a_long_sampling_is_checked_rarely() -> None:
    """After a fifth of its blocks at most."""
    watched, chain = Watched(), new_chain(LONG)
    with ThreadPoolExecutor(1) as executor:
        outcome = sample(POSTERIOR, replace(LONG, ess=20_000), chain, executor, watched)
    assert outcome.converged
    assert 5 * len(watched.checks) <= chain.blocks("sampling")


def test_a_chain_whose_target_is_made_smaller_is_judged_at_its_end(
    finished: tuple[Chain, Outcome],
) -> None:
    chain = copy.deepcopy(finished[0])
    outcome = sample(POSTERIOR, replace(PLAN, ess=50), chain, PluggedExecutor(0))
    assert outcome.converged
    assert chain.steps("sampling") == outcome.check.steps


def test_a_chain_whose_budget_is_made_smaller_is_judged_at_its_end(
    finished: tuple[Chain, Outcome],
) -> None:
    chain = copy.deepcopy(finished[0])
    outcome = sample(POSTERIOR, replace(PLAN, most_steps=40), chain, PluggedExecutor(0))
    assert chain.steps("sampling") == outcome.check.steps


def flat(draws: FloatArray) -> StudentMixture:
    """Fit nothing."""
    raise np.linalg.LinAlgError(f"{len(draws)} draws in a plane")


def test_without_any_proposal_differential_evolution_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(StudentMixture, "fitted", flat)
    chain, outcome = run(replace(PLAN, most_steps=20))
    assert chain.proposals["tuning"] is chain.proposals["sampling"] is None
    assert 20 == outcome.check.steps
    assert outcome.check.pareto_k is None
    (remark,) = outcome.remarks
    assert remark.startswith("no proposal could be fitted to the draws of the tuning: ")


def test_a_chain_whose_budget_was_small_goes_on_with_a_larger_one(
    finished: tuple[Chain, Outcome],
) -> None:
    chain, outcome = run(replace(PLAN, most_steps=40))
    assert not outcome.converged
    with ThreadPoolExecutor(1) as executor:
        outcome = sample(POSTERIOR, PLAN, chain, executor)
    assert_same_chain(finished[0], chain)
    assert_same_outcome(finished[1], outcome)


def test_a_finished_chain_is_left_as_it_is(finished: tuple[Chain, Outcome]) -> None:
    chain = copy.deepcopy(finished[0])
    again = sample(POSTERIOR, PLAN, chain, PluggedExecutor(0))
    assert_same_chain(finished[0], chain)
    assert_same_outcome(finished[1], again)


@pytest.mark.parametrize("walkers", [2, 4])
def test_too_few_walkers_are_refused(walkers: int) -> None:
    with pytest.raises(
        InputError, match=rf"^sampling.walkers: {walkers} are too few for 3 free .* at least 6$"
    ):
        new_chain(replace(PLAN, walkers=walkers))


@pytest.mark.parametrize(("change", "says"), [({"ensembles": 3}, "4"), ({"walkers": 13}, "even")])
def test_a_plan_that_cannot_be_is_refused(change: dict[str, int], says: str) -> None:
    with pytest.raises(InputError, match=says):
        replace(PLAN, **change)


def test_one_parameter_alone_is_sampled() -> None:
    """The offset of a known actuator under known white noise: a normal posterior."""
    known = {"d": 0.7, "alpha": 0.3575, "beta": 0.0272, "gamma": 0.0172, "initial": 0.0}
    posterior: Posterior = short_posterior("white", 50, fixed={**known, "sensor_sd": 0.3})
    assert ("offset",) == posterior.names
    point = fit(posterior, np.random.default_rng(4))
    plan = replace(PLAN, walkers=8)
    chain = first_chain(posterior, point, plan, np.random.default_rng(4))
    with ThreadPoolExecutor(1) as executor:
        outcome = sample(posterior, plan, chain, executor)
    assert outcome.converged
    zero = posterior.prior.theta(np.zeros((1, 1)))
    residual = posterior.only.displacement - posterior.simulate(zero)[0]
    expected = stats.norm(np.mean(residual), 0.3 / np.sqrt(50))
    result = draws(posterior, chain).ravel()
    error = 4 * expected.std() / np.sqrt(outcome.check.ess_bulk[0])
    # The prior pulls by less than a thousandth of the posterior's sd.
    assert expected.mean() == pytest.approx(np.mean(result), abs=error)
    assert expected.std() == pytest.approx(np.std(result), rel=0.15)
