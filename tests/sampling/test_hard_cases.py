"""A chain that has not converged is never called so, and one that has is.

The hard cases are chains broken in one way each (:mod:`tests.sampling.hard_chains`), judged with a
target of one effective draw, so that no large target hides a fault that the other criteria miss;
and targets that the sampler itself must not call sampled, within a budget that is ample for a good
one. Each chain fails by a wide margin, whatever its seed.

The good runs are a hundred, on three targets that differ in shape, in short blocks, where walkers
often rest for all of one. They need 100 to 300 steps and have a budget of 1,500. None may fail;
so the rate of false alarms is below 3% (at 95 % confidence). One in ten is in the default suite,
all with ``-m slow``.
"""

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.sampling import sampler
from bwbayes.sampling.chain import Phase
from bwbayes.sampling.diagnostics import ConvergenceDiagnostics, check
from bwbayes.sampling.plan import SamplingPlan
from tests.sampling.hard_chains import BLOCK, HARD, good, hard, moved
from tests.sampling.samplings import run
from tests.sampling.targets import TARGETS, gaussian, target

PLAN = SamplingPlan(
    ess=200, walkers=12, block=25, min_pilot_steps=50, max_pilot_steps=200, max_steps=400
)


# Chains


@pytest.mark.parametrize("name", HARD)
def test_hard_chain_never_passes(name: str) -> None:
    for seed in range(2):
        draws = hard(name, np.random.default_rng(seed))
        assert [] != check(draws, moved(draws), BLOCK).failures(1), seed


def test_twin_good_chain_passes_with_a_much_larger_target() -> None:
    for seed in range(10):
        draws = good(np.random.default_rng(seed))
        assert [] == check(draws, moved(draws), BLOCK).failures(1000), seed


# Targets


def point_at(*optima: list[float], width: float = 1.0) -> MAPEstimate:
    places = np.array(optima)
    covariance = width**2 * np.eye(places.shape[1])
    return MAPEstimate(places[0], covariance, 0.0, places, 25 * covariance)


def two_far_modes(x: FloatArray) -> FloatArray:
    """Give 80% of the probability to the second of them."""
    first, second = (-0.5 * np.sum((x - m) ** 2, axis=1) for m in (-30.0, 30.0))
    density: FloatArray = np.logaddexp(np.log(0.2) + first, np.log(0.8) + second)
    return density


def improper_ridge(x: FloatArray) -> FloatArray:
    """Flat along x₀ = x₁, without end."""
    density: FloatArray = -0.5 * ((x[:, 0] - x[:, 1]) / 0.1) ** 2
    return density


def improper_plain(x: FloatArray) -> FloatArray:
    return np.zeros(len(x))


def improper_tails(x: FloatArray) -> FloatArray:
    """So heavy that there is no integral."""
    density: FloatArray = -0.7 * np.log1p(np.sum(x**2, axis=1))
    return density


def improper_peak(x: FloatArray) -> FloatArray:
    """Grows without limit toward the origin, and has no integral there."""
    density: FloatArray = -6 * np.log(np.linalg.norm(x, axis=1))
    return density


FAR_STARTS = ([-1000.0, 0.0], [0.0, -1000.0], [0.0, 1000.0], [1000.0, 0.0])


def number_near_its_starts_alone(x: FloatArray) -> FloatArray:
    """As a posterior has it whose likelihood is nan everywhere else."""
    near = [np.linalg.norm(x - np.array(start), axis=1) < 12 for start in FAR_STARTS]
    return np.where(np.any(near, axis=0), 0.0, -np.inf)


MODES = point_at([-30.0, -30.0], [30.0, 30.0])
HARD_TARGETS = {
    "improper ridge": (improper_ridge, point_at([0.0, 0.0])),
    "improper plain": (improper_plain, point_at([0.0, 0.0])),
    "improper tails": (improper_tails, point_at([0.0, 0.0])),
    "improper peak": (improper_peak, point_at([1.0, 1.0])),
    "nan almost everywhere": (number_near_its_starts_alone, point_at(*FAR_STARTS)),
}


@pytest.mark.parametrize("name", HARD_TARGETS)
def test_hard_target_never_converges(name: str) -> None:
    density, point = HARD_TARGETS[name]
    _, outcome = run(PLAN, 1, target(density, 2), point)
    assert not outcome.converged
    assert re.match(f"step limit {PLAN.max_steps} (reached|out of reach): ", outcome.stop_reason)


def test_far_modes_converge_to_their_weights() -> None:
    """The proposal is fitted to both, so that walkers change between them."""
    chain, outcome = run(replace(PLAN, max_steps=4000), 2, target(two_far_modes, 2), MODES)
    assert outcome.converged
    share = np.mean(chain.coordinates("sampling")[..., 0] > 0)
    error = np.sqrt(0.8 * 0.2 / np.min(outcome.check.ess_bulk))
    assert 0.8 == pytest.approx(share, abs=4 * error)


def test_far_modes_do_not_converge_without_a_proposal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Differential evolution alone never changes between them: walkers stay where the pilot was."""
    monkeypatch.setattr(sampler._Sampling, "_fit_proposal", lambda *_, **__: None)
    chain, outcome = run(PLAN, 2, target(two_far_modes, 2), MODES)
    assert not outcome.converged
    upper = chain.coordinates("sampling")[..., 0] > 0
    assert (upper == upper[0]).all()
    assert 0 < np.mean(upper[0]) < 1


def thin_rings(x: FloatArray) -> FloatArray:
    """One in each other, so thin that hardly any place that is proposed lies on one."""
    radius = np.linalg.norm(x, axis=1)
    density: FloatArray = -0.5 * (np.sin(20 * radius) / 1e-3) ** 2 - 0.5 * radius**2
    return density


def interrupt(_: Phase, check: ConvergenceDiagnostics | None) -> None:
    if check is None:  # there is one more block
        raise KeyboardInterrupt


def test_budget_that_is_out_of_reach_is_not_used_up() -> None:
    """It is known after a tenth; going on ends at once, and with a budget that may do goes on."""
    plan, posterior = replace(PLAN, max_steps=8000), target(thin_rings, 2)
    chain, outcome = run(plan, 2, posterior, point_at([0.0, 0.0]))
    assert not outcome.converged
    assert outcome.stop_reason.startswith("step limit 8000 out of reach: about ")
    steps = chain.steps("sampling")
    assert steps + chain.set_aside * plan.block < 0.3 * plan.max_steps
    with ThreadPoolExecutor(1) as pool:
        again = sampler.sample(posterior, plan, chain, pool)
        assert again.stop_reason == outcome.stop_reason
        longer = replace(plan, max_steps=int(outcome.check.steps_needed))
        with pytest.raises(KeyboardInterrupt):
            sampler.sample(posterior, longer, chain, pool, interrupt)


# Good runs

GOOD = {
    "gaussian": (gaussian(3), 60),
    "bounded": ((target(TARGETS["bounded"].log_density, 2), point_at([0.5, 0.5], width=0.3)), 20),
    "bimodal": ((target(TARGETS["bimodal"].log_density, 3), point_at([0.5] * 3, width=0.3)), 20),
}


@pytest.mark.parametrize("one_in", [10, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("block", [5, 10])
@pytest.mark.parametrize("name", GOOD)
def test_good_run_converges(name: str, block: int, one_in: int) -> None:
    (posterior, point), runs = GOOD[name]
    plan = replace(PLAN, block=block, max_steps=1500)
    for seed in range(runs // 2 // one_in):
        _, outcome = run(plan, seed, posterior, point)
        assert outcome.converged, (seed, outcome.stop_reason)
