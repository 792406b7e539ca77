"""What the model tests compare with: slow and obvious ways to follow the Bouc-Wen equation."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.integrate import quad, solve_ivp

from bwbayes.arrays import FloatArray

__all__ = ["Model", "assert_close", "by_integration", "by_samples", "random_walk"]


# A rate that no travel feels; quotients of smaller ones lose their digits.
NO_RATE = 1e-200


class Model(NamedTuple):
    """α in um/V, β and γ in um^(1−n)/V, and n."""

    alpha: float
    beta: float
    gamma: float
    exponent: float = 1.0


def random_walk(seed: int, turns: int = 25, samples: int = 6) -> FloatArray:
    """Go straight between random turning points; (turns x samples + 1,), V."""
    generator = np.random.default_rng(seed)
    corners = generator.normal(0.0, 60.0, turns + 1)
    return np.interp(np.linspace(0, turns, turns * samples + 1), np.arange(turns + 1), corners)


def integrate(parameters: Model, start: float, travel: FloatArray) -> FloatArray:
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


def by_integration(voltage: FloatArray, parameters: Model, initial: float) -> FloatArray:
    """Integrate every stretch with DOP853 at a relative tolerance of 1e-12, split where h is 0."""
    steps = np.sign(np.diff(voltage))
    edges = [0, *(np.flatnonzero(np.diff(steps)) + 1).tolist(), voltage.size - 1]
    h = np.full(voltage.size, initial)
    for first, last in pairwise(edges):
        travel = np.abs(voltage[first + 1 : last + 1] - voltage[first])
        direction = steps[first] or 1.0
        g = integrate(parameters, float(direction * h[first]), travel)
        h[first + 1 : last + 1] = direction * g
    return h


def by_samples(voltage: FloatArray, parameters: Model, initial: float) -> FloatArray:
    """Step from sample to sample with the scalar closed form for n = 1 or n = 2."""
    h = [initial]
    for before, after in pairwise(voltage.tolist()):
        direction = math.copysign(1.0, after - before)
        h.append(direction * _step(parameters, direction * h[-1], abs(after - before)))
    return np.array(h)


def _step(parameters: Model, g: float, travel: float) -> float:
    alpha, beta, gamma, n = parameters
    if g >= 0:
        return _solution(alpha, beta + gamma, n, g, travel)
    crossing = _travel_to_zero(alpha, beta - gamma, n, -g)
    if travel <= crossing:
        against = beta - gamma if n == 1 else gamma - beta
        return _solution(alpha, against, n, g, travel)
    return _solution(alpha, beta + gamma, n, 0.0, travel - crossing)


def _solution(alpha: float, c: float, n: float, g: float, v: float) -> float:
    """Solve dg/dv = α − c g^n for n = 1 or 2."""
    if abs(c) < NO_RATE:
        return g + alpha * v
    if n == 1:
        return g * math.exp(-c * v) - alpha * math.expm1(-c * v) / c
    root, turn = math.sqrt(abs(c) / alpha), math.sqrt(abs(c) * alpha) * v
    t = math.tanh(turn) if c > 0 else math.tan(turn)
    return (g + t / root) / (1 + math.copysign(1.0, c) * g * root * t)


def _travel_to_zero(alpha: float, c: float, n: float, depth: float) -> float:
    """Return the v at which p falls from `depth` to 0 with dp/dv = −(α + c p^n), n = 1 or 2."""
    if abs(c) < NO_RATE:
        return depth / alpha
    if n == 1:
        return math.log1p(depth * c / alpha) / c
    root = math.sqrt(abs(c) / alpha)
    return (math.atan(depth * root) if c > 0 else math.atanh(depth * root)) / (root * alpha)


def assert_close(expected: FloatArray, got: FloatArray, tolerance: float) -> None:
    """Compare with an error in units of the record's largest |h|."""
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance * np.abs(expected).max())
