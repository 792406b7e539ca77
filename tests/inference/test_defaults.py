"""Default priors: scales of the drive in its units, not of its sampling, and wide enough."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.arrays import FloatArray
from bwbayes.inference.defaults import join_ranges, ranges_of, rounding_sd
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Distribution, Ranges
from bwbayes.model.inputs import Inputs
from bwbayes.record.teststand import RingBender
from tests.declared import NAMES as EVERY, context, declared, joint, parameter

NAMES = tuple(name for name in EVERY if name not in ("mass", "stiffness", "exponent"))
HYSTERESIS = ("d", "alpha", "beta", "gamma", "exponent", "initial")


def drive(amplitude: float = 100.0, interval: float = 1e-3, bias: float = 0.0) -> FloatArray:
    """Return ten seconds of 1 Hz that decay to a half."""
    time = np.arange(0, 10, interval)
    voltage: FloatArray = bias + amplitude * np.sin(2 * np.pi * time) * (1 - 0.05 * time)
    return voltage


def displacement(voltage: FloatArray, interval: float = 1e-3) -> FloatArray:
    """Return that of the ring bender with a lag of 20 ms, um."""
    actuator = Actuator("lag", "first", interval)
    table = RingBender()
    theta = [0.02 if n == "lag" else getattr(table, n) for n in actuator.parameters]
    clean: FloatArray = actuator.displacement(np.array([theta]), voltage)[0]
    return clean


def prior(name: str, ranges: Ranges, exponent: float | Distribution = 1.0) -> Distribution:
    result = declared(name).default(context(ranges, exponent, 4.1e5))
    assert isinstance(result, Distribution)
    return result


def score(name: str, value: float, ranges: Ranges) -> float:
    """Return how many prior sds a value lies from the median."""
    result = prior(name, ranges)
    ends = np.array([-np.inf, np.inf])
    return float(result.to_normal(np.array([value]), ends[0], ends[1])[0])


@given(every=st.integers(1, 20), amplitude=st.floats(10, 150), bias=st.floats(-50, 50))
def test_record_and_its_every_kth_sample_have_nearly_the_same_priors(
    every: int, amplitude: float, bias: float
) -> None:
    voltage = drive(amplitude, bias=bias)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(voltage.size)
    reading = displacement(voltage) + noise
    whole = ranges_of(Inputs(voltage, interval=1e-3), reading)
    part = ranges_of(Inputs(voltage[::every], interval=every * 1e-3), reading[::every])
    for name in NAMES:
        one, other = prior(name, whole), prior(name, part)
        quantiles = [p.frozen.ppf([0.16, 0.5, 0.84]) for p in (one, other)]
        # Within a tenth of the prior's sd.
        sd = np.ptp(quantiles[0]) / 2
        np.testing.assert_allclose(quantiles[0], quantiles[1], atol=0.1 * sd, err_msg=name)


@pytest.mark.parametrize("rate", [25.0, 5000.0])
def test_times_of_a_1_hz_drive_are_those_that_actuators_show(rate: float) -> None:
    """A lag of 0.5 to 50 ms lies within 1.4 sds, a discrepancy's 0.1 to 0.7 s within 1.5."""
    voltage = drive(interval=1 / rate)
    ranges = ranges_of(Inputs(voltage, interval=1 / rate), displacement(voltage, 1 / rate))
    for lag in (0.5e-3, 5e-3, 20e-3, 50e-3):
        assert abs(score("lag", lag, ranges)) < 1.4
        assert abs(score("damping", 4.1e5 * lag, ranges)) < 1.4
    for time in (0.1, 0.25, 0.5, 0.7):
        assert abs(score("discrepancy_time", time, ranges)) < 1.5
    assert prior("discrepancy_time", ranges).frozen.median() == pytest.approx(0.25, rel=0.05)


def share_below(ranges: Ranges, exponent: float | Distribution, **values: float) -> list[float]:
    """Return the part of the cut prior below each value; |gamma| <= beta and others cut it."""
    parameters = []
    for name in HYSTERESIS:
        known = exponent if name == "exponent" else prior(name, ranges, exponent)
        parameters.append(parameter(name, known))
    cut = joint(parameters)
    draws = cut.draw(np.random.default_rng(1), 4000)
    return [float(np.mean(draws[:, cut.free_names.index(n)] < v)) for n, v in values.items()]


@pytest.mark.parametrize(
    ("amplitude", "bias"),
    [(a, b) for a in (2.0, 5.0, 20.0, 100.0, 200.0) for b in (0.0, 1.0)]
    + [(2.0, 20.0), (20.0, 4.0)],
)
def test_true_parameters_lie_well_inside_whatever_the_drive(amplitude: float, bias: float) -> None:
    """Within the central 98% of the cut prior, and 95% of the offset's."""
    voltage = drive(amplitude, bias=bias * amplitude)
    ranges = ranges_of(Inputs(voltage, interval=1e-3), displacement(voltage))
    shares = share_below(ranges, 1.0, d=0.7, alpha=0.3575, beta=0.0272, gamma=0.0172)
    assert 0.01 < min(shares), shares
    assert max(shares) < 0.99, shares
    assert abs(score("offset", 0.0, ranges)) < 2


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("free", [True, False])
def test_scales_of_beta_and_gamma_follow_the_exponent(exponent: float, free: bool) -> None:
    """What is a rate of 0.0272 / V at an h of 8 um lies inside, be the exponent known or free."""
    voltage = drive()
    ranges = ranges_of(Inputs(voltage, interval=1e-3), displacement(voltage))
    given = Distribution("uniform", {"lower": 1.0, "upper": 5.0}) if free else exponent
    unit = 8.0 ** (1 - exponent)
    shares = share_below(ranges, given, beta=0.0272 * unit, gamma=0.0172 * unit)
    assert 0.01 < min(shares), shares
    assert max(shares) < 0.99, shares


# Powers of k and m by which a parameter grows if displacements are k and voltages m times as large.
# With another exponent n, beta and gamma grow by k^(1 - n) / m.
POWERS = {
    "d": (1, -1),
    "alpha": (1, -1),
    "beta": (0, -1),
    "gamma": (0, -1),
    "initial": (1, 0),
    "offset": (1, 0),
    "lag": (0, 0),
    "sensor_sd": (1, 0),
    "discrepancy_sd": (1, 0),
    "discrepancy_time": (0, 0),
}


def half_width(name: str, exponent: float, k: float = 1.0, m: float = 1.0) -> float:
    """Return half of the central 68% of a default prior, given k and m."""
    voltage = drive()
    ranges = ranges_of(Inputs(m * voltage, interval=1e-3), k * 0.6 * voltage)
    low, high = prior(name, ranges, exponent).frozen.ppf([0.16, 0.84])
    return float(high - low) / 2


@pytest.mark.parametrize("exponent", [1.0, 1.5, 3.0])
@pytest.mark.parametrize("name", POWERS)
def test_a_default_prior_goes_with_the_units(name: str, exponent: float) -> None:
    """Within the three digits that a default prior has."""
    of_k, of_m = map(float, POWERS[name])
    if name in ("beta", "gamma"):
        of_k = 1 - exponent
    for k, m in ((1000.0, 1.0), (1.0, 0.001), (0.03, 7.0)):
        grown = half_width(name, exponent, k, m) / half_width(name, exponent)
        np.testing.assert_allclose(k**of_k * m**of_m, grown, rtol=0.01)


@given(digits=st.integers(0, 3), scale=st.floats(0.1, 10), seed=st.integers(0, 9))
def test_readings_without_noise_have_that_of_rounding(digits: int, scale: float, seed: int) -> None:
    """Of q/√12 in multiples of q, of 2⁻²⁴ of the range in others; none is said of noisy readings.

    Scaled readings have a scaled rounding.
    """
    clean = scale * displacement(drive(interval=2e-3), 2e-3)
    finest = 2.0**-24 * np.ptp(clean) / np.sqrt(12)
    assert rounding_sd(clean) == pytest.approx(finest)
    step = scale * 10.0**-digits
    rounded = step * np.round(clean / step)
    assert rounding_sd(rounded) == pytest.approx(step / np.sqrt(12), rel=1e-6)
    noise = np.random.default_rng(seed).standard_normal(clean.size)
    assert rounding_sd(clean + 1e-4 * np.ptp(clean) * noise) == 0
    assert rounding_sd(step * np.round((clean + step * noise) / step)) == 0


def test_readings_that_jump_have_a_sensor_as_good_as_a_converter_at_best() -> None:
    """They hide their noise; the prior's median and width are those of readings that show it."""
    voltage = np.repeat(np.random.default_rng(0).uniform(-60, 60, 100), 4)
    jumping, smooth = 0.7 * voltage, displacement(drive())
    ranges = ranges_of(Inputs(voltage, interval=1e-3), jumping)
    least, usual = prior("sensor_sd", ranges), prior("sensor_sd", replace(ranges, resolution=0.0))
    finest = 2.0**-24 * np.ptp(jumping) / np.sqrt(12)
    assert least.support[0] == pytest.approx(finest, rel=0.01)
    quantiles = np.array([0.01, 0.5, 0.99])
    shifted = least.support[0] + usual.frozen.ppf(quantiles)
    np.testing.assert_allclose(least.frozen.ppf(quantiles), shifted, rtol=1e-12)
    noise = 0.1 * np.random.default_rng(0).standard_normal(smooth.size)
    for readings in (smooth, smooth + noise):
        assert ranges_of(Inputs(drive(), interval=1e-3), readings).resolution == 0


def test_a_record_without_noise_has_a_sensor_as_good_as_its_rounding_at_best() -> None:
    """Its density would have no bound; several records have a sensor of the finest of them."""
    voltage = drive()
    clean = displacement(voltage)
    noise = 0.1 * np.random.default_rng(0).standard_normal(clean.size)
    exact, rounded, noisy = (
        ranges_of(Inputs(voltage, interval=1e-3), readings)
        for readings in (clean, np.round(clean, 2), clean + noise)
    )
    assert prior("sensor_sd", rounded).support[0] == pytest.approx(0.01 / np.sqrt(12), rel=0.01)
    assert (
        prior("sensor_sd", join_ranges([exact, rounded])).support
        == prior("sensor_sd", exact).support
    )
    assert prior("sensor_sd", join_ranges([rounded, noisy])).support[0] == 0
