"""The statistics against what they stand for, and everything that must not count as converged."""

# mypy: allow-untyped-calls
# arviz_stats says that it has types, but its functions have none.

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from arviz_stats.base import array_stats  # type: ignore[attr-defined]  # not in an __all__
from emcee.moves import DEMove

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.sampling import diagnostics
from bwbayes.sampling.diagnostics import (
    Check,
    as_chains,
    check,
    effective_draws,
    nested_rhat,
    pareto_k,
)
from bwbayes.sampling.ensemble import advance, start
from bwbayes.sampling.proposals import StudentProposal
from tests.inference.problems import gaussian

STEPS, ENSEMBLES, WALKERS, FREE = 600, 4, 16, 2
BLOCK = 50

ENOUGH = np.full(2, 3e3)
GOOD = Check(1000, np.ones(2), ENOUGH, ENOUGH, ENOUGH, np.full(2, 4.0), 0.4, 0)


def autoregressive(
    kept: float, steps: int, shape: tuple[int, ...], generator: np.random.Generator
) -> FloatArray:
    """Draw stationary AR(1) series (steps, *shape) of unit variance."""
    draws = np.empty((steps, *shape))
    draws[0] = generator.standard_normal(shape)
    for step in range(1, steps):
        shocks = generator.standard_normal(shape)
        draws[step] = kept * draws[step - 1] + np.sqrt(1 - kept**2) * shocks
    return draws


def good_draws(seed: int = 1, kept: float = 0.5) -> FloatArray:
    generator = np.random.default_rng(seed)
    return autoregressive(kept, STEPS, (ENSEMBLES, WALKERS, FREE), generator)


def moving(walkers: int = WALKERS) -> IntArray:
    return np.full((STEPS // BLOCK, ENSEMBLES, walkers), 20, dtype=np.int64)


def shortcomings(draws: FloatArray, accepted: IntArray | None = None) -> list[str]:
    return check(draws, moving() if accepted is None else accepted, BLOCK).shortcomings(1000)


def folded_ess(draws: FloatArray) -> FloatArray:
    """Count effective draws in the wrong way: walkers folded into draws step by step."""
    steps, ensembles, walkers, free = draws.shape
    folded = draws.transpose(0, 2, 1, 3).reshape(steps * walkers, ensembles, 1, free)
    return effective_draws(folded)[0]


def test_good_draws_have_converged() -> None:
    assert [] == shortcomings(good_draws())


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.9, 0.98])
def test_effective_draws_of_a_known_process(kept: float) -> None:
    """An AR(1) series of N draws is worth N (1 − φ)/(1 + φ); within a third.

    The smaller of two estimates is taken, so it leans to the safe side.
    """
    draws = autoregressive(kept, 5000, (4, 16, 2), np.random.default_rng(2))
    expected = draws[..., 0].size * (1 - kept) / (1 + kept)
    bulk, _ = effective_draws(draws)
    np.testing.assert_allclose(expected, bulk, rtol=0.33)


def test_effective_draws_predict_the_variance_of_ensemble_means() -> None:
    """Over 300 independent repetitions the variance of the mean is one over the ESS, within 30 %.

    A variance from 300 numbers has a standard error of 8 %, and the ESS leans to the safe side by
    as much, being the smaller of two estimates (false alarms: 1 %).
    """
    series = autoregressive(0.9, 1000, (300, 4, 8, 1), np.random.default_rng(3))
    truth = 1 / np.var(np.mean(series, axis=(0, 2, 3)))
    bulk = np.mean([effective_draws(series[:, i])[0] for i in range(20)])
    assert truth == pytest.approx(bulk, rel=0.3)


@pytest.fixture(scope="module")
def emcee_runs() -> FloatArray:
    """Twenty-four stationary ensembles on a Gaussian, by differential evolution."""
    posterior, point = gaussian(3)
    factor = np.linalg.cholesky(point.covariance)
    chains = []
    for seed in np.random.SeedSequence(4).spawn(24):
        generator = np.random.default_rng(seed)
        state = start(posterior, point, 0, 16, generator)
        exact = generator.standard_normal((16, 3)) @ factor.T
        state = replace(state, coordinates=exact, log_density=posterior.log_density(exact))
        chains.append(advance(posterior, [(DEMove(), 1.0)], state, 500).coordinates)
    return np.stack(chains, axis=1)


def test_effective_draws_of_real_runs_predict_the_variance_of_their_means(
    emcee_runs: FloatArray,
) -> None:
    """Within a factor of two: 24 means give their variance within 29 % (one standard error)."""
    means = np.mean(emcee_runs, axis=(0, 2))
    truth = 24 / np.var(means, axis=0, ddof=1)
    bulk, _ = effective_draws(emcee_runs)
    ratio = np.mean(bulk / truth)
    assert 0.5 < ratio < 2, ratio


def test_the_means_effective_draws_are_not_those_of_the_ranks() -> None:
    """A lognormal of a Gaussian AR(1) series has an autocorrelation time of its own.

    Of log x with autocorrelation φ^k, x has (exp(s² φ^k) − 1) / (exp(s²) − 1): times of 30 and 39
    for φ = 0.95 and s = 1. The estimate, as arviz has it, is within a tenth in five seeds.
    """
    series = np.exp(autoregressive(0.95, 5000, (4, 16, 1), np.random.default_rng(17)))
    result = check(series, np.full((100, 4, 16), 20), BLOCK)
    kept = 0.95 ** np.arange(1, 2000)
    time = 1 + 2 * np.sum(np.expm1(kept)) / np.expm1(1)
    assert series.size / time == pytest.approx(result.ess_mean[0], rel=0.15)
    assert result.ess_mean[0] > 1.15 * result.ess_bulk[0]
    arvizs = array_stats.ess(as_chains(series), method="mean", chain_axis=0, draw_axis=1)
    assert result.ess_mean[0] <= arvizs[0] * (1 + 1e-12)


def test_twin_folding_walkers_step_by_step_overstates_many_times(emcee_runs: FloatArray) -> None:
    bulk, _ = effective_draws(emcee_runs)
    assert (folded_ess(emcee_runs) > 5 * bulk).all()
    draws = autoregressive(0.98, 500, (4, 16, 1), np.random.default_rng(5))
    assert (folded_ess(draws) > 20 * effective_draws(draws)[0]).all()


def test_walkers_that_move_together_are_not_counted_as_many() -> None:
    """The cap by ensemble means: sixteen walkers on one path are worth one."""
    path = autoregressive(0.5, 2000, (4, 1, 1), np.random.default_rng(6))
    together = path + 0.01 * np.random.default_rng(7).standard_normal((2000, 4, 16, 1))
    alone = effective_draws(path)[0]
    np.testing.assert_allclose(alone, effective_draws(together)[0], rtol=0.1)


def test_every_walker_is_a_chain() -> None:
    draws = np.arange(5 * 2 * 3 * 2, dtype=float).reshape(5, 2, 3, 2)
    chains = as_chains(draws)
    assert (6, 5, 2) == chains.shape
    for ensemble in range(2):
        for walker in range(3):
            np.testing.assert_array_equal(draws[:, ensemble, walker], chains[3 * ensemble + walker])


def test_rhat_and_effective_draws_are_arvizs() -> None:
    """Draws that repeat, as those of walkers that stay where they are, have equal ranks."""
    draws = np.round(autoregressive(0.5, 200, (4, 6, 3), np.random.default_rng(15)), 1)
    draws[:, 1, :, 2] += 1
    chains = as_chains(draws)
    superchain = np.repeat(np.arange(4), 6)
    axes: dict[str, int] = {"chain_axis": 0, "draw_axis": 1}
    rhat = array_stats.rhat_nested(chains, superchain_ids=superchain, method="rank", **axes)
    np.testing.assert_allclose(rhat, nested_rhat(draws), rtol=1e-12)
    bulk, _ = effective_draws(draws)
    arvizs = array_stats.ess(chains, method="bulk", **axes)
    assert (bulk <= arvizs * (1 + 1e-12)).all()
    # The third series, whose ensembles disagree, is capped by their means.
    np.testing.assert_allclose(arvizs[:2], bulk[:2], rtol=1e-12)


@pytest.mark.parametrize("steps", [201, 202, 203])
def test_rhat_of_halves_that_are_not_even_is_arvizs_within_rounding(steps: int) -> None:
    """There arviz leaves out the middle draw before it ranks, and not after."""
    draws = autoregressive(0.5, steps, (4, 6, 2), np.random.default_rng(16))
    half = steps // 2
    halves = np.concatenate([draws[:half], draws[steps - half :]], axis=1)
    ids = np.repeat(np.arange(8), 6)
    axes: dict[str, int] = {"chain_axis": 0, "draw_axis": 1}
    whole = array_stats.rhat_nested(as_chains(draws), superchain_ids=ids[:24], **axes)
    apart = array_stats.rhat_nested(as_chains(halves), superchain_ids=ids, **axes)
    result = check(draws, moving(6)[:8], 25).rhat
    np.testing.assert_allclose(np.maximum(whole, apart), result, atol=2e-4)


def test_nested_rhat_of_agreeing_ensembles_is_one() -> None:
    np.testing.assert_allclose(1.0, nested_rhat(good_draws()), atol=0.005)


@pytest.mark.parametrize("shift", [0.5, 3.0])
def test_ensembles_that_disagree_have_not_converged(shift: float) -> None:
    draws = good_draws()
    draws[:, 2, :, 1] += shift
    rhat = nested_rhat(draws)
    assert rhat[0] < 1.01 < rhat[1]
    assert shortcomings(draws)[0].startswith("R-hat")


def test_an_ensemble_of_another_width_has_not_converged() -> None:
    """Ranks are folded as well, so that a scale shows as a place does."""
    draws = good_draws()
    draws[:, 2, :, 1] *= 4
    rhat = check(draws, moving(), BLOCK).rhat
    assert rhat[0] < 1.01 < rhat[1]


def test_ensembles_that_never_move_have_not_converged() -> None:
    """Tight clusters, far apart, as they start."""
    generator = np.random.default_rng(8)
    starts = 10 * generator.standard_normal((ENSEMBLES, 1, FREE))
    starts = starts + 0.2 * generator.standard_normal((ENSEMBLES, WALKERS, FREE))
    draws = np.tile(starts, (STEPS, 1, 1, 1))
    result = shortcomings(draws, np.zeros_like(moving()))
    assert any(text.startswith("R-hat") for text in result)
    assert f"{ENSEMBLES * WALKERS} walkers are stuck" in result


def test_walkers_that_never_move_from_one_common_cloud_have_not_converged() -> None:
    cloud = np.random.default_rng(9).standard_normal((ENSEMBLES, WALKERS, FREE))
    draws = np.tile(cloud, (STEPS, 1, 1, 1))
    assert len(shortcomings(draws, np.zeros_like(moving()))) >= 2


def test_drift_is_caught_by_the_split() -> None:
    """All ensembles drift together: they agree as a whole, their halves do not."""
    draws = good_draws()
    draws += 0.6 * np.linspace(-1, 1, STEPS)[:, np.newaxis, np.newaxis, np.newaxis]
    assert (nested_rhat(draws) < 1.01).all()
    assert (check(draws, moving(), BLOCK).rhat > 1.01).all()


def test_one_stuck_walker_of_256_blocks() -> None:
    generator = np.random.default_rng(10)
    draws = autoregressive(0.5, STEPS, (ENSEMBLES, 64, FREE), generator)
    accepted = moving(64)
    assert [] == check(draws, accepted, BLOCK).shortcomings(1000)
    draws[:, 1, 7] = 0.3
    accepted[:, 1, 7] = 0
    assert ["1 walkers are stuck"] == check(draws, accepted, BLOCK).shortcomings(1000)


def test_a_walker_that_was_stuck_earlier_no_longer_blocks() -> None:
    accepted = moving()
    accepted[0, 1, 7] = 0
    assert [] == shortcomings(good_draws(), accepted)


def test_a_walker_that_moved_once_and_stands_still_since_is_stuck() -> None:
    """Its last two blocks are some 25 autocorrelation times of three steps; ten had moves."""
    accepted = moving()
    accepted[-2:, 1, 7] = 0
    assert ["1 walkers are stuck"] == shortcomings(good_draws(), accepted)


def test_walkers_that_keep_to_their_modes_in_one_parameter_are_told() -> None:
    """The R-hat of walkers is the worst parameter's, whichever that is."""
    assert check(good_draws(), moving(), BLOCK).walker_rhat < 1.02
    for parameter in range(FREE):
        draws = good_draws()
        draws[:, :, ::2, parameter] += 4
        result = check(draws, moving(), BLOCK)
        assert result.walker_rhat > 1.5
        assert any("of walkers" in text for text in result.shortcomings(1000))


def test_effective_draws_of_the_tails_are_those_of_the_outer_twentieths() -> None:
    """Draws that stay in a tail for long are few there, and hardly fewer in the body.

    Arviz's estimate on the same draws differs by how it finds the quantile.
    """
    generator = np.random.default_rng(17)
    draws = generator.standard_normal((2000, 4, 8, 1))
    for start_of_stay in range(0, 2000, 20):
        away = generator.random((4, 8, 1)) < 0.04
        draws[start_of_stay : start_of_stay + 20, away] += 6
    chains = as_chains(draws)
    axes: dict[str, int] = {"chain_axis": 0, "draw_axis": 1}

    def arvizs(part: float) -> float:
        return float(array_stats.ess(chains, method="tail", prob=(part, 1 - part), **axes)[0])

    _, tail = effective_draws(draws)
    assert arvizs(0.05) == pytest.approx(tail[0], rel=0.05)
    assert arvizs(0.25) > 2 * tail[0]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", [(0, 0, 0, 0), (-1, 3, 5, 1), (slice(None), 2, 3, 0)])
def test_what_is_not_finite_anywhere_never_counts_as_converged(
    value: float, where: tuple[int | slice, ...]
) -> None:
    draws = good_draws()
    draws[where] = value
    assert [] != shortcomings(draws)


@pytest.mark.parametrize("name", ["rhat", "ess_bulk", "ess_tail", "autocorrelation"])
def test_a_statistic_that_is_not_a_number_never_passes(name: str) -> None:
    good = Check(
        steps=1000,
        rhat=np.array([1.001, 1.002]),
        ess_bulk=np.array([5000.0, 6000.0]),
        ess_tail=np.array([5000.0, 6000.0]),
        ess_mean=np.array([5000.0, 6000.0]),
        autocorrelation=np.array([3.0, 4.0]),
        acceptance=0.4,
        stuck=0,
    )
    assert [] == good.shortcomings(2000)
    for values in ([np.nan, 1.0], [1.0, np.nan], [np.nan, np.nan]):
        scaled = getattr(good, name) * np.array(values)
        assert 1 == len(replace(good, **{name: scaled}).shortcomings(2000))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"rhat": np.array([1.0, 1.02])}, "R-hat 1.020 is not below 1.01"),
        ({"ess_bulk": np.array([1999.0, 3000.0])}, "ESS 1999 has not reached 2000"),
        ({"ess_tail": np.array([1500.0, 3000.0])}, "ESS 1500 has not reached 2000"),
        ({"autocorrelation": np.array([3.0, 25.0])}, "40 autocorrelation times are fewer than 50"),
        ({"stuck": 3}, "3 walkers are stuck"),
        # What is rounded to its limit shows its digits.
        ({"rhat": np.array([1.0, 1.01004])}, "R-hat 1.01004 is not below 1.01"),
        ({"rhat": np.array([1.0, 1.01])}, "R-hat 1.010 is not below 1.01"),
        ({"walker_rhat": 1.0502}, "R-hat 1.0502 of walkers is not below 1.05"),
        ({"ess_bulk": np.array([1999.7, 3000.0])}, "ESS 1999.7 has not reached 2000"),
        (
            {"autocorrelation": np.array([3.0, 20.04])},
            "49.9 autocorrelation times are fewer than 50",
        ),
        ({"pareto_k": 0.7004}, "Pareto k 0.7004 is not below 0.7"),
    ],
)
def test_each_shortcoming_is_told(change: dict[str, FloatArray | float], says: str) -> None:
    assert [says] == replace(GOOD, **change).shortcomings(2000)  # type: ignore[arg-type]


def test_acceptance_is_the_mean_fraction_of_moves() -> None:
    accepted = moving()
    accepted[0] = 50
    expected = (50 + 20 * (len(accepted) - 1)) / (len(accepted) * BLOCK)
    assert expected == pytest.approx(check(good_draws(), accepted, BLOCK).acceptance)


def test_a_proposal_that_does_not_cover_the_draws_is_a_shortcoming() -> None:
    for shape in (None, -0.2, 0.69):
        assert [] == replace(GOOD, pareto_k=shape).shortcomings(2000)
    for shape in (0.7, np.inf, np.nan):
        expected = [f"Pareto k {shape:.2f} is not below 0.7"]
        assert expected == replace(GOOD, pareto_k=shape).shortcomings(2000)


def test_a_chain_too_short_to_judge_has_not_converged() -> None:
    draws = good_draws()[:3]
    assert [] != check(draws, moving()[:1], 3).shortcomings(1)


@pytest.mark.parametrize("variance", [0.3, 0.5, 0.8])
def test_pareto_k_of_a_normal_proposal(variance: float) -> None:
    """N(0, v) as the proposal for N(0, 1) has weights of tail shape k = 1 − v."""
    draws = np.random.default_rng(11).standard_normal(40_000)
    log_weights = -0.5 * draws**2 * (1 - 1 / variance)
    assert 1 - variance == pytest.approx(pareto_k(log_weights), abs=0.07)


def test_pareto_k_trusts_a_fitted_student_and_not_one_that_misses_a_mode() -> None:
    generator = np.random.default_rng(12)
    draws = generator.standard_normal((10_000, 5))
    fitted = StudentProposal.fitted(draws)
    density = -0.5 * np.sum(draws**2, axis=1)
    assert pareto_k(density - fitted.log_density(draws)) < 0.5
    draws[:50] += 12
    density = np.logaddexp(
        np.log(0.995) - 0.5 * np.sum(draws**2, axis=1),
        np.log(0.005) - 0.5 * np.sum((draws - 12) ** 2, axis=1),
    )
    assert pareto_k(density - fitted.log_density(draws)) > 0.7


@pytest.mark.parametrize("variance", [0.3, 0.5, 0.8])
def test_pareto_k_of_a_chain_that_repeats_itself(variance: float) -> None:
    """A walker repeats places of large weight; three steps in four are proposed independently."""
    generator = np.random.default_rng(13)
    walkers, log_weight = generator.standard_normal(400), -0.5 * (1 - 1 / variance)
    log_weights = []
    for _ in range(400):
        independent = generator.random(400) < 0.75
        afar = generator.standard_normal(400) * variance**0.5
        nearby = walkers + 1.5 * generator.standard_normal(400)
        proposed = np.where(independent, afar, nearby)
        factor = np.where(independent, log_weight, -0.5) * (proposed**2 - walkers**2)
        walkers = np.where(np.log(generator.random(400)) < factor, proposed, walkers)
        log_weights.append(log_weight * walkers**2)
    assert 1 - variance == pytest.approx(pareto_k(np.array(log_weights).ravel()), abs=0.12)


def test_pareto_k_of_an_exact_proposal_passes() -> None:
    """Its log weights are equal, but for rounding."""
    proposal = StudentProposal(np.zeros(3), np.eye(3))
    draws = proposal.draw(np.random.RandomState(1), 5000)
    shifted = proposal.log_density(draws) + 1000.1 - proposal.log_density(draws)
    assert np.ptp(shifted) > 0
    for log_weights in (shifted, np.full(1000, 30.0)):
        assert replace(GOOD, pareto_k=pareto_k(log_weights)).covered


def test_pareto_k_of_no_draws_is_not_trusted() -> None:
    assert np.inf == pareto_k(np.empty(0))


def test_pareto_k_of_what_is_not_a_number_is_not_trusted() -> None:
    log_weights = np.random.default_rng(14).standard_normal(1000)
    log_weights[3] = np.nan
    assert not pareto_k(log_weights) < 0.7


def test_a_check_leaves_the_warnings_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even where its threads change them, as they do when two silence warnings side by side."""

    def silencing(_: FloatArray) -> FloatArray:
        warnings.simplefilter("ignore")
        return np.ones(5)

    monkeypatch.setattr(diagnostics, "_one_parameter", silencing)
    before = list(warnings.filters)
    check(good_draws(), moving(), BLOCK)
    assert before == list(warnings.filters)
