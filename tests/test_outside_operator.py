"""An operator that is not in the package goes by its import path, and does all that others do.

Twenty lines are enough for one: CONTRIBUTING shows a loop whose branches are hyperbolic tangents,
which obeys Masing's rules and so has the memory of Preisach's kin. A step along a straight piece of
the voltage is the other way to write one.
"""

import importlib
import json
import pickle
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import bwbayes
from bwbayes.app.config.config import Config, parse
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray, select
from bwbayes.control.exported import export_model
from bwbayes.errors import InputError
from bwbayes.inference.noise import NOISES, DiscrepancyNoise, noise_model
from bwbayes.inference.parameters import ParameterTable
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Declaration, Values, positive
from bwbayes.model.inputs import Limits, Span
from bwbayes.model.inverse import inverse
from bwbayes.model.operator import OneStateStep, Operator
from bwbayes.model.operators.extremum_memory import INITIAL, RemembersExtrema
from bwbayes.model.operators.scalar_memory import OneState, alpha, beta, d, initial
from bwbayes.model.registry import HYSTERESIS, build_part
from bwbayes.model.stages.backlash import Backlash
from tests.app import small
from tests.control.compiled import Compiled
from tests.programs import needs
from tests.test_contributing import example

HERE = "tests.test_outside_operator"


WIDTH = positive("width", "V", "u_s", "width of the loop", lambda ranges: 0.5 * ranges.voltage)


class BentStep(OneStateStep):
    """w = d u − h − k tanh(u / u_s), dh = α du − β |du| h: as an operator's own step."""

    ROW = "d, α, β, k and u_s"

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return w and its slope."""
        d, beta, bend, width = parameters[0], parameters[2], parameters[3], parameters[4]
        s = select(voltage < memory[0], -1.0, 1.0)
        top = s * parameters[1] / beta
        h = top + (memory[1] - top) * np.exp(-beta * np.abs(voltage - memory[0]))
        after[0], after[1] = voltage, h
        level, slope = saturated(voltage / width)
        w = d * voltage - h - bend * level
        return w, d - parameters[1] + s * beta * h - bend / width * slope

    def slopes(self, limits: Span) -> tuple[FloatArray, FloatArray]:
        """Return d − 2 α − k / u_s and d."""
        del limits
        d, alpha, _, bend, width = self.parameters.T
        return d - 2 * alpha - bend / width, d

    def coefficients(self) -> dict[str, tuple[Any, str]]:
        """Return d."""
        return {"d": (float(self.parameters[0, 0]), "um/V")}


def saturated(x: Any) -> tuple[Any, Any]:
    """Return tanh x and its slope: a function that a step calls."""
    level = np.tanh(x)
    return level, 1.0 - level * level


@dataclass(frozen=True)
class Bent(OneState):
    """The operator of that step, which it takes for its displacement, too."""

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """Slopes d and α, um/V, β, 1/V, k, um, u_s, V, and the start."""
        bend = positive("bend", "um", "k", "bend", lambda ranges: 0.02 * ranges.displacement)
        return d(), alpha(), beta(), bend, WIDTH, initial()

    def step(self, column: Values) -> BentStep:
        """Return the step."""
        names = ("d", "alpha", "beta", "bend", "width")
        return BentStep(np.stack([column[name] for name in names], axis=1))


@dataclass(frozen=True)
class OutsideNoise(DiscrepancyNoise):
    """A noise from outside."""


class Incomplete(RemembersExtrema):
    """Lacks a branch."""

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """The start alone."""
        return (INITIAL,)


class Forgetful(Bent):
    """Declares no state before the record."""

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """All but the start."""
        return super().parameters[:-1]


class Unbounded(Bent):
    """Misspells another parameter in the bounds of one."""

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """Those of the operator."""
        slope, *others = super().parameters
        return replace(slope, bounds=lambda earlier: (earlier["alhpa"], np.inf)), *others


class ChoosingStep(BentStep):
    """The same step with a function that numba does not compile."""

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return w and its slope."""
        return BentStep.move(parameters, memory, np.where(voltage > 1e9, 0.0, voltage), after)


class Choosing(Bent):
    """The operator of that step."""

    def step(self, column: Values) -> ChoosingStep:
        """Return the step."""
        return ChoosingStep(super().step(column).parameters)


class BranchingStep(BentStep):
    """The same step with a choice of one number."""

    @staticmethod
    def move(parameters: Any, memory: Any, voltage: Any, after: Any) -> tuple[Any, Any]:
        """Return w and its slope."""
        return BentStep.move(parameters, memory, 0.0 if voltage > 1e9 else voltage, after)


class Branching(Bent):
    """The operator of that step."""

    def step(self, column: Values) -> BranchingStep:
        """Return the step."""
        return BranchingStep(super().step(column).parameters)


@dataclass(frozen=True)
class OneNumbered(RemembersExtrema):
    """An operator whose branches are of one number: E = d |u − u_r|."""

    @property
    def parameters(self) -> tuple[Declaration, ...]:
        """The slope d, um/V, and the start."""
        return d(), INITIAL

    def numbers(self, column: Values) -> FloatArray:
        """Return d."""
        return column["d"][:, np.newaxis]

    @staticmethod
    def everett(numbers: Any, start: Any, voltage: Any) -> Any:
        """Return E."""
        return numbers[0] * (voltage - start if voltage > start else start - voltage)

    def reachable(
        self, column: Values, voltage: float, span: Span
    ) -> tuple[FloatArray, FloatArray]:
        """Return both ends."""
        del voltage, span
        return -np.ones_like(column["d"]), np.ones_like(column["d"])

    def typical_slope(self, column: Values, span: Span) -> FloatArray:
        """Return d."""
        del span
        return column["d"]


def play(y: Any, value: Any, half: Any) -> Any:
    """Return where a play stands, by a function that numba does not compile."""
    return np.clip(y, value - half, value + half)


class Playing(Backlash):
    """A stage that calls it."""

    @staticmethod
    def move(parameters: Any, memory: Any, value: Any, after: Any) -> Any:
        """Return y."""
        after[0], after[1] = play(memory[0], value, parameters[0]), value
        return after[0]


class Stranger:
    """Is no operator."""


CONFIG = """
[record]
file = "record.csv"
train = [[0.0, 5.0]]

[model]
hysteresis = "HYSTERESIS"
dynamics = "none"

[sampling]
ess = 200
block = 25
walkers = 20

[validation.held_out]
window = [5.0, 6.0]
"""
TANH_LOOP, BENT = "my_operator:TanhLoop", f"{HERE}:Bent"
TRUTH = {
    TANH_LOOP: {"d": 0.9, "alpha": 12.0, "width": 40.0, "initial": 0.0},
    BENT: {"d": 0.9, "alpha": 0.2, "beta": 0.03, "bend": 2.0, "width": 40.0, "initial": 0.0},
}


@pytest.fixture
def _my_operator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_operator.py").write_text(example("my_operator.py"), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)


def record_of(kind: str) -> bwbayes.Record:
    """Return a record that an operator from outside has made, with 0.3 um of sensor noise."""
    time = np.arange(300) * 0.02
    voltage = 100 * np.exp(-0.3 * time) * np.sin(2 * np.pi * time)
    operator = build_part("model.hysteresis", kind, HYSTERESIS, {}, Operator)
    actuator = Actuator("none", "first", 0.02, operator, span=Span(-100.0, 100.0))
    theta = np.array([[*TRUTH[kind].values(), 1.0]])
    clean = actuator.displacement(theta, voltage, from_rest=True)[0]
    noise = 0.3 * np.random.default_rng(3).standard_normal(time.size)
    return bwbayes.Record(voltage, clean + noise, interval=0.02)


def config(folder: Path, kind: str) -> Config:
    """Write a record that such an operator has made, and return a config that fits it."""
    bwbayes.write_record(record_of(kind), folder / "record.csv")
    return parse(CONFIG.replace("HYSTERESIS", kind), "outside.toml")


@pytest.mark.usefixtures("_my_operator")
def test_an_operator_from_outside_goes_all_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Resolved, fitted, sampled, predicted, reported and opened; the truth is within four sds.

    The noise is from outside, too; what a run has kept of it is read again. With three parameters,
    such a bound is missed by chance in one of 5,000 runs.
    """
    kind = TANH_LOOP
    small.without_pictures(monkeypatch)
    stated = config(tmp_path, kind)
    noise = {"noise": f"{HERE}:OutsideNoise"}
    stated = stated.model_copy(update={"model": stated.model.model_copy(update=noise)})
    folder = RunFolder.create(tmp_path / "run", resolve_config(stated, tmp_path))
    result = resume(folder, Console(quiet=True), workers=1)
    assert result.outcome.converged
    summary = json.loads(folder.summary.read_text(encoding="utf-8"))
    for name, truth in TRUTH[kind].items():
        if name != "initial":
            one = summary["parameters"][name]
            assert abs(truth - one["mean"]) < 4 * one["sd"], name
    assert summary["validation"]["held_out"]["coverage"]["sensor"]["95"] > 0.7
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    assert "held back" in page
    assert kind in folder.config.read_text(encoding="utf-8")
    bands = bwbayes.open_run(folder.path).bands["held_out"]
    np.testing.assert_array_equal(bands.mean, result.bands["held_out"].mean)


@pytest.mark.usefixtures("_my_operator")
@pytest.mark.parametrize("kind", list(TRUTH))
def test_both_engines_give_one_log_density(kind: str, tmp_path: Path) -> None:
    """The truth may be stated in the operator's own parameters."""
    stated = config(tmp_path, kind).model_copy(update={"truth": TRUTH[kind]})
    posterior = resolve_config(stated, tmp_path).study.posterior
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(1), 40))
    one = replace(posterior, engine="numpy").log_likelihood(theta)
    other = replace(posterior, engine="numba").log_likelihood(theta)
    assert (
        np.max(np.abs(one - other) / (posterior.single_record.voltage.size + np.abs(one))) < 1e-10
    )


@pytest.mark.parametrize(
    ("model", "said"),
    [
        ({"stages": [f"{HERE}:Playing"]}, r"Playing.move: .* `return np.clip\(.*\)` \(line \d+ of"),
        ({"hysteresis": f"{HERE}:Choosing"}, r"ChoosingStep.move: .* `return BentStep.move\("),
    ],
)
def test_what_numba_cannot_compile_is_one_clear_line(
    model: dict[str, Any], said: str, tmp_path: Path
) -> None:
    """Which formula, its line, and what to write; NumPy's engine takes it."""
    stated = config(tmp_path, BENT)
    sampling = stated.sampling.model_copy(update={"walkers": 40})
    stated = stated.model_copy(
        update={"model": stated.model.model_copy(update=model), "sampling": sampling}
    )
    posterior = resolve_config(stated, tmp_path).study.posterior
    theta = posterior.prior.theta(posterior.prior.draw(np.random.default_rng(1), 3))
    assert np.isfinite(replace(posterior, engine="numpy").log_likelihood(theta)).all()
    refused = rf'^{HERE}:{said}[^\n]*bwbayes.arrays.select[^\n]*; or take engine = "numpy"$'
    with pytest.raises(InputError, match=refused):
        replace(posterior, engine="numba").log_likelihood(theta)


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("BranchingStep", {"d": 0.9, "alpha": 0.2, "beta": 0.03, "bend": 2.0, "width": 40.0}),
        ("OneNumbered", {"d": 0.9}),
    ],
)
def test_a_formula_of_one_number_is_one_clear_line(kind: str, values: dict[str, float]) -> None:
    """Wherever the operator is asked to take all models at once."""
    operator = Branching() if kind == "BranchingStep" else OneNumbered()
    actuator = Actuator("none", "first", 0.02, operator, span=Span(-100.0, 100.0))
    theta = np.array([[*values.values(), 0.0, 1.0]] * 2)
    refused = rf"^{HERE}:{kind}: its formula takes one number, .* in place of if, [^\n]*$"
    with pytest.raises(InputError, match=refused):
        actuator.displacement(theta, np.array([0.0, 10.0, -10.0]))


@pytest.mark.usefixtures("_my_operator")
def test_what_is_compiled_for_an_operator_is_looked_up_without_its_module() -> None:
    """As of another folder: the index names what all operators have compiled."""
    typeof = pytest.importorskip("numba").typeof
    pytest.importorskip("bwbayes.model.compiled")  # knows the type
    known = typeof(importlib.import_module("my_operator").TanhLoop())
    kept = pickle.dumps(known)
    del sys.modules["my_operator"]
    assert pickle.loads(kept) == known


def test_an_operator_with_a_step_is_read_backwards_and_exported(tmp_path: Path) -> None:
    """Many models there and back to 1e-8 V, and the C file to 1e-12 of the range."""
    actuator = Actuator("none", "first", 0.02, Bent(), span=Span(-100.0, 100.0))
    spread = 1 + 0.02 * np.random.default_rng(2).uniform(-1, 1, (60, 1))
    theta = spread * np.array([*TRUTH[BENT].values(), 0.0])
    voltage = record_of(BENT).voltage
    displacement = actuator.displacement(theta, voltage, from_rest=True)
    back = inverse(actuator, theta, displacement, from_rest=True)
    np.testing.assert_allclose(back, np.broadcast_to(voltage, back.shape), atol=1e-8)
    made_for = export_model("bent", actuator, theta[0], Limits(-100.0, 100.0))
    assert BENT == made_for.numbers()["parts"]["hysteresis"]
    compiled = Compiled(made_for, tmp_path, needs("cc"))
    got = compiled.run("forward", voltage[0], voltage)
    np.testing.assert_allclose(got, displacement[0], atol=1e-12 * np.ptp(displacement[0]))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("no_such_module:Loop", "cannot import 'no_such_module:Loop' (ModuleNotFoundError"),
        ("broken_module:Loop", "(ZeroDivisionError: division by zero); write module:Class"),
        (f"{HERE}:Stranger", "makes a Stranger, which is not a bwbayes.model.operator.Operator"),
        (f"{HERE}:Incomplete", "cannot be made: Can't instantiate abstract class Incomplete"),
        (f"{HERE}:Forgetful", 'declares d, alpha, beta, bend, width; the last must be "initial"'),
    ],
)
def test_what_is_no_operator_is_one_clear_line(
    name: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_module.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(tmp_path)
    bwbayes.write_record(record_of(BENT), tmp_path / "record.csv")
    with pytest.raises(InputError, match=r"^model\.hysteresis: [^\n]*$") as refused:
        resolve_config(parse(CONFIG.replace("HYSTERESIS", name), "outside.toml"), tmp_path)
    assert said in str(refused.value)


def test_bounds_that_ask_for_what_no_part_declares_are_refused() -> None:
    actuator = Actuator("lag", "first", 1e-3, Unbounded())
    said = "model: the bounds of d ask for 'alhpa', which no part here declares; declare it"
    with pytest.raises(InputError, match=f"^{said}$"):
        ParameterTable(actuator, noise_model("white", 1e-3))


def test_an_option_that_an_operator_from_outside_does_not_have_is_refused() -> None:
    with pytest.raises(InputError, match="has no option passive; remove it"):
        build_part("model.hysteresis", BENT, HYSTERESIS, {"passive": True}, Operator)


def test_a_noise_or_filter_from_outside_is_checked_too() -> None:
    assert type(NOISES["white"](interval=1.0)) is type(
        noise_model("bwbayes.inference.noise:WhiteNoise", 1.0)
    )
    with pytest.raises(InputError, match="has no option interval"):
        noise_model("bwbayes.model.linear:Lag", 1.0)
