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
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.stats import kstest

from bwbayes.arrays import FloatArray
from bwbayes.data.teststand import Amplifier, LaserSensor, RingBender, VirtualTestStand, creep
from bwbayes.data.waveforms import Multisine, Sine, Waveform, signal
from bwbayes.errors import InputError, InputWarning

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
        Waveform(Multisine.flat(95.0, (0.7, 3.0, 11.0)), duration=3.0),
    ],
    ids=["identification", "step100", "multisine"],
)
def test_without_discrepancy_the_truth_is_a_slow_scalar_integration(drive: Waveform) -> None:
    command = drive.sample(1000.0)[1]
    truth = truth_of(VirtualTestStand("none"), drive)
    np.testing.assert_allclose(scalar_displacement(command), truth, rtol=0, atol=1e-8)


def test_the_dac_has_levels_of_97_7_millivolts_at_the_electrode() -> None:
    command = signal("identification").sample(1000.0)[1]
    output = Amplifier().output(command, MILLISECOND)
    step = 20.0 * 20.0 / 4096
    np.testing.assert_allclose(0.0977, step, atol=5e-5)
    np.testing.assert_array_equal(np.round(output / step), output / step)
    assert np.abs(output - command).max() <= step / 2
    # The sine passes nearly all of the 2049 levels between -100 V and 100 V.
    assert np.unique(output).size > 1900


def test_the_dac_and_the_limit_are_symmetric() -> None:
    command = signal("identification").sample(1000.0)[1]
    amplifier = Amplifier()
    np.testing.assert_array_equal(
        -amplifier.output(command, MILLISECOND), amplifier.output(-command, MILLISECOND)
    )


def test_a_command_beyond_100_volts_is_limited_and_said_so() -> None:
    drive = Waveform(Sine(130.0, 1.0), duration=1.0)
    with pytest.warns(InputWarning, match="reaches 130 V, the amplifier limits it to 100 V"):
        record = VirtualTestStand("none").run(drive, generator())
    output = Amplifier().output(record.voltage, MILLISECOND)
    np.testing.assert_array_equal([-100.0, 100.0], [output.min(), output.max()])
    np.testing.assert_allclose(130.0, record.voltage.max(), rtol=1e-12)


def test_a_100_volt_step_takes_two_samples_at_69_1_volts_per_millisecond() -> None:
    command = signal("step100").sample(1000.0)[1]
    output = Amplifier().output(command, MILLISECOND)
    slewed = 0.065 / 940e-9 * MILLISECOND
    np.testing.assert_allclose(69.1, slewed, atol=0.05)
    np.testing.assert_allclose([0, slewed, 100, 100], output[999:1003], rtol=1e-14)


def test_the_slew_holds_at_any_sample_rate_and_both_ways() -> None:
    command = np.array([100.0] * 2 + [-100.0] * 400)
    output = Amplifier().output(command, 1e-5)
    changes = np.diff(output)[1:]
    full = int(200.0 / 0.69148936)
    np.testing.assert_allclose(-0.69148936, changes[:full], rtol=1e-7)
    np.testing.assert_array_equal(-100.0, output[full + 2 :])


def test_the_amplifier_starts_settled_at_the_first_command() -> None:
    output = Amplifier().output(np.full(5, 100.0), MILLISECOND)
    np.testing.assert_array_equal(np.full(5, 100.0), output)


def test_the_adc_has_levels_of_30_5_nanometres() -> None:
    record = VirtualTestStand("none").run(signal("identification"), generator())
    assert record.displacement is not None
    step = 2000.0 / 65536
    np.testing.assert_allclose(0.0305, step, atol=5e-5)
    codes = record.displacement / step
    np.testing.assert_array_equal(np.round(codes), codes)
    assert np.gcd.reduce(codes.astype(np.int64)) == 1


def test_the_sensor_clips_at_its_two_millimetres() -> None:
    reading = LaserSensor().read(np.array([5000.0, -5000.0]), generator())
    np.testing.assert_array_equal([1000.0 - 2000.0 / 65536, -1000.0], reading)


def test_the_sensor_rounds_to_the_nearest_level() -> None:
    quiet = LaserSensor(sd=0.0)
    displacement = np.linspace(-70.0, 70.0, 4001)
    error = quiet.read(displacement, generator()) - displacement
    assert np.abs(error).max() <= 2000.0 / 65536 / 2
    np.testing.assert_allclose(2000.0 / 65536 / math.sqrt(12), error.std(), rtol=0.05)


def test_the_sensors_noise_has_an_sd_of_half_a_micrometre() -> None:
    noise = noise_of(VirtualTestStand("process"), signal("verification"))
    error = 0.5 / math.sqrt(2 * noise.size)
    np.testing.assert_allclose(0.5, noise.std(), rtol=0, atol=4 * error)
    np.testing.assert_allclose(0.0, noise.mean(), rtol=0, atol=4 * 0.5 / math.sqrt(noise.size))


def test_the_sensors_noise_is_white() -> None:
    """Autocorrelations at 20 lags within 4.5 standard errors (false alarms: 1.4 in 10,000)."""
    noise = noise_of(VirtualTestStand("process"), signal("verification"))
    lags = [np.mean(noise[lag:] * noise[:-lag]) / noise.var() for lag in range(1, 21)]
    np.testing.assert_allclose(np.zeros(20), lags, rtol=0, atol=4.5 / math.sqrt(noise.size))


def test_the_sensors_noise_is_gaussian() -> None:
    """Kolmogorov-Smirnov at 1 in 10,000 false alarms; 2,000 samples, so levels do not show."""
    noise = noise_of(VirtualTestStand("none"), np.zeros(2000))
    assert kstest(noise / 0.5, "norm").pvalue > 1e-4


def test_the_truth_is_smooth_where_the_reading_is_not() -> None:
    record = VirtualTestStand("none").run(signal("identification"), generator())
    assert record.truth is not None
    assert record.displacement is not None
    assert np.abs(np.diff(record.truth, 2)).max() < 0.1
    assert np.abs(np.diff(record.displacement, 2)).max() > 2.0


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


def test_the_process_moves_by_the_right_amount_in_one_sample(processes: FloatArray) -> None:
    moves = np.diff(processes)
    expected = 2 * 1.5**2 * (1 - math.exp(-MILLISECOND / 0.5))
    np.testing.assert_allclose(expected, np.mean(moves**2), rtol=4 * math.sqrt(2 / moves.size))


def test_the_process_is_the_default_and_adds_to_the_displacement() -> None:
    drive = signal("step50")
    process = truth_of(VirtualTestStand("process"), np.zeros(11_000), seed=3)
    bare = truth_of(VirtualTestStand("none"), drive)
    expected = bare + process
    np.testing.assert_allclose(expected, truth_of(VirtualTestStand(), drive, seed=3), atol=1e-12)


def test_creep_of_a_ramp_is_the_closed_form_of_its_lags() -> None:
    time: FloatArray = np.arange(5000.0) * MILLISECOND
    taus = 10.0 ** (np.arange(-4.0, 9.0) / 2)[:, np.newaxis]
    expected = (0.005 * (time + taus * np.expm1(-time / taus))).sum(axis=0)
    np.testing.assert_allclose(expected, creep(time, MILLISECOND), rtol=1e-6, atol=1e-13)


def test_creep_of_a_step_is_one_percent_per_decade() -> None:
    risen = creep(np.full(100_001, 60.0), MILLISECOND)
    for before, after in ((0.1, 1.0), (1.0, 10.0), (10.0, 100.0), (0.3, 3.0), (20.0, 40.0)):
        first, last = round(before / MILLISECOND), round(after / MILLISECOND)
        expected = 0.01 * 60.0 * math.log10(after / before)
        np.testing.assert_allclose(expected, risen[last] - risen[first], rtol=0.01)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32), st.floats(-3, 3), st.floats(-3, 3))
def test_creep_is_linear_in_the_displacement(seed: int, a: float, b: float) -> None:
    inputs = generator(seed).standard_normal((2, 50))
    weights = np.array([a, b])
    expected: FloatArray = weights @ [creep(each, MILLISECOND) for each in inputs]
    np.testing.assert_allclose(expected, creep(weights @ inputs, MILLISECOND), rtol=0, atol=1e-12)


def test_the_structural_drift_is_half_a_micrometre_over_the_record() -> None:
    truth = truth_of(VirtualTestStand("structural"), np.zeros(2001))
    np.testing.assert_allclose(np.linspace(0.0, 0.5, 2001), truth, rtol=0, atol=1e-14)


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


def test_the_structural_creep_is_one_percent_of_the_displacement_per_decade() -> None:
    def odd_part(kind: Literal["none", "structural"]) -> FloatArray:
        stand, command = VirtualTestStand(kind), signal("step100").sample(1000.0)[1]
        return (truth_of(stand, command) - truth_of(stand, -command)) / 2

    bare = odd_part("none")
    crept = odd_part("structural") - bare
    expected = 0.01 * bare[-1]
    np.testing.assert_allclose(expected, crept[1000 + 5000] - crept[1000 + 500], rtol=0.02)


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


def test_the_record_says_what_it_is() -> None:
    stand, drive = VirtualTestStand("structural", sample_rate=500.0), signal("step10")
    record = stand.run(drive, generator())
    np.testing.assert_array_equal(drive.sample(500.0)[1], record.voltage)
    np.testing.assert_array_equal([0.002, 0.0], [record.interval, record.start])
    expected = ("command", "virtual test stand, discrepancy structural")
    assert expected == (record.voltage_is, record.origin)


def test_the_records_voltage_is_the_command_before_the_dac() -> None:
    command = np.linspace(0.0, 0.04, 50)
    record = VirtualTestStand("none").run(command, generator())
    np.testing.assert_array_equal(command, record.voltage)
    # Below half a level the amplifier does not move.
    np.testing.assert_array_equal(np.zeros(50), record.truth)


def test_the_stand_does_not_keep_or_change_the_callers_array() -> None:
    command = np.linspace(0.0, 50.0, 100)
    record = VirtualTestStand("none").run(command, generator())
    command[:] = -1.0
    np.testing.assert_array_equal(np.linspace(0.0, 50.0, 100), record.voltage)


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


def test_another_actuator_can_be_put_on_the_stand() -> None:
    drive = signal("step10")
    bare = truth_of(VirtualTestStand("none"), drive)
    moved = truth_of(VirtualTestStand("none", table=RingBender(offset=5.0)), drive)
    np.testing.assert_allclose(bare + 5.0, moved, rtol=1e-14)


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
