"""The whole actuator against a slow simulation, and its recursions against scipy and limits."""

import math
from itertools import pairwise
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator, State
from bwbayes.model.declaration import check
from bwbayes.model.inputs import Hold, Span
from bwbayes.model.linear import Recursion, first_order_lag, second_order
from bwbayes.model.nonlinearity import PolynomialNonlinearity
from bwbayes.model.operators.bouc_wen import hysteresis
from bwbayes.model.registry import DYNAMICS
from bwbayes.record.teststand import TABLE_1
from tests.model.operators.slow import Model, assert_close, random_walk

HOLDS: tuple[Hold, ...] = get_args(Hold)
# The paper's Table 1 in the package's units, with a mass that lets the second order ring.
VALUES = dict(TABLE_1) | {"initial": 1.5, "lag": 3.85e-3, "mass": 2.0, "offset": 12.0}


def theta_of(actuator: Actuator, **changes: float) -> FloatArray:
    """One model (parameters,) of Table 1, with changes."""
    return np.array([{**VALUES, **changes}[name] for name in actuator.parameters])


def batch_of(actuator: Actuator, size: int) -> FloatArray:
    """Models (size, parameters) scattered around Table 1."""
    scatter = np.random.default_rng(1).uniform(0.7, 1.3, (size, len(actuator.parameters)))
    theta = theta_of(actuator) * scatter
    theta[:, actuator.parameters.index("exponent")] = np.resize([1.0, 1.0, 2.0, 1.3], size)
    return theta


def kinds(interval: float = 1e-3) -> list[Actuator]:
    return [Actuator(dynamics, hold, interval) for dynamics in DYNAMICS for hold in HOLDS]


def name_of(actuator: Actuator) -> str:
    return f"{actuator.dynamics}, {actuator.hold}"


every_kind = pytest.mark.parametrize("actuator", kinds(), ids=name_of)


def simulate(actuator: Actuator, theta: FloatArray, voltage: FloatArray) -> FloatArray:
    """Follow one model sample by sample, with a Runge-Kutta integrator inside each interval."""
    value = dict(zip(actuator.parameters, theta.tolist(), strict=True))
    model = Model(value["alpha"], value["beta"], value["gamma"], value["exponent"])
    drive = value["d"] * voltage - hysteresis(voltage, *model, initial=value["initial"])[0]
    if actuator.dynamics == "none":
        # A held drive changes just after the sample.
        drive = drive if actuator.hold == "first" else np.concatenate([drive[:1], drive[:-1]])
        return np.asarray(drive + value["offset"])
    x, result = np.array([drive[0], 0.0]), [drive[0]]
    for now, following in pairwise(drive.tolist()):
        slope = (following - now) / actuator.interval if actuator.hold == "first" else 0.0

        def rate(t: float, x: FloatArray, now: float = now, slope: float = slope) -> list[float]:
            gap = now + slope * t - x[0]
            if actuator.dynamics == "lag":
                return [gap / value["lag"], 0.0]
            force = value["stiffness"] * gap - value["damping"] * x[1]
            return [x[1], force / value["mass"]]

        span = (0.0, actuator.interval)
        x = solve_ivp(rate, span, x, "DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
        result.append(x[0])
    return np.asarray(np.array(result) + value["offset"])


@every_kind
@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_agrees_with_a_slow_simulation(actuator: Actuator, exponent: float) -> None:
    theta, voltage = theta_of(actuator, exponent=exponent, gamma=0.01), random_walk(2, turns=10)
    expected = simulate(actuator, theta, voltage)
    assert_close(expected, actuator.displacement(theta, voltage)[0], 1e-8)


@every_kind
@given(cuts=st.lists(st.integers(1, 149), max_size=6, unique=True))
@settings(max_examples=5)
def test_pieces_equal_the_whole(actuator: Actuator, cuts: list[int]) -> None:
    theta, voltage = batch_of(actuator, 8), random_walk(4)
    state: State | None = None
    pieces = []
    for piece in np.split(voltage, sorted(cuts)):
        displacement, state = actuator.advance(theta, piece, state)
        pieces.append(displacement)
    assert_close(actuator.displacement(theta, voltage), np.hstack(pieces), 1e-12)


@pytest.mark.parametrize("exponent", [1.0, 1.3, 2.0])
def test_pieces_go_on_from_a_saturated_state(exponent: float) -> None:
    """With gamma > beta a state at the ceiling must not be refused for its rounding."""
    actuator, voltage = Actuator("none"), 100 * np.sin(np.linspace(0, 30, 400))
    ratio = np.random.default_rng(5).uniform(1.0, 1.5, 60)
    theta = np.tile(theta_of(actuator, beta=0.3, exponent=exponent, initial=0.0), (60, 1))
    theta[:, actuator.parameters.index("gamma")] = 0.3 * ratio
    state: State | None = None
    for piece in np.array_split(voltage, 40):
        displacement, state = actuator.advance(theta, piece, state)
        assert np.isfinite(displacement).all()


@every_kind
def test_arguments_stay_as_they_are(actuator: Actuator) -> None:
    theta, voltage = batch_of(actuator, 3), random_walk(11)
    _, state = actuator.advance(theta, voltage)
    remembered = [one.copy() for one in state.filter]
    actuator.advance(theta, voltage, state)
    np.testing.assert_array_equal(batch_of(actuator, 3), theta)
    np.testing.assert_array_equal(random_walk(11), voltage)
    for one, other in zip(remembered, state.filter, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("shape", [(), (3,), (1, 9), (2, 7), (1, 2, 8)])
def test_theta_of_a_wrong_shape_is_refused_with_the_names_of_its_columns(
    shape: tuple[int, ...],
) -> None:
    with pytest.raises(InputError, match=r"^theta: has shape .*d, alpha, .*, lag, offset$"):
        Actuator("lag").displacement(np.ones(shape), [0.0, 1.0])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, math.nan) for name in VALUES),
        ("lag", -1e-3),
        ("mass", 0.0),
        ("mass", -1.0),
        ("damping", -1.0),
        ("stiffness", 0.0),
    ],
)
def test_a_parameter_outside_its_domain_is_named(name: str, value: float) -> None:
    for actuator in kinds():
        if name in actuator.parameters:
            theta = np.vstack([theta_of(actuator), theta_of(actuator, **{name: value})])
            with pytest.raises(InputError, match=f"^{name}: [^\n]* in model 1; [^\n]*$"):
                actuator.displacement(theta, [0.0, 1.0])


@pytest.mark.parametrize("voltage", [[], 1.0, [[0.0, 1.0]], [0.0, math.nan]])
@pytest.mark.parametrize("continued", [False, True])
def test_voltage_that_is_no_row_of_numbers_is_refused(voltage: object, continued: bool) -> None:
    actuator = Actuator("lag")
    state = actuator.advance(theta_of(actuator), [0.0, 1.0])[1] if continued else None
    with pytest.raises(InputError, match=r"^voltage: "):
        actuator.advance(theta_of(actuator), voltage, state)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("dynamics", {"dynamics": "third-order"}),
        ("hold", {"hold": "First"}),
        *(("interval", {"interval": value}) for value in (0.0, -1e-3, math.nan, math.inf)),
    ],
)
def test_an_actuator_that_cannot_be_is_refused(name: str, wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match=f"^{name}: "):
        Actuator(**wrong)  # type: ignore[arg-type]


# The static nonlinearity: displacements at the edge of the voltage's range

SPAN = Span(-20.0, 100.0)


def test_coefficients_are_displacements_at_the_edge_of_the_range() -> None:
    column = {"quadratic": np.array([1.0, -2.0]), "cubic": np.array([0.5, 0.0])}
    w = PolynomialNonlinearity(reference=SPAN).displacement(
        column, np.array([-20.0, 40.0, 70.0, 100.0])
    )
    np.testing.assert_allclose(w, [[0.5, 0.0, 0.3125, 1.5], [-2.0, 0.0, -0.5, -2.0]], rtol=1e-15)


def test_a_span_without_width_gives_nothing() -> None:
    column = {"quadratic": np.array([1.0]), "cubic": np.array([1.0])}
    w = PolynomialNonlinearity(reference=Span(5.0, 5.0)).displacement(column, np.full(3, 5.0))
    np.testing.assert_array_equal(w, np.zeros((1, 3)))


def test_says_what_is_wrong_by_name() -> None:
    with pytest.raises(InputError, match="nonlinearity: 'cubik' is unknown; did you mean cubic"):
        PolynomialNonlinearity(("cubik",))
    with pytest.raises(InputError, match="cubic: nan in model 1; must be finite"):
        check(PolynomialNonlinearity(("cubic",)).parameters, {"cubic": np.array([0.0, np.nan])})


# The recursions against scipy, closed forms and limits, for every kind of pole


INTERVAL = 1e-3


def batch(*parameters: float) -> list[FloatArray]:
    return [np.array([value]) for value in parameters]


def oscillator(parameters: tuple[float, float, float], hold: Hold) -> Recursion:
    mass, damping, stiffness = batch(*parameters)
    return second_order(mass, damping, stiffness, INTERVAL, hold)


def from_rest(recursion: Recursion, drive: FloatArray) -> FloatArray:
    """Output (samples,) of the first model for a drive (samples,) that starts at zero."""
    return np.asarray(recursion.run(drive[np.newaxis].copy(), recursion.at_rest())[0])


def walk(samples: int = 400) -> FloatArray:
    """Return a random walk (samples,) that starts at zero."""
    steps = np.random.default_rng(1).normal(size=samples - 1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def by_matrix_exponential(rate: FloatArray, hold: Hold, drive: FloatArray) -> FloatArray:
    """Step a system over every interval; the drive and its slope ride along as the last states."""
    transition = expm(rate * INTERVAL)
    state, positions = np.zeros(len(rate)), []
    for now, following in zip(drive, [*drive[1:], drive[-1]], strict=True):
        positions.append(state[0])
        state[-2:] = now, (following - now) / INTERVAL if hold == "first" else 0.0
        state = transition @ state
    return np.array(positions)


def by_pole(frequency: float, ratio: float, hold: Hold, drive: FloatArray) -> FloatArray:
    """Turn the deviation from the steady motion by the pole of an oscillator, sample by sample."""
    pole = frequency * complex(-ratio, np.sqrt(1 - ratio**2))
    position = velocity = 0.0
    positions = []
    for now, following in zip(drive, [*drive[1:], drive[-1]], strict=True):
        positions.append(position)
        slope = following - now if hold == "first" else 0.0
        behind = now - 2 * ratio * slope / frequency
        turned = np.exp(pole) * (velocity - slope - pole.conjugate() * (position - behind))
        deviation = turned.imag / pole.imag
        position = behind + slope + deviation
        velocity = slope + turned.real + pole.real * deviation
    return np.array(positions)


@given(
    frequency=st.floats(-2.5, 4.0).map(lambda power: 10.0**power),
    ratio=st.floats(0.0, 40.0) | st.floats(0.0, 0.9),
    hold=st.sampled_from(HOLDS),
)
@settings(max_examples=100)
def test_any_oscillator_agrees_with_its_equation(
    frequency: float, ratio: float, hold: Hold
) -> None:
    """Frequency in rad per sample, damping ratio from none to stiff.

    A matrix exponential loses digits with every turn of a hardly damped oscillator.
    """
    natural = frequency / INTERVAL
    parameters = (1 / natural**2, 2 * ratio / natural, 1.0)
    # d/dt of displacement, velocity, drive and slope of the drive.
    pull, brake = natural**2, 2 * ratio * natural
    rate = np.array([[0, 1, 0, 0], [-pull, -brake, pull, 0], [0, 0, 0, 1.0], [0] * 4])
    expected = (
        by_pole(frequency, ratio, hold, walk(60))
        if ratio < 0.9
        else by_matrix_exponential(rate, hold, walk(60))
    )
    got = from_rest(oscillator(parameters, hold), walk(60))
    # The angle of an undamped oscillation is known to its rounding only.
    tolerance = 1e-10 + 1e-12 * frequency
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance * np.abs(walk(60)).max())


@pytest.mark.parametrize("lag", [1e-9, 1e-5, 4e-4, 1e-3, 3.85e-3, 0.5, 1e4])
def test_lag_agrees_with_the_matrix_exponential(lag: float) -> None:
    rate = np.array([[-1 / lag, 1 / lag, 0], [0, 0, 1.0], [0, 0, 0]])
    for hold in HOLDS:
        expected = by_matrix_exponential(rate, hold, walk())
        got = from_rest(first_order_lag(np.array([lag]), INTERVAL, hold), walk())
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_without_a_lag_the_output_is_the_drive_as_it_is_held() -> None:
    for lag in (0.0, 1e-320, 1e-30):
        got = from_rest(first_order_lag(np.array([lag]), INTERVAL, "first"), walk())
        np.testing.assert_allclose(got, walk(), rtol=0, atol=1e-12)
        got = from_rest(first_order_lag(np.array([lag]), INTERVAL, "zero"), walk())
        np.testing.assert_array_equal(walk()[:-1], got[1:])


def test_finite_for_parameters_over_many_decades() -> None:
    generator = np.random.default_rng(2)
    mass, damping, stiffness, lag = 10 ** generator.uniform(-12, 12, (4, 20_000))
    damping[::7] = 0.0
    for hold in HOLDS:
        for recursion in (
            second_order(mass, damping, stiffness, INTERVAL, hold),
            first_order_lag(lag, INTERVAL, hold),
        ):
            assert np.isfinite(recursion.numerator).all()
            assert np.isfinite(recursion.denominator).all()


@given(decay=st.floats(690.0, 760.0), hold=st.sampled_from(HOLDS))
def test_what_decays_below_normal_numbers_is_nothing(decay: float, hold: Hold) -> None:
    """A processor takes ten times as long with a number below 2e-308 that is not zero."""
    smallest = np.finfo(float).tiny
    lag = first_order_lag(np.array([INTERVAL / decay]), INTERVAL, hold)
    # Poles whose product decays as fast: the last coefficient is exp(−b Δ / m).
    stiff = oscillator((1e-3, 1e-3 * decay / INTERVAL, 1e5), hold)
    for recursion in (lag, stiff):
        for taps in (recursion.numerator, recursion.denominator, recursion.free):
            assert ((taps == 0) | (np.abs(taps) >= smallest)).all()
