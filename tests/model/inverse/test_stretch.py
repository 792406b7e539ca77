"""Roots along one stretch, against the curves that they belong to."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bwbayes.model.inverse.stretch import reached, travel


@given(
    steepness=st.floats(0.1, 10.0),
    part=st.floats(-2.0, 0.999),
    rate=st.floats(-9.0, 0.0).map(lambda power: 10.0**power),
    far=st.floats(-3.0, 3.0).map(lambda power: 10.0**power),
)
def test_the_closed_form_is_the_inverse_of_its_curve(
    steepness: float, part: float, rate: float, far: float
) -> None:
    """Whatever the rate, d v − m (1 − exp(−c v)) / c and back; m below d, of either sign."""
    v, missing = np.linspace(0.0, far, 20), part * steepness
    rise = steepness * v + missing * np.expm1(-rate * v) / rate
    back = travel(steepness, missing, rate, rise)
    np.testing.assert_allclose(back, v, rtol=1e-9, atol=1e-12 * far)


@pytest.mark.parametrize("s", [1.0, -1.0])
def test_a_search_finds_all_samples_of_a_path_at_once(s: float) -> None:
    """A cubic, with targets that begin at the start and end beyond the edge."""

    def curve(u: np.ndarray) -> np.ndarray:
        assert (s * np.diff(u) >= 0).all()  # as a path is walked
        return u + 0.1 * u**3

    known = 2.0 + s * np.linspace(0.0, 3.0, 50)
    computed = reached(curve, curve(known), 2.0, 2.0 + 9 * s, 0.1)
    np.testing.assert_allclose(computed, known, atol=1e-13)
    short = reached(curve, curve(known), 2.0, 2.0 + 2 * s, 0.1)
    np.testing.assert_allclose(short, 2.0 + np.clip(s * (known - 2.0), 0.0, 2.0) * s, atol=1e-13)
