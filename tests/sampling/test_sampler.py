"""A sampling ends for a reason that it tells, with the same bits wherever and however it ran."""

import copy
import itertools
from dataclasses import replace

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.sampling.chain import Chain
from bwbayes.sampling.diagnostics import ConvergenceDiagnostics, SamplingResult
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.proposals import StudentMixture
from bwbayes.sampling.sampler import FIRST_CHECK, _next_check, sample
from tests.sampling.samplings import PLAN, POSTERIOR, PluggedExecutor, Watched, new_chain, run


@pytest.fixture(scope="module")
def watched() -> Watched:
    return Watched()


@pytest.fixture(scope="module")
def finished(watched: Watched) -> tuple[Chain, SamplingResult]:
    return run(watcher=watched)


@pytest.mark.usefixtures("finished")
def test_it_stops_at_the_first_two_checks_that_find_nothing_missing(watched: Watched) -> None:
    """The second on a fifth more draws at least; for the first half the draws are enough."""
    *_, first, second = watched.checks
    assert [] == first.failures(PLAN.ess, 0.5)
    assert [] == second.failures(PLAN.ess)
    assert second.steps >= 1.2 * first.steps
    passed = [not result.failures(PLAN.ess) for result in watched.checks]
    assert not any(before and after for before, after in itertools.pairwise(passed[:-1]))


def test_a_budget_that_ends_with_the_first_good_check_is_told() -> None:
    plan = replace(PLAN, block=40, max_steps=40 * FIRST_CHECK)
    _, outcome = run(plan)
    assert [] == outcome.check.failures(plan.ess)
    assert not outcome.converged
    assert outcome.stop_reason.endswith("only the last check passed")


def test_a_chain_whose_target_is_made_smaller_is_judged_at_its_end(
    finished: tuple[Chain, SamplingResult],
) -> None:
    chain = copy.deepcopy(finished[0])
    outcome = sample(POSTERIOR, replace(PLAN, ess=50), chain, PluggedExecutor(0))
    assert outcome.converged
    assert chain.steps("sampling") == outcome.check.steps


def flat(draws: FloatArray, *_: object) -> StudentMixture:
    raise np.linalg.LinAlgError(f"{len(draws)} draws in a plane")


def test_without_any_proposal_differential_evolution_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(StudentMixture, "fitted", flat)
    chain, outcome = run(replace(PLAN, max_steps=20))
    assert chain.proposals["tuning"] is chain.proposals["sampling"] is None
    assert 20 == outcome.check.steps
    assert outcome.check.pareto_k is None
    (remark,) = outcome.remarks
    assert remark.startswith("no proposal covers the posterior: ")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"ensembles": 3}, "4"),
        ({"walkers": 13}, "even"),
        ({"walkers": 4}, "^sampling.walkers: 4 are too few for 3 free .* at least 6$"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(change: dict[str, int], says: str) -> None:
    with pytest.raises(InputError, match=says):
        new_chain(replace(PLAN, **change))


def test_a_chain_without_an_effective_draw_is_looked_at_again() -> None:
    """As where no walker moves; needed steps are said up to a hundred times the budget."""
    nothing = np.zeros(2)
    still = ConvergenceDiagnostics(
        50, nothing, nothing, nothing, nothing, np.full(2, np.nan), 0.0, 96
    )
    assert _next_check(SamplingPlan(), 2, 0, still) == 3
