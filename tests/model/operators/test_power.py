"""The step of any exponent where the cases of a controller do not lead: ceilings, jumps, limits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import hyp2f1

from bwbayes.model.operator import Span
from bwbayes.model.power import PowerStep


def power(exponent: float, gamma: float = 0.003, beta: float = 0.006) -> PowerStep:
    d, alpha, *rest = (np.array([value]) for value in (0.7, 0.3575, beta, gamma, exponent))
    return PowerStep(d, alpha, *rest)


@pytest.mark.parametrize("exponent", [1.0, 1 + 1e-9, 1.05, 1.7, 3.3, 10.0, 50.0])
def test_inverts_the_hypergeometric_travel_inside_the_ceiling(exponent: float) -> None:
    """v(g) = (g/alpha) 2F1(1, 1/n; 1 + 1/n; (lambda/alpha) g^n), here with G = 1."""
    height = np.concatenate((np.geomspace(1e-8, 0.5, 40), np.linspace(0.51, 0.98, 48)))
    travel = height * hyp2f1(1.0, 1 / exponent, 1 + 1 / exponent, height**exponent) / 0.36
    d, alpha, *rest = np.array([[0.0, 0.36, 0.6 * 0.36, 0.4 * 0.36, exponent]]).T
    _, got = PowerStep(d, alpha, *rest).along(0.0, np.zeros(1), travel)
    np.testing.assert_allclose(got[0], height, rtol=1e-11)


def test_the_slope_is_that_of_the_displacement() -> None:
    step = power(1.7)
    _, _, memory = step.go(step.demagnetized(), np.array([60.0]))
    for voltage in (59.0, 20.0, -40.0, -90.0):
        here, near = (step.go(memory, np.array([voltage + part])) for part in (-1e-5, 1e-5))
        slope = step.go(memory, np.array([voltage])).slope
        assert slope == pytest.approx((near.w - here.w) / 2e-5, rel=1e-6)


def test_at_the_ceiling_h_stays() -> None:
    step = power(2.0)
    top = float(step.scales[1][0])
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
