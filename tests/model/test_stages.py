"""Every stage before and behind the hysteresis, by what its equation says, alone and in a chain.

The oracles are plain loops over samples and scipy; the compiled passes, pieces of a record, the
inverse, a model at a controller's pace and its C file have to agree with the whole record in NumPy.
"""

import ctypes
import math
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given, settings, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.control.exported import export_model
from bwbayes.control.sampled import SampledModel
from bwbayes.errors import InputError
from bwbayes.inference.compiled.walk import walk
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Context, Declaration, Distribution
from bwbayes.model.inputs import Hold, Inputs, Limits, Span
from bwbayes.model.inverse import inverse
from bwbayes.model.linear import Creep
from bwbayes.model.nonlinearity import PolynomialNonlinearity
from bwbayes.model.operator import Operator
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.duhem import Duhem
from bwbayes.model.operators.prandtl_ishlinskii import Plays
from bwbayes.model.registry import STAGES
from bwbayes.model.spec import Extent, ModelSpec
from bwbayes.model.stage import Stage, Timing
from bwbayes.model.stages.amplifier_limits import Saturation
from bwbayes.model.stages.backlash import Backlash
from bwbayes.model.stages.gain import Heating, Temperature
from bwbayes.model.stages.lags import Delay
from bwbayes.model.stages.sensor import ReversedSign
from bwbayes.record.teststand import RING_BENDER, true_values
from tests.control.compiled import Compiled, compiled_functions
from tests.programs import needs

SPAN = Span(-80.0, 80.0)
INTERVAL = 1e-3
VALUES = {
    "delay": 2.4e-3,
    "amplifier_lag": 2e-3,
    "amplifier_lag_speed": 500.0,
    "slew_limit": 6e3,
    "saturation_middle": 5.0,
    "saturation_reach": 200.0,
    "backlash": 0.8,
    "backlash_start": 0.3,
    "series_loss": 0.08,
    "series_radius": 12.0,
    "series_shape": 1.5,
    "series_half": 50.0,
    "series_start": 0.4,
    "sensor_lag": 1e-3,
    "sensor_lag_speed": 200.0,
    "sensor_quadratic": 0.02,
    "sensor_cubic": -0.015,
    "sensor_middle": 2.0,
    "sensor_half": 60.0,
    "temperature_gain": 2e-3,
    "temperature_width": 5e-3,
    "temperature_offset": 0.1,
    "temperature_reference": 24.0,
    "load_gain": 4e-3,
    "load_width": -0.02,
    "load_offset": 0.3,
    "load_reference": 2.0,
    "d": 1.0,
    "heating": 0.04,
    "heating_time": 0.2,
    "heating_speed": 1000.0,
    "heating_start": 0.4,
    "gain_drift": 0.05,
    "drift": 2.0,
    "drift_curvature": -1.5,
    "transient": 3.0,
    "transient_time": 0.1,
    "transient_begin": 0.02,
    "step": 2.5,
    "step_time": 0.0505,
    "oscillation_sine": 0.3,
    "oscillation_cosine": -0.2,
    "oscillation_frequency": 50.0,
}
# A search for a command, or a run a sample at a time, has no more than the voltage.
COMMANDED = tuple(name for name, stage in STAGES.items() if not stage().sees)
UNDONE = (*COMMANDED, "heating", "delay")
# A backlash that turns asks for a jump, which a slew rate does not let pass.
MANY = tuple(name for name in COMMANDED if name != "slew-limit")
every_stage = pytest.mark.parametrize("name", STAGES)
every_hold = pytest.mark.parametrize("hold", ["first", "zero"])


def _events(stage: Stage) -> list[Declaration]:
    return [declared for declared in stage.parameters if declared.scope == "event"]


def drive(samples: int = 600, seed: int = 3) -> FloatArray:
    """Return a voltage (samples,) that swings, rests and turns at small amplitudes, V."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / samples
    voltage: FloatArray = 60 * np.sin(2 * np.pi * 4 * t) * (1 - 0.6 * t)
    voltage += 4 * np.sin(2 * np.pi * 23 * t + rng.uniform(0, 6))
    voltage[samples // 3 : samples // 3 + 40] = voltage[samples // 3]
    return voltage


def inputs_of(voltage: FloatArray) -> Inputs:
    time = np.arange(voltage.size) / 600
    temperature = 20 + 8 * time + 2 * np.sin(9 * time)
    load = 3 + 2 * np.cos(7 * time)
    covariates = {"temperature_degC": temperature, "load_N": load}
    return Inputs(voltage, interval=INTERVAL, covariates=covariates)


def actuator(
    *names: str, hold: Hold = "first", operator: Operator | None = None, **parts: Any
) -> Actuator:
    stages = tuple(STAGES[name]() for name in names)
    return Actuator("lag", hold, INTERVAL, operator or BoucWen(), span=SPAN, stages=stages, **parts)


def theta(made: Actuator, models: int = 3) -> FloatArray:
    """Return parameters (models, parameters), the first in the middle of the others."""
    table = {"d": 1.0, "alpha": 0.3, "beta": 0.05, "gamma": 0.02, "exponent": 1.0, "offset": 2.0}
    values = true_values(made, {**table, "initial": 0.1}) | {"lag": 3e-3}
    values |= {name: value for name, value in VALUES.items() if name in values}
    rows = np.tile([*values.values()], (models, 1))
    free = [i for i, name in enumerate(made.parameters) if name in VALUES]
    scale = 1 + 0.2 * np.random.default_rng(1).uniform(-1, 1, (models - 1, len(free)))
    rows[1:, free] *= scale
    return rows


def _with_backlash(x: FloatArray) -> list[float]:
    y = [float(x[0])]
    for value in x.tolist():
        y.append(min(max(y[-1], value - VALUES["backlash"]), value + VALUES["backlash"]))
    return y[1:]


def _with_series_plays(x: FloatArray) -> list[float]:
    """Let thirty plays in the middle of their gaps follow, one after the other."""
    half, k, result = VALUES["series_half"], VALUES["series_shape"], x.copy()
    radii = [half * 1.5 * (j + 0.5) / 30 for j in range(30)]
    weights = [r ** (k - 1) * np.exp(-k * r / VALUES["series_radius"]) for r in radii]
    for radius, weight in zip(radii, weights, strict=True):
        play = float(x[0])
        for sample, value in enumerate(x.tolist()):
            play = min(max(play, value - radius), value + radius)
            result[sample] -= VALUES["series_loss"] * weight / sum(weights) * (value - play)
    return [float(value) for value in result]


def _with_slew_limit(x: FloatArray) -> list[float]:
    y, most = [float(x[0])], VALUES["slew_limit"] * INTERVAL
    for value in x.tolist():
        y.append(y[-1] + min(max(value - y[-1], -most), most))
    return y[1:]


def _heat(command: FloatArray) -> list[float]:
    """Heat by steps of a hundredth of a sample, of a drive that begins cold."""
    heat, every = 0.0, [0.0]
    for before, now in pairwise(command.tolist()):
        for _ in range(100):
            warming = abs(now - before) / INTERVAL / VALUES["heating_speed"] - heat
            heat += INTERVAL / 100 / VALUES["heating_time"] * warming
        every.append(heat)
    return every


def looped(name: str, x: FloatArray, hold: Hold) -> FloatArray:
    """Return what a stage at rest at the first value makes of values (samples,)."""
    v, inputs = VALUES, inputs_of(x)
    t, warmer = inputs.time, inputs.column("temperature_degC") - v["temperature_reference"]
    pressed, straight = inputs.column("load_N") - v["load_reference"], v["d"] * x
    s = (x - v["sensor_middle"]) / v["sensor_half"]
    middle, reach, phase = v["saturation_middle"], v["saturation_reach"], 2 * np.pi * 50.0 * t
    samples = np.arange(x.size)
    of_name = {
        "delay": np.interp(samples - v["delay"] / INTERVAL, samples, x),
        "backlash": _with_backlash(x),
        "series-plays": _with_series_plays(x),
        "slew-limit": _with_slew_limit(x),
        "saturation": middle + reach * np.tanh((x - middle) / reach),
        "temperature": x * (1 + v["temperature_gain"] * warmer),
        "temperature-width": straight + (x - straight) * (1 + v["temperature_width"] * warmer),
        "temperature-offset": x + v["temperature_offset"] * warmer,
        "load": x * (1 + v["load_gain"] * pressed),
        "load-width": straight + (x - straight) * (1 + v["load_width"] * pressed),
        "load-offset": x + v["load_offset"] * pressed,
        "moving-gain": x * (1 + v["gain_drift"] * t),
        "heating": x * (1 + v["heating"] * np.array(_heat(x))),
        "sensor-curve": x
        + v["sensor_half"] * (v["sensor_quadratic"] + v["sensor_cubic"] * s) * (s**2 - 1),
        "reversed-sign": -x,
        "drift": x + v["drift"] * t + v["drift_curvature"] * t**2,
        "transient": x
        + v["transient"] * np.exp(-np.maximum(t - v["transient_begin"], 0) / v["transient_time"]),
        "step": x + v["step"] * (t >= v["step_time"]),
        "oscillation": x
        + v["oscillation_sine"] * np.sin(phase)
        + v["oscillation_cosine"] * np.cos(phase),
    }
    if name in of_name:
        return np.asarray(of_name[name])
    assert name.endswith("-lag"), f"write the equation of the stage {name} here"
    # A lag, four hundred steps between each two samples; of a held command the mean in between.
    lag, fine = v[name.replace("-", "_")], 400
    held = hold == "zero" and name == "amplifier-lag"
    time = np.arange((x.size - 1) * fine + 1) / fine
    path = x[np.minimum(np.floor(time), x.size - 1).astype(int)] if held else None
    path = np.interp(time, np.arange(x.size), x) if path is None else path
    signal: Any = scipy.signal
    system = signal.StateSpace([[-1 / lag]], [[1 / lag]], [[1.0]], [[0.0]])
    step = INTERVAL / fine
    out = signal.lsim(system, path, step * np.arange(path.size), np.array([x[0]]), interp=not held)[
        1
    ]
    if not held:
        return np.asarray(out[::fine])
    means = (out[:-1] + out[1:]) / 2
    return np.append(means.reshape(-1, fine).mean(axis=1), np.nan)


def passed(name: str, x: FloatArray, hold: Hold = "first") -> FloatArray:
    """Return what the package's stage makes of the same."""
    stage = STAGES[name]()
    column = {one: np.array([value]) for one, value in VALUES.items()}
    numbers = stage.numbers_at(column, Timing(INTERVAL, hold), inputs_of(x))
    _, memory = stage.settled(numbers, x[:1])
    seen = stage.seen(inputs_of(x))
    return np.asarray(stage.advance(numbers, memory, x[np.newaxis], seen)[0][0])


@every_stage
@every_hold
def test_a_stage_does_what_its_equation_says(name: str, hold: Hold) -> None:
    x = drive(120)
    expected = looped(name, x, hold)
    known = np.isfinite(expected)
    np.testing.assert_allclose(passed(name, x, hold)[known], expected[known], rtol=0, atol=1e-4)


# Chains of stages from all along the signal's way: each is in one, and is compiled once.
CHAINS = [tuple(STAGES)[first::6] for first in range(6)]


@pytest.mark.parametrize(
    ("names", "operator"), [*zip(CHAINS, 2 * [BoucWen(), Duhem(), Plays(4)], strict=True)]
)
@given(st.sampled_from(["first", "zero"]), st.booleans(), st.booleans(), st.integers(0, 2**32 - 1))
@settings(max_examples=5)
def test_chains_agree_in_both_engines_and_in_pieces(
    names: tuple[str, ...], operator: Operator, hold: Hold, rich: bool, from_rest: bool, seed: int
) -> None:
    parts = {}
    if rich:
        parts = {
            "nonlinearity": PolynomialNonlinearity(reference=SPAN),
            "creep": Creep((0.1, 1.0), True, SPAN),
        }
    made, voltage = actuator(*names, hold=hold, operator=operator, **parts), drive(400, seed)
    models = theta(made)
    inputs = inputs_of(voltage)
    whole = made.displacement(models, inputs, from_rest=from_rest)
    cut = 2 + seed % 300
    first, state = made.advance(models, inputs[:cut], from_rest=from_rest)
    second, _ = made.advance(models, inputs[cut:], state)
    size = np.ptp(whole)
    np.testing.assert_allclose(np.hstack([first, second]), whole, rtol=0, atol=1e-11 * size)
    onwards = walk(made, models, inputs, from_rest=from_rest)
    pieces = np.hstack([onwards(cut), onwards(voltage.size)])
    np.testing.assert_allclose(pieces, whole, rtol=0, atol=1e-11 * size)
    alone = made.displacement(models[1:2], inputs, from_rest=from_rest)
    np.testing.assert_allclose(alone, whole[1:2], rtol=0, atol=1e-11 * size)


@given(st.floats(-0.1, 0.1))
def test_readings_that_need_the_voltage_beyond_their_record_are_left_out(delay: float) -> None:
    """Those that are left do not depend on it; where all was at rest before, it is known."""
    made, stage = actuator("delay"), Delay()
    part = inputs_of(drive())[150:400]
    alone, column = inputs_of(part.voltage.copy()), {"delay": np.array([delay])}
    whole, cut = (
        stage.advance(
            stage.numbers_at(column, Timing(INTERVAL, "first"), inputs),
            np.empty((1, 0)),
            inputs.voltage[np.newaxis],
            stage.seen(inputs),
        )[0][0]
        for inputs in (part, alone)
    )
    row = theta(made, 1)
    row[:, made.parameters.index("delay")] = delay
    known = np.isfinite(made.known(row, whole))
    np.testing.assert_allclose(cut[known], whole[known], rtol=0, atol=1e-9)
    assert np.sum(~known) == np.ceil(abs(delay) / INTERVAL)
    assert np.isfinite(made.known(row, whole, from_rest=True)).all() == (delay >= 0)


@pytest.mark.parametrize("names", [*((name,) for name in UNDONE), MANY])
@pytest.mark.parametrize(("hold", "from_rest"), [("first", True), ("zero", False)])
def test_the_inverse_makes_the_displacement_again(
    names: tuple[str, ...], hold: Hold, from_rest: bool
) -> None:
    """Where nothing was cut off: the drive alone is slower than the slew rate."""
    made = actuator(*names, hold=hold)
    models, voltage = theta(made, 2), drive(300)[:160]
    if not from_rest:
        voltage = np.concatenate([np.full(30, voltage[0]), voltage])
    wanted = made.displacement(models, voltage, from_rest=from_rest)
    command = inverse(made, models, wanted, from_rest=from_rest)
    again = np.vstack(
        [
            made.displacement(row[np.newaxis], own, from_rest=from_rest)
            for row, own in zip(models, command, strict=True)
        ]
    )
    np.testing.assert_allclose(again, wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("names", "hold"),
    [*product(((name,) for name in COMMANDED), ("first", "zero")), (COMMANDED, "zero")],
)
def test_a_controller_and_its_c_file_do_the_same_and_undo_a_stage(
    names: tuple[str, ...], hold: Hold, tmp_path: Path
) -> None:
    made, voltage = actuator(*names, hold=hold), drive()
    voltage[0] = 0.0
    row = theta(made, 1)
    row[:, [made.parameters.index(name) for name in ("initial", "offset")]] = 0.0
    expected = made.displacement(row, voltage, from_rest=True)[0]
    model = SampledModel.of(made, row)
    state, moved = model.begin(voltage[:1]), []
    for sample in voltage:
        displacement, state = model.forward(state, np.array([sample]))
        moved.append(displacement[0])
    size = np.ptp(expected)
    sampled = np.array(moved) + model.zero[0]
    np.testing.assert_allclose(sampled, expected, rtol=0, atol=1e-11 * size)
    compiled = Compiled(export_model("chain", made, row[0], Limits(*SPAN)), tmp_path, needs("cc"))
    displacement = compiled.run("forward", voltage[0], voltage)
    np.testing.assert_allclose(displacement, moved, rtol=0, atol=1e-11 * size)
    if names == COMMANDED:
        return
    command = compiled.run("inverse", voltage[0], displacement[int(hold == "zero") :])
    again = compiled.run("forward", voltage[0], command)
    # A backlash that turns asks for a jump, which the limits may be in the way of.
    near = np.abs(command) < 0.99 * SPAN.high
    assert near.mean() > 0.9
    reached = displacement[: again.size]
    error = np.abs(again - reached)[np.roll(near, int(hold == "zero"))]
    assert np.quantile(error, 0.98) < 1e-6


@every_stage
def test_a_stage_does_the_same_in_c(name: str, tmp_path: Path) -> None:
    """Sample by sample: at rest, on the way and back; whatever it sees, time or a covariate."""
    stage, x = STAGES[name](), drive(120)
    column = {one: np.array([value]) for one, value in VALUES.items()}
    inputs = inputs_of(x)
    (numbers,) = stage.numbers_at(column, Timing(INTERVAL, "first"), inputs)
    functions: dict[str, Any] = {"settle": stage.settle, "move": stage.move, "undo": stage.undo}
    functions = {key: one for key, one in functions.items() if one is not getattr(Stage, key)}
    size = max(stage.remembers, 1)
    shapes = {"parameters": numbers.shape, "memory": (size,), "after": (size,)}
    library = compiled_functions([*functions.values()], shapes, tmp_path, needs("cc"))

    def compare(key: str, *arguments: Any) -> tuple[float, FloatArray]:
        """Return what Python makes of arguments, and the memory that it leaves, as C does."""
        after, in_c = np.zeros(size), np.zeros(size)
        last = () if key == "undo" else (after,)
        expected = float(functions[key](numbers, *arguments, *last))
        given = (numbers, *arguments, in_c)[: len(arguments) + 1 + len(last)]
        row = ctypes.POINTER(ctypes.c_double)
        got = getattr(library, f"c_{key}")(
            *(a.ctypes.data_as(row) if np.ndim(a) else ctypes.c_double(a) for a in given)
        )
        np.testing.assert_allclose([got, *in_c], [expected, *after], rtol=1e-12, atol=1e-12)
        return expected, after

    memory = compare("settle", x[0])[1] if stage.remembers else np.zeros(size)
    for value, seen in zip(x, stage.seen(inputs).T, strict=True):
        numbers[len(numbers) - len(seen) :] = seen
        moved, after = compare("move", memory, value)
        if "undo" in functions:
            compare("undo", memory, moved)
        memory = after


@pytest.mark.parametrize(
    "names", [("backlash",), ("amplifier-lag", "temperature-width", "temperature", "backlash")]
)
@pytest.mark.parametrize("from_rest", [False, True])
@pytest.mark.parametrize("creep", [None, Creep((0.1, 1.0), False, SPAN)])
def test_both_engines_give_the_same_log_density(
    names: tuple[str, ...], from_rest: bool, creep: Creep | None
) -> None:
    """With gaps, an offset of the record's own and an unknown start."""
    made, voltage = actuator(*names, creep=creep), drive()
    models = theta(made)
    rng = np.random.default_rng(5)
    inputs = inputs_of(voltage)
    readings = made.displacement(models[:1], inputs)[0] + 0.1 * rng.normal(size=voltage.size)
    readings[rng.integers(0, readings.size, 40)] = np.nan
    sds = np.tile([0.1, 0.05, 0.02], (len(models), 1))
    every = np.hstack([models, sds])
    densities = []
    for engine in ("numpy", "numba"):
        likelihood = Likelihood(
            inputs,
            readings,
            (slice(20, 580),),
            made,
            DiscrepancyNoise(),
            from_rest,
            engine=engine,
            offset_sd=0.0 if from_rest else 3.0,
            half_range=SPAN.half,
        )
        densities.append(likelihood.start(every))
    for numpy, compiled in zip(*densities, strict=True):
        np.testing.assert_allclose(compiled, numpy, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", [name for name in STAGES if name not in UNDONE])
def test_a_stage_undoes_what_it_makes_of_what_it_sees(name: str) -> None:
    stage, x = STAGES[name](), drive(120)
    column = {one: np.array([value]) for one, value in VALUES.items()}
    inputs = inputs_of(np.cos(x))
    numbers, seen = stage.numbers_at(column, Timing(INTERVAL, "first"), inputs), stage.seen(inputs)
    memory = np.empty((1, 0))
    made, _ = stage.advance(numbers, memory, x[np.newaxis], seen)
    assert not np.allclose(made, x)
    np.testing.assert_allclose(stage.inverse(numbers, memory, made, seen), [x], rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["temperature-width", "load-width"])
def test_a_wider_loop_starts_from_rest_where_another_does(name: str) -> None:
    """At zero volts, whatever the first voltage."""
    stage, column = STAGES[name](), {one: np.array([value]) for one, value in VALUES.items()}
    numbers = stage.numbers_at(column, Timing(INTERVAL, "first"), inputs_of(drive() + 7.0))
    assert stage.settled(numbers, np.zeros(1))[0] == 0.0


def test_stages_that_follow_one_covariate_share_its_reference() -> None:
    made = actuator("temperature-width", "temperature", "temperature-offset")
    assert made.parameters.count("temperature_reference") == 1


def test_a_chain_stands_in_the_order_of_the_signal() -> None:
    spec = ModelSpec().with_stages("sensor-curve", "backlash", "saturation", "backlash")
    made = spec.actuator(1e-3, "first", _extent())
    assert [stage.name for stage in made.stages] == ["saturation", "backlash", "sensor-curve"]
    with pytest.raises(InputError, match="'backlash' is there twice; leave one out"):
        ModelSpec.from_keys({"stages": ["backlash", "backlash"]})
    with pytest.raises(InputError, match=r"model.stages: 'backlsh' is unknown.*backlash"):
        spec.with_stages("backlsh")


@every_stage
def test_a_stage_declares_priors_that_follow_the_record(name: str) -> None:
    """Wide ones, in which the values of an actuator of any size lie; and says what it does."""
    stage: Stage = STAGES[name]()
    values = {}
    for declared in stage.parameters:
        default = declared.default(Context(RING_BENDER))
        assert default is not None
        if isinstance(default, Distribution):
            default = float(default.frozen.median())
        values[declared.name] = default
    assert stage.describe(values)
    assert stage.advice
    own = {declared.name for declared in stage.parameters}
    assert all(set(start) <= own | {"lag"} for start in stage.starts)


@pytest.mark.parametrize("name", [n for n, stage in STAGES.items() if _events(stage())])
def test_an_event_is_not_expected_of_the_next_record(name: str) -> None:
    """There all that belongs to it is as where it has not happened, and nothing is left of it."""
    stage, x = STAGES[name](), drive(120)
    values = VALUES | {declared.name: declared.at_rest for declared in _events(stage)}
    column = {one: np.array([value]) for one, value in values.items()}
    numbers = stage.numbers_at(column, Timing(INTERVAL, "first"), inputs_of(x))
    _, memory = stage.settled(numbers, x[:1])
    result, _ = stage.advance(numbers, memory, x[np.newaxis], stage.seen(inputs_of(x)))
    np.testing.assert_array_equal(result[0], x)
    made = actuator(name)
    assert not SampledModel.of(made, theta(made)).actuator.stages


def _extent() -> Extent:

    return Extent(SPAN, 1e-3, 10.0)


def test_a_stage_without_undo_is_refused_in_one_line_where_a_command_is_asked_for() -> None:
    class OneWay(Saturation):
        undo = Stage.undo

    made = Actuator("lag", "first", INTERVAL, BoucWen(), span=SPAN, stages=(OneWay(),))
    models = theta(made, 1)
    with pytest.raises(InputError, match="inverse: no command undoes the stage saturation; leave"):
        inverse(made, models, made.displacement(models, drive(50)))
    assert "no command undoes" in str(
        export_model("one way", made, models[0], Limits(*SPAN)).without_inverse
    )


class Branching(ReversedSign):
    """A formula of one number."""

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        return value if value > 0.0 else -value

    @staticmethod
    def undo(parameters: Any, memory: Any, value: Any) -> Any:  # noqa: ARG004
        """Return x."""
        return math.tan(value)


class Remembering(Branching):
    """The same with a memory."""

    remembers = 1

    @staticmethod
    def settle(parameters: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return x."""
        return min(value, 1.0)


@pytest.mark.parametrize("kind", [Branching, Remembering])
def test_a_formula_of_one_number_is_refused_in_one_line(kind: type[Stage]) -> None:
    """Wherever it is met first; what else goes wrong in it keeps its traceback."""
    stage, numbers, memory = kind(), np.empty((2, 0)), np.zeros((2, kind.remembers))
    values = np.array([[1.0, -1.0], [2.0, 3.0]])
    refused = (
        rf"^{__name__}:{kind.__name__}: its formula takes one number, .* in place of if, [^\n]*$"
    )
    for ask in (
        lambda: stage.settled(numbers, values[:, 0]),
        lambda: stage.advance(numbers, memory, values),
        lambda: stage.inverse(numbers, memory, values),
    ):
        with pytest.raises(InputError, match=refused):
            ask()
    with pytest.raises(ValueError, match="could not be broadcast"):
        Heating().advance(np.ones((2, 5)), np.zeros((3, 2)), values)


class Wearing(Backlash):
    """Another formula with the same parameters."""

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:
        """Return y."""
        after[0], after[1] = memory[0] + 0.1 * (value - memory[0]), value
        return after[0] * parameters[0]


def test_a_stage_derived_from_another_is_compiled_by_itself() -> None:
    """In a process that has compiled its base already."""
    inputs, moved = inputs_of(drive(200)), {}
    for kind in (Backlash, Wearing):
        made = Actuator("lag", "first", INTERVAL, BoucWen(), span=SPAN, stages=(kind(),))
        models = theta(made)
        moved[kind] = walk(made, models, inputs)(inputs.samples)
        expected = made.displacement(models, inputs)
        np.testing.assert_allclose(moved[kind], expected, rtol=0, atol=1e-10)
    assert np.abs(moved[Wearing] - moved[Backlash]).max() > 1.0


class Aging(Temperature):
    """y = x (1 + c (t − t₀)): sees the time."""

    name, sees = "aging", ("time",)


class Leaking(Temperature):
    """The same with the command in place of the time: cross-talk."""

    name, sees = "leaking", ("voltage",)


@pytest.mark.parametrize("kind", [Aging, Leaking])
def test_a_stage_sees_time_or_command(kind: type[Stage]) -> None:
    """From the record's beginning on, in both engines and in pieces."""
    made = Actuator("lag", "first", INTERVAL, BoucWen(), span=SPAN, stages=(kind(),))
    models, inputs = theta(made), inputs_of(drive())
    without = replace(made, stages=()).displacement(np.delete(models, [-3, -2], axis=1), inputs)
    change, reference, offset = np.hsplit(models[:, -3:], 3)
    seen = inputs.column(*kind.sees)
    expected = offset + (without - offset) * (1 + change * (seen - reference))
    for moved in (made.displacement(models, inputs), walk(made, models, inputs)(inputs.samples)):
        np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-10)
    onwards = walk(made, models, inputs)
    pieces = np.hstack([onwards(123), onwards(inputs.samples)])
    np.testing.assert_allclose(pieces, expected, rtol=0, atol=1e-10)
    if kind is Leaking:  # one that grows from pass to pass
        with pytest.raises(InputError, match="what leaking makes of the command cannot be undone"):
            inverse(made, models[:1], expected[:1, :30])
        return
    command = inverse(made, models, expected)
    for row, own, wanted in zip(models, command, expected, strict=True):
        again = made.displacement(row, Inputs(own, interval=INTERVAL))
        np.testing.assert_allclose(again[0], wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("kind", "seen"), [(Aging, "time"), (Temperature, "temperature_degC")])
def test_what_is_not_known_of_a_command_is_refused_in_one_line(
    kind: type[Stage], seen: str
) -> None:
    """Nothing is taken at a reference."""
    made = Actuator("lag", "first", INTERVAL, BoucWen(), span=SPAN, stages=(kind(),))
    models = theta(made, 1)
    with pytest.raises(InputError, match=f"stages: .* follows {seen}, which a model"):
        SampledModel.of(made, models)
    refused = "temperature_degC: the model needs it at every sample"
    for command in (made.displacement, lambda *given: inverse(made, *given)):
        if kind is Temperature:
            with pytest.raises(InputError, match=refused):
                command(models, drive(50))
        else:
            assert np.isfinite(command(models, drive(50))).all()
