"""The step of any exponent where the cases of a controller do not lead: ceilings, jumps, limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bwbayes.model.boucwen import hysteresis
from bwbayes.model.operator import Span
from bwbayes.model.power import PowerStep


def power(exponent: float, gamma: float = 0.003, beta: float = 0.006) -> PowerStep:
    d, alpha, *rest = (np.array([one]) for one in (0.7, 0.3575, beta, gamma, exponent))
    return PowerStep(d, alpha, *rest)


@settings(max_examples=60, deadline=None)
@given(
    turns=st.lists(st.floats(-150.0, 150.0), min_size=1, max_size=8),
    exponent=st.floats(1.0, 6.0),
    part=st.floats(-0.98, 1.5),
)
def test_any_exponent_is_the_simulation(turns: list[float], exponent: float, part: float) -> None:
    """On any path, of steps of any length, to 1e-10 of the largest h; also where γ > β."""
    beta = 0.03 * 8.0 ** (1 - exponent)
    step = power(exponent, part * beta, beta)
    path = np.array([0.0, *turns])
    shape = {"alpha": 0.3575, "beta": beta, "gamma": part * beta, "exponent": exponent}
    expected = hysteresis(path, **shape)[0]
    memory, made = step.demagnetized(), []
    for one in path:
        w, _, memory = step.go(memory, np.array([one]))
        made.append(0.7 * one - w[0])
    largest = max(float(np.max(np.abs(expected))), 1e-6)
    np.testing.assert_allclose(made, expected, rtol=0, atol=1e-10 * largest)


def test_the_slope_is_that_of_the_displacement() -> None:
    step = power(1.7)
    _, _, memory = step.go(step.demagnetized(), np.array([60.0]))
    for voltage in (59.0, 20.0, -40.0, -90.0):
        here, near = (step.go(memory, np.array([voltage + part])) for part in (-1e-5, 1e-5))
        slope = step.go(memory, np.array([voltage])).slope
        assert slope == pytest.approx((near.w - here.w) / 2e-5, rel=1e-6)


def test_at_the_ceiling_h_stays() -> None:
    step = power(2.0)
    top = float(step.ceiling[0])
    assert top == pytest.approx((0.3575 / 0.009) ** 0.5)
    w, slope, memory = step.go(np.array([[10.0, top, 0.0, 0.0]]), np.array([50.0]))
    assert memory[0, 1] == pytest.approx(top, rel=1e-14)
    assert w == pytest.approx(0.7 * 50 - top)
    assert slope == pytest.approx(0.7, abs=1e-12)
    # A jump of any size leads there.
    assert step.go(step.demagnetized(), np.array([1e4])).memory[0, 1] == pytest.approx(top)


def test_without_rates_h_grows_with_the_voltage() -> None:
    step = power(2.0, 0.0, 0.0)
    w, slope, _ = step.go(step.demagnetized(), np.array([80.0]))
    assert w == pytest.approx((0.7 - 0.3575) * 80)
    assert slope == pytest.approx(0.7 - 0.3575)
    least, most = step.slopes(Span(-100.0, 100.0))
    assert least == pytest.approx(0.7 - 0.3575)
    assert most == pytest.approx(0.7)
