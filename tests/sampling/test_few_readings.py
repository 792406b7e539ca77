"""Few readings leave open whether the model misses anything at all: two modes, both sampled.

In one a discrepancy explains what the model misses, in the other it is next to nothing and all is
the sensor's noise. The share of each is worked out twice: by the chain, and by importance sampling
around the modes, which knows nothing of chains.
"""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.inference import map_estimate, resolve_engine
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.proposals import StudentMixture
from tests.inference.problems import decaying_sine, posterior_of
from tests.sampled import converged

READINGS = 20
PLAN = SamplingPlan(ess=2000, walkers=24, ensembles_per_task=4, tries=4, ahead=8)

# Readings whose share of the mode without a discrepancy is 1, 20 and 38%.
SEEDS = (5, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 4)))


def few_readings(seed: int) -> Posterior:
    """Return the posterior of twenty readings with a sine of 0.2 um that no model has."""
    actuator = Actuator("none", "first", 0.15)
    voltage, generator = 0.75 * decaying_sine(READINGS, periods=3), np.random.default_rng(seed)
    theta = np.array([[0.7, 0.36, 0.027, 0.017, 1.0, 0.0, 0.0]])
    times = actuator.interval * np.arange(READINGS)
    missed = 0.2 * np.sin(2.2 * times + seed) + generator.normal(0, 0.1, READINGS)
    displacement = actuator.displacement(theta, voltage)[0] + missed
    fixed = {"initial": 0.0, "exponent": 1.0}
    posterior = posterior_of(voltage, displacement, actuator, "discrepancy", fixed)
    return replace(posterior, engine=resolve_engine())


def without_discrepancy(posterior: Posterior, coordinates: FloatArray) -> BoolArray:
    """Return where (...,) a discrepancy is less than a fiftieth of a micrometer."""
    free, _ = posterior.prior.constrain(coordinates.reshape(-1, coordinates.shape[-1]))
    column = posterior.names.index("discrepancy_sd")
    return np.asarray(free[:, column] < 0.02).reshape(coordinates.shape[:-1])


def share_by_weights(posterior: Posterior, point: MAPEstimate) -> tuple[float, float]:
    """Return the share of the mode without a discrepancy by importance sampling, and its error."""
    around = StudentMixture.around(point.optima, *map_estimate.mode_weights(posterior, point))
    # Twice as wide as the modes: what is between them is reached too.
    proposal = replace(around, factors=2**0.5 * around.factors, freedom=3.0)
    places, proposed = proposal.evaluate(proposal.draw(np.random.RandomState(1), 400_000))
    weights = scipy.special.softmax(posterior.log_density(places) - proposed)
    inside = without_discrepancy(posterior, places)
    share = float(weights @ inside)
    return share, float(np.sqrt(np.sum(weights**2 * (inside - share) ** 2)))


@pytest.mark.parametrize("seed", SEEDS)
def test_the_share_of_each_mode_is_that_of_importance_sampling(seed: int) -> None:
    """Within four standard errors of both; those of the chain are of its four ensembles' means."""
    posterior = few_readings(seed)
    point = map_estimate.fit(posterior, np.random.default_rng(seed))
    assert len(point.optima) == 2
    expected, error = share_by_weights(posterior, point)
    inside = without_discrepancy(posterior, converged(posterior, PLAN).coordinates("sampling"))
    by_ensemble = np.mean(inside, axis=(0, 2))
    spread = np.hypot(error, np.std(by_ensemble, ddof=1) / 2)
    assert abs(np.mean(by_ensemble) - expected) < 4 * spread
    assert 5 * spread < expected  # a chain of one mode alone would be found
