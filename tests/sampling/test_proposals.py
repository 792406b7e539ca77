"""Proposals propose what their density says, whatever they were fitted to.

That they leave a distribution as it is, :mod:`tests.sampling.test_moves` shows.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from bwbayes.arrays import FloatArray
from bwbayes.sampling.proposals import StudentMixture

# Two components far apart, so that a draw shows which one it came from, and a wide one.
MIXTURE = StudentMixture(
    np.array([0.2, 0.7, 0.1]),
    np.array([[-40.0, 3.0], [40.0, 0.0], [0.0, 200.0]]),
    np.array([[[1.0, 0.0], [0.5, 2.0]], [[0.5, 0.0], [-1.0, 0.4]], [[3.0, 0.0], [0.0, 3.0]]]),
)


def test_the_density_is_that_of_scipys_mixture() -> None:
    """Near each component and far from all of them."""
    x = np.random.default_rng(2).uniform([-60, -20], [60, 220], (200, 2))
    parts = np.stack(
        [
            stats.multivariate_t(center, factor @ factor.T, df=6).logpdf(x)
            for center, factor in zip(MIXTURE.centers, MIXTURE.factors, strict=True)
        ]
    )
    expected = logsumexp(parts, axis=0, b=MIXTURE.weights[:, np.newaxis])
    np.testing.assert_allclose(expected, MIXTURE.log_density(x), atol=1e-10)


def test_draws_have_the_distribution() -> None:
    """Each coordinate, and one direction across, by Kolmogorov-Smirnov at one in 10,000."""
    draws = MIXTURE.draw(np.random.RandomState(3), 20_000)  # emcee's generator
    for direction in np.array([[1.0, 0.0], [0.0, 1.0], [0.6, -0.8]]):

        def cdf(x: FloatArray, direction: FloatArray = direction) -> FloatArray:
            widths = np.linalg.norm(direction @ MIXTURE.factors, axis=1)
            return np.asarray(
                stats.t.cdf(x[:, np.newaxis], 6, MIXTURE.centers @ direction, widths)
                @ MIXTURE.weights
            )

        assert stats.kstest(draws @ direction, cdf).pvalue > 1e-4


GENERATOR = np.random.default_rng(12)
NORMAL = GENERATOR.standard_normal((1000, 3))
FLAT = {
    "all the same": np.zeros((100, 3)),
    "one coordinate the same": np.column_stack([NORMAL, np.full(1000, 0.1)]),
    "one parameter, the same": np.full((1000, 1), 0.1),
    "in a plane": np.column_stack([NORMAL, NORMAL @ [0.3, 0.7, -0.2]]),
    "fewer than coordinates": GENERATOR.standard_normal((5, 9)),
}


@pytest.mark.parametrize("name", FLAT)
def test_draws_that_do_not_span_the_space_give_no_proposal(name: str) -> None:
    with pytest.raises(np.linalg.LinAlgError, match="do not span the space"):
        StudentMixture.fitted(FLAT[name])


def stuck(generator: np.random.Generator) -> FloatArray:
    """Nine tenths of the walkers do not move, so body, flank and tail cannot be told apart."""
    draws = generator.standard_normal((2000, 3))
    draws[200:] = draws[0]
    return draws


TINY = {
    "a few outliers": np.concatenate([NORMAL, 1e3 + NORMAL[:4]]),
    "far outliers": np.concatenate([NORMAL, 1e8 * (1 + NORMAL[:5])]),
    "stuck walkers": stuck(np.random.default_rng(13)),
    "units far apart": NORMAL * [1e-6, 1.0, 1e3],
}


@pytest.mark.parametrize("name", TINY)
def test_components_of_hardly_any_draws_give_no_nan(name: str) -> None:
    mixture = StudentMixture.fitted(TINY[name], np.zeros(len(TINY[name])))
    assert (4,) == mixture.weights.shape
    assert (mixture.weights > 0).all()
    assert np.isfinite(mixture.log_density(TINY[name])).all()
    proposed = mixture.draw(np.random.RandomState(14), 500)
    assert np.isfinite(mixture.log_density(proposed)).all()
