"""The compiled stages of operators against the operators themselves, on any path of the voltage."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.inference.compiled.stages import drive_of, prepared
from bwbayes.model.operator import Operator, Span
from bwbayes.model.operators.backlash_like import BacklashLike
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.bouc_wen_asymmetric import BoucWenAsymmetric
from bwbayes.model.operators.duhem import Duhem
from bwbayes.model.operators.no_hysteresis import NoHysteresis
from tests.model.operators.slow import SPAN, drawn, run
from tests.model.operators.test_memory import CASES, Case

OPERATORS: dict[str, Operator] = {
    "bouc-wen": BoucWen(),
    "bouc-wen not passive": BoucWen(passive=False),
    "linear": NoHysteresis(),
    "backlash-like": BacklashLike(),
    "bouc-wen-asymmetric": BoucWenAsymmetric(),
    "duhem": Duhem(),
    "duhem with even terms": Duhem(odd=False),
}


def models(operator: Operator, seed: int) -> dict[str, FloatArray]:
    """Draw as many models as there are lanes from the default priors."""
    return drawn(operator, LANES, seed)


def compiled(
    operator: Operator,
    column: dict[str, FloatArray],
    voltage: FloatArray,
    piece: int,
    span: Span = SPAN,
) -> FloatArray:
    """Return w (models, samples) of the stage, run in pieces of so many samples."""
    memory = operator.begin(column, float(voltage[0]), span, from_rest=False)
    stage = prepared(operator, column, voltage, memory)
    assert stage is not None
    own = np.ascontiguousarray(stage.group.T).ravel()
    out, parts = np.empty(piece * LANES), []
    for first in range(0, voltage.size, piece):
        last = min(first + piece, voltage.size)
        drive_of(stage.kind, own, stage.plan, voltage, first, last, out)
        parts.append(out[: (last - first) * LANES].reshape(-1, LANES).T.copy())
    return np.hstack(parts) + stage.rest[:, np.newaxis]


def assert_alike(name: str, voltage: FloatArray, seed: int, piece: int) -> None:
    operator = OPERATORS[name]
    column = models(operator, seed)
    memory = operator.begin(column, float(voltage[0]), SPAN, from_rest=False)
    expected = operator.advance(column, voltage, memory)[0]
    got = compiled(operator, column, voltage, piece)
    size = np.abs(expected).max(axis=1, keepdims=True) + np.abs(column["initial"][:, np.newaxis])
    assert (np.abs(got - expected) <= 2e-12 * size).all()


@pytest.mark.parametrize("name", OPERATORS)
@given(
    corners=st.lists(st.integers(-1000, 1000).map(lambda u: u / 10), min_size=2, max_size=9),
    seed=st.integers(0, 9),
    piece=st.integers(1, 5),
    samples=st.integers(1, 4),
)
@settings(deadline=None, max_examples=20)
def test_stages_agree_on_any_path(
    name: str, corners: list[float], seed: int, piece: int, samples: int
) -> None:
    place = np.linspace(0, len(corners) - 1, (len(corners) - 1) * samples + 1)
    assert_alike(name, np.interp(place, np.arange(len(corners)), corners), seed, piece)


# Whole tens meet extrema, ends of the span and zero exactly.
whole = st.integers(-17, 17).map(lambda k: 10.0 * k)
tens = st.lists(whole, max_size=150).map(lambda volts: np.array([*volts, 100.0]))


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
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
    got = compiled(case.operator, column, voltage, 64, span)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-11)
