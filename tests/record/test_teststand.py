"""The virtual stand has the paper's electronics, actuator and sensor, and the stated discrepancies.

Tests of random quantities allow four standard errors (false alarms: 6 in 100,000) unless they say
otherwise; their seeds are fixed.
"""

from __future__ import annotations

import itertools
import math
from typing import Literal

import numpy as np
import pytest
from scipy.linalg import expm

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, InputWarning
from bwbayes.record.teststand import Amplifier, VirtualTestStand, creep
from bwbayes.record.waveforms import Decay, Sine, Triangle, Waveform, signal

MILLISECOND = 1e-3


def generator(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def truth_of(stand: VirtualTestStand, drive: Waveform | FloatArray, seed: int = 1) -> FloatArray:
    truth = stand.run(drive, generator(seed)).truth
    assert truth is not None
    return truth


def noise_of(stand: VirtualTestStand, drive: Waveform | FloatArray) -> FloatArray:
    record = stand.run(drive, generator())
    assert record.displacement is not None
    assert record.truth is not None
    return record.displacement - record.truth


def scalar_output(command: FloatArray) -> list[float]:
    """DAC, limit and slew, one sample at a time, with the paper's numbers."""
    levels = [round(volt / 20 / (20 / 4096)) * (20 / 4096) * 20 for volt in command]
    output = [levels[0]]
    for required in levels[1:]:
        most = 0.065 / 940e-9 * MILLISECOND
        change = min(max(-100.0, min(100.0, required)) - output[-1], most)
        output.append(output[-1] + max(change, -most))
    return output


def scalar_hysteresis(output: list[float]) -> list[float]:
    """Equation (6) with Table 1, one sample at a time, by the solution of its two linear pieces."""
    ceiling = 0.3575 / (0.0272 + 0.0172)
    h = [0.0]
    for before, after in itertools.pairwise(output):
        sign, travel = math.copysign(1.0, after - before), abs(after - before)
        along = sign * h[-1]
        if along < 0:
            # Down to zero with the rate beta - gamma, and what is left of the way from there.
            reach = 0.3575 / (0.0272 - 0.0172)
            to_zero = math.log(1 - along / reach) / (0.0272 - 0.0172)
            part = min(travel, to_zero)
            along = reach + (along - reach) * math.exp(-(0.0272 - 0.0172) * part)
            travel -= part
        if travel > 0:
            along = ceiling + (along - ceiling) * math.exp(-(0.0272 + 0.0172) * travel)
        h.append(sign * along)
    return h


def scalar_displacement(command: FloatArray) -> list[float]:
    """Equation (7) for a drive held over each interval, by the matrix exponential."""
    output = scalar_output(command)
    hysteretic = scalar_hysteresis(output)
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
        Waveform(Triangle(95.0, 3.0), duration=3.0, decay=Decay(0.5, 0.7, "exponential")),
    ],
    ids=["identification", "step100", "triangle"],
)
def test_without_discrepancy_the_truth_is_a_slow_scalar_integration(drive: Waveform) -> None:
    command = drive.sample(1000.0)[1]
    truth = truth_of(VirtualTestStand("none"), drive)
    np.testing.assert_allclose(scalar_displacement(command), truth, rtol=0, atol=1e-8)


def test_a_command_beyond_100_volts_is_limited_and_said_so() -> None:
    drive = Waveform(Sine(130.0, 1.0), duration=1.0)
    with pytest.warns(InputWarning, match="reaches 130 V, the amplifier limits it to 100 V"):
        record = VirtualTestStand("none").run(drive, generator())
    output = Amplifier().output(record.voltage, MILLISECOND)
    np.testing.assert_array_equal([-100.0, 100.0], [output.min(), output.max()])
    np.testing.assert_allclose(130.0, record.voltage.max(), rtol=1e-12)


def test_the_sensors_noise_has_an_sd_of_half_a_micrometre() -> None:
    noise = noise_of(VirtualTestStand("process"), signal("verification"))
    error = 0.5 / math.sqrt(2 * noise.size)
    np.testing.assert_allclose(0.5, noise.std(), rtol=0, atol=4 * error)
    np.testing.assert_allclose(0.0, noise.mean(), rtol=0, atol=4 * 0.5 / math.sqrt(noise.size))


@pytest.fixture(scope="module")
def processes() -> FloatArray:
    """Process discrepancies (2000 seeds, 1001 samples), um: the truth at a command of zero."""
    stand, command = VirtualTestStand("process"), np.zeros(1001)
    return np.stack([truth_of(stand, command, seed) for seed in range(2000)])


def test_the_process_is_stationary_with_an_sd_of_1_5(processes: FloatArray) -> None:
    for sample in (0, 1, 10, 500, 1000):
        values = processes[:, sample]
        np.testing.assert_allclose(1.5, values.std(), rtol=4 / math.sqrt(2 * values.size))
        error = 1.5 / math.sqrt(values.size)
        np.testing.assert_allclose(0.0, values.mean(), rtol=0, atol=4 * error)


def test_the_process_forgets_exponentially_in_half_a_second(processes: FloatArray) -> None:
    for lag in (50, 250, 500, 1000):
        expected = math.exp(-lag * MILLISECOND / 0.5)
        got = np.corrcoef(processes[:, 0], processes[:, lag])[0, 1]
        error = (1 - expected**2) / math.sqrt(len(processes))
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


@pytest.mark.parametrize("kind", ["none", "process", "structural"])
def test_the_same_seed_gives_the_same_record_and_another_seed_another(
    kind: Literal["none", "process", "structural"],
) -> None:
    stand, drive = VirtualTestStand(kind), signal("step10")
    first, same, other = (stand.run(drive, generator(seed)) for seed in (7, 7, 8))
    assert first.displacement is not None
    assert other.displacement is not None
    np.testing.assert_array_equal(first.displacement, same.displacement)
    np.testing.assert_array_equal(first.truth, same.truth)
    assert np.mean(first.displacement != other.displacement) > 0.5


def test_the_true_parameters_are_table_1_in_micrometres_and_the_noise() -> None:
    table = {
        "d": 0.7,
        "alpha": 0.3575,
        "beta": 0.0272,
        "gamma": 0.0172,
        "exponent": 1.0,
        "initial": 0.0,
        "mass": 0.00134,
        "damping": 1580.0,
        "stiffness": 4.10e5,
        "offset": 0.0,
        "sensor_sd": 0.5,
    }
    process = {"discrepancy_sd": 1.5, "discrepancy_time": 0.5}
    expected = table | process
    assert expected == VirtualTestStand("process").parameters()
    assert table == VirtualTestStand("none").parameters()
    assert table == VirtualTestStand("structural").parameters()


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
        stand.run(Waveform(Sine(1.0, 600.0), 1.0), generator())
