"""A proposal that does not cover its draws is given up, and differential evolution goes on alone.

The planted proposal is a normal distribution of a third of the posterior's width, whose weights
have a tail of shape 0.91: far above the limit of 0.7, that of a fitted one far below.
"""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.sampling.chain import Chain
from bwbayes.sampling.proposals import COMPONENTS, StudentMixture, StudentProposal
from bwbayes.sampling.sampler import FIRST_CHECK, Outcome, draws, sample
from tests.sampling.samplings import (
    LONG,
    PLAN,
    POSTERIOR,
    InterruptedRunError,
    PluggedExecutor,
    assert_same_chain,
    assert_same_outcome,
    new_chain,
    run,
)


def narrow(draws: FloatArray) -> StudentMixture:
    """Fit normal distributions of a third of the width: a tail shape of 1 − 0.3² = 0.91."""
    centre, factor = np.mean(draws, axis=0), 0.3 * np.linalg.cholesky(np.cov(draws, rowvar=False))
    component = StudentProposal(centre, factor, freedom=1e6)
    return StudentMixture(np.full(COMPONENTS, 1 / COMPONENTS), (component,) * COMPONENTS)


@pytest.fixture(scope="module")
def fallen_back() -> tuple[Chain, Outcome]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StudentMixture, "fitted", narrow)
        return run(LONG)


def test_a_proposal_that_does_not_cover_its_draws_is_given_up(
    fallen_back: tuple[Chain, Outcome],
) -> None:
    """At the first check; what it drew does not count, and what counts it did not draw."""
    chain, outcome = fallen_back
    assert FIRST_CHECK == chain.set_aside
    assert chain.proposals["sampling"] is not None
    assert chain.proposal_in_use("sampling") is None
    assert {"differential evolution", "snooker"} == set(chain.moves("sampling"))
    assert len(chain.history("sampling")) == chain.blocks("sampling") + FIRST_CHECK
    assert chain.steps("sampling") == len(chain.log_density("sampling")) == outcome.check.steps
    first = chain.history("sampling")[FIRST_CHECK][0].coordinates
    np.testing.assert_array_equal(first, chain.coordinates("sampling")[: PLAN.block, 0])


def test_a_proposal_that_was_given_up_is_told_of(fallen_back: tuple[Chain, Outcome]) -> None:
    (remark,) = fallen_back[1].remarks
    steps = FIRST_CHECK * PLAN.block
    told = rf"the proposal did not cover its first {steps} steps \(Pareto k (0\.\d\d) "
    result = re.match(told, remark)
    assert result
    assert float(result[1]) > 0.7
    assert "differential evolution and snooker moves alone" in remark
    assert fallen_back[1].check.pareto_k is None


def test_without_the_proposal_the_draws_are_the_posteriors(
    fallen_back: tuple[Chain, Outcome],
) -> None:
    chain, outcome = fallen_back
    assert outcome.converged
    result = draws(POSTERIOR, chain)
    error = 4 / np.sqrt(outcome.check.ess_bulk)
    assert (np.abs(np.mean(result, axis=(0, 1, 2))) < error).all()
    assert (np.abs(np.var(result, axis=(0, 1, 2)) - 1) < np.sqrt(2) * error).all()


@pytest.mark.parametrize("blocks", [1, FIRST_CHECK, FIRST_CHECK + 1])
def test_interrupted_around_the_fall_back_it_goes_on_to_the_same_end(
    fallen_back: tuple[Chain, Outcome], monkeypatch: pytest.MonkeyPatch, blocks: int
) -> None:
    """In the first block of the sampling, before the check that fails, and after it."""
    monkeypatch.setattr(StudentMixture, "fitted", narrow)
    expected, outcome = fallen_back
    before = expected.blocks("pilot") + expected.blocks("tuning")
    chain = new_chain(LONG)
    with pytest.raises(InterruptedRunError):
        sample(POSTERIOR, LONG, chain, PluggedExecutor(PLAN.ensembles * (before + blocks)))
    assert (FIRST_CHECK if blocks >= FIRST_CHECK else 0) == chain.set_aside
    with ThreadPoolExecutor(1) as executor:
        again = sample(POSTERIOR, LONG, chain, executor)
    assert FIRST_CHECK == chain.set_aside
    assert_same_chain(expected, chain)
    assert_same_outcome(outcome, again)


def test_a_budget_that_ends_with_a_proposal_that_does_not_cover_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(StudentMixture, "fitted", narrow)
    chain, outcome = run(replace(PLAN, most_steps=40))
    assert 0 == chain.set_aside
    assert re.search(r"used up: .*Pareto k 0\.\d\d is not below 0\.7", outcome.stop_reason)
