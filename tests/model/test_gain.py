"""The polynomial gain: displacements at the edge of the voltage's range."""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.errors import InputError
from bwbayes.model.declaration import check
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.operator import Span

SPAN = Span(-20.0, 100.0)


def test_coefficients_are_displacements_at_the_edge_of_the_range() -> None:
    column = {"quadratic": np.array([1.0, -2.0]), "cubic": np.array([0.5, 0.0])}
    w = PolynomialGain(reference=SPAN).displacement(column, np.array([-20.0, 40.0, 70.0, 100.0]))
    np.testing.assert_allclose(w, [[0.5, 0.0, 0.3125, 1.5], [-2.0, 0.0, -0.5, -2.0]], rtol=1e-15)


def test_a_span_without_width_gives_nothing() -> None:
    column = {"quadratic": np.array([1.0]), "cubic": np.array([1.0])}
    w = PolynomialGain(reference=Span(5.0, 5.0)).displacement(column, np.full(3, 5.0))
    np.testing.assert_array_equal(w, np.zeros((1, 3)))


def test_says_what_is_wrong_by_name() -> None:
    with pytest.raises(InputError, match="gain: 'cubik' is unknown; did you mean cubic"):
        PolynomialGain(("cubik",))
    with pytest.raises(InputError, match="cubic: nan in model 1; must be finite"):
        check(PolynomialGain(("cubic",)).parameters, {"cubic": np.array([0.0, np.nan])})
