"""A model's spec: a chain of stages to be changed, compared, and written as a config has it."""

import json
import tomllib

import numpy as np
import pytest
import tomlkit
from hypothesis import given, strategies as st

from bwbayes.app.config.config import ModelConfig
from bwbayes.control.exported import export_model
from bwbayes.errors import InputError
from bwbayes.inference.noise import NOISES
from bwbayes.model.inputs import Limits, Span
from bwbayes.model.inverse import inverse
from bwbayes.model.nonlinearity import TERMS
from bwbayes.model.registry import DYNAMICS, HYSTERESIS, STAGES
from bwbayes.model.spec import Extent, ModelSpec, StageSpec
from tests.control import cases

FURTHER = (*TERMS, *STAGES, "creep")


@st.composite
def specs(draw: st.DrawFn) -> ModelSpec:
    """Any model of the package's stages, some of which have options."""
    names = draw(st.lists(st.sampled_from(FURTHER), unique=True))
    spec = ModelSpec(
        hold=draw(st.sampled_from(["auto", "first", "zero"])),
        history=draw(st.sampled_from(["unknown", "demagnetized"])),
        noise=draw(st.sampled_from([*NOISES])),
    ).with_stages(*names, draw(st.sampled_from([*DYNAMICS])), draw(st.sampled_from([*HYSTERESIS])))
    if draw(st.booleans()):
        passive = draw(st.booleans())
        spec = spec.with_stages(StageSpec.of("hysteresis", "bouc-wen", {"passive": passive}))
    if draw(st.booleans()):
        times = draw(st.lists(st.floats(0.1, 1e3), min_size=1, max_size=3))
        spec = spec.with_stages(
            StageSpec.of("creep", "creep", {"creep": times, "creep_growth": True})
        )
    return spec


@given(specs(), specs())
def test_a_spec_is_what_a_config_says(spec: ModelSpec, other: ModelSpec) -> None:
    """Written by its keys and read again it is equal, whatever the config said before."""
    again = ModelSpec.from_keys(json.loads(json.dumps(spec.keys)))
    assert (again, hash(again)) == (spec, hash(spec))
    assert (spec == other) == (spec.keys == other.keys)
    assert (spec == other) == (not spec.changes_to(other))
    config = ModelConfig.model_validate(other.keys).with_spec(spec)
    assert ModelConfig.model_validate(config.model_dump()).spec == spec


@pytest.mark.parametrize(
    "names",
    [("lag",), ("second-order", "quadratic", "backlash"), ("plays", "amplifier-lag", "creep")],
    ids=", ".join,
)
def test_a_spec_alone_declares_simulates_inverts_and_prints_a_model(names: tuple[str, ...]) -> None:
    """Its keys make it again, its command gives the displacement, and C has both ways."""
    spec = ModelSpec(hold="first").with_stages(*names)
    text = tomlkit.dumps({"model": spec.keys})
    assert ModelSpec.from_keys(tomllib.loads(text)["model"]) == spec
    actuator = spec.actuator(1e-3, "first", Extent(cases.SPAN, 1e-3, 10.0))
    theta = cases.theta(actuator)
    assert theta.shape == (1, len(actuator.declarations))
    voltage = 40 * np.sin(np.linspace(0, 6, 400)) ** 3
    displacement = actuator.displacement(theta, voltage, from_rest=True)
    command = inverse(actuator, theta, displacement, from_rest=True)
    moved = actuator.displacement(theta, command[0], from_rest=True)
    np.testing.assert_allclose(moved, displacement, rtol=0, atol=1e-6)
    assert (
        "double actuator_inverse("
        in export_model("made", actuator, theta[0], Limits(*cases.SPAN)).c_code()
    )


def test_an_unknown_history_is_refused() -> None:
    with pytest.raises(InputError, match=r"^history: 'swept' is unknown; write one of unknown, "):
        ModelSpec(history="swept")


@given(specs(), st.sampled_from(FURTHER))
def test_a_stage_is_added_replaced_and_left_out(spec: ModelSpec, name: str) -> None:
    """The order in which stages are added does not count, and what was there stays."""
    added = spec.with_stages(name)
    assert {*added.chain} == {*spec.chain, name}
    assert added.with_stages(name) == added
    if name not in spec.chain:
        assert added.without(name) == spec
    for operator in HYSTERESIS:
        other = added.with_stages(operator)
        assert other.operator == StageSpec("hysteresis", operator)
        assert other == spec.with_stages(operator).with_stages(name)
    assert [stage for stage in added.chain if stage in STAGES] == [
        stage for stage in STAGES if stage in added.chain
    ]


@given(specs())
def test_without_a_clock_only_the_path_of_the_voltage_counts(spec: ModelSpec) -> None:
    """Every other stage stays, and the noise is white; a config keeps what both have in common."""
    timeless = spec.without_clock
    actuator = timeless.actuator(1.0, "first", Extent(Span(-1.0, 1.0), 1.0, 100.0))
    assert actuator.static.stages == actuator.stages
    assert (actuator.dynamics, actuator.creep, timeless.noise) == ("none", None, "white")
    lost = [name for name in spec.chain if name not in timeless.chain]
    assert all(
        name in DYNAMICS or name == "creep" or not STAGES[name]().rate_independent for name in lost
    )
    assert timeless.without_clock == timeless
    assert ModelConfig.model_validate(spec.keys).with_spec(timeless).spec == timeless
