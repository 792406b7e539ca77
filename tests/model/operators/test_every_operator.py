"""Promises of every operator in the registry, and of one from outside the package."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.map_estimate import fit
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Span
from bwbayes.model.linear import Creep
from bwbayes.model.nonlinearity import PolynomialNonlinearity
from bwbayes.model.operator import Operator
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.bouc_wen_asymmetric import BoucWenAsymmetric
from bwbayes.model.operators.duhem import BacklashLike, Duhem
from bwbayes.model.operators.pinned import DomainWall, JilesAtherton, Pinned
from bwbayes.model.operators.scalar_memory import OneState
from bwbayes.model.registry import HYSTERESIS, build_part
from tests.inference.problems import decaying_sine, posterior_of
from tests.model.operators.slow import RANGES, SPAN, drawn, run


def has_step(name: str) -> bool:
    return type(build_part("hysteresis", name, HYSTERESIS, {})).step is not Operator.step


every_operator = pytest.mark.parametrize("name", HYSTERESIS)


def posterior(
    name: str,
    options: Mapping[str, Any] | None = None,
    *,
    from_rest: bool = False,
    parts: bool = False,
) -> Posterior:
    operator = build_part("hysteresis", name, HYSTERESIS, options or {})
    voltage = decaying_sine(300)[60:]
    nonlinearity = PolynomialNonlinearity() if parts else None
    creep = Creep((0.1, 1.0), growing=True) if parts else None
    actuator = Actuator("lag", "first", 0.01, operator, nonlinearity, creep, Span(-100.0, 100.0))
    displacement = 0.6 * voltage + np.random.default_rng(1).normal(size=voltage.size)
    return posterior_of(voltage, displacement, actuator, "discrepancy", {}, from_rest=from_rest)


def drawn_from(of: Posterior, count: int) -> FloatArray:
    return of.prior.theta(of.prior.draw(np.random.default_rng(2), count))


@every_operator
def test_pieces_of_a_record_equal_the_whole(name: str) -> None:
    of = posterior(name, parts=True)
    actuator, theta = of.likelihood.actuator, of.single_record.table.actuator(drawn_from(of, 5))
    whole = actuator.displacement(theta, of.single_record.voltage)
    state, parts = None, []
    for first, last in ((0, 1), (1, 2), (2, 77), (77, 240)):
        part, state = actuator.advance(theta, of.single_record.voltage[first:last], state)
        parts.append(part)
    size = np.ptp(whole)
    np.testing.assert_allclose(np.concatenate(parts, axis=1), whole, atol=1e-9 * size)


def models(name: str, size: int, seed: int) -> tuple[Operator, dict[str, FloatArray]]:
    operator = build_part("hysteresis", name, HYSTERESIS, {})
    return operator, drawn(operator, size, seed)


def assert_near(name: str, expected: FloatArray, got: FloatArray) -> None:
    tolerance = 1e-6 if name in ("jiles-atherton", "domain-wall") else 1e-12
    size = np.ptp(expected, axis=1, keepdims=True) + np.abs(expected[:, :1]) + 1e-9
    assert (np.abs(got - expected) <= tolerance * size).all()


corners = st.lists(st.integers(-1000, 1000).map(lambda u: u / 10), min_size=2, max_size=6)


@every_operator
@settings(max_examples=10)
@given(path=corners, seed=st.integers(0, 9), holds=st.lists(st.integers(1, 3), min_size=6))
@example(path=[-15.4, 39.9], seed=8, holds=[1] * 6)  # d u and h nearly cancel
def test_neither_the_pace_nor_the_batch_matters(
    name: str, path: list[float], seed: int, holds: list[int]
) -> None:
    """Waiting at any sample changes nothing, and a model does not feel its neighbors."""
    operator, column = models(name, 5, seed)
    w = run(operator, column, np.array(path))
    repeats = np.array(holds[: len(path)])
    slow = run(operator, column, np.repeat(path, repeats))
    assert_near(name, np.repeat(w, repeats, axis=1), slow)
    # As far as a difference of terms as large as the voltage has digits.
    rounding = 1e-13 + 1e-14 * np.abs(path).max()
    for row in (0, 4):
        alone = run(operator, {k: v[row : row + 1] for k, v in column.items()}, np.array(path))
        np.testing.assert_allclose(alone[0], w[row], rtol=1e-13, atol=rounding)


@every_operator
def test_from_rest_the_voltage_came_straight_from_zero(name: str) -> None:
    operator, column = models(name, 5, 6)
    memory = operator.begin(column, 35.0, SPAN, from_rest=True)
    w, _ = operator.advance(column, np.array([35.0, 20.0]), memory)
    again, _ = operator.advance(column, np.array([35.0, 20.0]), memory)
    np.testing.assert_array_equal(again, w)
    at_zero = operator.begin(column, 0.0, SPAN, from_rest=True)
    whole, _ = operator.advance(column, np.array([0.0, 35.0, 20.0]), at_zero)
    assert_near(name, whole[:, 1:], w)


@every_operator
def test_draws_of_the_default_priors_have_displacements_of_the_right_size(name: str) -> None:
    """The median range of w is within a factor of three of the record's."""
    operator, column = models(name, 50, 1)
    voltage = RANGES.bias + RANGES.voltage * np.sin(np.linspace(0, 12, 60))
    size = np.ptp(run(operator, column, voltage)[:, 20:], axis=1)
    assert 1 / 3 < np.median(size) / (2 * RANGES.displacement) < 3


@every_operator
def test_the_initial_curve_rises(name: str) -> None:
    """From zero volts either way, and from no hysteresis; Duhem's is in its own tests."""
    operator, column = models(name, 50, 3)
    column["initial"] = np.zeros_like(column["initial"])
    for sign in (1.0, -1.0) if name != "duhem" else ():
        memory = operator.begin(column, 0.0, SPAN, from_rest=True)
        w, _ = operator.advance(column, sign * np.linspace(0, 60, 100), memory)
        assert (np.diff(sign * w, axis=1) >= -1e-9 * np.abs(w[:, -1:])).all()


@every_operator
@settings(max_examples=5)
@given(ends=st.tuples(st.integers(-100, 100), st.integers(-100, 100)), seed=st.integers(0, 9))
def test_a_settled_loop_loses_energy(name: str, ends: tuple[int, int], seed: int) -> None:
    """∮ u dw ≥ 0, by the trapezium rule on a loop that is gone through again and again."""
    operator, column = models(name, 5, seed)
    back_and_forth = np.interp(np.linspace(0, 8, 1601), np.arange(9), [*ends] * 4 + [ends[0]])
    w = run(operator, column, back_and_forth.astype(float))
    # Whole periods, which differ by what has not settled.
    u, last = back_and_forth[-401:], w[:, -401:]
    lost = np.sum((u[1:] + u[:-1]) / 2 * np.diff(last, axis=1), axis=1)
    unsettled = np.abs(last[:, 0] - last[:, -1]) * np.abs(u).max()
    size = np.ptp(u) * np.ptp(last, axis=1)
    assert (lost >= -1e-4 * size - unsettled - 1e-9).all()


@every_operator
def test_states_that_are_reachable_are_inside_the_prior(name: str) -> None:
    of = posterior(name)
    column = of.table.columns(drawn_from(of, 40))
    (initial,) = (p for p in of.prior.parameters if p.name == "initial")
    low, high = initial.declared.limits(column)
    least, most = of.single_record.actuator.hysteresis.reachable(
        column, float(of.single_record.voltage[0]), Span(-100.0, 100.0)
    )
    assert (least <= most).all()
    slack = 1e-9 * (np.abs(least) + np.abs(most))
    assert (least >= low - slack).all()
    assert (most <= high + slack).all()


@every_operator
def test_parameters_outside_their_domain_are_refused_by_name(name: str) -> None:
    """The last is the state before the record, and draws of the priors are inside."""
    operator, column = models(name, 20, 8)
    operator.check(column)
    *others, last = operator.parameters
    assert (last.name, last.scope) == ("initial", "record")
    assert {declared.scope for declared in others} == {"actuator"}
    for declared in operator.parameters:
        assert all((declared.label, declared.description, declared.unit))
        below = [declared.floor - 0.1] if declared.floor > -np.inf else []
        for value in (np.nan, np.inf, *below):
            wrong = {other: values.copy() for other, values in column.items()}
            wrong[declared.name][3] = value
            with pytest.raises(InputError, match=rf"^{declared.name}: .* in model 3; must "):
                operator.check(wrong)


@pytest.mark.parametrize("name", [name for name in HYSTERESIS if has_step(name)])
def test_the_slope_of_a_step_is_that_of_its_displacement(name: str) -> None:
    """From a turn of its own for each model; to a millionth, where it has no corner."""
    operator, column = models(name, 30, 9)
    column = (
        {**column, "exponent": np.full_like(column["d"], 1.7)} if name == "bouc-wen" else column
    )
    operator.check({**column, "initial": np.zeros_like(column["d"])})
    step = operator.step(column)
    ways = np.linspace(-90.0, 90.0, column["d"].size)
    _, _, turned = step.apply(step.demagnetized(), ways)
    for voltage in (59.0, 20.0, -40.0, -90.0):
        (low, _, _), (_, slope, _), (high, _, _) = (
            step.apply(turned, np.full_like(ways, voltage + part)) for part in (-1e-4, 0.0, 1e-4)
        )
        off = np.abs((high - low) / 2e-4 - slope) / np.abs(column["d"])
        assert np.median(off) < 1e-6


# Laws of those whose memory is one number, also with other terms.
OPERATORS: dict[str, OneState] = {
    "bouc-wen": BoucWen(),
    "backlash-like": BacklashLike(),
    "duhem": Duhem(),
    "duhem with even terms": Duhem(odd=False),
    "bouc-wen-asymmetric": BoucWenAsymmetric(),
    "bouc-wen-asymmetric by the voltage": BoucWenAsymmetric(("b2", "b3")),
    "jiles-atherton": JilesAtherton(),
    "domain-wall": DomainWall(),
}


def of_state(name: str, size: int, seed: int) -> dict[str, FloatArray]:
    """Draw models; fewer where there is an integrator to run."""
    pinned = isinstance(OPERATORS[name], Pinned)
    return drawn(OPERATORS[name], min(size, 2 if size < 20 else 50) if pinned else size, seed)


@pytest.mark.parametrize("name", OPERATORS)
def test_a_minor_loop_is_not_forgotten_and_not_congruent(name: str) -> None:
    """None of these does what a Preisach model would: neither wiping out nor congruency."""
    operator, column = OPERATORS[name], of_state(name, 100, 5)
    column["initial"] = np.zeros_like(column["initial"])
    straight = run(operator, column, np.array([0.0, 40.0, 60.0]))
    detour = run(operator, column, np.array([0.0, 40.0, 0.0, 40.0, 60.0]))
    missed = np.abs(detour[:, -1] - straight[:, -1]) / np.ptp(straight, axis=1)
    assert np.median(missed) > 1e-4
    after_less = run(operator, column, np.array([0.0, 40.0, 0.0, 40.0]))
    after_more = run(operator, column, np.array([0.0, 60.0, 0.0, 40.0, 0.0, 40.0]))
    heights = [np.diff(w[:, -2:], axis=1)[:, 0] for w in (after_less, after_more)]
    assert np.median(np.abs(heights[0] - heights[1]) / np.abs(heights[0])) > 1e-4


@pytest.mark.parametrize("name", OPERATORS)
def test_sweeps_reach_what_they_say(name: str) -> None:
    operator, column = OPERATORS[name], of_state(name, 200, 7)
    low, high = operator.reachable(column, 20.0, Span(-30.0, 70.0))
    assert (low < high).all()
    column["initial"] = np.zeros_like(column["initial"])
    start = operator.begin(column, 0.0, SPAN, from_rest=True)
    _, end = operator.advance(column, np.array([70.0, -30.0, 70.0, -30.0, 20.0]), start)
    # The state need not be what the parameter is, and may grow as that falls.
    ends = [
        operator.begin({**column, "initial": initial}, 20.0, SPAN, from_rest=False).state
        for initial in (low, high)
    ]
    slack = 1e-6 * np.max(np.abs(ends), axis=0)
    assert (end.state >= np.min(ends, axis=0) - slack).all()
    assert (end.state <= np.max(ends, axis=0) + slack).all()


def assert_fitted(of: Posterior) -> None:
    """Fit a simulated record: the mode is at least as probable as the truth."""
    generator = np.random.default_rng(4)
    free = of.prior.draw(generator, 1)
    clean = of.single_record.actuator.displacement(
        of.single_record.table.actuator(of.prior.theta(free)), of.single_record.voltage
    )[0]
    noise = 0.01 * np.ptp(clean) * generator.standard_normal(clean.size)
    record = of.altered(displacement=clean + noise)
    truth = record.log_density(of.prior.unconstrain(free))[0]
    assert fit(record, generator).log_density >= truth


@pytest.mark.slow
def test_a_point_fit_asks_for_no_impossible_loop() -> None:
    """Bounds of single parameters do not say which shape terms may go together."""
    assert_fitted(posterior("bouc-wen-asymmetric", {"terms": ["b3", "b5", "b6"]}))


@pytest.mark.slow
@every_operator
def test_every_operator_is_fitted(name: str) -> None:
    assert_fitted(posterior(name))
