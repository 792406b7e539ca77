"""Derivatives in a posterior's coordinates are those of closed forms, within the errors stated."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.inference.engine import Engine
from bwbayes.inference.linearization import STEP, gradient_and_hessian, value_and_jacobian
from bwbayes.inference.mode_finding import Target
from bwbayes.inference.posterior import Posterior
from tests.inference.linear import Linear, every_case
from tests.inference.problems import short_posterior

numbers = st.floats(-3.0, 3.0)


@given(rate=st.floats(0.1, 3.0), phase=numbers, z=numbers, power=st.integers(-6, 6))
def test_a_slope_is_the_complex_steps_within_its_error(
    rate: float, phase: float, z: float, power: int
) -> None:
    """Of exp(sin(rate z + phase)), in any unit: h²|f‴|/6 by truncation, and a few ε|f|/h."""
    unit = 10.0**power

    def function(places: FloatArray) -> FloatArray:
        values: FloatArray = unit * np.exp(np.sin(rate * places + phase))
        return values

    exact = np.imag(unit * np.exp(np.sin(rate * (z + 1e-30j) + phase))) / 1e-30
    value, slopes = value_and_jacobian(function, np.array([[z]]))
    # |f‴| of exp(sin) is at most 4 e.
    truncation, rounding = STEP**2 * 4 * np.e * rate**3 / 6, 16 * 2.0**-52 * np.e / STEP
    assert value == function(np.array([[z]]))
    assert abs(slopes[0, 0, 0] - exact) < unit * (truncation + rounding)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_slope_beside_the_impossible_is_that_of_the_other_side(side: float) -> None:
    def function(places: FloatArray) -> FloatArray:
        moved = places @ np.array([[2.0, 0.0], [0.0, 5.0]])
        return np.where(side * places[:, :1] > 0, np.nan, moved)

    _, slopes = value_and_jacobian(function, np.zeros((1, 2)))
    np.testing.assert_allclose(slopes[0], [[2.0, 0.0], [0.0, 5.0]], rtol=1e-9)
    _, slopes = value_and_jacobian(function, np.zeros((1, 2)), value=np.full((1, 2), np.nan))
    np.testing.assert_array_equal(slopes[0, 0], [0.0, 0.0])


@given(st.lists(numbers, min_size=10, max_size=10))
def test_the_hessian_of_a_quadratic_is_exact(numbers: list[float]) -> None:
    matrix = np.zeros((3, 3))
    matrix[np.tril_indices(3)] = numbers[:6]
    matrix, slope = matrix + matrix.T, np.array(numbers[6:9])

    def function(w: FloatArray) -> FloatArray:
        values: FloatArray = numbers[9] + w @ slope + 0.5 * np.einsum("mi,ij,mj->m", w, matrix, w)
        return values

    for value in (None, numbers[9]):
        gradient, hessian = gradient_and_hessian(function, 3, 0.1, value)
        np.testing.assert_allclose(gradient, slope, atol=1e-12)
        np.testing.assert_allclose(hessian, matrix, atol=1e-11)
    both = gradient_and_hessian(lambda w: np.outer(function(w), [1.0, 2.0]), 3, 0.1)
    np.testing.assert_allclose(both[0], np.outer(slope, [1.0, 2.0]), atol=1e-11)
    np.testing.assert_allclose(both[1], np.multiply.outer(matrix, [1.0, 2.0]), atol=1e-10)


@every_case
def test_a_linear_model_is_the_closed_form(free: tuple[str, ...], noise: str) -> None:
    model = Linear(free, noise)
    z = np.array([[0.3, -0.8, 1.1][: len(free)], [-1.0, 0.2, 0.4][: len(free)]])
    linear = Target(model.posterior).linearize(z)
    design = model.design[model.rows] * model.sd
    residual = (model.readings - model.level)[model.rows] - z @ design.T
    weighted = np.linalg.solve(model.noise[np.ix_(model.rows, model.rows)], design)
    for number in range(2):
        np.testing.assert_allclose(linear.slopes[number], design.T, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(linear.residual[number], residual[number], atol=1e-9)
        np.testing.assert_allclose(linear.gradient[number], residual[number] @ weighted, rtol=1e-6)
        np.testing.assert_allclose(
            linear.fisher_information[number], design.T @ weighted, rtol=1e-6
        )


@pytest.mark.parametrize("engine", ["numpy", "numba"])
def test_the_gradient_is_that_of_the_density_where_nothing_is_unknown(engine: Engine) -> None:
    """In the physical coordinates of a record from rest; several models at once."""
    posterior = short_posterior(samples=200, fixed={"initial": 0.0})
    posterior = replace(posterior.altered(from_rest=True), engine=engine)
    places = np.random.default_rng(1).normal(0, 0.5, (3, len(posterior.names)))
    linear = Target(posterior).linearize(places)

    def log_likelihood(z: FloatArray) -> FloatArray:
        return posterior.log_likelihood(posterior.prior.theta(posterior.prior.constrain(z)[0]))

    _, expected = value_and_jacobian(log_likelihood, places, Target(posterior).physical)
    np.testing.assert_allclose(linear.gradient, expected, rtol=1e-5, atol=1e-4)


def test_what_two_records_say_adds_up() -> None:
    single = short_posterior(samples=200, fixed={"initial": 0.0, "offset": 0.0, "sensor_sd": 0.3})
    single = single.altered(name="first")
    second = replace(
        single.single_record, name="second", displacement=single.single_record.displacement[::-1]
    )
    shared = single.table.of_scope("record", "event")
    table = replace(single.table, records=("first", "second"), shared=shared)
    joint = Posterior((single.single_record, second), single.prior, single.engine, table)
    z = np.full((1, len(joint.names)), 0.1)
    parts = [Target(p).linearize(z) for p in (single, single.altered(**vars(second)))]
    whole = Target(joint).linearize(z)
    np.testing.assert_allclose(whole.gradient, sum(p.gradient for p in parts), rtol=1e-9)
    information = sum(p.fisher_information for p in parts)
    np.testing.assert_allclose(whole.fisher_information, information, rtol=1e-9)
    residual = np.concatenate([p.residual for p in parts], axis=1)
    np.testing.assert_array_equal(whole.residual, residual)
