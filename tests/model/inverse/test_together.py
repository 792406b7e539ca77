"""Many models side by side have the voltages that each has alone, and these make the reference."""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.arrays import BoolArray, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator, State
from bwbayes.model.gain import PolynomialGain
from bwbayes.model.inverse import together as side
from bwbayes.model.inverse.alone import One
from bwbayes.model.inverse.chain import inverse
from bwbayes.model.inverse.limits import Limits
from bwbayes.model.inverse.together import MANY
from bwbayes.model.operator import Operator
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.scalar_memory import StateMemory
from tests.control import cases
from tests.model.inverse.test_chain import CLOSE, SPAN, TABLE_1, smooth


def scattered(actuator: Actuator, models: int = MANY, seed: int = 1) -> FloatArray:
    """Return θ (models, parameters) of Table 1, each parameter some per cent off, n = 1."""
    source = np.random.default_rng(seed)
    theta = np.array([[TABLE_1[name] for name in actuator.parameters]]).repeat(models, axis=0)
    for place, name in enumerate(actuator.parameters):
        if name == "initial":
            theta[:, place] = source.normal(0.0, 3.0, models)
        elif name != "exponent":
            theta[:, place] *= np.exp(0.1 * source.standard_normal(models))
    columns = dict(zip(actuator.parameters, theta.T, strict=True))
    columns["alpha"][:] = np.minimum(columns["alpha"], 0.55 * columns["d"])
    return theta


def side_by_side(
    actuator: Actuator,
    theta: FloatArray,
    asked: FloatArray,
    state: State | None = None,
    *,
    from_rest: bool = False,
) -> FloatArray:
    """Return the inverse, with no model that goes alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delattr(One, "voltage")
        return inverse(actuator, theta, asked, state, from_rest=from_rest)


def followed(
    operator: Operator,
    column: dict[str, FloatArray],
    state: FloatArray,
    drive: FloatArray,
    gain: PolynomialGain | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Return voltages of drives from h (models,) at zero volts on, and which models' are right."""
    actuator = Actuator("none", "first", 1e-3, operator, gain, span=SPAN)
    columns = {**column, "offset": np.zeros_like(state)}
    models = enumerate(columns["d"].tolist())
    ones = [
        One(
            actuator,
            {name: values[row : row + 1] for name, values in columns.items()},
            False,
            None,
            d,
        )
        for row, d in models
    ]
    here = State(StateMemory(0.0, state), (np.zeros_like(state),), (np.empty((state.size, 0)),))
    made = np.empty_like(drive)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(side, "MANY", 1)
        right = side.together(ones, columns, here, drive, made)
    return made, right


def test_models_that_cannot_go_side_by_side_go_alone() -> None:
    """Another exponent, γ > β, and slopes below zero after a turn; the others are not disturbed."""
    actuator = Actuator("lag", "first", 1e-3, span=SPAN)
    theta = scattered(actuator, MANY + 2)
    columns = actuator.columns(theta)
    columns["exponent"][1] = 1.3
    columns["initial"][:] = 0.0
    columns["gamma"][2] = 1.1 * columns["beta"][2]
    steep = {name: values.copy() for name, values in columns.items()}
    steep["alpha"][0] = 0.99 * steep["d"][0]
    steep["gamma"][0] = -0.9 * steep["beta"][0]
    drive = np.tile(smooth(), (len(theta), 1))
    _, right = followed(BoucWen(), steep, steep["initial"], drive)
    assert [False, True, True, True] == right[:4].tolist()
    together = inverse(actuator, theta, smooth())
    for row in range(4):
        alone = inverse(actuator, theta[row], smooth())[0]
        np.testing.assert_allclose(together[row], alone, atol=CLOSE * np.ptp(alone))


def test_limits_hold_for_all_of_them() -> None:
    """What is beyond them is refused, or the nearest command is what each gets alone."""
    actuator = Actuator("lag", "first", 1e-3, span=SPAN)
    theta, limits = scattered(actuator), Limits(-40.0, 40.0)
    with pytest.raises(InputError, match="beyond the amplifier's -40 to 40 V"):
        inverse(actuator, theta, smooth(), limits=limits)
    nearest = inverse(actuator, theta, smooth(), limits=limits, nearest=True)
    assert np.max(np.abs(nearest)) <= 40.0
    alone = inverse(actuator, theta[7], smooth(), limits=limits, nearest=True)[0]
    np.testing.assert_allclose(nearest[7], alone, atol=CLOSE * 80)


@pytest.mark.parametrize("name", [one for one in cases.ACTUATORS if "all" not in one])
@pytest.mark.parametrize("from_rest", [True, False])
def test_whatever_has_a_step_goes_side_by_side_as_alone(name: str, from_rest: bool) -> None:
    """With gain and creep; some of them by themselves, and what they make is the reference."""
    actuator = cases.actuator(name)
    theta = cases.theta(actuator, MANY, name)
    asked = smooth(120)
    together = inverse(actuator, theta, asked, from_rest=from_rest)
    for row in (0, 3, MANY - 1):
        alone = inverse(actuator, theta[row], asked, from_rest=from_rest)[0]
        np.testing.assert_allclose(together[row], alone, rtol=0, atol=CLOSE * np.ptp(alone))
        made = actuator.displacement(theta[row], together[row], from_rest=from_rest)[0]
        np.testing.assert_allclose(made, asked, rtol=0, atol=CLOSE * np.ptp(asked))


def test_models_whose_gain_turns_back_are_told() -> None:
    """One falls before it gets there, one falls and rises again; the others meet their drive."""
    actuator = Actuator("none", gain=PolynomialGain(("quadratic", "cubic"), SPAN), span=SPAN)
    theta = cases.theta(actuator, 4, "gain")
    columns = actuator.columns(theta)
    columns["initial"][:] = 0.0
    rise = columns["d"] * SPAN.half
    columns["quadratic"][1] = -2 * rise[1]
    columns["quadratic"][2], columns["cubic"][2] = -1.5 * rise[2], 0.75 * rise[2]
    drive = np.tile(np.concatenate([np.linspace(0, 60, 31), np.linspace(58, -30, 45)]), (4, 1))
    made, right = followed(actuator.hysteresis, columns, np.zeros(4), drive, actuator.gain)
    assert [True, False, False, True] == right.tolist()
    columns["offset"][:] = 0.0
    rows = np.flatnonzero(right)
    again = np.column_stack([columns[name] for name in actuator.parameters])
    for row in rows:
        reached = actuator.displacement(again[row], made[row], from_rest=True)[0]
        np.testing.assert_allclose(reached, drive[row], rtol=0, atol=CLOSE * 90)
