"""Margins are those of textbooks and of closed-loop poles; a design keeps them with every draw."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from bwbayes.control.loop import ANGLES, Gains, Margins, Robustness, design, margins
from bwbayes.control.sampled import SampledModel
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.operators.bouc_wen import BoucWen
from tests.control import cases

QUICK = {"bouc-wen", "bouc-wen, second-order", "plays, lag, nonlinearity"}
every_actuator = pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in cases.ACTUATORS
    ],
)


def models(name: str, count: int = 20, interval: float = 1e-3) -> SampledModel:
    actuator = cases.actuator(name, "zero", interval)
    return SampledModel.of(actuator, cases.theta(actuator, count, name))


def without_hysteresis(slope: float) -> SampledModel:
    actuator = Actuator("none", "zero", 1e-3, BoucWen())
    values = {"d": slope, "alpha": 1e-12 * slope, "beta": 1.0, "exponent": 1.0}
    return SampledModel.of(
        actuator, np.array([[values.get(one, 0.0) for one in actuator.parameters]])
    )


def largest_pole(gains: Gains, draws: SampledModel) -> float:
    """Return the largest pole of the closed loop at the steepest slope, with a sample's delay."""
    numerator, denominator, gain = (values[0, 0] for values in draws.sections)
    opened = np.convolve(denominator, [1.0, -1.0])
    slope = draws.slopes(cases.SPAN)[1][0]
    fed = np.append(0.0, slope * gain * np.convolve(numerator, gains.steps))
    return float(np.abs(np.roots(fed + np.pad(opened, (0, fed.size - opened.size)))).max())


def margins_of(gains: Gains, draws: SampledModel, delay: int) -> Margins:
    return margins(gains, draws.frequency_response(ANGLES), draws.slopes(cases.SPAN), delay)


def scaled(gains: Gains, factor: float) -> Gains:
    first, second, third = (factor * one for one in gains.steps)
    return replace(gains, steps=(first, second, third))


@settings(max_examples=15, deadline=None)
@given(speed=st.floats(0.01, 0.4), slope=st.floats(0.1, 10.0), delay=st.integers(0, 4))
def test_margins_of_an_integrator_are_the_closed_form(
    speed: float, slope: float, delay: int
) -> None:
    """L = K z^−(1+D) / (1 − 1/z): |L| = K / (2 sin(θ/2)), its lag is π/2 + (D + 1/2) θ."""
    made = without_hysteresis(slope)
    result = margins_of(Gains((speed / slope, 0.0, 0.0), 1e-3), made, delay)
    crossing = 2 * np.arcsin(speed / 2)
    gain = 2 * np.sin(np.pi / (2 * (2 * delay + 1))) / speed
    assert result.gain[0] == pytest.approx(gain, rel=1e-3)
    assert result.phase[0] == pytest.approx(90 - np.degrees((delay + 0.5) * crossing), abs=0.02)
    assert result.crossover[0] == pytest.approx(crossing / (2 * np.pi * 1e-3), rel=0.02)
    assert bool(gain > 1) == result.stable or not result.circle[0] > 0


@pytest.mark.parametrize("name", sorted(QUICK))
def test_at_its_gain_margin_a_loop_has_a_pole_on_the_circle(name: str) -> None:
    """The margin comes from the frequency response; poles are worked out apart, and agree."""
    draws = models(name)
    gains = design(draws, draws, cases.SPAN, 1, Robustness())[0]
    factors = margins_of(gains, draws, 1).gain
    for row in (0, 7):
        theta = cases.theta(draws.actuator, 20, name)[row : row + 1]
        single = SampledModel.of(draws.actuator, theta)
        inside, beyond = (
            largest_pole(scaled(gains, factor * factors[row]), single) for factor in (0.98, 1.02)
        )
        assert inside < 1 < beyond


@every_actuator
@pytest.mark.parametrize("delay", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (0, 3))])
def test_a_design_keeps_its_margins_and_is_the_fastest(name: str, delay: int) -> None:
    draws = models(name)
    required = Robustness(2.5, 50.0)
    gains, result = design(draws, draws, cases.SPAN, delay, required)
    assert result.stable
    assert (result.gain >= required.gain).all()
    assert (result.phase >= required.phase).all()
    faster = margins_of(scaled(gains, 1.03), draws, delay)
    kept = (faster.gain >= required.gain) & (faster.phase >= required.phase) & (faster.circle > 0)
    assert not kept.all()


def test_the_controllers_zeros_are_the_models_poles() -> None:
    draws = models("bouc-wen, second-order", 1)
    gains, _ = design(draws, draws, cases.SPAN, 1, Robustness())
    poles = np.roots(draws.sections.denominator[0, 0])
    np.testing.assert_allclose(np.roots(gains.steps), poles, atol=1e-12)
    # As K_p e + K_i ∫ e + K_d e′ in steps: backward differences.
    first, second, third = gains.steps
    assert first == pytest.approx(
        gains.proportional + gains.integral * 1e-3 + gains.derivative / 1e-3
    )
    assert second == pytest.approx(-gains.proportional - 2 * gains.derivative / 1e-3)
    assert third == pytest.approx(gains.derivative / 1e-3)


def test_slopes_that_change_from_sample_to_sample_leave_it_stable() -> None:
    """What the circle criterion promises, tried: increments die out whatever the slopes are."""
    draws = models("bouc-wen, second-order", 3)
    gains, result = design(draws, draws, cases.SPAN, 1, Robustness())
    assert (result.circle > 0).all()
    generator = np.random.default_rng(3)
    least, largest = draws.slopes(cases.SPAN)
    _, first, second = draws.sections.numerator[0, 0]
    _, back, far = draws.sections.denominator[0, 0]
    worst = 0.0
    for _ in range(20):
        x, w, errors, queue = [1.0, 0.9], [0.0, 0.0], [0.0, 0.0], [0.0]
        for _ in range(400):
            errors.append(-x[-1])
            change = sum(q * e for q, e in zip(gains.steps, errors[:-4:-1], strict=True))
            queue.append(change)
            slope = generator.choice([least[0], largest[0]])
            # Increments of the drive; the displacement's own sum them up.
            w.append(w[-1] + slope * queue.pop(0))
            x.append(first * w[-1] + second * w[-2] - back * x[-1] - far * x[-2])
        worst = max(worst, abs(x[-1]))
    assert worst < 1e-6


def test_a_slope_that_may_vanish_is_refused() -> None:
    actuator = Actuator("none", "zero")
    theta = cases.theta(actuator)
    theta[0, actuator.parameters.index("d")] = 0.4
    one = SampledModel.of(actuator, theta)
    with pytest.raises(InputError, match="slopes as low as"):
        design(one, one, cases.SPAN, 1, Robustness())
