"""Slope and level in place of d and the offset: a map that is undone, and that a few readings need.

Readings of an actuator with next to no hysteresis leave open whether α is none, or β so large or so
small that α does not show. Without the map walkers take one in a thousand of a mixture's places.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.inference import resolve_engine
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.proposals import StudentMixture
from bwbayes.sampling.secant import SecantMap
from tests.inference.problems import decaying_sine, posterior_of
from tests.sampled import converged

PLAN = SamplingPlan(
    ess=400, walkers=32, block=25, ensembles_per_task=4, tries=4, ahead=8, max_steps=3_000
)


@cache
def linear_actuator(seed: int, alpha: float = 0.005, readings: int = 40) -> Posterior:
    """Return the posterior of few readings of an actuator with hardly any hysteresis."""
    actuator = Actuator("none", "first", 2 / readings)
    voltage, generator = decaying_sine(readings, periods=2), np.random.default_rng(seed)
    theta = np.array([[0.7, alpha, 0.027, 0.017, 1.0, 0.0, 0.0]])
    displacement = actuator.displacement(theta, voltage)[0] + generator.normal(0, 0.2, readings)
    return replace(
        posterior_of(voltage, displacement, actuator, "white", {"exponent": 1.0}),
        engine=resolve_engine(),
    )


def places(posterior: Posterior, generator: np.random.Generator, count: int) -> FloatArray:
    """Draw places (count, free) from the prior: far from the readings, and on every leg."""
    return posterior.prior.unconstrain(posterior.prior.draw(generator, count))


@given(st.integers(0, 10**6), st.sampled_from([40, 30_000]))
def test_it_is_undone_and_tells_how_much_it_stretches(seed: int, readings: int) -> None:
    """A long record's, too, whose levels are those of a thinned one."""
    posterior = linear_actuator(1, readings=readings)
    generator = np.random.default_rng(seed)
    reference, *bent = places(posterior, generator, 4)
    mapped = SecantMap(reference, posterior)
    whitened, log_slope = mapped.forward(np.array(bent))
    again, log_back = mapped.inverse(whitened)
    np.testing.assert_allclose(again, bent, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(log_back, -log_slope, rtol=1e-6, atol=1e-6)


def test_its_stretch_is_that_of_differences() -> None:
    posterior, generator = linear_actuator(1), np.random.default_rng(3)
    mapped = SecantMap(places(posterior, generator, 1)[0], posterior)
    step = 1e-5 * np.eye(len(posterior.names))
    for place in places(posterior, generator, 20):
        ahead, back = (mapped.forward(place + sign * step)[0] for sign in (1, -1))
        _, log_slope = np.linalg.slogdet((ahead - back) / 2e-5)
        assert mapped.forward(place)[1] == pytest.approx(log_slope, abs=1e-3)


def test_a_place_without_a_model_is_nan() -> None:
    """There d would be below zero, or below α."""
    posterior = linear_actuator(1)
    mapped = SecantMap(places(posterior, np.random.default_rng(1), 1)[0], posterior)
    whitened = np.tile(mapped.forward(mapped.reference)[0], (2, 1))
    whitened[1, posterior.names.index("d")] -= 1e3
    bent, log_slope = mapped.inverse(whitened)
    np.testing.assert_array_equal(np.isnan(bent).all(axis=1), [False, True])
    assert np.isfinite(log_slope).all()


def test_a_mixture_is_the_same_after_a_file() -> None:
    """A file does not keep what is sampled: the mixture is told."""
    posterior, generator = linear_actuator(1), np.random.default_rng(1)
    bent = places(posterior, generator, 5)
    free = len(posterior.names)
    maps = (SecantMap(bent[0], posterior),)
    mixture = StudentMixture(np.ones(1), bent[:1], np.eye(free)[np.newaxis], maps)
    read = StudentMixture.of_arrays(mixture.arrays())
    assert read is not None
    np.testing.assert_array_equal(
        read.of_posterior(posterior).log_density(bent), mixture.log_density(bent)
    )


@pytest.mark.parametrize("seed", [1, *(pytest.param(s, marks=pytest.mark.slow) for s in (2, 3))])
def test_forty_readings_without_a_loop_converge(seed: int) -> None:
    """Within 3,000 steps; without the map about 25,000 would be needed."""
    chain = converged(linear_actuator(seed), PLAN, seed)
    proposal = chain.proposal_in_use("sampling")
    assert proposal is not None
    assert proposal.has_secant
