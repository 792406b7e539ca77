"""What the model tests compare with: slow and obvious ways to follow the Bouc-Wen equation."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray

__all__ = ["Model", "assert_close", "by_samples", "random_walk"]


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
