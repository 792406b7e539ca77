"""Normal likelihoods in closed form, against integrals on a dense grid and what is obvious."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bwbayes.population.normal import Hyperprior, NormalLikelihoods, left_out, spreads

PRIOR = Hyperprior(0.2, 1.0, 0.7)
MEASURED = NormalLikelihoods(np.array([0.1, 0.4, 0.3, 0.9]), np.array([100.0, 25.0, 400.0, 0.0]))


def test_posterior_of_the_spread_is_that_of_an_integral_on_a_dense_grid() -> None:
    """Mean and spread on a grid, specimens integrated out one by one by their convolution."""
    mean = np.linspace(-1.5, 2.0, 701)[:, np.newaxis]
    spread = np.linspace(1e-3, 3.0, 600)
    logs = stats.norm.logpdf(mean, 0.2, 1.0) + stats.halfnorm.logpdf(spread, scale=0.7)
    for m, precision in zip(MEASURED.mean[:3], MEASURED.precision[:3], strict=True):
        logs = logs + stats.norm.logpdf(m, mean, np.sqrt(1 / precision + spread**2))
    density = np.exp(logs - np.max(logs))
    density /= np.sum(density)
    seen = spreads(MEASURED, PRIOR)
    for power in (1, 2):
        assert np.sum(density * spread**power) == pytest.approx(
            seen.probability @ seen.spread**power, rel=5e-3
        )
    assert np.sum(density * mean) == pytest.approx(seen.probability @ seen.mean, abs=2e-3)
    square = seen.probability @ (seen.variance + seen.mean**2)
    assert np.sum(density * mean**2) == pytest.approx(square, rel=5e-3)
    drawn = seen.draw(np.random.default_rng(1), 20_000)
    # Five standard errors of 20,000 draws.
    assert np.mean(drawn[0]) == pytest.approx(
        np.sum(density * mean), abs=5 * np.std(drawn[0]) / 141
    )
    assert np.mean(drawn[1]) == pytest.approx(
        np.sum(density * spread), abs=5 * np.std(drawn[1]) / 141
    )


def test_a_record_that_tells_nothing_is_the_population_and_moves_nothing() -> None:
    known = NormalLikelihoods(MEASURED.mean[:3], MEASURED.precision[:3])
    np.testing.assert_allclose(
        spreads(known, PRIOR).probability, spreads(MEASURED, PRIOR).probability, rtol=1e-9
    )
    assert 1.0 == left_out(MEASURED, PRIOR)[3]


def test_p_of_a_specimen_left_out_is_even_and_sees_one_that_is_off() -> None:
    """Kolmogorov-Smirnov at 1e-3 over 400 sound specimens; one of eight spreads off is seen."""
    generator = np.random.default_rng(3)
    p = []
    for _ in range(50):
        mean, spread = generator.normal(0.2, 1.0), abs(generator.normal(0, 0.7))
        sd = generator.uniform(0.02, 0.2, 8)
        measured = mean + np.hypot(spread, sd) * generator.standard_normal(8)
        p.append(left_out(NormalLikelihoods(measured, sd**-2.0), PRIOR))
    assert stats.kstest(np.concatenate(p), "uniform").pvalue > 1e-3
    off = np.array([0.0, 0.05, -0.05, 0.02, -0.03, 0.01, 0.04, 0.9])
    p_off = left_out(NormalLikelihoods(off, np.full(8, 1e4)), PRIOR)
    assert p_off[7] < 1e-4 < np.min(p_off[:7])
