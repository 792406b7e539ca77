"""What all operators given by a differential equation promise, and what none of them does."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.model.operator import Span
from bwbayes.model.operators.backlash_like import BacklashLike
from bwbayes.model.operators.bouc_wen_asymmetric import BoucWenAsymmetric
from bwbayes.model.operators.duhem import Duhem
from bwbayes.model.operators.pinned import DomainWall, JilesAtherton, Pinned
from bwbayes.model.operators.scalar_memory import OneState
from tests.model.operators.differential import SPAN, prior_draws, w_of

OPERATORS: dict[str, OneState] = {
    "backlash-like": BacklashLike(),
    "duhem": Duhem(),
    "duhem with even terms": Duhem(odd=False),
    "bouc-wen-asymmetric": BoucWenAsymmetric(),
    "bouc-wen-asymmetric by the voltage": BoucWenAsymmetric(("b2", "b3")),
    "jiles-atherton": JilesAtherton(),
    "domain-wall": DomainWall(),
}
ODD = (
    "backlash-like",
    "duhem",
    "bouc-wen-asymmetric by the voltage",
    "jiles-atherton",
    "domain-wall",
)
every = pytest.mark.parametrize("name", OPERATORS)
few = settings(deadline=None, max_examples=10)
corners = st.lists(st.integers(-1000, 1000).map(lambda u: u / 10), min_size=2, max_size=5)


def models(operator: OneState, size: int, seed: int) -> dict[str, FloatArray]:
    """Draw models that hold from the default priors; fewer where there is an integrator to run."""
    size = min(size, 2 if size < 20 else 50) if isinstance(operator, Pinned) else size
    column = prior_draws(operator, 2 * size + 20, seed)
    holds = np.broadcast_to(operator.holds(column), column["d"].shape)
    return rows(column, np.flatnonzero(holds)[:size])


def rows(column: Mapping[str, FloatArray], which: object) -> dict[str, FloatArray]:
    return {name: np.atleast_1d(values[which]) for name, values in column.items()}  # type: ignore[call-overload]


def tolerance(operator: OneState) -> float:
    """Largest error that is promised, in units of the range of w."""
    return 1e-6 if isinstance(operator, Pinned) else 1e-12


def assert_near(operator: OneState, expected: FloatArray, got: FloatArray) -> None:
    size = np.ptp(expected, axis=1, keepdims=True) + np.abs(expected[:, :1])
    assert (np.abs(got - expected) <= tolerance(operator) * size).all()


@pytest.mark.parametrize("name", ODD)
@few
@given(path=corners, seed=st.integers(0, 9))
def test_the_mirrored_drive_and_start_give_the_mirrored_displacement(
    name: str, path: list[float], seed: int
) -> None:
    operator, voltage = OPERATORS[name], np.array(path)
    column = models(operator, 3, seed)
    mirrored = {**column, "initial": -column["initial"]}
    expected = -w_of(operator, column, voltage)
    np.testing.assert_array_equal(w_of(operator, mirrored, -voltage), expected)


@every
def test_a_minor_loop_is_not_forgotten_and_not_congruent(name: str) -> None:
    """What a Preisach model would do, none of these does: neither wiping out nor congruency."""
    operator = OPERATORS[name]
    column = models(operator, 100, 5)
    column["initial"] = np.zeros_like(column["initial"])
    straight = w_of(operator, column, np.array([0.0, 40.0, 60.0]))
    detour = w_of(operator, column, np.array([0.0, 40.0, 0.0, 40.0, 60.0]))
    missed = np.abs(detour[:, -1] - straight[:, -1]) / np.ptp(straight, axis=1)
    assert np.median(missed) > 1e-4
    after_less = w_of(operator, column, np.array([0.0, 40.0, 0.0, 40.0]))
    after_more = w_of(operator, column, np.array([0.0, 60.0, 0.0, 40.0, 0.0, 40.0]))
    heights = [np.diff(w[:, -2:], axis=1)[:, 0] for w in (after_less, after_more)]
    assert np.median(np.abs(heights[0] - heights[1]) / np.abs(heights[0])) > 1e-4


@every
def test_sweeps_reach_what_they_say_and_the_memory_stays_as_it_is(name: str) -> None:
    operator = OPERATORS[name]
    column = models(operator, 200, 7)
    low, high = operator.reachable(column, 20.0, Span(-30.0, 70.0))
    assert (low < high).all()
    memory = operator.begin(column, 0.0, SPAN, from_rest=False)
    before = memory.state.copy()
    column["initial"] = np.zeros_like(column["initial"])
    operator.advance(column, np.array([10.0, -5.0]), memory)
    np.testing.assert_array_equal(memory.state, before)
    start = operator.begin(column, 0.0, SPAN, from_rest=True)
    _, end = operator.advance(column, np.array([70.0, -30.0, 70.0, -30.0, 20.0]), start)
    # The state need not be what the parameter is, and may grow as that falls.
    ends = [
        operator.begin({**column, "initial": one}, 20.0, SPAN, from_rest=False).state
        for one in (low, high)
    ]
    slack = 1e-6 * np.max(np.abs(ends), axis=0)
    assert (end.state >= np.min(ends, axis=0) - slack).all()
    assert (end.state <= np.max(ends, axis=0) + slack).all()
