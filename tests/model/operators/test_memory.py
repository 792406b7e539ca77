"""Operators that remember extrema: against slow plain ones, and the laws they keep or do not."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Context, Ranges
from bwbayes.model.inputs import Span
from bwbayes.model.operators.extremum_memory import RemembersExtrema
from bwbayes.model.operators.prandtl_ishlinskii import MaxwellSlip, Plays, PrandtlIshlinskii
from bwbayes.model.operators.preisach import KrasnoselskiiPokrovskii, Preisach
from tests.model.operators.slow import Rows, by_extrema, by_plays, path, rows, run, walk

SPANS = (Span(-100.0, 120.0), Span(-150.0, 90.0), Span(5.0, 160.0), Span(-30.0, -20.0), None)
INITIALS = [-1.0, -0.6, 0.0, 0.37, 0.9, 1.0]


@dataclass(frozen=True)
class Case:
    """An operator, a model of it, and its Everett function as a scalar formula."""

    operator: RemembersExtrema
    column: Rows
    everett: Callable[[float, float], float]


def _exponential(low: float, high: float) -> float:
    x = abs(high - low) / 2
    return 2 * (0.7 * x + 0.4 * (x - 30.0 * (1 - math.exp(-x / 30.0))))


def _plays(low: float, high: float) -> float:
    travel = abs(high - low)
    return 0.7 * travel + sum(
        w * max(travel - 2 * r, 0) for w, r in zip(WEIGHTS, VOLTS, strict=True)
    )


def _bells(low: float, high: float) -> float:
    moved = 80.0 * (math.tanh(high / 80.0) - math.tanh(low / 80.0))
    return 0.7 * abs(high - low) + 0.002 * moved**2


NODES, PARTS = np.polynomial.legendre.leggauss(40)


def _ramps(low: float, high: float) -> float:
    shifts = 25.0 * NODES
    # tanh x − tanh y without its cancellation.
    split = np.cosh((high - shifts) / 80.0) * np.cosh((low - shifts) / 80.0)
    moved = 80.0 * np.sinh((high - low) / 80.0) / split
    return 0.7 * abs(high - low) + 0.002 * float(PARTS @ moved**2) / 2


VOLTS = (2.0, 9.0, 31.0, 70.0)
WEIGHTS = (0.1, 0.3, 0.0, 0.2)
NUMBERED = {f"weight_{j + 1}": w for j, w in enumerate(WEIGHTS)}
SLIPPING = {f"alpha_{j + 1}": w for j, w in enumerate(WEIGHTS)}
BELLS = {"d": 0.7, "rayleigh": 0.004, "saturation": 80.0}
EVEN = {"threshold": 75.0, "d": 0.7} | {f"weight_{j}": 0.1 * j for j in range(1, 5)}


def _even(low: float, high: float) -> float:
    travel = abs(high - low)
    return 0.7 * travel + sum(0.1 * j * max(travel - 30.0 * j, 0) for j in range(1, 5))


CASES = {
    "prandtl-ishlinskii": Case(
        PrandtlIshlinskii(), rows(d=0.7, alpha=0.4, threshold=30.0, initial=INITIALS), _exponential
    ),
    "plays": Case(Plays(VOLTS), rows(d=0.7, **NUMBERED, initial=INITIALS), _plays),
    "plays evenly": Case(Plays(4), rows(**EVEN, initial=INITIALS), _even),
    "maxwell-slip": Case(MaxwellSlip(VOLTS), rows(d=1.3, **SLIPPING, initial=INITIALS), _plays),
    "preisach": Case(Preisach(), rows(**BELLS, initial=INITIALS), _bells),
    "krasnoselskii-pokrovskii": Case(
        KrasnoselskiiPokrovskii(), rows(**BELLS, width=50.0, initial=INITIALS), _ramps
    ),
}
every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
INVARIANT = ("prandtl-ishlinskii", "plays", "plays evenly", "maxwell-slip")
voltages = st.floats(-150, 150).map(lambda u: round(u, 3))
paths = st.lists(voltages, min_size=2, max_size=30).map(np.array)
spans = st.sampled_from(SPANS)


def assert_close(expected: FloatArray, got: FloatArray, part: float = 1e-9) -> None:
    assert np.max(np.abs(got - expected)) <= part * max(np.ptp(expected), 1e-9)


def slowly(case: Case, voltage: FloatArray, span: Span | None) -> FloatArray:
    starts = case.column["initial"].tolist()
    full = [path(start, voltage, span) for start in starts]
    return np.array([by_extrema(case.everett, one, voltage.size) for one in full])


@every_case
@pytest.mark.parametrize("span", SPANS)
def test_agrees_with_extrema_looked_for_anew(case: Case, span: Span | None) -> None:
    for seed in range(3):
        voltage = walk(seed, turns=12)
        assert_close(slowly(case, voltage, span), run(case.operator, case.column, voltage, span))


def test_exponential_thresholds_are_the_limit_of_many_plays() -> None:
    voltage = walk(6, turns=30)
    case, span = CASES["prandtl-ishlinskii"], SPANS[0]
    got = run(case.operator, case.column, voltage, span)
    errors = []
    for count in (1_000, 4_000):
        edges = np.linspace(0.0, 900.0, count + 1)
        middles, weights = (edges[1:] + edges[:-1]) / 2, -0.4 * np.diff(np.exp(-edges / 30.0))
        plain = by_plays(0.7, middles, weights, path(INITIALS[3], voltage, span))
        errors.append(np.max(np.abs(got[3] - plain[-voltage.size :])) / np.ptp(got))
    assert errors[1] < 2e-5
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.5)


def _by_relays(width: float, voltages: list[float], cells: int) -> FloatArray:
    """Follow ramps of a width, one by one, on a grid of switching voltages."""
    grid = (np.arange(cells) + 0.5) / cells * 640.0 - 320.0
    up, down = (one[np.tril_indices(cells)] for one in np.meshgrid(grid, grid, indexing="ij"))
    weight = 0.002 / np.cosh(up / 80.0) ** 2 / np.cosh(down / 80.0) ** 2 * (640.0 / cells) ** 2
    weight[up == down] /= 2

    def ramp(beyond: FloatArray) -> FloatArray:
        if width == 0:
            return np.sign(beyond)
        return np.clip(2 * beyond / width, -1.0, 1.0)

    state = ramp(-(up + down) / 2)
    result = []
    for u in voltages:
        state = np.maximum(ramp(u - up), np.minimum(ramp(u - down), state))
        result.append(0.7 * u + float(weight @ state))
    return np.array(result)


@pytest.mark.parametrize(("name", "width"), [("preisach", 0.0), ("krasnoselskii-pokrovskii", 50.0)])
def test_densities_are_the_limit_of_many_relays(name: str, width: float) -> None:
    voltage, span = walk(7, turns=15), SPANS[0]
    got = run(CASES[name].operator, CASES[name].column, voltage, span)[3]
    errors = []
    for cells in (150, 600):
        plain = _by_relays(width, path(INITIALS[3], voltage, span), cells)[-voltage.size :]
        # Relays and displacement are counted from different zeros.
        errors.append(np.ptp(got - plain) / np.ptp(got))
    # A grid of relays is as good as its cells are small.
    assert errors[1] < 3e-3
    assert errors[1] < errors[0] / 3


@every_case
@settings(max_examples=15)
@given(voltage=paths, inside=paths)
def test_a_closed_loop_is_wiped_out(case: Case, voltage: FloatArray, inside: FloatArray) -> None:
    """A detour that stays between a record's end and its turn before leaves no trace."""
    turn, end = float(voltage[-2]), float(voltage[-1])
    low, high = min(turn, end), max(turn, end)
    detour = np.clip(inside, low, high)
    after = np.array([end, -170.0, 170.0, 0.0])
    span = SPANS[0]
    straight = run(case.operator, case.column, np.concatenate([voltage, after]), span)
    around = run(case.operator, case.column, np.concatenate([voltage, detour, after]), span)
    np.testing.assert_allclose(straight[:, -4:], around[:, -4:], rtol=0, atol=1e-11)


@every_case
@settings(max_examples=15)
@given(first=paths, second=paths, low=voltages, high=voltages)
def test_loops_between_the_same_voltages_are_congruent(
    case: Case, first: FloatArray, second: FloatArray, low: float, high: float
) -> None:
    loop = np.array([low, high, (low + high) / 2, low, (low + high) / 2, high])
    shapes = []
    for before in (first, second):
        got = run(case.operator, case.column, np.concatenate([before, loop]), SPANS[0])[:, -4:]
        shapes.append(got - got[:, :1])
    np.testing.assert_allclose(shapes[0], shapes[1], rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", INVARIANT)
@settings(max_examples=15)
@given(voltage=paths, travel=st.floats(0.1, 100))
def test_masing(name: str, voltage: FloatArray, travel: float) -> None:
    """From a turn at the largest voltage so far it is the first curve, twice as large."""
    case = CASES[name]
    top = float(np.max(np.abs(voltage))) + 60
    path_down = np.array([*voltage, top, top - min(travel, top)])
    got = run(case.operator, case.column, path_down, None)
    first = run(case.operator, case.column, np.array([0.0, min(travel, top) / 2]), None)
    np.testing.assert_allclose(got[:, -2] - got[:, -1], 2 * first[:, -1], rtol=0, atol=1e-11)


@every_case
@settings(max_examples=15)
@given(voltage=voltages, span=spans.filter(bool))
def test_the_start_goes_from_the_ascending_to_the_descending_branch(
    case: Case, voltage: float, span: Span
) -> None:
    column = {name: np.resize(values, 21) for name, values in case.column.items()}
    column["initial"] = np.linspace(-1, 1, 21)
    w = run(case.operator, column, np.array([voltage]), span)[:, 0]
    assert np.min(np.diff(w)) >= -1e-11
    low, high = min(span.low, voltage), max(span.high, voltage)
    one = {name: values[:1] for name, values in column.items()}
    ascending = run(case.operator, one, np.array([0.0, high, low, voltage]), None)[0, -1]
    descending = run(case.operator, one, np.array([0, high, low, high, voltage]), None)[0, -1]
    assert w[0] == pytest.approx(ascending, abs=1e-11)
    assert w[-1] == pytest.approx(descending, abs=1e-11)
    lowest, highest = case.operator.reachable(column, voltage, span)
    alike = np.ptp(w) <= 1e-11
    if not span.low < voltage < span.high:
        assert alike
        assert not highest.any()
    else:
        assert (lowest == -1).all()
        assert (highest == 1).all()


@every_case
@given(voltage=paths)
def test_a_demagnetized_actuator_came_straight_from_zero_volts(
    case: Case, voltage: FloatArray
) -> None:
    """At any ``initial``: as a record whose first sample is at zero volts goes on."""
    span = Span(-200.0, 200.0)
    actuator = Actuator("none", hysteresis=case.operator, span=span, demagnetized=True)
    column = {**case.column, "offset": np.zeros(len(INITIALS))}
    theta = np.column_stack([column[name] for name in actuator.parameters])
    before = replace(actuator, demagnetized=False)
    longer = np.concatenate([[0.0], voltage])
    expected = before.displacement(theta, longer, from_rest=True)[:, 1:]
    assert_close(expected, actuator.displacement(theta, voltage))


def test_springs_that_hold_back_more_than_all_are_refused() -> None:
    column = rows(d=[1.3, 0.5], **SLIPPING, initial=0.0)
    with pytest.raises(InputError, match=r"^d: 0.5 in model 1; must not be less"):
        MaxwellSlip(VOLTS).check(column)


def test_ramps_wider_than_ten_bells_are_refused() -> None:
    column = rows(**BELLS, width=801.0, initial=0.0)
    with pytest.raises(InputError, match=r"^width: 801 in model 0; must be at most 10 times"):
        KrasnoselskiiPokrovskii().check(column)


@pytest.mark.parametrize("thresholds", [0, -1, (), (0.0, 1.0), (2.0, 1.0), (1.0, math.nan)])
@pytest.mark.parametrize("kind", [Plays, MaxwellSlip])
def test_thresholds_that_cannot_be_are_refused(kind: type[Plays], thresholds: object) -> None:
    with pytest.raises(InputError, match=r"^thresholds: "):
        kind(thresholds)  # type: ignore[arg-type]


@pytest.mark.parametrize("saturation", [1e-1, 1.0, 1e2, 1e4])
@pytest.mark.parametrize("ratio", [1e-6, 1e-2, 1.0, 10.0])
def test_ramps_keep_their_digits(saturation: float, ratio: float) -> None:
    """Small branches and far saturation, against quadrature over the shift."""
    width = ratio * saturation
    column = rows(d=0.0, rayleigh=1.0, saturation=saturation, width=width, initial=0.0)
    branch = KrasnoselskiiPokrovskii().branch(column)
    nodes, parts = np.polynomial.legendre.leggauss(150)
    shifts = width / 2 * nodes
    for start, end in ((0.0, 1.0), (-0.3, 0.2), (0.7, 0.7 + 1e-7), (0.5, 0.5 + 1e-3)):
        u, v = start * 5 * saturation, end * 5 * saturation
        split = np.cosh((v - shifts) / saturation) * np.cosh((u - shifts) / saturation)
        moved = saturation * math.sinh((v - u) / saturation) / split
        expected = float(parts @ moved**2) / 4
        assert branch(u, np.array([v]))[0, 0] == pytest.approx(expected, rel=1e-10, abs=1e-300)


@pytest.mark.parametrize("fixed", [{}, {"alpha_3": 0.4, "width": 0.3}, {"d": 1.0}])
@pytest.mark.parametrize("operator", [MaxwellSlip(5), KrasnoselskiiPokrovskii()])
def test_bounds_leave_only_what_the_domain_allows(
    operator: RemembersExtrema, fixed: dict[str, float]
) -> None:
    """A point fit may go anywhere that the coordinates lead."""
    known = Context(Ranges(1.0, 1.0, 0.0, 1.0))
    parameters = []
    for declared in operator.parameters:
        default = fixed.get(declared.name, declared.default(known))
        assert default is not None
        parameters.append(Parameter.of(declared, default))
    prior = JointPrior(parameters, operator.holds)
    far = np.random.default_rng(3).normal(0, 4, (2000, prior.dimensions))
    free, _ = prior.constrain(far)
    operator.check(dict(zip(prior.names, prior.theta(free).T, strict=True)))
