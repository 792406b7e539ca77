"""The compiled stages of operators that remember extrema give NumPy's numbers, branch by branch."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.inference.compiled.stages import drive_of, prepared
from bwbayes.model.operator import Operator, Span
from tests.model.operators.slow import Rows, run, walk
from tests.model.operators.test_memory import CASES, SPANS, Case

PIECE = 64
every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


def compiled(
    operator: Operator, column: Rows, voltage: FloatArray, span: Span | None
) -> FloatArray:
    """Run the compiled stage along a record; as many models as there are lanes."""
    start = span or Span(0.0, 0.0)
    memory = operator.begin(column, float(voltage[0]), start, from_rest=span is None)
    stage = prepared(operator, column, voltage, memory)
    assert stage is not None
    assert stage.able.all()
    own, out, parts = stage.group.T.ravel(), np.empty(PIECE * LANES), []
    for first in range(0, voltage.size, PIECE):
        last = min(first + PIECE, voltage.size)
        drive_of(stage.kind, own, stage.plan, voltage, first, last, out)
        parts.append(out.reshape(PIECE, LANES)[: last - first].T.copy())
    return np.concatenate(parts, axis=1) + stage.rest[:, np.newaxis]


def assert_engines_agree(case: Case, voltage: FloatArray, span: Span | None) -> None:
    column = {name: np.resize(values, LANES) for name, values in case.column.items()}
    expected = run(case.operator, column, voltage, span)
    got = compiled(case.operator, column, voltage, span)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-11)


@every_case
@pytest.mark.parametrize("span", SPANS)
def test_engines_agree_on_random_walks(case: Case, span: Span | None) -> None:
    for seed in range(4):
        assert_engines_agree(case, walk(seed, turns=40), span)
    fine = np.cumsum(np.random.default_rng(5).normal(0, 1, 1000))
    assert_engines_agree(case, fine, span)


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
    assert_engines_agree(case, voltage, Span(10.0 * min(low, high), 10.0 * max(low, high)))
