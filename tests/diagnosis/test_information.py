"""What a record taught is what the closed form says, and a prior that decides is named."""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.identifiability import Learned, learned
from bwbayes.inference.posterior import Posterior
from tests.inference.linear import Linear


def exact(model: Linear, spread: float = 1.0) -> FloatArray:
    """Draws (steps, ensembles, walkers, free) of the closed form, that many times as wide."""
    known = model.exact
    flat = known.mean + spread * (known.draw(6000, 1) - known.mean)
    return flat.reshape(1000, 2, 3, -1)


def of(posterior: Posterior, draws: FloatArray) -> Learned:
    flat = draws.reshape(-1, draws.shape[-1])
    density = posterior.log_density(posterior.prior.unconstrain(flat)).reshape(draws.shape[:-1])
    return learned(posterior.prior, draws, density, np.random.default_rng(2))


@pytest.fixture(scope="module")
def model() -> Linear:
    return Linear(("d", "alpha", "offset"), "white")


def test_the_contraction_is_that_of_the_variances(model: Linear) -> None:
    """Within 0.07: four errors of 4,000 draws of either."""
    expected = 1 - (model.exact.sd / model.sd) ** 2
    made, narrow = (of(model.posterior, exact(model, spread)) for spread in (1.0, 0.5))
    got = [made.parameters[name].contraction for name in model.posterior.names]
    np.testing.assert_allclose(got, expected, atol=0.07)
    # The twin: draws that are half as wide look as if the record had taught more.
    got = [narrow.parameters[name].contraction for name in model.posterior.names]
    assert np.max(np.abs(got - expected)) > 0.1


def test_the_worst_combination_is_the_closed_forms(model: Linear) -> None:
    """Of the whitened posterior covariance the largest eigenvalue, and how it moves."""
    made = of(model.posterior, exact(model))
    values, vectors = np.linalg.eigh(model.exact.covariance / np.outer(model.sd, model.sd))
    (worst, *_) = made.combinations
    assert worst.left == pytest.approx(np.sqrt(values[-1]), abs=0.04)
    assert worst.text.split()[0] == model.posterior.names[int(np.argmax(np.abs(vectors[:, -1])))]
    assert str(made.findings[-1]).startswith(f"determined worst: {worst.text}")


def test_a_parameter_that_the_readings_do_not_touch_is_its_priors(model: Linear) -> None:
    """Its contraction is nothing, and the prior decides."""
    draws, posterior = exact(model), model.posterior
    source = np.random.default_rng(3)
    draws[..., 2] = model.mean[2] + model.sd[2] * source.normal(size=draws.shape[:-1])
    # The likelihood of the others, at the best offset.
    flat = draws.reshape(-1, 3)
    fixed = flat.copy()
    fixed[:, 2] = model.exact.mean[2]
    density = posterior.log_likelihood(posterior.prior.theta(fixed))
    density += posterior.prior.constrain(posterior.prior.unconstrain(flat))[1]
    made = learned(
        posterior.prior, draws, density.reshape(draws.shape[:-1]), np.random.default_rng(2)
    )
    offset = made.parameters["offset"]
    assert abs(offset.contraction) < 0.1
    assert offset.prior_decides
    assert str(made.findings[0]).startswith("offset: the prior decides")
    assert not made.parameters["d"].prior_decides
