"""Modes are those of closed forms, and what is simulated once is what is simulated each time."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.inference.engine import Engine
from bwbayes.inference.mode_finding import Target, climb, refine
from tests.inference.linear import CASES, Linear, every_case
from tests.inference.problems import short_posterior

if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior

LINEAR = {noise: Linear(free, noise) for free, noise in CASES}


@pytest.mark.parametrize("noise", LINEAR)
@given(
    start=st.lists(st.floats(-4.0, 4.0), min_size=3, max_size=3), width=st.sampled_from([0.01, 1.0])
)
def test_a_normal_posteriors_mode_is_the_closed_form(
    noise: str, start: list[float], width: float
) -> None:
    """From anywhere, in units far from those of the mode: to 1e-5 sds, its covariance to 1e-4."""
    model = LINEAR[noise]
    place = np.array(start[: model.mean.size])
    mode = refine(model.posterior, place, width * np.eye(place.size))
    exact = model.exact
    np.testing.assert_allclose(
        (model.mean + mode.coordinates * model.sd - exact.mean) / exact.sd, 0.0, atol=1e-5
    )
    covariance = mode.covariance * np.outer(model.sd, model.sd) / np.outer(exact.sd, exact.sd)
    correlation = exact.covariance / np.outer(exact.sd, exact.sd)
    np.testing.assert_allclose(covariance, correlation, atol=1e-4)


@dataclass
class Ridge:
    """A density that is flat along a diagonal, as of a record that does not tell a ratio."""

    width: float

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Return it, up to a constant, at coordinates (points, 2)."""
        across = (coordinates @ np.array([0.6, 0.8])) / self.width
        return np.asarray(-0.5 * across**2)


@pytest.mark.parametrize("width", [1e-2, 1e-5, 1e-7])
def test_a_direction_without_any_curvature_leaves_a_covariance(width: float) -> None:
    """Which has a Cholesky factor, and is no wider than the prior if it would have none."""
    mode = refine(cast("Posterior", Ridge(width)), np.array([0.3, 0.1]), np.eye(2))
    assert np.isfinite(np.linalg.cholesky(mode.covariance)).all()
    assert np.linalg.eigvalsh(mode.covariance)[0] > 0


@every_case
def test_a_climb_to_a_normal_posterior_ends_at_its_mode(free: tuple[str, ...], noise: str) -> None:
    """Of several starts the best, with the Fisher information's covariance."""
    model, target = LINEAR[noise], Target(LINEAR[noise].posterior)
    state = climb(target, np.array([[3.0, -2.0, 1.0], [0.5, 4.0, -1.0]])[:, : len(free)])
    away = (model.mean + state.coordinates * model.sd - model.exact.mean) / model.exact.sd
    np.testing.assert_allclose(away, 0.0, atol=1e-5)
    covariance, log_determinant = target.covariance(state)
    exact = model.exact.covariance / np.outer(model.sd, model.sd)
    np.testing.assert_allclose(covariance, exact, rtol=1e-6)
    assert log_determinant == pytest.approx(np.linalg.slogdet(exact)[1], abs=1e-6)


@pytest.mark.parametrize("engine", ["numpy", "numba"])
@pytest.mark.parametrize("sparse", [False, True])
def test_a_displacement_that_is_held_gives_the_density_of_the_noise(
    engine: Engine, sparse: bool
) -> None:
    posterior = replace(short_posterior(samples=200), engine=engine)
    if sparse:
        reading = np.full_like(posterior.single_record.displacement, np.nan)
        reading[::4] = posterior.single_record.displacement[::4]
        posterior = posterior.altered(displacement=reading)
    target = Target(posterior)
    places = np.tile(np.random.default_rng(1).normal(0, 0.5, len(posterior.names)), (5, 1))
    places[:, target.noise] += np.random.default_rng(2).normal(0, 0.5, (5, target.noise.size))
    places[4, target.noise] = 1e4  # beyond anything that is possible
    moved = target.at(places[:1])[0].displacement
    held = target.noise_density(places, moved[np.newaxis])
    np.testing.assert_allclose(held, posterior.log_density(places), rtol=1e-9)


def test_steps_in_the_noise_side_by_side_are_those_of_each_state_alone() -> None:
    """But for what differences make of the densities' rounding, ε |f| / h² of 1e5 nats: 1e-7."""
    posterior = replace(short_posterior(samples=200), engine="numpy")
    target = Target(posterior)
    places = np.random.default_rng(3).normal(0, 0.5, (3, len(posterior.names)))
    states = target.at(places)
    for state, before in zip(target.step_noise(states), states, strict=True):
        (alone,) = target.step_noise([before])
        np.testing.assert_allclose(state.coordinates, alone.coordinates, atol=1e-6)
        density = posterior.log_density(state.coordinates[np.newaxis])
        np.testing.assert_allclose(density, state.density, rtol=1e-9)
        assert state.density > before.density
