"""Jiles-Atherton and domain walls: against an integrator of the equation as it is published."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import brentq

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.operators import pinned
from bwbayes.model.operators.pinned import DomainWall, JilesAtherton, Pinned
from tests.model.operators.slow import by_integration, paths, rows, run

BOTH = (JilesAtherton(), DomainWall())
MODEL = {
    "d": 0.62,
    "saturation": 80.0,
    "coupling": 0.3,
    "pinning": 12.0,
    "reversible": 0.4,
    "initial": 1.0,
}
MODELS = {
    "usual": MODEL,
    "soft": {**MODEL, "pinning": 2.5},
    "hard": {**MODEL, "pinning": 150.0, "initial": -9.0},
    "no coupling": {**MODEL, "coupling": 0.0, "reversible": 0.0},
    "strong coupling": {**MODEL, "coupling": 0.9, "reversible": 0.7, "initial": 0.3},
    "far from saturation": {**MODEL, "saturation": 5000.0},
    "deep in saturation": {**MODEL, "saturation": 15.0},
    "saturated at once": {**MODEL, "saturation": 0.3, "initial": 0.01},
}
PATHS = ("walk", "plateaus", "steps of all sizes", "unipolar")


def langevin(y: float) -> float:
    if abs(y) < 0.05:
        return y / 3 - y**3 / 45 + 2 * y**5 / 945 - y**7 / 4725
    return 1 / math.tanh(y) - 1 / y


def curve_of(operator: Pinned) -> tuple[Callable[[float], float], float]:
    return (math.tanh, 1.0) if isinstance(operator, DomainWall) else (langevin, 1 / 3)


def plain(operator: Pinned, model: dict[str, float], voltage: FloatArray) -> FloatArray:
    """Integrate dP_irr/du with the implicit P solved by bisection, and return P."""
    curve, initial_slope = curve_of(operator)
    ws, c, k = model["saturation"], model["reversible"], model["pinning"]
    bare = model["d"] * (1 - model["coupling"])
    field, a = initial_slope * ws / bare, model["coupling"] / bare

    def whole(u: float, fixed: float) -> float:
        def excess(p: float) -> float:
            return p - c * ws * curve((u + a * p) / field) - (1 - c) * fixed

        reach = abs(fixed) + ws
        return float(brentq(excess, -reach, reach, xtol=1e-14, rtol=1e-14))

    def ahead(u: float, fixed: float) -> float:
        return ws * curve((u + a * whole(u, fixed)) / field) - fixed

    def slope(u: float, fixed: float, s: float) -> float:
        forward = max(s * ahead(u, fixed), 0.0)
        return forward / (k - a * forward)

    def excess(fixed: float) -> float:
        return ahead(voltage[0], fixed) - model["initial"]

    start = float(brentq(excess, -2 * ws, 2 * ws, xtol=1e-14, rtol=1e-14))
    fixed = by_integration(voltage, slope, start, (ahead,))
    return np.array([whole(u, p) for u, p in zip(voltage.tolist(), fixed.tolist(), strict=True)])


# Every model along one path; along the others in the slow suite.
CASES = [
    pytest.param(
        path,
        MODELS[name],
        operator,
        id=f"{path}, {name}, {type(operator).__name__}",
        marks=[] if (place + row) % 4 == 0 else [pytest.mark.slow],
    )
    for place, path in enumerate(PATHS)
    for row, name in enumerate(MODELS)
    for operator in BOTH
]


@pytest.mark.parametrize(("name", "model", "operator"), CASES)
def test_agrees_with_the_equation_as_published(
    name: str, model: dict[str, float], operator: Pinned
) -> None:
    voltage = paths()[name][:40]
    operator.check(rows(**model))
    expected = plain(operator, model, voltage)
    got = run(operator, rows(**model), voltage)[0]
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6 * np.ptp(expected))


@pytest.mark.parametrize("y", [0.0, 1e-9, 0.03, 0.7, 0.99999, 1.0, 1.00001, 4.0, 30.0, 1e6])
def test_the_curve_of_langevin_and_its_inverse(y: float) -> None:
    level, slope = pinned.curve(False, np.array([-y, y]))
    assert level[0] == -level[1]
    # The series to y¹⁵ from Bernoulli's numbers, where it converges fast, or the closed form.
    if y < 0.1:
        bernoulli = (1 / 6, -1 / 30, 1 / 42, -1 / 30, 5 / 66, -691 / 2730, 7 / 6, -3617 / 510)
        terms = [
            (2 * k + 2, b * 2.0 ** (2 * k + 2) / math.factorial(2 * k + 2))
            for k, b in enumerate(bernoulli)
        ]
        expected = sum(factor * y ** (power - 1) for power, factor in terms)
        steepness = sum(factor * (power - 1) * y ** (power - 2) for power, factor in terms)
    else:
        expected = 1 / math.tanh(y) - 1 / y
        steepness = 1 / y**2 - (1 / math.sinh(y) ** 2 if y < 300 else 0.0)
    assert float(level[1]) == pytest.approx(expected, rel=5e-14)
    assert float(slope[1]) == pytest.approx(steepness, rel=2e-13)
    back = pinned.curve(False, pinned.field_at(False, level))[0]
    np.testing.assert_allclose(back, level, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("saturation", 0.0, "saturation: 0 in model 0; must be positive"),
        ("coupling", 1.0, "coupling: 1 in model 0; must be at most 0.98"),
        ("reversible", -0.1, "reversible: -0.1 in model 0; must not be negative"),
        ("pinning", 1e-6, "pinning: 1e-06 in model 0; must be at least 0.001"),
        ("initial", -5.3, "initial: -5.3 in model 0; must lie within pinning d"),
        ("d", math.nan, "d: nan in model 0; must be finite"),
    ],
)
def test_refuses_by_name(name: str, value: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        JilesAtherton().check(rows(**{**MODEL, name: value}))
