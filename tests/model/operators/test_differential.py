"""Operators given by a differential equation: as published, and the laws they keep or do not."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, example, given, settings, strategies as st
from scipy.optimize import brentq
from scipy.special import hyp2f1

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.operators import pinned
from bwbayes.model.operators.bouc_wen import BoucWen, PowerStep, ceiling, hysteresis
from bwbayes.model.operators.bouc_wen_asymmetric import BoucWenAsymmetric
from bwbayes.model.operators.duhem import BacklashLike, Duhem
from bwbayes.model.operators.pinned import DomainWall, JilesAtherton, Pinned
from bwbayes.model.operators.scalar_memory import OneState
from tests.model.operators.slow import (
    Model,
    assert_close,
    by_integration,
    drawn,
    paths,
    random_walk,
    rows,
    run,
)  # fmt: skip

ALPHA = 0.3575
PLAIN = {"d": 0.62, "alpha": ALPHA, "beta": 0.0272, "gamma": 0.0172, "initial": 2.5}
DUHEM = {"d": 0.62, "d3": -3e-6, "alpha": 0.31, "beta": 0.033, "alpha2": 2e-5, "initial": 2.5}
EVEN = {**DUHEM, "d2": 4e-4, "alpha1": -1e-3}
NO_TERMS = dict.fromkeys(("b2", "b3", "b4", "b5", "b6"), 0.0)
TERMS = (
    {"b2": 0.1, "b3": -0.2, "b4": 0.05, "b5": 0.02, "b6": -0.06},
    {"b2": 0.0, "b3": 0.0, "b4": 0.1, "b5": 0.2, "b6": 0.0},
    {"b2": -0.3, "b3": 0.3, "b4": 0.1, "b5": 0.3, "b6": -0.1},
)
# (β, γ) for h near 10 um: the paper's, equal, opposite, γ < 0, γ > β.
SHAPES = ((0.0272, 0.0172), (0.02, 0.02), (0.02, -0.02), (0.03, -0.01), (0.02, 0.03))
EXPONENTS = (1.0, 1.2, 2.0, 3.0, 10.0)

Values = dict[str, float]
every_path = pytest.mark.parametrize("path", paths())
few = settings(deadline=None, max_examples=40)
corners = st.lists(st.floats(-100, 100).map(lambda u: round(u, 6)), min_size=2, max_size=8)


def shaped(shape: tuple[float, float], exponent: float) -> Model:
    """Give a shape the units of an exponent, such that h stays near 10 um."""
    beta, gamma = (rate * 10.0 ** (1 - exponent) for rate in shape)
    return Model(ALPHA, beta, gamma, exponent)


def top_of(model: Model) -> float:
    return float(ceiling(*np.array([*model])[:, np.newaxis])[0])


def integrated(voltage: FloatArray, model: Model, start: float) -> FloatArray:
    alpha, beta, gamma, n = model

    def slope(_: float, h: float, s: float) -> float:
        return float(alpha - (s * beta * math.copysign(1.0, h) + gamma) * abs(h) ** n)

    return by_integration(voltage, slope, start, (lambda _, h: h,))


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize("number", range(len(SHAPES)))
def test_bouc_wen_agrees_with_an_integrator(number: int, exponent: float) -> None:
    """Inside the ceiling on both sides, and beyond it where that is allowed; a path for each."""
    model = shaped(SHAPES[number], exponent)
    top = min(top_of(model), 10.0)
    beyond = exponent == 1 and model.gamma <= model.beta
    walks = list(paths().values())
    for place, part in enumerate((0.0, 0.7, -0.7, *((2.0, -2.0) if beyond else ()))):
        voltage = walks[(number + place) % len(walks)]
        got = hysteresis(voltage, *model, initial=part * top)[0]
        assert_close(integrated(voltage, model, part * top), got, 1e-9)


@pytest.mark.parametrize("exponent", [1.0, 1 + 1e-9, 1.05, 1.7, 3.3, 10.0, 50.0])
def test_any_exponent_inverts_the_hypergeometric_travel(exponent: float) -> None:
    """v(g) = (g/alpha) 2F1(1, 1/n; 1 + 1/n; (lambda/alpha) g^n), here with G = 1."""
    height = np.concatenate((np.geomspace(1e-8, 0.5, 40), np.linspace(0.51, 0.98, 48)))
    travel = height * hyp2f1(1.0, 1 / exponent, 1 + 1 / exponent, height**exponent) / 0.36
    d, alpha, *rest = np.array([[0.0, 0.36, 0.6 * 0.36, 0.4 * 0.36, exponent]]).T
    _, got = PowerStep.of(d, alpha, *rest).along(0.0, np.zeros(1), travel)
    np.testing.assert_allclose(got[0], height, rtol=1e-11)


def test_finite_for_parameters_over_many_decades() -> None:
    generator, exponents = np.random.default_rng(14), (1.0, 1.0, 1.5, 2.0, 5.0, 10.0)
    voltage = np.concatenate([np.zeros(2), random_walk(14, turns=8, samples=5)])
    for _ in range(5):
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


def of(top: float, ratio: float, exponent: float, alpha: float) -> Model:
    """Return the model with this ceiling (um) and ratio of β − γ to β + γ."""
    rate = alpha / top**exponent
    return Model(alpha, (1 + ratio) / 2 * rate, (1 - ratio) / 2 * rate, exponent)


# From β = 0 (−1) through β = γ (0) and γ = 0 (1) to γ near −β.
any_model = st.builds(
    of,
    st.floats(0.1, 100),
    st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-1, 20)),
    st.sampled_from([1.0, 1.3, 2.0, 5.0]),
    st.floats(0.01, 10),
)


def growth(model: Model, path: list[float]) -> float:
    """Return what a rounding error can grow to, for paths on which it stays small.

    With γ > β the flow drives starts apart, at most with the rate n (γ − β) h^(n−1) at the ceiling.
    """
    n, top = model.exponent, top_of(model)
    rate = max(model.gamma - model.beta, 0) * n * top ** (n - 1)
    exponent = rate * float(np.abs(np.diff(path)).sum())
    assume(exponent <= 12)
    return float(np.exp(exponent))


@few
@given(model=any_model, share=st.floats(-1, 1), path=corners, pieces=st.integers(1, 9))
@example(model=of(1.0, -1.0, 1.0, 1.0), share=1.0, path=[0.0, 0.0], pieces=1)
def test_bouc_wen_stays_below_its_ceiling_however_fine_the_path(
    model: Model, share: float, path: list[float], pieces: int
) -> None:
    """And its mirror image mirrors; in volts and um as in mV and nm."""
    top, voltage, n = top_of(model), np.array(path), model.exponent
    h = hysteresis(voltage, *model, initial=share * top)[0]
    assert np.abs(h).max() <= top * (1 + 1e-11)
    np.testing.assert_array_equal(hysteresis(-voltage, *model, initial=-share * top)[0], -h)
    close = 1e-10 * growth(model, path) * top
    samples = np.linspace(0, voltage.size - 1, (voltage.size - 1) * pieces + 1)
    fine = np.interp(samples, np.arange(voltage.size), voltage)
    got = hysteresis(fine, *model, initial=share * top)[0][::pieces]
    np.testing.assert_allclose(got, h, rtol=0, atol=close)
    rate = 1e3 ** (1 - n) / 1e3
    other = Model(model.alpha, model.beta * rate, model.gamma * rate, n)
    got = hysteresis(1e3 * voltage, *other, initial=1e3 * share * top)[0] / 1e3
    np.testing.assert_allclose(got, h, rtol=0, atol=close)


@pytest.mark.parametrize("gamma", [0.1, 1.0, 10.0])
def test_a_sharp_loop_stays_below_its_ceiling(gamma: float) -> None:
    """With β = 0 a turn at the ceiling is an unstable rest, where rounding grows by e^(γ v)."""
    turns = (0, 100), (100, -100), (-100, 100), (100, -100)
    sweeps = [np.linspace(*ends, 333) for ends in turns]
    alpha = np.linspace(0.1, 1.0, 50)
    h = hysteresis(np.concatenate(sweeps), alpha, 0.0, gamma)
    assert (np.abs(h).max(axis=1) <= alpha / gamma * (1 + 1e-11)).all()


# The stand-in for an energy, h²/(2 α), never grows by more than is supplied.
signs = st.floats(-0.6, 0.6)


@few
@given(
    beta=st.floats(0.005, 0.1),
    ratio=st.floats(-1, 1),
    terms=st.tuples(signs, signs, signs, signs, signs),
    bent=st.tuples(st.floats(0, 1), st.floats(-1, 1)),
    voltages=st.lists(st.integers(-100, 100).map(float), min_size=2, max_size=6),
)
def test_no_path_draws_energy_within_the_constraints(
    beta: float,
    ratio: float,
    terms: tuple[float, ...],
    bent: tuple[float, float],
    voltages: list[float],
) -> None:
    """Bouc-Wen, asymmetric, and Duhem: ∫ h du − Δ(h²)/(2 α(u)), on a fine path."""
    path = np.interp(np.linspace(0, len(voltages) - 1, 4001), np.arange(len(voltages)), voltages)
    alpha2 = bent[0] * 4 * ALPHA * beta**2
    alpha1 = bent[1] * np.sqrt(max(alpha2 * (4 * ALPHA - alpha2 / beta**2), 0.0))
    common = {"d": 0.62, "alpha": ALPHA, "beta": beta, "initial": 2.5}
    shape = {**common, "gamma": ratio * beta}
    strength = {"d2": 0.0, "d3": 0.0, "alpha1": alpha1, "alpha2": alpha2}
    models: tuple[tuple[OneState, Values], ...] = (
        (BoucWen(), {**shape, "exponent": 1.0}),
        (BoucWenAsymmetric(), {**shape, **dict(zip(NO_TERMS, terms, strict=True))}),
        (Duhem(odd=False), {**common, **strength}),
    )
    for operator, model in models:
        column = rows(**model)
        if not operator.holds(column).all():
            continue
        operator.check(column)
        h = 0.62 * path - run(operator, column, path)[0]
        supplied = np.diff(path) * (h[1:] + h[:-1]) / 2
        alpha = ALPHA + model.get("alpha1", 0.0) * path + model.get("alpha2", 0.0) * path**2
        lost = supplied - np.diff(h**2 / (2 * alpha))
        # The rule's own error is a twelfth of the step's cube times the curvature.
        step = np.abs(np.diff(path)).max()
        curvature = np.abs(np.diff(h, 2)).max(initial=0.0) / step if step > 0 else 0.0
        assert lost.min() >= -(step**2) * (curvature + 0.02 * step) - 1e-9


def test_beyond_the_constraints_a_path_gives_energy() -> None:
    """γ > β, b₅ near −1, and twenty times the largest α₂."""
    path = np.linspace(0.0, 10.0, 2001)
    h = hysteresis(path, ALPHA, 0.01, 0.03, initial=-7.0)[0]
    assert np.sum(np.diff(path) * (h[1:] + h[:-1]) / 2) - np.ptp(h**2 / (2 * ALPHA)) < -2.0
    model = rows(**{**PLAIN, **NO_TERMS, "b5": -0.9})
    assert not BoucWenAsymmetric().holds(model).any()
    with pytest.raises(InputError, match=r"gamma: .* must be passive"):
        BoucWenAsymmetric().check(model)
    alpha2 = 80 * 0.31 * 0.01**2
    model = rows(d=0.62, d3=0.0, alpha=0.31, beta=0.01, alpha2=alpha2, initial=5.0)
    assert not Duhem().holds(model).any()
    with pytest.raises(InputError, match=r"alpha2: .* 4 alpha beta"):
        Duhem().check(model)
    path = np.linspace(20.0, 10.0, 2001)
    h = 0.62 * path - run(Duhem(), model, path)[0]
    supplied = np.sum(np.diff(path) * (h[1:] + h[:-1]) / 2)
    assert supplied - np.diff((h**2 / (2 * (0.31 + alpha2 * path**2)))[[0, -1]])[0] < -1.0


@pytest.mark.parametrize(("terms", "start"), [*zip(TERMS, (2.5, -6.0, 2.5), strict=True)])
@every_path
def test_asymmetric_loops_agree_with_their_equation(path: str, terms: Values, start: float) -> None:
    voltage, model = paths()[path], {**PLAIN, **terms, "gamma": 0.005, "initial": start}

    def slope(u: float, h: float, s: float) -> float:
        x, z = np.sign(u), np.sign(h)
        signed = s * z + model["b2"] * x * s + model["b3"] * x * z
        signed += model["b4"] * s + model["b5"] * z + model["b6"] * x
        return float(model["alpha"] - abs(h) * (model["gamma"] + model["beta"] * signed))

    BoucWenAsymmetric().check(rows(**model))
    h = by_integration(voltage, slope, start, (lambda u, _: u, lambda _, h: h))
    got = model["d"] * voltage - run(BoucWenAsymmetric(), rows(**model), voltage)[0]
    assert_close(h, got, 1e-9)


@pytest.mark.parametrize("rate", [1e-9, 0.033, 40.0])
@pytest.mark.parametrize("model", [DUHEM, EVEN], ids=["odd", "even"])
@pytest.mark.parametrize("path", ["walk", "steps of all sizes", "unipolar"])
def test_duhem_agrees_with_the_equation_as_published(path: str, model: Values, rate: float) -> None:
    """That is dy = β |du| (f(u) − y) + g(u) du."""
    voltage, model = paths()[path][: 12 if rate > 10 else None], {**model, "beta": rate}
    d, d2, d3 = model["d"], model.get("d2", 0.0), model["d3"]

    def f(u: float) -> float:
        return d * u + d2 * u**2 + d3 * u**3

    def slope(u: float, y: float, s: float) -> float:
        strength = model["alpha"] + model.get("alpha1", 0.0) * u + model["alpha2"] * u**2
        return s * rate * (f(u) - y) + d + 2 * d2 * u + 3 * d3 * u**2 - strength

    expected = by_integration(voltage, slope, f(voltage[0]) - model["initial"])
    got = run(Duhem(odd="d2" not in model), rows(**model), voltage)[0]
    assert_close(expected, got, 1e-9)


@every_path
def test_simpler_loops_are_bouc_wen(path: str) -> None:
    """Asymmetric ones without terms, and backlash-like ones: dw = a |du| (c u − w) + b du."""
    voltage, (d, alpha, beta, gamma, initial) = paths()[path], PLAIN.values()
    expected = d * voltage - hysteresis(voltage, alpha, beta, gamma, initial=initial)
    none = run(BoucWenAsymmetric(terms=()), rows(**PLAIN), voltage)
    assert_close(expected, none, 1e-14)
    zeros = run(BoucWenAsymmetric(), rows(**PLAIN, **NO_TERMS), voltage)
    np.testing.assert_array_equal(none, zeros)
    a, b, c = beta, d - alpha, d
    start = c * voltage[0] - initial
    expected = by_integration(voltage, lambda u, w, s: s * a * (c * u - w) + b, start)
    column = rows(**{name: value for name, value in PLAIN.items() if name != "gamma"})
    assert_close(expected, run(BacklashLike(), column, voltage)[0], 1e-9)


def test_asymmetric_bounds_leave_out_nothing_that_holds() -> None:
    operator, generator = BoucWenAsymmetric(), np.random.default_rng(5)
    column = drawn(operator, 20_000, 3)
    size = column["d"].size
    column |= {name: generator.uniform(-1, 1, size) for name in NO_TERMS}
    holding = operator.holds(column)
    assert holding.sum() > 100
    for declared in operator.parameters[3:-1]:
        assert declared.bounds is not None
        low, high = (np.broadcast_to(b, size)[holding] for b in declared.bounds(column))
        values = column[declared.name][holding]
        slack = 1e-9 * (np.abs(values) + 1)
        assert ((low <= values + slack) & (values <= high + slack)).all()


GOOD = {"voltage": [0.0, 1.0], "alpha": ALPHA, "beta": 0.02, "gamma": 0.01}


@pytest.mark.parametrize(
    ("argument", "wrong"),
    [
        ("alpha", {"alpha": [ALPHA, -1.0]}),
        ("alpha", {"alpha": [[ALPHA]]}),
        ("alpha", {"alpha": []}),
        ("alpha", {"alpha": [1.0, 1.0], "beta": [0.02, 0.02, 0.02]}),
        ("beta", {"beta": -0.01, "gamma": 0.02}),
        ("gamma", {"gamma": -0.03}),
        ("initial", {"gamma": 0.03, "initial": 8.0}),
        ("initial", {"exponent": 2.0, "initial": -4.0}),
        ("exponent", {"exponent": 0.99}),
        ("voltage", {"voltage": []}),
        ("voltage", {"voltage": [[0.0, 1.0]]}),
        ("voltage", {"voltage": [0.0, math.nan]}),
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


def test_unknown_terms_are_refused_by_name() -> None:
    with pytest.raises(InputError, match="terms: 'b7' is unknown"):
        BoucWenAsymmetric(terms=("b7",))


# Jiles-Atherton and domain walls: against an integrator of the equation as it is published


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
