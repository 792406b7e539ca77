"""The virtual stand makes every part that a model can have, with a truth that a fit can recover.

A record's truth is what the fitted model computes from the stated true values and the amplifier's
output, to rounding: with any operator, gain, creep and dynamics. Without a word in the config the
stand is the paper's ring bender, and its records are the same to the last level of the ADC as they
were when it could be nothing else.
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from bwbayes.app.config.config import parse
from bwbayes.app.problem.problem import Problem, resolve
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.registry import DYNAMICS, HYSTERESIS, made
from bwbayes.record.teststand import Amplifier, LaserSensor, VirtualTestStand
from bwbayes.record.waveforms import signal

RATE = 100.0
SIGNAL = "{ amplitude = 90.0, frequency = 1.0, duration = 4.0, decay = 0.2 }"
MECHANICS = "".join(
    f"{name} = {{ fixed = {value} }}\n"
    for name, value in (("mass", 0.00134), ("damping", 1580.0), ("stiffness", 4.1e5))
)

EVERY = {name: f"hysteresis = '{name}'\n" for name in HYSTERESIS} | {
    "duhem with even terms": "hysteresis = 'duhem'\nodd = false\n",
    "plays at given thresholds": "hysteresis = 'plays'\nthresholds = [5.0, 20.0]\n",
    "gain": "gain = ['quadratic', 'cubic']\n",
    "creep": "creep = true\n",
    "creep that grows": "creep = [0.5, 5.0]\ncreep_growth = true\n",
    "all": "hysteresis = 'preisach'\ngain = ['quadratic']\ncreep = [2.0]\n",
}


def of(stand: str, model: str, folder: Path, more: str = "", record: str = "") -> Problem:
    """Resolve a config with an actuator on the stand and a model of it."""
    text = (
        f"[record]\nsignal = {SIGNAL}\n{record}"
        f"[stand]\ndiscrepancy = 'none'\nsample_rate = {RATE}\n"
        f"[stand.model]\n{stand}[model]\nnoise = 'white'\n{model}{more}"
    )
    return resolve(parse(text, "config"), folder)


def reproduced(problem: Problem) -> FloatArray:
    """Return what the fitted model makes of the stated truth and the amplifier's output."""
    posterior, truth = problem.posterior, problem.config.truth
    actuator = posterior.likelihood.actuator
    true = {"initial": 0.0} | truth
    theta = np.array([[true[name] for name in actuator.parameters]])
    output = Amplifier().output(posterior.only.voltage, actuator.interval)
    from_rest = "initial" not in truth
    displacement: FloatArray = actuator.displacement(theta, output, from_rest=from_rest)[0]
    return displacement


def assert_reproduced(problem: Problem) -> None:
    truth = problem.record.truth
    assert truth is not None
    np.testing.assert_allclose(reproduced(problem), truth, rtol=0, atol=1e-12 * np.ptp(truth))


@pytest.mark.parametrize("parts", EVERY)
def test_the_model_reproduces_the_stands_record_with_the_stated_truth(
    parts: str, tmp_path: Path
) -> None:
    stand = EVERY[parts]
    lag = "" if "dynamics" in stand else "dynamics = 'lag'\n"
    problem = of(stand + lag, stand + lag, tmp_path)
    names = {p.name for p in problem.parameters} - {"initial"}
    assert names <= set(problem.config.truth)
    assert_reproduced(problem)


@pytest.mark.parametrize("dynamics", DYNAMICS)
def test_so_it_does_with_all_dynamics(dynamics: str, tmp_path: Path) -> None:
    parts = f"hysteresis = 'prandtl-ishlinskii'\ndynamics = '{dynamics}'\n"
    more = f"[parameters]\n{MECHANICS}" if dynamics == "second-order" else ""
    assert_reproduced(of(parts, parts, tmp_path, more))


@pytest.mark.parametrize("name", ["duhem", "prandtl-ishlinskii", "jiles-atherton"])
def test_so_it_does_from_a_state_that_is_stated(name: str, tmp_path: Path) -> None:
    parts = f"hysteresis = '{name}'\ndynamics = 'lag'\n"
    true = "[stand.parameters]\ninitial = 0.4\n"
    problem = of(parts, parts, tmp_path, true)
    assert problem.config.truth["initial"] == 0.4
    assert_reproduced(problem)


def test_twin_another_value_does_not_reproduce_it(tmp_path: Path) -> None:
    parts = "hysteresis = 'preisach'\ndynamics = 'lag'\n"
    problem = of(parts, parts, tmp_path, "[truth]\nsaturation = 199.0\n")
    with pytest.raises(AssertionError):
        assert_reproduced(problem)


@pytest.mark.parametrize("name", [name for name in HYSTERESIS if name != "linear"])
def test_every_operator_is_an_actuator_of_the_ring_benders_size(name: str) -> None:
    """Its range at 100 V within a quarter, the opening of its loop within a half.

    A linear actuator has no loop to open.
    """
    voltage = 100 * np.sin(np.arange(2000) * 2 * np.pi / 1000)

    def size(operator: str) -> tuple[float, float]:
        actuator = Actuator("none", "zero", 1e-3, made("", operator, HYSTERESIS, {}))
        stand = VirtualTestStand("none", sensor=LaserSensor(sd=0.0), actuator=actuator)
        truth = stand.run(voltage, np.random.default_rng(1)).truth
        assert truth is not None
        return float(np.ptp(truth[1000:])), float(truth[1501] - truth[1001])

    np.testing.assert_allclose(size(name)[0], size("bouc-wen")[0], rtol=0.25)
    np.testing.assert_allclose(size(name)[1], size("bouc-wen")[1], rtol=0.5)


LEVELS = {
    "none": "41ad81fc7c39d3a9",
    "process": "657223cd6d81ace3",
    "structural": "2ed3767a738c0246",
}


@pytest.mark.parametrize("kind", LEVELS)
def test_the_default_is_the_ring_bender_as_it_always_was(
    kind: Literal["none", "process", "structural"],
) -> None:
    record = VirtualTestStand(kind, RATE).run(signal("identification"), np.random.default_rng(7))
    assert record.displacement is not None
    levels = np.round(record.displacement / LaserSensor().step).astype("<i4")
    assert LEVELS[kind] == sha256(levels.tobytes()).hexdigest()[:16]


@pytest.mark.parametrize(
    ("stand", "true", "said"),
    [
        ("hysteresis = 'plais'\n", "", "stand.model.hysteresis: 'plais' is unknown; "),
        ("odd = true\n", "", "stand.model.hysteresis: 'bouc-wen' has no option odd"),
        ("creep_growth = true\n", "", "stand.model.creep_growth: there is no creep"),
        ("", "bete = 0.1\n", "test stand: bete: its actuator has no such parameter; .*beta"),
        ("", "alpha = -1.0\n", "test stand: alpha: -1 "),
        ("gain = ['square']\n", "", "stand.gain: 'square' is unknown"),
    ],
)
def test_what_the_stand_cannot_be_is_said_in_one_line(
    stand: str, true: str, said: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=f"^{said}"):
        of(stand, "", tmp_path, f"[stand.parameters]\n{true}")
