"""The compiled inverse of many models against the one that goes alone, along any path."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.inverse import together as side
from bwbayes.model.inverse.chain import inverse
from bwbayes.model.linear import Hold
from tests.control import cases
from tests.model.inverse.test_chain import CLOSE, SPAN, smooth
from tests.model.inverse.test_together import side_by_side

# One of each kind, by the name of its case.
KINDS = (
    "bouc-wen",
    "bouc-wen not passive",
    "backlash-like, lag, creep",
    "plays, lag, gain",
    "bouc-wen, n = 1.7, lag",
    "bouc-wen, n = 1.05 and gamma < 0",
    "bouc-wen-asymmetric, lag",
    "duhem, lag",
    "linear, second-order, creep",
    "maxwell-slip with all",
)

# Goals, um, and samples to get there: jumps across the range, ramps, steps of next to nothing and
# rests.
paths = st.lists(
    st.tuples(
        st.one_of(
            st.floats(-35.0, 35.0),
            st.sampled_from([0.0, 1e-6, -1e-9, 20.0, 20.0 + 1e-7, 35.0]),
        ),
        st.sampled_from([1, 1, 2, 5, 12]),
    ),
    min_size=1,
    max_size=7,
)


def path_of(turns: list[tuple[float, int]]) -> FloatArray:
    """Return the displacements (samples,) that go to each goal in its samples, from zero on."""
    ends = [0.0, *(goal for goal, _ in turns)]
    parts = [
        np.linspace(a, b, samples + 1)[1:]
        for a, b, (_, samples) in zip(ends[:-1], ends[1:], turns, strict=True)
    ]
    return np.concatenate([[0.0], *parts])


def plain(name: str, gain: PolynomialGain | None) -> tuple[Actuator, FloatArray]:
    """Return an actuator without dynamics and creep, and three models that rise everywhere."""
    actuator = replace(cases.actuator(name), dynamics="none", gain=gain, creep=None)
    theta = cases.theta(actuator, 3, name)
    return actuator, theta


@pytest.mark.parametrize("gain", [None, cases.GAIN], ids=["no gain", "gain"])
@pytest.mark.parametrize("name", KINDS)
@settings(max_examples=8, deadline=None)
@given(turns=paths, from_rest=st.booleans())
@example(turns=[(1e-9, 12)], from_rest=False)  # no more than the rounding of where it starts
def test_along_any_path_as_alone(
    name: str, gain: PolynomialGain | None, turns: list[tuple[float, int]], from_rest: bool
) -> None:
    """From jumps over all of the range to steps of 1e-9 um, and what is made is the reference."""
    actuator, theta = plain(name, gain)
    asked = path_of(turns)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(side, "MANY", 1)
        made = side_by_side(actuator, theta, asked, from_rest=from_rest)
        patch.setattr(side, "MANY", 99)
        alone = inverse(actuator, theta, asked, from_rest=from_rest)
    np.testing.assert_allclose(made, alone, rtol=0, atol=CLOSE * 100)
    for model, voltage in zip(theta, made, strict=True):
        given_back = actuator.displacement(model, voltage, from_rest=from_rest)[0]
        np.testing.assert_allclose(given_back, asked, rtol=0, atol=CLOSE * 70)


@pytest.mark.parametrize("hold", ["first", "zero"])
@pytest.mark.parametrize("name", cases.ACTUATORS)
def test_every_actuator_goes_on_from_where_it_stands(name: str, hold: Hold) -> None:
    """Dynamics, creep and hysteresis in motion: the next piece makes what is asked of each."""
    actuator = cases.actuator(name, hold)
    theta = cases.theta(actuator, side.MANY, name)
    turns = (0, 60, -30, 10)
    before = np.concatenate([np.linspace(a, b, 20) for a, b in pairwise(turns)])
    y, state = actuator.advance(theta, before, from_rest=True)
    # The displacement goes on as it moves, and slows down.
    speed = (y[:, -1:] - y[:, -2:-1]) * 10 * (1 - np.exp(-np.arange(1, 101) / 10))
    asked = y[:, -1:] + speed + smooth(100, 10.0)
    made = side_by_side(actuator, theta, asked, state)
    # A held voltage acts one sample later, so that the first sample is out of reach.
    late = int(hold == "zero")
    for row in (0, 7, side.MANY - 1):
        _, its = actuator.advance(theta[row], before, from_rest=True)
        again = actuator.advance(theta[row], made[row], its)[0][0]
        bound = CLOSE * np.ptp(asked)
        np.testing.assert_allclose(again[late:], asked[row, late:], rtol=0, atol=bound)


def test_a_spring_that_is_sampled_fast_is_not_undone_sample_by_sample() -> None:
    """Its inverse would run away: without creep it looks ahead, with creep it is refused."""
    actuator = Actuator("second-order", "first", 1e-3, span=SPAN)
    theta = cases.theta(actuator, side.MANY)
    columns = actuator.columns(theta)
    columns["mass"][:], columns["damping"][:] = 100.0, 300.0
    asked = smooth(1000)
    made = inverse(actuator, theta, asked)
    again = actuator.displacement(theta[3], made[3])[0]
    np.testing.assert_allclose(again, asked, rtol=0, atol=CLOSE * np.ptp(asked))
    with_creep = replace(actuator, creep=cases.CREEP)
    rows = cases.theta(with_creep, side.MANY)
    both = with_creep.columns(rows)
    assert np.max(np.abs(with_creep.sections(both).zeros)) < 1
    both["mass"][:], both["damping"][:] = 100.0, 300.0
    assert np.max(np.abs(with_creep.sections(both).zeros), axis=1).min() > 1
    with pytest.raises(InputError, match=r"creep of 0\.031 of the drive cannot be undone"):
        inverse(with_creep, rows, asked)


def test_without_numba_each_goes_alone() -> None:
    actuator, theta = plain("bouc-wen", None)
    asked = smooth(60)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(side, "MANY", 1)
        made = inverse(actuator, theta, asked)
        patch.setattr(side, "find_spec", lambda _: None)
        alone = inverse(actuator, theta, asked)
    np.testing.assert_allclose(made, alone, rtol=0, atol=CLOSE * np.ptp(alone))
    assert not np.array_equal(made, alone)


def test_numba_is_loaded_for_many_models_alone() -> None:
    code = (
        "import sys, numpy as np, bwbayes\n"
        "from bwbayes.model.inverse.chain import inverse\n"
        "from tests.control import cases\n"
        "actuator = cases.actuator('bouc-wen')\n"
        "for models in (2, 50):\n"
        "    inverse(actuator, cases.theta(actuator, models), np.linspace(0, 9, 5))\n"
        "    print('numba' in sys.modules)\n"
    )
    run = [sys.executable, "-c", code]
    printed = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    assert ["False", "True"] == printed.split()
