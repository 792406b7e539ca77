"""The polynomial gain: displacements at the edge of the voltage's range."""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.errors import InputError
from bwbayes.model.declaration import Context, Ranges
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.operator import Span

SPAN = Span(-20.0, 100.0)
RANGES = Ranges(voltage=60.0, displacement=20.0, middle=0.0, time=1.0, bias=40.0)


def test_coefficients_are_displacements_at_the_edge_of_the_range() -> None:
    column = {"quadratic": np.array([1.0, -2.0]), "cubic": np.array([0.5, 0.0])}
    w = PolynomialGain().displacement(column, np.array([-20.0, 40.0, 70.0, 100.0]), SPAN)
    np.testing.assert_allclose(w, [[0.5, 0.0, 0.3125, 1.5], [-2.0, 0.0, -0.5, -2.0]], rtol=1e-15)


@pytest.mark.parametrize("term", ["quadratic", "cubic"])
def test_a_single_term_needs_no_other_column(term: str) -> None:
    gain, column = PolynomialGain((term,)), {term: np.array([3.0])}
    gain.check(column)
    assert [declared.name for declared in gain.parameters] == [term]
    np.testing.assert_allclose(gain.displacement(column, np.array([100.0]), SPAN), [[3.0]])


def test_the_default_priors_are_parts_of_the_displacement_range() -> None:
    priors = [str(declared.default(Context(RANGES))) for declared in PolynomialGain().parameters]
    assert priors == ["normal(mean = 0, sd = 3)", "normal(mean = 0, sd = 2)"]


def test_a_span_without_width_gives_nothing() -> None:
    column = {"quadratic": np.array([1.0]), "cubic": np.array([1.0])}
    w = PolynomialGain().displacement(column, np.full(3, 5.0), Span(5.0, 5.0))
    np.testing.assert_array_equal(w, np.zeros((1, 3)))


def test_says_what_is_wrong_by_name() -> None:
    with pytest.raises(InputError, match="gain: 'cubik' is unknown; did you mean cubic"):
        PolynomialGain(("cubik",))
    with pytest.raises(InputError, match="cubic: nan in model 1; must be finite"):
        PolynomialGain(("cubic",)).check({"cubic": np.array([0.0, np.nan])})
