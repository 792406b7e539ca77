"""A proposal that does not cover its draws is given up, and another one is fitted to these.

After half of the budget differential evolution goes on alone.

The planted proposal is a normal distribution of a third of the posterior's width, whose weights
have a tail of shape 0.91: far above the limit of 0.7, that of a fitted one far below.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.inference.posterior import Posterior
from bwbayes.sampling import sampler
from bwbayes.sampling.chain import Chain, draws
from bwbayes.sampling.monitor import Outcome
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.proposals import COMPONENTS, StudentMixture, StudentProposal
from bwbayes.sampling.sampler import FIRST_CHECK, Watcher, sample
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

# As it is, before a defect is planted.
tune = sampler._tune


def narrow(draws: FloatArray, _: FloatArray | None = None) -> StudentMixture:
    """Fit normal distributions of a third of the width: a tail shape of 1 − 0.3² = 0.91."""
    center, factor = np.mean(draws, axis=0), 0.3 * np.linalg.cholesky(np.cov(draws, rowvar=False))
    component = StudentProposal(center, factor, freedom=1e6)
    return StudentMixture(np.full(COMPONENTS, 1 / COMPONENTS), (component,) * COMPONENTS)


def tuned_to_a_narrow_one(
    posterior: Posterior, plan: SamplingPlan, chain: Chain, executor: Executor, watcher: Watcher
) -> None:
    """Tune, and plant a narrow proposal for the first draws that count."""
    tune(posterior, plan, chain, executor, watcher)
    every = chain.coordinates("tuning")
    chain.freeze("sampling", narrow(every.reshape(-1, every.shape[-1])))


Planting = Callable[[pytest.MonkeyPatch], None]


def plant_first(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(sampler, "_tune", tuned_to_a_narrow_one)


def plant_every(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(StudentMixture, "fitted", narrow)


def planted(planting: Planting) -> tuple[Chain, Outcome]:
    with pytest.MonkeyPatch.context() as patch:
        planting(patch)
        return run(LONG)


@pytest.fixture(scope="module")
def refitted() -> tuple[Chain, Outcome]:
    return planted(plant_first)


@pytest.fixture(scope="module")
def fallen_back() -> tuple[Chain, Outcome]:
    return planted(plant_every)


def test_proposals_that_do_not_cover_their_draws_are_given_up(
    fallen_back: tuple[Chain, Outcome],
) -> None:
    """In half of the budget; what they drew does not count, and what counts they did not."""
    chain, outcome = fallen_back
    half = LONG.most_steps / 2 / LONG.block
    assert 0 < chain.refitted <= half < chain.set_aside
    assert chain.set_aside < 1.5 * half
    assert chain.proposals["sampling"] is not None
    assert chain.proposal_in_use("sampling") is None
    assert {"differential evolution", "snooker"} == set(chain.moves("sampling"))
    assert len(chain.history("sampling")) == chain.blocks("sampling") + chain.set_aside
    assert chain.steps("sampling") == len(chain.log_density("sampling")) == outcome.check.steps
    first = chain.history("sampling")[chain.set_aside][0].coordinates
    np.testing.assert_array_equal(first, chain.coordinates("sampling")[: PLAN.block, 0])


def test_proposals_that_were_given_up_are_told_of(fallen_back: tuple[Chain, Outcome]) -> None:
    chain, outcome = fallen_back
    (remark,) = outcome.remarks
    steps = chain.set_aside * PLAN.block
    (shape,) = re.findall(rf"did not cover the first {steps} steps \(Pareto k (0\.\d\d)\)", remark)
    assert float(shape) > 0.7
    assert remark.startswith("the proposal ")
    assert "differential evolution and snooker moves alone" in remark
    assert fallen_back[1].check.pareto_k is None


@pytest.mark.parametrize("given_up", ["refitted", "fallen_back"])
def test_without_the_proposal_the_draws_are_the_posteriors(
    request: pytest.FixtureRequest, given_up: str
) -> None:
    chain, outcome = request.getfixturevalue(given_up)
    assert outcome.converged
    result = draws(POSTERIOR, chain)
    error = 4 / np.sqrt(outcome.check.ess_bulk)
    assert (np.abs(np.mean(result, axis=(0, 1, 2))) < error).all()
    assert (np.abs(np.var(result, axis=(0, 1, 2)) - 1) < np.sqrt(2) * error).all()


@pytest.mark.parametrize(
    ("given_up", "planting"), [("refitted", plant_first), ("fallen_back", plant_every)]
)
@pytest.mark.parametrize("blocks", [1, FIRST_CHECK, FIRST_CHECK + 1, 2 * FIRST_CHECK + 1])
def test_interrupted_around_the_fall_back_it_goes_on_to_the_same_end(
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    given_up: str,
    planting: Planting,
    blocks: int,
) -> None:
    """In the first block of the sampling, before a check that fails, and after it."""
    expected, outcome = request.getfixturevalue(given_up)
    blocks = min(blocks, len(expected.history("sampling")) - 1)
    planting(monkeypatch)
    before = expected.blocks("pilot") + expected.blocks("tuning")
    chain = new_chain(LONG)
    with pytest.raises(InterruptedRunError):
        sample(POSTERIOR, LONG, chain, PluggedExecutor(PLAN.ensembles * (before + blocks)))
    so_far = blocks // FIRST_CHECK * FIRST_CHECK
    assert min(so_far, expected.set_aside) == chain.set_aside
    chain.refit = None  # a file does not keep it
    with ThreadPoolExecutor(1) as executor:
        again = sample(POSTERIOR, LONG, chain, executor)
    assert expected.set_aside == chain.set_aside
    assert_same_chain(expected, chain)
    assert_same_outcome(outcome, again)
