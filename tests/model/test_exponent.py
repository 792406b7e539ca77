"""The flow along one stretch against an integrator, closed forms, and properties of any flow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp
from scipy.special import hyp2f1

from bwbayes.arrays import FloatArray
from bwbayes.model.exponent import ExponentFlow

EXPONENTS = (1.0, 1.05, 1.5, 2.0, 2.5, 3.0, 5.0, 10.0)
ALPHA = 0.36
# (beta, gamma) in units of alpha: ordinary, equal, opposite, gamma > beta, nearly opposite, only
# gamma.
SHAPES = ((1.0, 0.6), (1.0, 1.0), (1.0, -1.0), (0.7, 0.9), (1.0, -0.9), (0.0, 1.0))
FAR_STARTS = (1.3, -3.0, 40.0, -40.0)
TRAVEL = np.array([0.0, 1e-3, 0.1, 0.4, 1.0, 1.9, 3.0, 5.0, 9.0, 30.0])


def flow(alpha: float, beta: float, gamma: float, exponent: float) -> ExponentFlow:
    return ExponentFlow(*(np.array([value]) for value in (alpha, beta, gamma, exponent)))


def advance(
    parameters: tuple[float, float, float, float], start: float, travel: FloatArray
) -> FloatArray:
    displacement: FloatArray = flow(*parameters).advance(np.array([start]), travel)[0]
    return displacement


def integrate(
    parameters: tuple[float, float, float, float], start: float, travel: FloatArray
) -> FloatArray:
    """Integrate the equation step by step, with a fresh start at the kink in g = 0."""
    alpha, beta, gamma, n = parameters

    def slope(_: float, g: FloatArray) -> FloatArray:
        return np.asarray(alpha - (beta * np.sign(g) + gamma) * np.abs(g) ** n)

    def solve(start: float, until: FloatArray) -> FloatArray:
        if until.size == 0 or until[-1] == 0:
            return np.full(until.size, start)
        span = (0.0, float(until[-1]))
        solution = solve_ivp(
            slope, span, [start], "DOP853", until, rtol=1e-12, atol=1e-13 * max(1.0, abs(start))
        )
        return np.asarray(solution.y[0])

    if start >= 0:
        return solve(start, travel)
    # Substituting p = t^2 takes the kink at p = 0 out of the quadrature.
    zero, _ = quad(
        lambda t: 2 * t / (alpha + (beta - gamma) * t ** (2 * n)),
        0.0,
        np.sqrt(-start),
        epsabs=1e-14,
        epsrel=1e-13,
        limit=200,
    )
    before = travel[travel < zero]
    after = travel[travel >= zero] - zero
    return np.concatenate((solve(start, before), solve(0.0, after)))


def scale(parameters: tuple[float, float, float, float], start: float) -> float:
    """Largest |h| of a record: of the ceiling or the start, or the travel's reach without one."""
    alpha, beta, gamma, n = parameters
    reach = alpha * TRAVEL[-1]
    ceiling = (alpha / (beta + gamma)) ** (1 / n) if beta + gamma > 0 else reach
    return float(max(min(ceiling, reach), abs(start)))


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize(("beta", "gamma"), [pair for pair in SHAPES if pair[0] >= pair[1]])
def test_agrees_with_an_integrator_from_far_outside(
    exponent: float, beta: float, gamma: float
) -> None:
    parameters = (ALPHA, beta * ALPHA, gamma * ALPHA, exponent)
    travel = TRAVEL[:-2]
    for start in FAR_STARTS if exponent < 5 else FAR_STARTS[:2]:
        expected = integrate(parameters, start, travel)
        got = advance(parameters, start, travel)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10 * scale(parameters, start))


@pytest.mark.parametrize("exponent", [1.0, 1 + 1e-9, 1.05, 1.7, 3.3, 10.0, 50.0])
def test_inverts_the_hypergeometric_travel_inside_the_ceiling(exponent: float) -> None:
    """v(g) = (g/alpha) 2F1(1, 1/n; 1 + 1/n; (lambda/alpha) g^n), here with G = 1."""
    height = np.concatenate((np.geomspace(1e-8, 0.5, 40), np.linspace(0.51, 0.98, 48)))
    travel = height * hyp2f1(1.0, 1 / exponent, 1 + 1 / exponent, height**exponent) / ALPHA
    got = advance((ALPHA, 0.6 * ALPHA, 0.4 * ALPHA, exponent), 0.0, travel)
    np.testing.assert_allclose(got, height, rtol=1e-11)


@pytest.mark.parametrize("exponent", [1.05, 1.7, 3.3, 10.0, 50.0])
@pytest.mark.parametrize("ratio", [1 + 1e-9, 1.1, 2.0, 1e3, 1e5])
def test_falls_from_any_height_by_the_hypergeometric_travel(exponent: float, ratio: float) -> None:
    """For z > 1: tau = T(z) - T(z0), T(z) = z^(1-n)/(n-1) 2F1(1, 1-1/n; 2-1/n; z^-n).

    The height after it is the test's choice, so the travel never loses the digits that count.
    """
    order = exponent - 1

    def time_from_infinity(z: FloatArray) -> FloatArray:
        power = order / exponent
        return np.asarray(z**-order / order * hyp2f1(1.0, power, 1 + power, z**-exponent))

    height = np.geomspace(ratio, 1.0 + 1e-3 * (ratio - 1), 30)[1:]
    travel = time_from_infinity(height) - time_from_infinity(np.array(ratio))
    # Where z0 and z are both far up, their difference holds the travel to this much only.
    spread = 1e-13 * time_from_infinity(height) * (height**exponent - 1) / height
    got = advance((1.0, 0.5, 0.5, exponent), ratio, travel)
    assert np.all(np.abs(got / height - 1) < 1e-11 + spread)


Model = tuple[float, float, float, float, float]


@st.composite
def models(draw: st.DrawFn, largest: float = 1e2, smallest: float = 1e-4) -> Model:
    """(alpha, beta, gamma, exponent, start) in the domain; the start anywhere if beta >= gamma."""
    size = st.floats(smallest, largest)
    alpha, beta = draw(size), draw(size | st.just(0.0))
    gamma = draw(size | st.floats(-1.0, 1.0).map(lambda part: part * beta))
    exponent = draw(st.sampled_from((1.0, 1 + 1e-9, 2.0)) | st.floats(1.0, 10.0))
    start = draw(st.floats(-20.0, 20.0))
    if gamma > beta:
        start *= 0.98 / 20.0 * (alpha / (beta + gamma)) ** (1 / exponent)
    return alpha, beta, gamma, exponent, start


@settings(deadline=None, max_examples=150)
@given(
    models(largest=1e6, smallest=1e-12),
    st.sampled_from((1.0, 1 + 1e-9, 50.0)) | st.floats(1.0, 50.0),
    st.floats(-1e6, 1e6),
    st.floats(1e-12, 1e6),
)
def test_extreme_parameters_give_finite_displacements(
    model: Model, exponent: float, start: float, travel: float
) -> None:
    alpha, beta, gamma, *_ = model
    assume(beta >= gamma)
    points = np.linspace(0.0, travel, 20)
    path = advance((alpha, beta, gamma, exponent), start, points)
    assert np.all(np.isfinite(path))
    reach = abs(start) + alpha * travel
    assert np.all(np.abs(path) <= reach * (1 + 1e-11))
