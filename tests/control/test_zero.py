"""0 um is where the actuator stands at zero volts: for commands, which begin there, loops and C."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bwbayes.app.config.keywords import config_of
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.control import export
from bwbayes.app.jobs.fit_methods import amplifier_limits
from bwbayes.app.study.resolve import resolve_config
from bwbayes.control.compensation import compensate
from bwbayes.control.references import Reference, build_reference
from bwbayes.errors import InputError
from bwbayes.model.inputs import Limits, Span
from bwbayes.model.registry import HYSTERESIS
from bwbayes.record.record import Record
from bwbayes.record.teststand import VirtualTestStand
from tests.control.commands import compensated, fit_of
from tests.control.compiled import Compiled
from tests.programs import needs

OFFSET, INTERVAL = 7.0, 0.005
TIME = INTERVAL * np.arange(400)

# A model with a gain about the middle of 0 to 100 V, which is not zero at zero volts.
VALUES = {
    "d": 0.7, "alpha": 0.3575, "beta": 0.0272, "gamma": 0.0172, "quadratic": 1.5, "lag": 3.8e-3,
    "offset": OFFSET, "sensor_sd": 0.1, "discrepancy_sd": 1e-6, "discrepancy_time": 0.5,
    "creep_1": 0.012, "creep_2": 0.009,
}  # fmt: skip


def problem(**keys: Any) -> Run:
    stand = VirtualTestStand("none", 1 / INTERVAL, true={"offset": OFFSET})
    run = stand.run(50 * (1 - np.cos(4 * np.pi * TIME)), np.random.default_rng(1))
    config, records = config_of(run, {"from_rest": True, **keys})
    return resolve_config(config, Path(), records)


def test_a_reference_means_the_same_for_a_command_a_loop_and_c(tmp_path: Path) -> None:
    """With a gain about another voltage, and creep; what C makes counts from zero volts as well."""
    of = problem(nonlinearity=["quadratic"], creep=[0.1, 1.0])
    flat = np.array([[VALUES[name] for name in of.study.posterior.names]] * 2)
    asked = build_reference("sine", INTERVAL, 10.0, 2.0, middle=15.0)
    command = compensated(of, asked, flat, from_rest=True).voltage
    assert command[0] == pytest.approx(0.0, abs=1e-9)
    at_zero = flat.copy()
    at_zero[:, of.study.posterior.names.index("offset")] = 0.0
    same = compensated(of, asked, at_zero, from_rest=True)
    np.testing.assert_allclose(same.voltage, command, atol=1e-9)

    model = export(fit_of(of, flat), tmp_path, voltage=(-100.0, 100.0), beyond_training=True)
    state, stepped = model.model.begin(np.zeros(1)), []
    reference = np.asarray(asked.displacement)[1:]
    for target in reference:
        voltage, state = model.model.inverse(state, np.array([target]), Span(-100.0, 100.0))
        stepped.append(voltage[0])
    np.testing.assert_allclose(stepped, command[:-1], atol=1e-6)

    compiled = Compiled(model, tmp_path, needs("cc"))
    np.testing.assert_allclose(compiled.run("inverse", 0.0, reference), command[:-1], atol=1e-6)
    assert model.model.displacement(model.model.begin(np.zeros(1))) == pytest.approx(0.0, abs=1e-12)
    theta = of.study.posterior.single_record.table.actuator(
        of.study.posterior.prior.theta(at_zero[:1])
    )
    moved = model.model.actuator.displacement(theta, command, from_rest=True)[0]
    assert abs(moved[0]) > 0.1
    got = compiled.run("forward", 0.0, command)
    np.testing.assert_allclose(got, moved - moved[0], atol=1e-10)


@pytest.mark.parametrize("from_rest", [True, False])
@pytest.mark.parametrize(
    "hysteresis",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name not in ("bouc-wen", "plays")))
        for name in HYSTERESIS
    ],
)
def test_a_command_begins_where_the_actuator_is(hysteresis: str, from_rest: bool) -> None:
    """At zero volts and 0 um, with every operator, whatever the sensor's offset."""
    of = problem(hysteresis=hysteresis, dynamics="lag")
    flat = of.study.posterior.prior.draw(np.random.default_rng(2), 1).repeat(2, axis=0)
    flat[:, of.study.posterior.names.index("offset")] = OFFSET
    asked = Reference(5 * (1 - np.cos(2 * np.pi * TIME[:20] / TIME[20])), INTERVAL)
    command = compensated(of, asked, flat, from_rest=from_rest, nearest=True)
    for played in (command.compensated, command.linear):
        assert played.voltage[0] == pytest.approx(0.0, abs=1e-6)
        for kind in ("parameter", "displacement"):
            spread = 6 * flat[:, of.study.posterior.names.index("discrepancy_sd")].max()
            edges = [played.bands.lower[kind, 95][0], played.bands.upper[kind, 95][0]]
            np.testing.assert_allclose(edges, 0.0, atol=1e-6 if kind == "parameter" else spread)


def test_a_reference_that_begins_elsewhere_gets_a_way_from_zero() -> None:
    of = problem(dynamics="lag")
    flat = np.array([[VALUES[name] for name in of.study.posterior.names]] * 2)
    asked = Reference(25 + 10 * np.cos(2 * np.pi * TIME), INTERVAL, smoothed=0.01)
    command = compensated(of, asked, flat, from_rest=False)
    assert (1.0, 1.0) == (command.reference.approach, command.summary["approach_s"])
    way = round(1.0 / INTERVAL)
    np.testing.assert_array_equal(command.asked[way:], asked.given)
    assert (0.0, 0.0) == (command.asked[0], command.smoothed[0])
    assert command.voltage[0] == pytest.approx(0.0, abs=1e-9)
    assert np.max(np.abs(np.diff(command.asked[: way + 1]))) < 0.4
    assert any("begins at 35 um: a way of 1 s is put before it" in one for one in command.remarks)
    again = command.reference.from_zero()
    assert again is command.reference


def test_smoothing_keeps_where_a_reference_begins_and_ends() -> None:
    """However short it is, and however wide the smoothing; a ramp stays as it is."""
    for samples, smoothed in ((10, 1.0), (400, 0.02)):
        ramp = Reference(np.linspace(0, 30, samples), INTERVAL, smoothed=smoothed)
        np.testing.assert_allclose(np.asarray(ramp.displacement), ramp.given, atol=1e-9)
    moving = Reference(np.sin(3 * TIME) + TIME, INTERVAL, smoothed=0.05)
    ends = np.asarray(moving.displacement)[[0, -1]]
    np.testing.assert_allclose(ends, moving.given[[0, -1]], atol=1e-9)


def test_an_amplifier_without_zero_volts_is_refused_and_is_not_the_default() -> None:
    of = problem(dynamics="lag")
    flat = np.array([[VALUES[name] for name in of.study.posterior.names]] * 2)
    asked = build_reference("sine", INTERVAL, 5.0, 2.0)
    with pytest.raises(InputError, match=r"20 to 100 V leaves out zero volts.*include it"):
        compensate(
            of.study.posterior, flat, asked, np.random.default_rng(1), limits=Limits(20.0, 100.0)
        )
    voltage = 60 + 40 * np.sin(4 * np.pi * TIME)
    record = Record(voltage, 0.5 * voltage + np.sin(TIME), interval=INTERVAL)
    config, records = config_of(record, {})
    assert amplifier_limits(resolve_config(config, Path(), records).study, None).span == (
        0.0,
        100.0,
    )
