"""The compiled stages of operators that remember extrema give NumPy's numbers, branch by branch."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.model.operator import Span
from tests.inference.test_stages import compiled
from tests.model.operators.slow import run
from tests.model.operators.test_memory import CASES, Case

PIECE = 64
every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


# Whole tens meet extrema, ends of the span and zero exactly.
whole = st.integers(-17, 17).map(lambda k: 10.0 * k)
tens = st.lists(whole, max_size=150).map(lambda volts: np.array([*volts, 100.0]))


@every_case
@settings(max_examples=25, deadline=None)
@given(
    voltage=tens.map(lambda volts: np.array([*volts, 100.0])),
    low=st.integers(-16, 16),
    high=st.integers(-16, 16),
)
def test_engines_agree_where_voltages_meet_exactly(
    case: Case, voltage: FloatArray, low: int, high: int
) -> None:
    span = Span(10.0 * min(low, high), 10.0 * max(low, high))
    column = {name: np.resize(values, LANES) for name, values in case.column.items()}
    expected = run(case.operator, column, voltage, span)
    got = compiled(case.operator, column, voltage, PIECE, span)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-11)
