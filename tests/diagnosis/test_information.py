"""What a record taught is what the closed form says, and a prior that decides is named."""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.identifiability import Learned, learned
from bwbayes.inference.posterior import Posterior
from tests.inference.test_solvable import closed_form, linear_posterior, prior_moments


def exact(posterior: Posterior, spread: float = 1.0) -> FloatArray:
    """Draws (steps, ensembles, walkers, free) of the closed form, that many times as wide."""
    known = closed_form(posterior)
    source = np.random.default_rng(1)
    flat = source.multivariate_normal(known.mean, spread**2 * known.covariance, size=6000)
    return flat.reshape(1000, 2, 3, -1)


def of(posterior: Posterior, draws: FloatArray) -> Learned:
    flat = draws.reshape(-1, draws.shape[-1])
    density = posterior.log_density(posterior.prior.unconstrain(flat)).reshape(draws.shape[:-1])
    return learned(posterior.prior, draws, density, np.random.default_rng(2))


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    return linear_posterior(("d", "alpha", "offset"), "white")


def test_the_contraction_is_that_of_the_variances(posterior: Posterior) -> None:
    """Within 0.07: four errors of 4,000 draws of either."""
    made = of(posterior, exact(posterior))
    ratio = closed_form(posterior).sd / prior_moments(posterior)[1]
    got = [made.parameters[name].contraction for name in posterior.names]
    np.testing.assert_allclose(got, 1 - ratio**2, atol=0.07)
    # The twin: draws that are half as wide look as if the record had taught more.
    narrow = of(posterior, exact(posterior, 0.5))
    got = [narrow.parameters[name].contraction for name in posterior.names]
    assert np.max(np.abs(got - (1 - ratio**2))) > 0.1


def test_the_worst_combination_is_the_closed_forms(posterior: Posterior) -> None:
    """Of the whitened posterior covariance the largest eigenvalue, and how it moves."""
    made = of(posterior, exact(posterior))
    known, (_, sd) = closed_form(posterior), prior_moments(posterior)
    whitened = known.covariance / np.outer(sd, sd)
    values, vectors = np.linalg.eigh(whitened)
    (worst, *_) = made.combinations
    assert worst.left == pytest.approx(np.sqrt(values[-1]), abs=0.04)
    assert worst.text.split()[0] == posterior.names[int(np.argmax(np.abs(vectors[:, -1])))]
    assert str(made.findings[-1]).startswith(f"determined worst: {worst.text}")


def test_a_parameter_that_the_readings_do_not_touch_is_its_priors(posterior: Posterior) -> None:
    """Its contraction is nothing, and the prior decides."""
    draws = exact(posterior)
    mean, sd = prior_moments(posterior)
    source = np.random.default_rng(3)
    draws[..., 2] = mean[2] + sd[2] * source.normal(size=draws.shape[:-1])
    # The likelihood of the others, at the best offset.
    flat = draws.reshape(-1, 3)
    fixed = flat.copy()
    fixed[:, 2] = closed_form(posterior).mean[2]
    theta = posterior.prior.theta(fixed)
    density = posterior.log_likelihood(theta)
    density += posterior.prior.constrain(posterior.prior.unconstrain(flat))[1]
    made = learned(
        posterior.prior, draws, density.reshape(draws.shape[:-1]), np.random.default_rng(2)
    )
    offset = made.parameters["offset"]
    assert abs(offset.contraction) < 0.1
    assert offset.prior_decides
    assert str(made.findings[0]).startswith("offset: the prior decides")
    assert not made.parameters["d"].prior_decides
