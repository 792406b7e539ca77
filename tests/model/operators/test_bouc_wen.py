"""Hysteresis along whole records: against an integrator, closed forms, and the model's laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.operators.bouc_wen import ceiling, hysteresis
from bwbayes.record.waveforms import signal
from tests.model.references import Model, assert_close, by_integration, by_samples, random_walk

ALPHA = 0.3575
# (β, γ) for h near 10 um: the paper's, equal, opposite, γ < 0, γ > β.
SHAPES = ((0.0272, 0.0172), (0.02, 0.02), (0.02, -0.02), (0.03, -0.01), (0.02, 0.03))
EXPONENTS = (1.0, 1.2, 2.0, 3.0, 10.0)


def model(shape: tuple[float, float], exponent: float) -> Model:
    """Give a shape the units of an exponent, such that h stays near 10 um."""
    beta, gamma = (rate * 10.0 ** (1 - exponent) for rate in shape)
    return Model(ALPHA, beta, gamma, exponent)


def starts(parameters: Model) -> tuple[float, ...]:
    """Inside the ceiling on both sides, and beyond it where that is allowed, for n = 1."""
    highest = min(float(ceiling(*np.array([*parameters])[:, np.newaxis])[0]), 10.0)
    inside = (0.0, 0.7 * highest, -0.7 * highest)
    beyond = parameters.exponent == 1 and parameters.gamma <= parameters.beta
    return (*inside, 2 * highest, -2 * highest) if beyond else inside


# Largest error that is promised, in units of the largest |h|.
BOUND = 1e-9


def signals() -> dict[str, FloatArray]:
    return {
        "identification": signal("identification").sample(20.0)[1],
        "verification": signal("verification").sample(4.0)[1],
        "random walk": random_walk(1, turns=20),
    }


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize("name", signals())
def test_agrees_with_an_integrator(name: str, exponent: float) -> None:
    voltage = signals()[name]
    shapes = SHAPES if name == "random walk" else SHAPES[:3]
    for index, shape in enumerate(shapes):
        parameters = model(shape, exponent)
        initial = starts(parameters)[index % len(starts(parameters))]
        expected = by_integration(voltage, parameters, initial)
        got = hysteresis(voltage, *parameters, initial=initial)[0]
        assert_close(expected, got, BOUND)


@given(
    beta=st.floats(0.0, 0.2),
    fraction=st.floats(-1.0, 1.0),
    start=st.integers(-3000, 3000).map(lambda h: h / 100),
    corners=st.lists(st.integers(-10_000, 10_000).map(lambda u: u / 100), min_size=1, max_size=20),
)
@settings(deadline=None, max_examples=150)
def test_any_passive_linear_model_agrees_with_the_scalar_closed_form(
    beta: float, fraction: float, start: float, corners: list[float]
) -> None:
    parameters, voltage = Model(ALPHA, beta, fraction * beta), np.array(corners)
    expected = by_samples(voltage, parameters, start)
    got = hysteresis(voltage, *parameters, initial=start)[0]
    assert_close(expected, got, 1e-12)


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize("limit", [(0.02, 0.02), (0.02, -0.02)])
def test_equal_and_opposite_rates_are_limits_and_not_exceptions(
    limit: tuple[float, float], exponent: float
) -> None:
    voltage = 0.3 * random_walk(4)
    expected = hysteresis(voltage, *model(limit, exponent), initial=-3.0)[0]
    for off in (1e-9, 1e-12, 1e-15):
        near = model((limit[0] * (1 + off), limit[1]), exponent)
        assert_close(expected, hysteresis(voltage, *near, initial=-3.0)[0], 100 * off + 1e-9)


@pytest.mark.parametrize("fraction", [0.0, 1.0, -1.0])
def test_saturation_without_beta_stays_finite_and_below_the_ceiling(fraction: float) -> None:
    """There the ceiling is a state of unstable rest: rounding must not push h through it."""
    voltage = 1000 * np.sin(np.linspace(0, 30, 400))
    for beta in (0.0, 1e-18, 1e-9):
        initial = fraction * ALPHA / (beta + ALPHA)
        h = hysteresis(voltage, ALPHA, beta, ALPHA, initial=initial)
        assert np.isfinite(h).all()
        assert np.abs(h).max() <= 1 + 1e-12


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize("samples", [1, 2, 50])
def test_constant_voltage_keeps_the_initial_state(exponent: float, samples: int) -> None:
    for initial in (0.0, 3.0, -3.0):
        got = hysteresis(np.full(samples, 7.0), *model(SHAPES[0], exponent), initial=initial)
        np.testing.assert_array_equal(np.full((1, samples), initial), got)


def test_ceiling_is_infinite_where_gamma_is_minus_beta() -> None:
    row = np.array([0.02])
    assert np.inf == ceiling(np.array([ALPHA]), row, -row, np.array([2.0]))[0]


GOOD = {"voltage": [0.0, 1.0], "alpha": ALPHA, "beta": 0.02, "gamma": 0.01}


@pytest.mark.parametrize(
    ("argument", "wrong"),
    [
        ("alpha", {"alpha": 0.0}),
        ("alpha", {"alpha": -1.0}),
        ("alpha", {"alpha": [ALPHA, -1.0]}),
        ("alpha", {"alpha": math.nan}),
        ("alpha", {"alpha": [[ALPHA]]}),
        ("alpha", {"alpha": []}),
        ("alpha", {"alpha": [1.0, 1.0], "beta": [0.02, 0.02, 0.02]}),
        ("beta", {"beta": -0.01, "gamma": 0.02}),
        ("beta", {"beta": -0.03, "gamma": 0.01}),
        ("beta", {"beta": math.inf}),
        ("gamma", {"gamma": -0.03}),
        ("gamma", {"gamma": math.nan}),
        ("initial", {"gamma": 0.03, "initial": 8.0}),
        ("initial", {"exponent": 2.0, "initial": -4.0}),
        ("exponent", {"exponent": 0.99}),
        ("exponent", {"exponent": math.inf}),
        ("initial", {"initial": math.nan}),
        ("initial", {"initial": [0.0, 1.0], "alpha": [ALPHA, ALPHA, ALPHA]}),
        ("voltage", {"voltage": []}),
        ("voltage", {"voltage": 3.0}),
        ("voltage", {"voltage": [[0.0, 1.0]]}),
        ("voltage", {"voltage": [0.0, math.nan]}),
        ("voltage", {"voltage": [0.0, -math.inf]}),
    ],
)
def test_outside_the_domain_one_line_names_the_argument(
    argument: str, wrong: dict[str, object]
) -> None:
    with pytest.raises(InputError, match=f"^{argument}: [^\n]*$"):
        hysteresis(**{**GOOD, **wrong})  # type: ignore[arg-type]


def test_the_edges_of_the_domain_are_inside() -> None:
    for beta, gamma, initial in ((0.0, 0.0, 5.0), (0.0, 0.1, ALPHA / 0.1), (0.1, -0.1, -50.0)):
        for exponent in (1.0, 2.5):
            start = initial if exponent == 1 else np.sign(initial)
            h = hysteresis([0, 10, -10], ALPHA, beta, gamma, exponent, start)
            assert np.isfinite(h).all()


@pytest.mark.parametrize("exponents", [(1.0,), (1.0, 1.5, 2.0, 5.0, 10.0)])
def test_finite_for_parameters_over_many_decades(exponents: tuple[float, ...]) -> None:
    generator = np.random.default_rng(14)
    voltage = np.concatenate([np.zeros(2), random_walk(14, turns=8, samples=5)])
    for _ in range(10):
        alpha = 10 ** generator.uniform(-6, 6, 1000)
        beta = 10 ** generator.uniform(-8, 4, 1000)
        gamma = beta * generator.choice([-1, 1, 0, *generator.uniform(-1, 3, 20)], 1000)
        beta[gamma > 0] *= generator.choice([0, 1, 1, 1], (gamma > 0).sum())
        exponent = generator.choice(exponents, 1000)
        highest = np.minimum(ceiling(alpha, beta, gamma, exponent), 1e6)
        beyond = 10 ** generator.uniform(-3, 3, 1000)
        inside = np.where((gamma > beta) | (exponent > 1), 1.0, beyond)
        initial = highest * inside * generator.uniform(-1, 1, 1000)
        assert np.isfinite(hysteresis(voltage, alpha, beta, gamma, exponent, initial)).all()
