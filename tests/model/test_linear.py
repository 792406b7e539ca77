"""The recursions against scipy, closed forms and limits, for every kind of pole."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.linalg import expm

from bwbayes.arrays import FloatArray
from bwbayes.model.inputs import Hold
from bwbayes.model.linear import Recursion, first_order_lag, second_order

INTERVAL = 1e-3
HOLDS: tuple[Hold, ...] = ("first", "zero")


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
