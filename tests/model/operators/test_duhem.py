"""The Duhem operator: the equation as published, its φ functions, and when it is passive."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bwbayes.errors import InputError
from bwbayes.model.operators.duhem import Duhem
from bwbayes.model.relaxing import phi_functions
from tests.model.operators.differential import by_integration, paths, single, w_of
from tests.model.references import assert_close

ODD = {"d": 0.62, "d3": -3e-6, "alpha": 0.31, "beta": 0.033, "alpha2": 2e-5, "initial": 2.5}
EVEN = {**ODD, "d2": 4e-4, "alpha1": -1e-3}
PASSIVE = Duhem(odd=False)


def f_and_g(u: float, model: dict[str, float]) -> tuple[float, float]:
    """Return f(u) and g(u) = f′(u) − α(u)."""
    d, d2, d3 = model["d"], model.get("d2", 0.0), model["d3"]
    strength = model["alpha"] + model.get("alpha1", 0.0) * u + model["alpha2"] * u**2
    return d * u + d2 * u**2 + d3 * u**3, d + 2 * d2 * u + 3 * d3 * u**2 - strength


@pytest.mark.parametrize("rate", [1e-9, 1e-3, 0.033, 1.0, 40.0])
@pytest.mark.parametrize("model", [ODD, EVEN], ids=["odd", "even"])
@pytest.mark.parametrize("name", ["walk", "plateaus", "steps of all sizes", "unipolar"])
def test_agrees_with_the_equation_as_published(
    name: str, model: dict[str, float], rate: float
) -> None:
    """That is dy = β |du| (f(u) − y) + g(u) du."""
    voltage, model = paths()[name], {**model, "beta": rate}
    if rate > 10:
        voltage = voltage[:12]

    def slope(u: float, y: float, s: float) -> float:
        f, g = f_and_g(u, model)
        return s * rate * (f - y) + g

    start = f_and_g(voltage[0], model)[0] - model["initial"]
    expected = by_integration(voltage, slope, start)
    got = w_of(Duhem(odd="d2" not in model), single(**model), voltage)[0]
    assert_close(expected, got, 1e-9)


@pytest.mark.parametrize("z", [0.0, 1e-9, 1e-3, 0.5, 1.0, 1.0000001, 1.5, 9.0, 30.0, 700.0, 1e9])
def test_phi_functions_to_rounding(z: float) -> None:
    """Against their series in exact fractions, or what is left of them where exp(−z) is nothing."""
    if z < 40:
        x, factorial = Fraction(z), [Fraction(math.factorial(order)) for order in range(204)]
        exact = [
            float(sum(((-x) ** j / factorial[j + k] for j in range(200)), start=Fraction(0)))
            for k in (1, 2, 3)
        ]
    else:
        exact = [1 / z, (1 - 1 / z) / z, (0.5 - (1 - 1 / z) / z) / z]
    got = [float(value[0]) for value in phi_functions(np.array([z]))]
    np.testing.assert_allclose(got, exact, rtol=2e-15)


@given(
    rate=st.floats(0.005, 0.5),
    share=st.floats(0.0, 1.0),
    tilt=st.floats(-1.0, 1.0),
    corners=st.lists(st.integers(-100, 100).map(float), min_size=2, max_size=6),
)
@settings(deadline=None, max_examples=60)
def test_no_closed_path_draws_energy_within_the_constraint(
    rate: float, share: float, tilt: float, corners: list[float]
) -> None:
    """The energy h²/(2 α(u)) is stored; what is supplied beyond it, ∫ h du − Δ, is lost."""
    alpha2 = share * 4 * 0.31 * rate**2
    alpha1 = tilt * np.sqrt(max(alpha2 * (4 * 0.31 - alpha2 / rate**2), 0.0))
    model = single(
        d=0.62, d2=0.0, d3=0.0, alpha=0.31, beta=rate, alpha1=alpha1, alpha2=alpha2, initial=1.0
    )
    assert PASSIVE.holds(model).all()
    PASSIVE.check(model)
    nodes, weights = np.polynomial.legendre.leggauss(20)
    for before, after in pairwise(corners):
        pieces = np.linspace(before, after, 2 + int(abs(after - before) * max(rate, 0.05) * 2))
        middles = (pieces[1:] + pieces[:-1]) / 2
        inner = middles[:, np.newaxis] + np.diff(pieces)[:, np.newaxis] / 2 * nodes
        path = np.hstack([pieces[:-1, np.newaxis], inner]).ravel()
        path = np.append(path, after)
        h = 0.62 * path - w_of(PASSIVE, model, path)[0]
        inside = h[:-1].reshape(-1, nodes.size + 1)[:, 1:]
        supplied = float(np.sum((inside @ weights) * np.diff(pieces) / 2))
        strength = 0.31 + alpha1 * path[[0, -1]] + alpha2 * path[[0, -1]] ** 2
        stored = float(np.diff(h[[0, -1]] ** 2 / (2 * strength))[0])
        assert supplied - stored >= -1e-9 * (1 + abs(supplied) + np.max(h**2 / 0.31))
        model = {**model, "initial": h[-1:]}


def test_beyond_the_constraint_a_path_gives_more_energy_than_it_stored() -> None:
    """Twenty times the largest α₂: there α falls faster than h, and h²/(2 α) rises by itself."""
    rate = 0.01
    model = single(d=0.62, d3=0.0, alpha=0.31, beta=rate, alpha2=80 * 0.31 * rate**2, initial=5.0)
    assert not Duhem().holds(model).any()
    with pytest.raises(InputError, match=r"alpha2: .* 4 alpha beta"):
        Duhem().check(model)
    path = np.linspace(20.0, 10.0, 2001)
    h = 0.62 * path - w_of(Duhem(), model, path)[0]
    strength = 0.31 + 80 * 0.31 * rate**2 * path**2
    supplied = np.sum(np.diff(path) * (h[1:] + h[:-1]) / 2)
    stored = float(np.diff((h**2 / (2 * strength))[[0, -1]])[0])
    assert supplied - stored < -1.0


def test_the_initial_curve_rises_where_it_is_said_to() -> None:
    voltage = np.linspace(0, 300, 500)
    rising = single(**{**ODD, "d3": ODD["alpha2"] / 3, "initial": 0.0})
    assert np.diff(w_of(Duhem(), rising, voltage)[0]).min() > 0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("alpha", 0.0, "alpha: 0 in model 0; must be positive"),
        ("beta", -0.1, "beta: -0.1 in model 0; must not be negative"),
        ("alpha2", -1e-9, "alpha2: -1e-09 in model 0; must not be negative"),
        ("d3", np.inf, "d3: inf in model 0; must be finite"),
    ],
)
def test_refuses_by_name(name: str, value: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Duhem().check(single(**{**ODD, name: value}))
