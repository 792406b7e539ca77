"""The polynomial gain: displacements at the edge of the voltage's range."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Context, Ranges, check
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.operator import Span

SPAN = Span(-20.0, 100.0)
RANGES = Ranges(voltage=60.0, displacement=20.0, middle=0.0, time=1.0, bias=40.0)


def test_coefficients_are_displacements_at_the_edge_of_the_range() -> None:
    column = {"quadratic": np.array([1.0, -2.0]), "cubic": np.array([0.5, 0.0])}
    w = PolynomialGain(reference=SPAN).displacement(column, np.array([-20.0, 40.0, 70.0, 100.0]))
    np.testing.assert_allclose(w, [[0.5, 0.0, 0.3125, 1.5], [-2.0, 0.0, -0.5, -2.0]], rtol=1e-15)


@pytest.mark.parametrize("term", ["quadratic", "cubic"])
def test_a_single_term_needs_no_other_column(term: str) -> None:
    gain, column = PolynomialGain((term,), SPAN), {term: np.array([3.0])}
    check(gain.parameters, column)
    assert [declared.name for declared in gain.parameters] == [term]
    np.testing.assert_allclose(gain.displacement(column, np.array([100.0])), [[3.0]])


def test_the_default_priors_are_parts_of_the_displacement_range() -> None:
    priors = [str(declared.default(Context(RANGES))) for declared in PolynomialGain().parameters]
    assert priors == ["normal(mean = 0, sd = 3)", "normal(mean = 0, sd = 2)"]


def test_a_span_without_width_gives_nothing() -> None:
    column = {"quadratic": np.array([1.0]), "cubic": np.array([1.0])}
    w = PolynomialGain(reference=Span(5.0, 5.0)).displacement(column, np.full(3, 5.0))
    np.testing.assert_array_equal(w, np.zeros((1, 3)))


def test_says_what_is_wrong_by_name() -> None:
    with pytest.raises(InputError, match="gain: 'cubik' is unknown; did you mean cubic"):
        PolynomialGain(("cubik",))
    with pytest.raises(InputError, match="cubic: nan in model 1; must be finite"):
        check(PolynomialGain(("cubic",)).parameters, {"cubic": np.array([0.0, np.nan])})


def displaced(term: str, voltage: list[float]) -> FloatArray:
    """Return the displacement of Bouc-Wen hysteresis and one term of a gain, um."""
    span = Span(-100.0, 100.0)
    actuator = Actuator("none", "first", 1.0, gain=PolynomialGain((term,), span), span=span)
    values = {"d": 0.7, "alpha": 0.3, "beta": 0.03, "gamma": 0.01, "exponent": 1.0, term: 5.0}
    model = [[values.get(name, 0.0) for name in actuator.parameters]]
    moved: FloatArray = actuator.displacement(model, np.array(voltage))[0]
    return moved


@given(st.lists(st.integers(-100, 100).map(float), min_size=2, max_size=20))
def test_a_cubic_gain_keeps_the_odd_symmetry(voltage: list[float]) -> None:
    mirrored = displaced("cubic", [-u for u in voltage])
    np.testing.assert_allclose(mirrored, -displaced("cubic", voltage), rtol=0, atol=1e-12)


def test_a_quadratic_gain_breaks_it() -> None:
    up, down = displaced("quadratic", [0.0, 100.0]), displaced("quadratic", [0.0, -100.0])
    np.testing.assert_allclose(up + down, [0.0, 10.0], rtol=0, atol=1e-12)
