"""A model a sample at a time: coefficients, a discrete system of scipy, and C that agrees.

A function printed as C does the same; one that cannot be printed is refused.
"""

import ctypes
import json
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.signal import StateSpace, dlsim

from bwbayes.arrays import FloatArray, anywhere, look_up, select
from bwbayes.control.exported import MATH_H, Exported, c_functions, export_model, to_ascii
from bwbayes.control.sampled import SampledModel, require_inverse
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Hold, Limits
from bwbayes.model.registry import HYSTERESIS, build_part
from bwbayes.model.stages.sensor import ReversedSign
from tests.control import cases
from tests.control.compiled import Compiled, compiled_functions
from tests.programs import needs

every_actuator = pytest.mark.parametrize("name", cases.ACTUATORS)
every_hold = pytest.mark.parametrize("hold", cases.HOLDS)


def of(name: str, hold: Hold, limits: Limits | None = None) -> Exported:
    actuator = cases.actuator(name, hold)
    return export_model(
        name, actuator, cases.theta(actuator, 1, name)[0], limits or Limits(*cases.SPAN)
    )


def simulated(system: Any, drive: FloatArray) -> FloatArray:
    """Return what scipy makes of a drive (samples, inputs), um."""
    return np.asarray(dlsim(system, drive)[1])


@every_actuator
@every_hold
def test_the_c_file_is_the_simulation(name: str, hold: Hold, tmp_path: Path) -> None:
    """Sample by sample, forward to 1e-12 of the range, and its inverse leads back."""
    made, voltage = of(name, hold), cases.drive()
    compiled = Compiled(made, tmp_path, needs("cc"))
    actuator = cases.actuator(name, hold)
    theta = cases.theta(actuator, 1, name)
    expected = actuator.displacement(theta, voltage, from_rest=True)[0]
    displacement = compiled.run("forward", voltage[0], voltage)
    np.testing.assert_allclose(displacement, expected, rtol=0, atol=1e-12 * np.ptp(expected))
    late = int(hold == "zero")
    command = compiled.run("inverse", voltage[0], displacement[late:])
    again = compiled.run("forward", voltage[0], command)
    reached = displacement[: again.size]
    np.testing.assert_allclose(again, reached, rtol=0, atol=1e-11 * np.ptp(expected))
    np.testing.assert_allclose(command, voltage[: command.size], rtol=0, atol=1e-8)


def test_the_inverse_moves_as_fast_as_its_amplifier_can(tmp_path: Path) -> None:
    """By its current over the capacitance at most, and as without a limit where that suffices."""
    limits = Limits(*cases.SPAN, slew=1e6, current=2e-3, capacitance=1e-5)
    made, free = (of("bouc-wen, second-order", "zero", each) for each in (limits, None))
    most = 200 * made.model.actuator.interval  # V: 2 mA into 10 uF for a sample
    (tmp_path / "free").mkdir()
    limited = Compiled(made, tmp_path, needs("cc"))
    unlimited = Compiled(free, tmp_path / "free", needs("cc"))
    slow, fast = 5 * np.sin(np.linspace(0, 6, 2000)), np.repeat([5.0, -5.0], 100)
    command = unlimited.run("inverse", 0.0, slow)
    assert np.max(np.abs(np.diff(command, prepend=0.0))) < most
    np.testing.assert_array_equal(limited.run("inverse", 0.0, slow), command)
    steps = np.abs(np.diff(limited.run("inverse", 0.0, fast), prepend=0.0))
    assert np.max(steps) == pytest.approx(most, rel=1e-9)
    assert np.max(np.abs(np.diff(unlimited.run("inverse", 0.0, fast)))) > most
    assert "up to 200 V/s, 0.002 A into 1e-05 F" in made.c_code()
    assert "It has no limit of slew or current" in free.c_code()
    keys = ("slew_V_per_s", "current_A", "capacitance_F")
    assert [made.numbers()[key] for key in keys] == [1e6, 2e-3, 1e-5]


def test_the_inverse_keeps_to_its_limits(tmp_path: Path) -> None:
    compiled = Compiled(
        of("bouc-wen, second-order", "zero", Limits(-40.0, 50.0)), tmp_path, needs("cc")
    )
    reference = np.repeat([1e3, -1e3, np.inf, 5.0], 40)
    command = compiled.run("inverse", 0.0, reference)
    assert [50.0, -40.0, 50.0] == command[39:120:40].tolist()
    assert 5.0 == pytest.approx(compiled.run("forward", 0.0, command)[-1], abs=1e-12)


@pytest.mark.parametrize("name", ["bouc-wen with all", "plays, lag, nonlinearity"])
@every_hold
def test_a_value_that_cannot_be_used_holds_the_last_voltage(
    name: str, hold: Hold, tmp_path: Path
) -> None:
    """Bit by bit as if the last voltage had come again, with a flag at just these samples."""
    compiled = Compiled(of(name, hold), tmp_path, needs("cc"))
    voltage = cases.drive(400)
    rng = np.random.default_rng(5)
    lost = rng.random(voltage.size) < 0.2
    lost[[0, 200, 201, 202]] = True
    last = np.maximum.accumulate(np.where(lost, -1, np.arange(voltage.size)))
    before = np.where(last < 0, voltage[0], voltage[last])
    for bad in (np.nan, np.inf, -np.inf, 1e308):
        given = np.where(lost, bad, voltage)
        displacement, held = compiled.run_with_flags("forward", voltage[0], given)
        np.testing.assert_array_equal(held, lost)
        np.testing.assert_array_equal(displacement, compiled.run("forward", voltage[0], before))
    reference = compiled.run("forward", voltage[0], voltage)
    given = np.where(lost, np.nan, reference)
    command, held = compiled.run_with_flags("inverse", voltage[0], given)
    np.testing.assert_array_equal(held, lost)
    np.testing.assert_array_equal(command[lost], np.append(voltage[0], command)[:-1][lost])
    # Later references are met as ever, unless a limit is in the way.
    late = int(hold == "zero")
    reached = compiled.run("forward", voltage[0], command)
    free = ~lost & (command > cases.SPAN.low) & (command < cases.SPAN.high)
    met = np.flatnonzero(free[: voltage.size - late])
    assert met.size > 200
    np.testing.assert_allclose(reached[met + late], reference[met], atol=1e-9)
    begun = compiled.run_with_flags("forward", np.nan, voltage[:1] * 0)
    np.testing.assert_array_equal(begun[0], compiled.run("forward", 0.0, voltage[:1] * 0))


@every_hold
def test_the_header_says_which_sample_the_inverse_is_of(hold: Hold) -> None:
    code = of("bouc-wen with all", hold).c_code()
    assert ("forward of\n * inverse is one sample late" in code) == (hold == "zero")
    assert ("inverse returns the voltage of the same sample." in code) == (hold == "first")


def test_a_model_without_an_inverse_says_why_in_its_file(tmp_path: Path) -> None:
    actuator = Actuator("none")
    theta = cases.theta(actuator)[0]
    theta[actuator.parameters.index("d")] = 0.4
    made = export_model("turns */ back", actuator, theta, Limits(*cases.SPAN))
    code = made.c_code()
    assert "There is no inverse:\n * inverse: the model_s slope may be as low as" in code
    assert "actuator_inverse" not in code
    assert "turns __ back" in code
    voltage = cases.drive(300)
    displacement = Compiled(made, tmp_path, needs("cc")).run("forward", voltage[0], voltage)
    expected = actuator.displacement(theta, voltage, from_rest=True)[0]
    np.testing.assert_allclose(displacement, expected, rtol=0, atol=1e-12 * np.ptp(expected))


@pytest.mark.parametrize("name", ["bouc-wen with all", "linear, second-order, creep"])
@every_hold
def test_the_linear_part_is_the_recursion(name: str, hold: Hold) -> None:
    """scipy.signal simulates from the drive what the actuator does."""
    actuator = cases.actuator(name, hold)
    theta, voltage = cases.theta(actuator, 1, name), cases.drive(800)
    column = actuator.columns(theta)
    memory = actuator.begin(column, voltage, from_rest=True)
    w = actuator.hysteresis.advance(column, voltage, memory)[0]
    if actuator.nonlinearity is not None:
        w = w + actuator.nonlinearity.displacement(column, voltage)
    inputs = [w[0]]
    if actuator.creep is not None and actuator.creep.growing:
        inputs.append(actuator.creep.drive(column, w, voltage)[0])
    drives = np.stack(inputs, axis=1)
    system = SampledModel.of(actuator, theta).linear
    assert isinstance(system, StateSpace)
    moved = simulated(system, drives - drives[0])[:, 0]
    expected = actuator.displacement(theta, voltage, from_rest=True)[0]
    np.testing.assert_allclose(moved, expected - expected[0], rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["bouc-wen with all", "plays, lag, nonlinearity"])
def test_the_numbers_have_units_and_are_those_of_the_model(name: str) -> None:
    made = of(name, "first")
    numbers = json.loads(json.dumps(made.numbers(), allow_nan=False))
    actuator = cases.actuator(name)
    theta = cases.theta(actuator, 1, name)[0]
    assert list(actuator.parameters) == list(numbers["parameters"])
    stated = dict(zip(actuator.parameters, theta.tolist(), strict=True))
    for declared, value in zip(actuator.declarations, theta, strict=True):
        known = numbers["parameters"][declared.name]
        assert (value, declared.unit_in(stated)) == (known["mean"], known["unit"])
    assert 1e-3 == numbers["interval_s"]
    known = numbers["parts"]["hysteresis"]
    assert type(actuator.hysteresis) is HYSTERESIS[known]
    assert f"Parts: hysteresis {known}, dynamics" in made.c_code()
    assert all({"value", "unit"} == set(number) for number in numbers["hysteresis"].values())
    system = made.linear
    for matrix in "ABCD":
        np.testing.assert_array_equal(numbers["state_space"][matrix], getattr(system, matrix))


ROWS = (0.5, -2.0, 3.0)


def halves(x: Any) -> Any:
    """Halve a number α until it is below one."""
    rounds = 0
    while x > 1.0:
        x /= 2
        rounds += 1
    return x, rounds


def everything(parameters: Any, memory: Any, x: Any, after: Any) -> Any:
    """Do what a step may do."""
    total, low = 0.0, np.floor(x / 3.0)
    for j in range(len(parameters)):
        total += parameters[j] * ROWS[j] - (x - (total - low)) / (2.0 + x**2)
    for k in range(2, -1, -1):
        total = look_up(parameters, k + 0.0 * x) - total * 0.5
    if anywhere((x > 2.0) & (memory[1] < x)):
        part, rounds = halves(x)
        total = total + part * rounds
    else:
        total = -np.minimum(total, select(x < -1.0, np.expm1(x), np.abs(x)))
    after[0], after[1] = x, total
    return total, low


def swaps(x: Any, y: Any) -> Any:
    """Assign in C one after the other, which is something else."""
    x, y = y, x
    return x - y


def divides(x: Any) -> Any:
    """Round down as Python does: by the remainder, not by the quotient in floats."""
    return x // 3.0


def unknown(x: Any) -> Any:
    """Call what C does not have."""
    return sorted([x])


def test_greek_and_signs_have_names() -> None:
    assert "alpha - beta^2 >= phi_1(-z)" == to_ascii("α − β² ≥ φ_1(−z)")


def signs(x: Any) -> Any:
    """Call a function of NumPy that math.h does not have."""
    return np.sign(x)


def chooses(x: Any) -> Any:
    """Choose by NumPy's own function, for which there is ``select``."""
    return np.where(x > 0.0, x, 0.0)


def writes(x: Any, after: Any) -> Any:
    """Give an argument by its name."""
    return np.abs(x, out=after)


def scaled(x: Any) -> Any:
    """Use a module's constant that is no number."""
    return x * ROWS


@pytest.mark.parametrize(
    "function", [swaps, divides, unknown, signs, chooses, writes, scaled], ids=lambda f: f.__name__
)
def test_what_c_does_not_have_is_refused(function: Callable[..., Any]) -> None:
    with pytest.raises(InputError, match=rf"^{function.__name__}: `.*` has no counterpart in C"):
        c_functions([function], {}, "c_")


class Signed(ReversedSign):
    """A stage whose formula has no counterpart in C."""

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:  # noqa: ARG004
        """Return y."""
        return value + 0.1 * np.sign(value)


def test_a_refused_formula_leaves_no_files(tmp_path: Path) -> None:
    made = replace(cases.actuator("bouc-wen"), stages=(Signed(),))
    model = export_model("signed", made, cases.theta(made)[0], Limits(*cases.SPAN))
    with pytest.raises(
        InputError, match=r"^Signed.move: `np.sign\(value\)` has no counterpart in C here; "
    ):
        model.save(tmp_path / "model")
    assert not (tmp_path / "model").exists()


@pytest.fixture(scope="module")
def math_h(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, ctypes.CDLL]:
    """Return a module with each of NumPy's functions by itself, and the same in C."""
    folder, lines = tmp_path_factory.mktemp("math_h"), ["import numpy as np"]
    for name in MATH_H:
        arguments = ", ".join("xy"[: getattr(np, name).nin])
        lines += [f"def of_{name}({arguments}):", f"    return np.{name}({arguments})"]
    (folder / "every_function.py").write_text("\n".join(lines), encoding="ascii")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        module = import_module("every_function")
    functions = [getattr(module, f"of_{name}") for name in MATH_H]
    return module, compiled_functions(functions, {}, folder, needs("cc"))


@pytest.mark.parametrize("name", MATH_H)
@given(x=st.floats(-20.0, 20.0), y=st.floats(-20.0, 20.0))
def test_a_function_of_numpy_has_its_counterpart_in_c(
    math_h: tuple[Any, ctypes.CDLL], name: str, x: float, y: float
) -> None:
    """Outside of where it is defined as well: nan is nan and infinity infinity."""
    module, library = math_h
    arguments = (x, y)[: getattr(np, name).nin]
    with np.errstate(all="ignore"):
        expected = getattr(module, f"of_{name}")(*map(np.float64, arguments))
    got = getattr(library, f"c_of_{name}")(*map(ctypes.c_double, arguments))
    assert got == pytest.approx(float(expected), rel=1e-14, abs=1e-300, nan_ok=True)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return ``everything`` as a function of C."""
    folder: Path = tmp_path_factory.mktemp("printed")
    shapes = {"parameters": (3,), "memory": (2,), "after": (2,)}
    return compiled_functions([everything], shapes, folder, needs("cc")).c_everything


@given(x=st.floats(-50.0, 50.0))
def test_printed_c_does_what_the_function_does(compiled: Any, x: float) -> None:
    parameters, memory, after = np.array([1.0, 0.1, -0.3]), np.array([0.0, 4.0]), np.zeros(2)
    expected, low = everything(parameters, memory, np.float64(x), after)
    row = ctypes.POINTER(ctypes.c_double)
    written, second = np.zeros(2), ctypes.c_double()
    got = compiled(
        *(values.ctypes.data_as(row) for values in (parameters, memory)),
        ctypes.c_double(x),
        written.ctypes.data_as(row),
        ctypes.byref(second),
    )
    assert (got, second.value) == pytest.approx((float(expected), float(low)), rel=1e-12, abs=1e-12)
    np.testing.assert_allclose(written, after, rtol=1e-12, atol=1e-12)


# A model a sample at a time: the simulation's displacement, and a voltage that leads back


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
    # It is not far from them, or they would say nothing.
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
