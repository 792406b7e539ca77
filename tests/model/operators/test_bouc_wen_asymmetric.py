"""The generalized Bouc-Wen operator: its equation, plain Bouc-Wen hysteresis, and its energy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from bwbayes.errors import InputError
from bwbayes.model.operators.bouc_wen import hysteresis
from bwbayes.model.operators.bouc_wen_asymmetric import BoucWenAsymmetric
from tests.model.operators.differential import by_integration, paths, prior_draws, single, w_of
from tests.model.references import assert_close

PLAIN = {"d": 0.62, "alpha": 0.3575, "beta": 0.0272, "gamma": 0.0172, "initial": 2.5}
NO_TERMS = dict.fromkeys(("b2", "b3", "b4", "b5", "b6"), 0.0)
TERMS = (
    {"b2": 0.1, "b3": -0.2, "b4": 0.05, "b5": 0.02, "b6": -0.06},
    {"b2": 0.0, "b3": 0.0, "b4": 0.1, "b5": 0.2, "b6": 0.0},
    {"b2": -0.3, "b3": 0.3, "b4": 0.1, "b5": 0.3, "b6": -0.1},
)


def slope(model: dict[str, float], u: float, h: float, s: float) -> float:
    """Return dh/du by the equation as it is written."""
    x, z = np.sign(u), np.sign(h)
    terms = s * z + model["b2"] * x * s + model["b3"] * x * z
    terms += model["b4"] * s + model["b5"] * z + model["b6"] * x
    return float(model["alpha"] - abs(h) * (model["gamma"] + model["beta"] * terms))


@pytest.mark.parametrize("start", [2.5, -6.0])
@pytest.mark.parametrize("terms", TERMS)
@pytest.mark.parametrize("name", paths())
def test_agrees_with_the_equation(name: str, terms: dict[str, float], start: float) -> None:
    voltage, model = paths()[name], {**PLAIN, **terms, "gamma": 0.005, "initial": start}
    BoucWenAsymmetric().check(single(**model))
    kinks = (lambda u, _: u, lambda _, h: h)
    h = by_integration(voltage, lambda u, h, s: slope(model, u, h, s), start, kinks)
    got = model["d"] * voltage - w_of(BoucWenAsymmetric(), single(**model), voltage)[0]
    assert_close(h, got, 1e-9)


@pytest.mark.parametrize("name", paths())
def test_without_terms_it_is_bouc_wen(name: str) -> None:
    voltage = paths()[name]
    shape = (PLAIN["alpha"], PLAIN["beta"], PLAIN["gamma"])
    expected = PLAIN["d"] * voltage - hysteresis(voltage, *shape, initial=PLAIN["initial"])
    got = w_of(BoucWenAsymmetric(), single(**PLAIN, **NO_TERMS), voltage)
    assert_close(expected, got, 1e-14)
    np.testing.assert_array_equal(got, w_of(BoucWenAsymmetric(terms=()), single(**PLAIN), voltage))


def test_the_bounds_leave_out_nothing_that_holds_and_little_that_does_not() -> None:
    """Every draw inside the bounds of all terms holds, up to the last one's missing room."""
    operator = BoucWenAsymmetric()
    column = prior_draws(operator, 20_000, 3)
    declared = {one.name: one for one in operator.parameters}
    assert declared["b3"].bounds is not None
    low, high = declared["b3"].bounds(column)
    room = np.asarray(low) <= np.asarray(high)
    np.testing.assert_array_equal(
        (operator.holds(column) & room), room & (column["alpha"] < column["d"])
    )
    assert room.mean() > 0.7
    generator = np.random.default_rng(5)
    anywhere = {**column, **{name: generator.uniform(-1, 1, 20_000) for name in NO_TERMS}}
    holding = operator.holds(anywhere)
    assert holding.sum() > 100
    for name in ("gamma", *NO_TERMS):
        bounds = declared[name].bounds
        assert bounds is not None
        low, high = (np.broadcast_to(b, holding.shape)[holding] for b in bounds(anywhere))
        values = anywhere[name][holding]
        slack = 1e-9 * (np.abs(values) + 1)
        assert ((low <= values + slack) & (values <= high + slack)).all()


signs = st.floats(-0.6, 0.6)


@given(
    ratio=st.floats(-1, 1),
    terms=st.tuples(signs, signs, signs, signs, signs),
    corners=st.lists(st.integers(-100, 100).map(float), min_size=2, max_size=6),
)
@settings(deadline=None, max_examples=60)
def test_no_path_draws_energy_within_the_constraint(
    ratio: float, terms: tuple[float, ...], corners: list[float]
) -> None:
    """∫ h du − Δ(h²)/(2 α) never falls; by the trapezium rule on a fine path."""
    model = {**PLAIN, **dict(zip(NO_TERMS, terms, strict=True)), "gamma": ratio * 0.0272}
    operator, column = BoucWenAsymmetric(), single(**model)
    assume(bool(operator.holds(column).all()))
    path = np.interp(np.linspace(0, len(corners) - 1, 4001), np.arange(len(corners)), corners)
    h = model["d"] * path - w_of(operator, column, path)[0]
    supplied = np.diff(path) * (h[1:] + h[:-1]) / 2
    lost = supplied - np.diff(h**2) / (2 * model["alpha"])
    # The rule's own error is a twelfth of the step's cube times the curvature.
    step = np.abs(np.diff(path)).max()
    assert lost.min() >= -(step**3) * model["alpha"] * 0.06 - 1e-9


def test_models_beyond_the_constraint_are_refused() -> None:
    model = {**PLAIN, **NO_TERMS, "b5": -0.9, "initial": -7.0}
    operator, column = BoucWenAsymmetric(), single(**model)
    assert not operator.holds(column).any()
    with pytest.raises(InputError, match=r"gamma: .* must be passive"):
        operator.check(column)


def test_h_stays_within_its_ceilings_and_gets_near_them() -> None:
    operator = BoucWenAsymmetric()
    column = prior_draws(operator, 4_000, 4)
    holds = np.flatnonzero(operator.holds(column))
    column = {name: values[holds] for name, values in column.items()}
    bounds = operator.parameters[-1].bounds
    assert bounds is not None
    low, high = (np.asarray(one) for one in bounds(column))
    assert ((low <= column["initial"]) & (column["initial"] <= high)).all()
    voltage = np.array([50.0, 300.0, -20.0, 1e5, 0.0, -1e5, 0.0, 1e5])
    h = column["d"][:, np.newaxis] * voltage - w_of(operator, column, voltage)
    slack = 1e-12 * column["d"] * 1e5 + 1e-9 * (high - low)
    assert (h >= (low - slack)[:, np.newaxis]).all()
    assert (h <= (high + slack)[:, np.newaxis]).all()
    # Where the rates are such that 1e5 V lead from one to the other.
    near = np.maximum(high, -low) < 1e4 * column["alpha"]
    assert (np.max(h, axis=1) > 0.99 * high)[near].all()
    assert (np.min(h, axis=1) < 0.99 * low)[near].all()


def test_refuses_unknown_terms_and_parameters_by_name() -> None:
    with pytest.raises(InputError, match="terms: 'b7' is unknown"):
        BoucWenAsymmetric(terms=("b7",))
    column = single(**PLAIN, **{**NO_TERMS, "b4": np.nan})
    with pytest.raises(InputError, match="b4: nan in model 0; must be finite"):
        BoucWenAsymmetric().check(column)
