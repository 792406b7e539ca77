"""The compiled stages of operators that remember extrema give NumPy's numbers, branch by branch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.inference.compiled.stages import STAGES, drive_of
from bwbayes.model.actuator import Actuator
from bwbayes.model.operator import Operator, Span
from tests.inference.problems import INTERVAL, decaying_sine, posterior_of
from tests.model.operators.slow import Rows, rows, run, walk
from tests.model.operators.test_memory import CASES, SPANS, Case

PIECE = 64
COMPILED = [name for name in CASES if type(CASES[name].operator) in STAGES]
every_case = pytest.mark.parametrize("case", [CASES[n] for n in COMPILED], ids=COMPILED)


def compiled(
    operator: Operator, column: Rows, voltage: FloatArray, span: Span | None
) -> FloatArray:
    """Run the compiled stage along a record; as many models as there are lanes."""
    start = span or Span(0.0, 0.0)
    memory = operator.begin(column, float(voltage[0]), start, from_rest=span is None)
    stage = STAGES[type(operator)](operator, column, voltage, memory)
    assert stage.able.all()
    own, out, parts = stage.own.T.ravel(), np.empty(PIECE * LANES), []
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


@every_case
@pytest.mark.parametrize("from_rest", [True, False])
def test_log_densities_agree_on_prior_draws(case: Case, from_rest: bool) -> None:
    voltage = decaying_sine(500)[0 if from_rest else 37 :]
    one = {name: values[:1] for name, values in case.column.items()}
    displacement = run(case.operator, one, voltage, Span(-100.0, 100.0))[0]
    displacement += np.random.default_rng(1).normal(0, 0.3, voltage.size)
    actuator = Actuator("lag", "first", INTERVAL, case.operator)
    fixed = {"initial": 0.0} if from_rest else {}
    posterior = posterior_of(
        voltage, displacement, actuator, "discrepancy", fixed, from_rest=from_rest
    )
    prior = posterior.prior
    theta = prior.theta(prior.draw(np.random.default_rng(2), 300))
    expected = replace(posterior, engine="numpy").log_likelihood(theta)
    got = replace(posterior, engine="numba").log_likelihood(theta)
    assert np.isfinite(expected).all()
    np.testing.assert_array_less(np.abs(got - expected), 1e-10 * (voltage.size + np.abs(expected)))


def test_what_a_stage_cannot_do_is_left_to_numpy() -> None:
    voltage = np.array([0.0, 50.0, -20.0, 80.0])
    column = rows(d=0.7, rayleigh=0.004, saturation=[80.0, 1e-2, 1e6], initial=0.0)
    operator = CASES["preisach"].operator
    memory = operator.begin(column, 0.0, Span(-50, 80), from_rest=False)
    stage = STAGES[type(operator)](operator, column, voltage, memory)
    assert stage.able.tolist() == [True, False, False]
    plays = CASES["plays evenly"]
    column = plays.column | {"threshold": np.linspace(50.0, 60.0, 6)}
    memory = plays.operator.begin(column, 0.0, Span(-50, 80), from_rest=False)
    stage = STAGES[type(plays.operator)](plays.operator, column, voltage, memory)
    assert not stage.able.any()
