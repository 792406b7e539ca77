"""The compiled walk along a voltage gives the actuator's displacement, in pieces of any size."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.inference.compiled.lanes import LANES
from bwbayes.inference.compiled.walk import walk
from bwbayes.model.actuator import Actuator
from bwbayes.model.linear import Hold
from bwbayes.model.operators.pinned import DomainWall, JilesAtherton, Pinned
from tests.inference.test_gain_and_creep import PARTS, WAYS
from tests.inference.test_likelihood import moving
from tests.model.operators.slow import SPAN, drawn, paths
from tests.model.operators.test_memory import CASES

# Not of one length, and one of them a sample.
CUTS = (0, 1, 65, 130, 137, 200)


def assert_walks_as(actuator: Actuator, theta: FloatArray, voltage: FloatArray, seed: int) -> None:
    """Compare with NumPy's displacement, of a start in motion."""
    sections = actuator.sections(actuator.columns(theta))
    unrest = np.random.default_rng(seed).normal(0, 5, (len(theta), sections.unknowns))
    expected = actuator.advance(theta, voltage, unrest=unrest)[0]
    begun = walk(actuator, theta, voltage, unrest)
    assert begun is not None
    edges = [cut for cut in CUTS if cut < voltage.size] + [voltage.size]
    got = np.hstack([begun.to(last) for _, last in pairwise(edges)])
    size = np.abs(expected).max(axis=1, keepdims=True)
    assert (np.abs(got - expected) <= 1e-11 * size).all()


@pytest.mark.parametrize(("dynamics", "hold"), WAYS)
@pytest.mark.parametrize("parts", ["none", *PARTS])
@pytest.mark.parametrize("count", [1, LANES + 3])
def test_bouc_wen_walks_as_with_numpy(dynamics: str, hold: Hold, parts: str, count: int) -> None:
    fixed = {"mass": 300.0, "damping": 3000.0, "stiffness": 4.1e5}
    posterior = moving("white", dynamics, fixed, hold=hold, parts=PARTS.get(parts, {}))
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(5), count))
    only = posterior.only
    assert_walks_as(only.actuator, only.table.actuator(theta), only.voltage, count)
    compiled = replace(posterior, engine="numba").simulate(theta)
    np.testing.assert_allclose(compiled, posterior.simulate(theta), rtol=0, atol=1e-9)


def as_theta(actuator: Actuator, column: dict[str, FloatArray]) -> FloatArray:
    """Return θ (models, parameters) of an operator's columns, with a lag and an offset."""
    known = {"lag": np.array(0.01), "offset": np.array(3.0)}
    known |= {"quadratic": np.array(0.4), "cubic": np.array(-0.3)} | column
    known |= {f"creep_{k}": np.array(0.01 * k) for k in (1, 2, 3)}
    known |= {"creep_growth": np.array(0.5)}
    return np.stack([np.resize(known[name], LANES) for name in actuator.parameters], axis=1)


@pytest.mark.parametrize("operator", [JilesAtherton(), DomainWall()])
@pytest.mark.parametrize("path", paths())
@pytest.mark.parametrize("parts", ["none", "both"])
def test_pinned_walls_walk_as_with_numpy(operator: Pinned, path: str, parts: str) -> None:
    """NumPy takes the same pieces: an integrator's steps end where a piece does."""
    actuator = Actuator("lag", "first", 1e-3, operator, **PARTS.get(parts, {}), span=SPAN)
    theta, voltage = as_theta(actuator, drawn(operator, LANES, 3)), paths()[path]
    begun, state = walk(actuator, theta, voltage), None
    assert begun is not None
    for first, last in pairwise([*(cut for cut in CUTS if cut < voltage.size), voltage.size]):
        expected, state = actuator.advance(theta, voltage[first:last], state)
        size = np.abs(expected).max(axis=1, keepdims=True)
        assert (np.abs(begun.to(last) - expected) <= 1e-9 * size).all()


@pytest.mark.parametrize("name", CASES)
def test_operators_that_remember_extrema_walk_as_with_numpy(name: str) -> None:
    actuator = Actuator("lag", "first", 1e-3, CASES[name].operator, span=SPAN)
    for voltage in paths().values():
        assert_walks_as(actuator, as_theta(actuator, dict(CASES[name].column)), voltage, 1)
