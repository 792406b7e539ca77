"""The virtual stand has the paper's electronics, actuator and sensor, and the stated discrepancies.

Tests of random quantities allow four standard errors (false alarms: 6 in 100,000) unless they say
otherwise; their seeds are fixed.
"""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from bwbayes.app.config.config import parse
from bwbayes.app.fit.fitted import Run
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, InputWarning
from bwbayes.model.actuator import Actuator
from bwbayes.model.operators.bouc_wen import hysteresis
from bwbayes.model.registry import HYSTERESIS, build_part
from bwbayes.record.teststand import Amplifier, LaserSensor, VirtualTestStand, creep
from bwbayes.record.waveforms import Waveform, signal, sine, triangle

MILLISECOND = 1e-3


def generator(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def truth_of(stand: VirtualTestStand, drive: Waveform | FloatArray, seed: int = 1) -> FloatArray:
    truth = stand.run(drive, generator(seed)).truth
    assert truth is not None
    return truth


def scalar_output(command: FloatArray) -> list[float]:
    """DAC, limit and slew, one sample at a time, with the paper's numbers."""
    levels = [round(volt / 20 / (20 / 4096)) * (20 / 4096) * 20 for volt in command]
    output = [levels[0]]
    for required in levels[1:]:
        most = 0.065 / 940e-9 * MILLISECOND
        change = min(max(-100.0, min(100.0, required)) - output[-1], most)
        output.append(output[-1] + max(change, -most))
    return output


def scalar_displacement(command: FloatArray) -> list[float]:
    """Equation (7) for a drive held over each interval, by the matrix exponential."""
    output = scalar_output(command)
    hysteretic = hysteresis(output, 0.3575, 0.0272, 0.0172)[0]
    rates = np.array([[0.0, 1.0], [-4.10e5 / 0.00134, -1580 / 0.00134]])
    transition = expm(rates * MILLISECOND)
    drive = [0.7 * u - h for u, h in zip(output, hysteretic, strict=True)]
    state, result = np.array([drive[0], 0.0]), [drive[0]]
    for held in drive[:-1]:
        rest = np.array([held, 0.0])
        state = rest + transition @ (state - rest)
        result.append(float(state[0]))
    return result


@pytest.mark.parametrize(
    "drive",
    [
        signal("identification"),
        signal("step100"),
        Waveform(triangle(95.0, 3.0), duration=3.0, decay=0.3, decay_from=0.5),
    ],
    ids=["identification", "step100", "triangle"],
)
def test_without_discrepancy_the_truth_is_a_slow_scalar_integration(drive: Waveform) -> None:
    command = drive.sample(1000.0)[1]
    truth = truth_of(VirtualTestStand("none"), drive)
    np.testing.assert_allclose(scalar_displacement(command), truth, rtol=0, atol=1e-8)


def test_a_command_beyond_100_volts_is_limited_and_said_so() -> None:
    drive = Waveform(sine(130.0, 1.0), duration=1.0)
    with pytest.warns(InputWarning, match="reaches 130 V, the amplifier limits it to 100 V"):
        record = VirtualTestStand("none").run(drive, generator())
    output = Amplifier().output(record.voltage, MILLISECOND)
    np.testing.assert_array_equal([-100.0, 100.0], [output.min(), output.max()])
    np.testing.assert_allclose(130.0, record.voltage.max(), rtol=1e-12)


def test_the_sensors_noise_has_an_sd_of_half_a_micrometre() -> None:
    record = VirtualTestStand("process").run(signal("verification"), generator())
    assert record.displacement is not None
    assert record.truth is not None
    noise = record.displacement - record.truth
    error = 0.5 / math.sqrt(2 * noise.size)
    np.testing.assert_allclose(0.5, noise.std(), rtol=0, atol=4 * error)
    np.testing.assert_allclose(0.0, noise.mean(), rtol=0, atol=4 * 0.5 / math.sqrt(noise.size))


def test_the_process_is_stationary_and_forgets_exponentially_in_half_a_second() -> None:
    """The truth at a command of zero: 600 seeds."""
    stand, command, seeds = VirtualTestStand("process"), np.zeros(1001), 600
    processes = np.stack([truth_of(stand, command, seed) for seed in range(seeds)])
    for sample in (0, 1, 10, 500, 1000):
        values = processes[:, sample]
        np.testing.assert_allclose(1.5, values.std(), rtol=4 / math.sqrt(2 * seeds))
        np.testing.assert_allclose(0.0, values.mean(), rtol=0, atol=4 * 1.5 / math.sqrt(seeds))
    for lag in (50, 250, 500, 1000):
        expected = math.exp(-lag * MILLISECOND / 0.5)
        got = np.corrcoef(processes[:, 0], processes[:, lag])[0, 1]
        error = (1 - expected**2) / math.sqrt(seeds)
        np.testing.assert_allclose(expected, got, rtol=0, atol=4 * error)


def test_creep_of_a_step_is_one_percent_per_decade() -> None:
    risen = creep(np.full(100_001, 60.0), MILLISECOND)
    for before, after in ((0.1, 1.0), (1.0, 10.0), (10.0, 100.0), (0.3, 3.0), (20.0, 40.0)):
        first, last = round(before / MILLISECOND), round(after / MILLISECOND)
        expected = 0.01 * 60.0 * math.log10(after / before)
        np.testing.assert_allclose(expected, risen[last] - risen[first], rtol=0.01)


def test_the_structural_even_term_is_one_micrometre_at_100_volts() -> None:
    """Actuator and creep are odd in the voltage: their sum over both signs is even term + drift."""
    stand = VirtualTestStand("structural")
    drift = np.linspace(0.0, 0.5, 11_000)
    for height, expected in ((100.0, 1.0), (50.0, 0.25)):
        command = signal(f"step{height:.0f}").sample(1000.0)[1]
        even = (truth_of(stand, command) + truth_of(stand, -command)) / 2 - drift
        # The amplifier steps at sample 1000; what it moves is seen one sample later.
        np.testing.assert_allclose(0.0, even[:1001], rtol=0, atol=1e-12)
        # From 0.2 s after the step on the dynamics have settled.
        np.testing.assert_allclose(expected, even[1200:], rtol=1e-3)


def test_bad_input_is_named_in_one_line() -> None:
    stand = VirtualTestStand("none")
    with pytest.raises(InputError, match=r"^test stand: discrepancy: no 'noise'; .*'process'"):
        VirtualTestStand("noise")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^test stand: sample_rate: 0.0 Hz"):
        VirtualTestStand(sample_rate=0.0)
    for voltage in ([0.0], [[0.0, 1.0]], [0.0, np.nan], []):
        with pytest.raises(InputError, match=r"^test stand: voltage of shape"):
            stand.run(voltage, generator())
    with pytest.raises(InputError, match="cannot resolve 600 Hz"):
        stand.run(Waveform(sine(1.0, 600.0), 1.0), generator())


# Any actuator on the stand: its truth is what the fitted model computes, to rounding

RATE = 100.0
MECHANICS = """[parameters]
mass = { fixed = 0.00134 }
damping = { fixed = 1580.0 }
stiffness = { fixed = 4.1e5 }
"""
SIGNAL = "{ amplitude = 90.0, frequency = 1.0, duration = 4.0, decay = 0.2 }"

EVERY = {name: f"hysteresis = '{name}'\n" for name in HYSTERESIS} | {
    "duhem with even terms": "hysteresis = 'duhem'\nodd = false\n",
    "plays at given thresholds": "hysteresis = 'plays'\nthresholds = [5.0, 20.0]\n",
    "no dynamics": "hysteresis = 'prandtl-ishlinskii'\ndynamics = 'none'\n",
    "second order": "hysteresis = 'prandtl-ishlinskii'\ndynamics = 'second-order'\n",
    "gain": "nonlinearity = ['quadratic', 'cubic']\n",
    "creep": "creep = true\n",
    "creep that grows": "creep = [0.5, 5.0]\ncreep_growth = true\n",
    "all": "hysteresis = 'preisach'\nnonlinearity = ['quadratic']\ncreep = [2.0]\n",
}


def of(stand: str, model: str, folder: Path, more: str = "", record: str = "") -> Run:
    text = (
        f"[record]\nsignal = {SIGNAL}\n{record}"
        f"[stand]\ndiscrepancy = 'none'\nsample_rate = {RATE}\n"
        f"[stand.model]\n{stand}[model]\nnoise = 'white'\n{model}{more}"
    )
    return resolve_config(parse(text, "config"), folder)


def assert_reproduced(problem: Run) -> None:
    """Compute the record's truth by the fitted model from the true values and the output."""
    posterior, true = problem.study.posterior, problem.config.truth
    actuator, truth = posterior.likelihood.actuator, problem.study.record.truth
    theta = np.array([[({"initial": 0.0} | true)[name] for name in actuator.parameters]])
    output = Amplifier().output(posterior.single_record.voltage, actuator.interval)
    (displacement,) = actuator.displacement(theta, output, from_rest="initial" not in true)
    assert truth is not None
    np.testing.assert_allclose(displacement, truth, rtol=0, atol=1e-12 * np.ptp(truth))


@pytest.mark.parametrize("parts", EVERY)
def test_the_model_reproduces_the_stands_record_with_the_stated_truth(
    parts: str, tmp_path: Path
) -> None:
    stand = EVERY[parts]
    lag = "" if "dynamics" in stand else "dynamics = 'lag'\n"
    problem = of(stand + lag, stand + lag, tmp_path, MECHANICS * (parts == "second order"))
    names = {p.name for p in problem.study.parameters} - {"initial"}
    assert names <= set(problem.config.truth)
    assert_reproduced(problem)


@pytest.mark.parametrize("name", ["duhem", "prandtl-ishlinskii", "jiles-atherton"])
def test_so_it_does_from_a_state_that_is_stated(name: str, tmp_path: Path) -> None:
    parts = f"hysteresis = '{name}'\ndynamics = 'lag'\n"
    problem = of(parts, parts, tmp_path, "[stand.parameters]\ninitial = 0.4\n")
    assert problem.config.truth["initial"] == 0.4
    assert_reproduced(problem)
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
        actuator = Actuator("none", "zero", 1e-3, build_part("", operator, HYSTERESIS, {}))
        stand = VirtualTestStand("none", sensor=LaserSensor(sd=0.0), actuator=actuator)
        truth = stand.run(voltage, np.random.default_rng(1)).truth
        assert truth is not None
        return float(np.ptp(truth[1000:])), float(truth[1501] - truth[1001])

    np.testing.assert_allclose(size(name)[0], size("bouc-wen")[0], rtol=0.25)
    np.testing.assert_allclose(size(name)[1], size("bouc-wen")[1], rtol=0.5)


@pytest.mark.parametrize(
    ("stand", "true", "said"),
    [
        ("hysteresis = 'plais'\n", "", "stand.model.hysteresis: 'plais' is unknown; "),
        ("odd = true\n", "", "stand.model.hysteresis: 'bouc-wen' has no option odd"),
        ("creep_growth = true\n", "", "stand.model.creep_growth: there is no creep"),
        ("", "bete = 0.1\n", "test stand: bete: its actuator has no such parameter; .*beta"),
        ("", "alpha = -1.0\n", "test stand: alpha: -1 "),
        ("nonlinearity = ['square']\n", "", "stand.nonlinearity: 'square' is unknown"),
    ],
)
def test_what_the_stand_cannot_be_is_said_in_one_line(
    stand: str, true: str, said: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=f"^{said}"):
        of(stand, "", tmp_path, f"[stand.parameters]\n{true}")
