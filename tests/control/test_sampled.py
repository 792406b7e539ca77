"""A model a sample at a time: the simulation's displacement, and a voltage that leads back."""

import numpy as np
import pytest

from bwbayes.control.sampled import SampledModel, require_inverse
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.registry import HYSTERESIS, build_part
from tests.control import cases

every_actuator = pytest.mark.parametrize("name", cases.ACTUATORS)


@every_actuator
def test_slopes_lie_within_their_bounds(name: str) -> None:
    actuator = cases.actuator(name)
    theta = cases.theta(actuator, 3, name)
    model = SampledModel.of(actuator, theta)
    least, largest = model.slopes(cases.SPAN)
    voltage = cases.drive()
    path = np.concatenate(
        [voltage, np.linspace(voltage[-1], 100, 300), np.linspace(100, -100, 300)]
    )
    column = actuator.columns(theta)
    memory = actuator.begin(column, path, from_rest=True)
    w = actuator.hysteresis.advance(column, path, memory)[0]
    if actuator.nonlinearity is not None:
        w = w + actuator.nonlinearity.displacement(column, path)
    moves = np.diff(path) != 0
    slopes = np.diff(w)[:, moves] / np.diff(path)[moves]
    assert (slopes >= least[:, np.newaxis] - 1e-9).all()
    assert (slopes <= largest[:, np.newaxis] + 1e-9).all()
    # Not far from them, or they would say nothing.
    assert (slopes.min(axis=1) - least < 0.12 * largest).all()
    assert (largest - slopes.max(axis=1) < 0.12 * largest).all()


@pytest.mark.parametrize("name", ["prandtl-ishlinskii", "preisach", "jiles-atherton"])
def test_operators_without_a_step_are_refused(name: str) -> None:
    operator = build_part("hysteresis", name, HYSTERESIS, {})
    column = {one.name: np.ones(1) for one in operator.parameters}
    with pytest.raises(InputError, match=r"no step of bounded time .* such as bouc-wen"):
        operator.step(column)


def test_dynamics_whose_inverse_runs_away_have_none() -> None:
    """A resonance that is sampled fast, with a drive that goes straight between samples."""
    actuator = Actuator("second-order", "first", 1e-3)
    theta = cases.theta(actuator)
    for one, value in {"mass": 1.0, "damping": 100.0}.items():
        theta[0, actuator.parameters.index(one)] = value
    model = SampledModel.of(actuator, theta)
    with pytest.raises(InputError, match="swing on and on"):
        require_inverse(model, cases.SPAN)
