"""The statistics against what they stand for, and everything that must not count as converged."""

# mypy: allow-untyped-calls
# arviz_stats says that it has types, but its functions have none.

from dataclasses import replace

import numpy as np
import pytest
from arviz_stats.base import array_stats  # not in an __all__

from bwbayes.arrays import FloatArray
from bwbayes.sampling.diagnostics import (
    ConvergenceDiagnostics,
    as_chains,
    check,
    effective_draws,
    nested_rhat,
    pareto_k,
)
from tests.sampling.targets import student
from tests.stand import autoregressive

ENOUGH = np.full(2, 3e3)
GOOD = ConvergenceDiagnostics(1000, np.ones(2), ENOUGH, ENOUGH, ENOUGH, np.full(2, 4.0), 0.4, 0)


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.9, 0.98])
def test_effective_draws_of_a_known_process(kept: float) -> None:
    """An AR(1) series of N draws is worth N (1 − φ)/(1 + φ); within a third.

    The smaller of two estimates is taken, so it leans to the safe side.
    """
    draws = autoregressive(kept, 5000, (4, 16, 2), np.random.default_rng(2))
    expected = draws[..., 0].size * (1 - kept) / (1 + kept)
    for values in np.moveaxis(draws, -1, 0):
        assert expected == pytest.approx(effective_draws(values)[0], rel=0.33)


def test_rhat_and_effective_draws_are_arvizs() -> None:
    """Draws that repeat, as those of walkers that stay where they are, have equal ranks."""
    draws = np.round(autoregressive(0.5, 200, (4, 6, 3), np.random.default_rng(15)), 1)
    draws[:, 1, :, 2] += 1
    superchain = np.repeat(np.arange(4), 6)
    rhat, bulk, arvizs = nested_rhat(draws), [], []
    for i in range(3):
        chains = as_chains(draws[..., i])
        expected = array_stats.rhat_nested(chains, superchain_ids=superchain, method="rank")
        assert expected == pytest.approx(rhat[i], rel=1e-12)
        bulk.append(effective_draws(draws[..., i])[0])
        arvizs.append(array_stats.ess(chains, method="bulk"))
    np.testing.assert_allclose(arvizs[:2], bulk[:2], rtol=1e-12)
    # The third series, whose ensembles disagree, is capped by their means.
    assert bulk[2] < arvizs[2]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", [(0, 0, 0, 0), (-1, 3, 5, 1), (slice(None), 2, 3, 0)])
def test_what_is_not_finite_anywhere_never_counts_as_converged(
    value: float, where: tuple[int | slice, ...]
) -> None:
    draws = autoregressive(0.5, 600, (4, 16, 2), np.random.default_rng(1))
    draws[where] = value
    assert [] != check(draws, np.full((12, 4, 16), 20), 50).failures(1000)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"rhat": np.array([1.0, 1.02])}, "R-hat 1.020 is not below 1.01"),
        ({"rhat": np.array([1.0, 1.01004])}, "R-hat 1.011 is not below 1.01"),
        ({"walker_rhat": 1.0502}, "R-hat 1.051 of walkers is not below 1.05"),
        ({"ess_bulk": np.array([1999.7, 3000.0])}, "ESS 1999 has not reached 2000"),
        ({"ess_tail": np.array([1500.0, 3000.0])}, "ESS 1500 has not reached 2000"),
        ({"autocorrelation": np.array([3.0, 20.04])}, "49 autocorrelation times are fewer than 50"),
        ({"stuck": 3}, "3 walkers are stuck"),
        ({"pareto_k": 0.7004}, "Pareto k 0.71 is not below 0.7"),
    ],
)
def test_each_shortcoming_is_told(change: dict[str, FloatArray | float], says: str) -> None:
    assert [says] == replace(GOOD, **change).failures(2000)  # type: ignore[arg-type]


@pytest.mark.parametrize("variance", [0.3, 0.5, 0.8])
def test_pareto_k_of_a_normal_proposal(variance: float) -> None:
    """N(0, v) as the proposal for N(0, 1) has weights of tail shape k = 1 − v."""
    draws = np.random.default_rng(11).standard_normal(40_000)
    log_weights = -0.5 * draws**2 * (1 - 1 / variance)
    assert 1 - variance == pytest.approx(pareto_k(log_weights), abs=0.07)


def test_pareto_k_trusts_a_fitted_student_and_not_one_that_misses_a_mode() -> None:
    generator = np.random.default_rng(12)
    draws = generator.standard_normal((10_000, 5))
    fitted = student(np.mean(draws, axis=0), np.linalg.cholesky(np.cov(draws.T)))
    density = -0.5 * np.sum(draws**2, axis=1)
    assert pareto_k(density - fitted.log_density(draws)) < 0.5
    draws[:50] += 12
    density = np.logaddexp(
        np.log(0.995) - 0.5 * np.sum(draws**2, axis=1),
        np.log(0.005) - 0.5 * np.sum((draws - 12) ** 2, axis=1),
    )
    assert pareto_k(density - fitted.log_density(draws)) > 0.7
