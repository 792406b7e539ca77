"""The voltage for a displacement, whatever the actuator is made of, gives that displacement."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Hold, Limits, Span
from bwbayes.model.inverse import inverse
from bwbayes.model.linear import Creep
from bwbayes.model.nonlinearity import PolynomialNonlinearity
from bwbayes.model.registry import HYSTERESIS, build_part
from bwbayes.record.teststand import TABLE_1
from tests.control import cases
from tests.inference.problems import decaying_sine
from tests.model.operators.test_every_operator import drawn_from, every_operator, posterior

SPAN = Span(-100.0, 100.0)

# Largest error of the simulated inverse, as a part of the range.
CLOSE = 1e-9

VALUES = {
    **TABLE_1,
    "lag": 3.85e-3,
    "quadratic": 3.0,
    "cubic": -1.5,
    "creep_1": 0.02,
    "creep_2": 0.03,
    "creep_growth": 0.5,
    "offset": 1.3,
}


def theta_of(actuator: Actuator, **others: float) -> FloatArray:
    known = {**VALUES, **others}
    return np.array([[known[name] for name in actuator.parameters]])


def smooth(samples: int = 400, size: float = 30.0) -> FloatArray:
    """Displacements that begin at rest and go to and fro with falling amplitudes, um."""
    t = np.linspace(0.0, 1.0, samples - 30)
    rise = np.sin(np.pi * np.minimum(t / 0.2, 1.0) / 2) ** 2
    moved = size * rise * (1 - 0.8 * t) * np.sin(2 * np.pi * 3 * t)
    return np.concatenate([np.zeros(30), moved])


def assert_returned(
    actuator: Actuator,
    theta: FloatArray,
    reference: FloatArray,
    *,
    from_rest: bool = False,
    first: int = 0,
) -> FloatArray:
    """Every model's voltage makes the reference again, each simulated alone."""
    voltage = inverse(actuator, theta, reference, from_rest=from_rest)
    for row, model in enumerate(theta):
        asked = np.atleast_2d(reference)[min(row, np.atleast_2d(reference).shape[0] - 1)]
        back = actuator.displacement(model, voltage[row], from_rest=from_rest)[0]
        assert np.max(np.abs(back - asked)[first:]) < CLOSE * np.ptp(asked)
    return voltage


def calm(actuator: Actuator, theta: FloatArray) -> None:
    """Make draws' displacement grow with the voltage, wherever it turned before."""
    column = {name: theta[:, i] for i, name in enumerate(actuator.parameters)}
    for name in ("quadratic", "cubic"):
        if name in column:
            column[name] *= 0.2
    if not {"d", "alpha", "beta"} <= column.keys():
        return
    column["alpha"][:] = np.minimum(column["alpha"], 0.4 * column["d"])
    if "gamma" in column:
        # Close to −β the ceiling is far away, and a turn there goes the wrong way.
        half = 0.5 * column["beta"]
        column["gamma"][:] = np.clip(column["gamma"], -half, half)
        for name in ("b2", "b3", "b4", "b5", "b6"):
            if name in column:
                column[name][:] = np.clip(column[name], -0.1, 0.1)
    if "d3" in column:
        column["d3"][:] = np.abs(column["d3"])
        most = np.minimum(column["d3"], 3 * column["alpha"] * column["beta"] ** 2)
        column["alpha2"][:] = np.minimum(column["alpha2"], most)


@every_operator
@pytest.mark.parametrize(("from_rest", "parts"), [(True, False), (False, True)])
def test_the_inverse_of_every_operator_gives_the_displacement_again(
    name: str, from_rest: bool, parts: bool
) -> None:
    """Draws of the default priors that rise with the voltage; with gain and creep too."""
    integrated = name in ("jiles-atherton", "domain-wall")
    of = posterior(name, parts=parts)
    actuator = of.likelihood.actuator
    theta = of.single_record.table.actuator(drawn_from(of, 1 if integrated or parts else 4))
    if parts:
        creep = Creep((0.1, 1.0), growing=not integrated, reference=SPAN)
        actuator = replace(
            actuator, nonlinearity=PolynomialNonlinearity(reference=SPAN), creep=creep
        )
        names = of.likelihood.actuator.parameters
        theta = theta[:, [i for i, n in enumerate(names) if n in actuator.parameters]]
    calm(actuator, theta)
    voltage = decaying_sine(30 if integrated else 120 if parts else 300)
    reference = actuator.displacement(theta, voltage, from_rest=from_rest)
    assert_returned(actuator, theta, reference, from_rest=from_rest)


# Goals, um, and samples to get there: jumps across the range, ramps, steps of next to nothing and
# rests.
paths = st.lists(
    st.tuples(
        st.one_of(
            st.floats(-35.0, 35.0), st.sampled_from([0.0, 1e-6, -1e-9, 20.0, 20.0 + 1e-7, 35.0])
        ),
        st.sampled_from([1, 1, 2, 5, 12]),
    ),
    min_size=1,
    max_size=7,
)


@pytest.mark.parametrize("name", cases.ACTUATORS)
@settings(max_examples=5)
@given(turns=paths, from_rest=st.booleans())
@example(turns=[(1e-9, 12)], from_rest=False)  # no more than the rounding of where it starts
def test_along_any_path(name: str, turns: list[tuple[float, int]], from_rest: bool) -> None:
    """From jumps over all of the range to steps of 1e-9 um."""
    actuator = replace(cases.actuator(name), dynamics="none", creep=None)
    theta = cases.theta(actuator, 2, name)
    ends = [0.0, *(goal for goal, _ in turns)]
    ramps = [
        np.linspace(a, b, samples + 1)[1:]
        for (a, b), (_, samples) in zip(pairwise(ends), turns, strict=True)
    ]
    asked = np.concatenate([[0.0], *ramps])
    for model, voltage in zip(
        theta, inverse(actuator, theta, asked, from_rest=from_rest), strict=True
    ):
        back = actuator.displacement(model, voltage, from_rest=from_rest)[0]
        np.testing.assert_allclose(back, asked, rtol=0, atol=70 * CLOSE)


@pytest.mark.parametrize("hold", ["first", "zero"])
@pytest.mark.parametrize("dynamics", ["none", "lag", "second-order"])
@pytest.mark.parametrize("parts", [True, False])
def test_dynamics_gain_and_creep_are_undone(hold: Hold, dynamics: str, parts: bool) -> None:
    """With a held voltage as with straight lines, for a reference that begins at rest."""
    nonlinearity = PolynomialNonlinearity(reference=SPAN) if parts else None
    creep = Creep((0.1, 1.0), growing=True, reference=SPAN) if parts else None
    actuator = Actuator(dynamics, hold, 1e-3, nonlinearity=nonlinearity, creep=creep, span=SPAN)
    assert_returned(actuator, theta_of(actuator), smooth())


@pytest.mark.parametrize("hold", ["first", "zero"])
def test_a_spring_that_swings_slowly_is_undone(hold: Hold) -> None:
    """10 Hz, hardly damped, at 1 kHz: in straight lines the causal inverse would run away."""
    actuator = Actuator("second-order", hold, 1e-3, span=SPAN)
    theta = theta_of(actuator, mass=100.0, damping=300.0)
    voltage = assert_returned(actuator, theta, smooth(2000))
    assert np.max(np.abs(voltage)) < 120.0
    add_prior_creep = replace(actuator, creep=Creep((0.1, 1.0), reference=SPAN))
    if hold == "first":
        theta = theta_of(add_prior_creep, mass=100.0, damping=300.0)
        with pytest.raises(InputError, match=r"creep of 0\.05 of the drive cannot be undone"):
            inverse(add_prior_creep, theta, smooth(2000))


def test_a_displacement_that_begins_in_motion_is_missed_at_its_beginning_alone() -> None:
    """The two-sided inverse of a spring that is sampled fast, and the held drive's one sample."""
    reference = smooth()[60:] + 1.0
    actuator = Actuator("lag", "zero", 1e-3, span=SPAN)
    theta = theta_of(actuator)
    voltage = assert_returned(actuator, theta, reference, first=2)
    missed = actuator.displacement(theta, voltage[0])[0] - reference
    assert abs(missed[1]) > 1e-3


def limited() -> tuple[Actuator, FloatArray]:
    actuator = Actuator("none", "first", 1e-3, span=SPAN)
    return actuator, theta_of(actuator, offset=0.0)


@pytest.mark.parametrize(
    ("limits", "line"),
    [
        (Limits(-30.0, 30.0), r"beyond the amplifier's -30 to 30 V"),
        (Limits(slew=500.0), r"faster than the amplifier's 500 V/s"),
        (Limits(current=1e-3, capacitance=1e-6), r"faster than the amplifier's 1000 V/s"),
    ],
)
def test_what_the_amplifier_cannot_do_is_refused_with_place_and_time(
    limits: Limits, line: str
) -> None:
    actuator, theta = limited()
    with pytest.raises(InputError, match=line) as refused:
        inverse(actuator, theta, smooth(), from_rest=True, limits=limits)
    assert "reference: " in str(refused.value)
    assert " s " in str(refused.value)
    # The advice: with an amplifier of one sign, usually another middle.
    for fix in ("move its middle", "smaller or smoother", "widen the limits", "`nearest=True`"):
        assert fix in str(refused.value)


def test_the_nearest_command_keeps_to_the_limits_and_is_right_elsewhere() -> None:
    """Clipped where the voltage would go too far; where it need not, the reference is met again."""
    actuator, theta = limited()
    reference = smooth()
    clipped = inverse(
        actuator, theta, reference, from_rest=True, limits=Limits(-35.0, 35.0), nearest=True
    )[0]
    assert np.max(clipped) == 35.0
    inside = np.abs(clipped) < 35.0
    back = actuator.displacement(theta, clipped, from_rest=True)[0]
    np.testing.assert_allclose(back[inside], reference[inside], atol=1e-9)
    beyond = np.sign(clipped[~inside]) * (reference - back)[~inside]
    assert (beyond >= -1e-9).all()


def test_the_nearest_command_is_as_fast_as_the_limits_allow() -> None:
    actuator, theta = limited()
    limits = Limits(slew=800.0)
    reference = smooth()
    slow = inverse(actuator, theta, reference, from_rest=True, limits=limits, nearest=True)[0]
    steps = np.abs(np.diff(slow))
    assert np.max(steps) <= 0.8 * (1 + 1e-12)
    back = actuator.displacement(theta, slow, from_rest=True)[0]
    behind = np.abs(back - reference) > 1e-6
    # Where it is behind, it goes as fast as it may.
    np.testing.assert_allclose(steps[behind[1:]], 0.8, rtol=1e-9)
    assert 0.05 < np.mean(behind) < 0.95


@pytest.mark.parametrize(
    ("reference", "line"),
    [
        ([], "has shape"),
        ([1.0, np.nan, 2.0], "not a finite number in sample 1"),
        ([[1.0], [2.0]], "one for each model"),
    ],
)
def test_references_that_are_none_are_refused(reference: list[object], line: str) -> None:
    actuator, theta = limited()
    with pytest.raises(InputError, match=line):
        inverse(actuator, theta, reference)  # type: ignore[arg-type]


def test_a_displacement_beyond_saturation_is_refused_with_its_time() -> None:
    """Pinned walls have a largest displacement."""
    operator = build_part("hysteresis", "domain-wall", HYSTERESIS, {})
    actuator = Actuator("none", "first", 1e-3, operator, span=SPAN)
    known = {"d": 0.7, "saturation": 40.0, "coupling": 0.2, "pinning": 20.0, "reversible": 0.3}
    theta = np.array([[{**VALUES, **known}[name] for name in actuator.parameters]])
    with pytest.raises(InputError, match=r"no voltage gives 60 um at 0.002 s"):
        inverse(actuator, theta, [0.0, 10.0, 60.0], from_rest=True)
    nearest = inverse(actuator, theta, [0.0, 10.0, 60.0], from_rest=True, nearest=True)
    assert np.isfinite(nearest).all()


def test_limits_that_leave_nothing_are_refused() -> None:
    with pytest.raises(InputError, match="no voltage from 1 to 1 V"):
        Limits(1.0, 1.0)
    with pytest.raises(InputError, match="together"):
        Limits(current=1.0)
    with pytest.raises(InputError, match="slew 0; must be positive"):
        Limits(slew=0.0)
