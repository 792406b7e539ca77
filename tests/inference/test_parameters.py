"""The joint prior: one density in two sets of coordinates, its draws, constraints and defaults."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import stats
from scipy.special import logsumexp

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.defaults import join_ranges, ranges_of, rounding_sd
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Distribution, Ranges
from bwbayes.model.inputs import Inputs
from bwbayes.model.operators.bouc_wen import ceiling
from bwbayes.record.teststand import TABLE_1
from tests.declared import NAMES as EVERY, context, declared, joint, parameter
from tests.inference.problems import joint_prior, single

HYSTERESIS = ("d", "alpha", "beta", "gamma", "exponent", "initial")
ALL = (*HYSTERESIS, "lag", "offset", "sensor_sd", "discrepancy_sd", "discrepancy_time")
RANGES = Ranges(voltage=100.0, displacement=60.0, middle=3.0, time=0.5, duration=8.0)

WIDE = {
    # Priors that the constraints cut hard, on every side.
    "d": Distribution("lognormal", {"median": 0.5, "sigma": 0.8}),
    "alpha": Distribution("lognormal", {"median": 0.5, "sigma": 0.8}),
    "beta": Distribution("halfnormal", {"scale": 0.03}),
    "gamma": Distribution("normal", {"mean": 0.01, "sd": 0.04}),
    "exponent": Distribution("uniform", {"lower": 0.5, "upper": 3.0}),
    "initial": Distribution("normal", {"mean": 2.0, "sd": 20.0}),
}


def normal(mean: float, sd: float) -> Distribution:
    return Distribution("normal", {"mean": mean, "sd": sd})


def cut_prior(**fixed: float) -> JointPrior:
    return joint_prior(HYSTERESIS, RANGES, fixed, WIDE)


def active(prior: JointPrior) -> JointPrior:
    """Return a prior without the constraint that gamma lies below beta."""
    return joint(list(prior.parameters), passive=False)


PRIORS = {
    "default": joint_prior(ALL, RANGES, {}),
    "summed": joint_prior((*ALL, "delay"), RANGES, {}),
    "cut": cut_prior(),
    "alpha fixed": cut_prior(alpha=0.6),
    "gamma fixed": cut_prior(gamma=-0.03),
    "exponent fixed": cut_prior(exponent=1.0),
    "active": active(cut_prior()),
    "active, beta fixed": active(cut_prior(beta=0.01)),
    "active, initial fixed": active(cut_prior(initial=3.0)),
}


@pytest.mark.parametrize("name", PRIORS)
def test_coordinates_and_parameters_have_one_density(name: str) -> None:
    """With derivatives by differences, log p(z) = log p(x) + log |dx/dz| up to one constant."""
    prior = PRIORS[name]
    z = 1.2 * np.random.default_rng(1).standard_normal((200, prior.dimensions))
    free, log_prior = prior.constrain(z)
    # Only an initial state that is fixed beyond the ceiling is outside.
    inside = np.isfinite(log_prior)
    np.testing.assert_array_equal(inside, np.isfinite(prior.log_density(free)))
    assert np.sum(inside) > 50
    step = 1e-4
    jacobians = np.empty((200, prior.dimensions, prior.dimensions))
    for column in range(prior.dimensions):
        move = step * np.eye(prior.dimensions)[column]
        difference = prior.constrain(z + move)[0] - prior.constrain(z - move)[0]
        jacobians[:, :, column] = difference / (2 * step)
    # Rows and columns differ in scale by many powers of ten; the determinant does not care.
    volume = np.linalg.slogdet(jacobians[inside])[1]
    difference = prior.log_density(free[inside]) + volume - log_prior[inside]
    np.testing.assert_allclose(difference, np.median(difference), atol=2e-5)


@pytest.mark.parametrize("name", PRIORS)
def test_parameters_and_coordinates_round_trip(name: str) -> None:
    prior = PRIORS[name]
    z = np.clip(2 * np.random.default_rng(2).standard_normal((500, prior.dimensions)), -5, 5)
    np.testing.assert_allclose(z, prior.unconstrain(prior.constrain(z)[0]), atol=1e-5)


def test_the_coordinate_of_a_delay_is_that_of_its_sum_with_the_lag() -> None:
    """A record determines the sum: its posterior is straight, whatever the lag."""
    prior = PRIORS["summed"]
    lag, delay = (prior.free_names.index(name) for name in ("lag", "delay"))
    lags = np.array([0.0, 1e-6, 1e-3, 4e-3])[:, np.newaxis]
    free = np.repeat(prior.constrain(np.zeros((1, prior.dimensions)))[0], len(lags), axis=0)
    free[:, [lag]], free[:, [delay]] = lags, -0.012 - lags
    np.testing.assert_allclose(np.ptp(prior.unconstrain(free)[:, delay]), 0.0, atol=1e-9)


def violations(prior: JointPrior, free: FloatArray) -> list[str]:
    v = dict(zip(prior.names, prior.theta(free).T, strict=True))
    (gamma,) = (p.declared for p in prior.parameters if p.name == "gamma")
    passive = gamma is not None and gamma.stated_bounds == "|gamma| <= beta"
    top = ceiling(v["alpha"], v["beta"], v["gamma"], v["exponent"])
    allowed = {
        "0 < alpha < d": (v["alpha"] > 0) & (v["alpha"] <= v["d"]),
        "|gamma| <= beta": (np.abs(v["gamma"]) <= v["beta"])
        | (np.array(not passive) & (v["gamma"] >= -v["beta"])),
        "exponent": v["exponent"] >= 1,
        "initial": (np.abs(v["initial"]) <= top * (1 + 1e-12))
        | (("initial" not in prior.free_names) & (v["gamma"] <= v["beta"])),
    }
    return [name for name, holds in allowed.items() if not holds.all()]


@pytest.mark.parametrize("name", PRIORS)
def test_constraints_hold_for_draws_and_at_any_coordinates(name: str) -> None:
    prior, generator = PRIORS[name], np.random.default_rng(3)
    assert [] == violations(prior, prior.draw(generator, 2000))
    z = 10 * generator.standard_normal((2000, prior.dimensions))
    free, log_prior = prior.constrain(z)
    assert np.isfinite(free).all()
    assert [] == violations(prior, free[np.isfinite(log_prior)])


def test_outside_the_constraints_the_density_is_zero() -> None:
    inside = np.array([0.7, 0.36, 0.027, 0.017, 1.5, 0.5])
    prior = PRIORS["cut"]
    assert np.isfinite(prior.log_density(inside[np.newaxis]))
    for column, value in [
        (0, 0.35),  # d below alpha
        (1, 0.71),
        (1, -0.1),
        (2, 0.016),  # beta below gamma
        (3, 0.028),
        (3, -0.028),
        (4, 0.9),
        (5, 60.0),
        (5, -60.0),
        (0, np.nan),
    ]:
        outside = inside.copy()
        outside[column] = value
        assert -np.inf == prior.log_density(outside[np.newaxis])[0]


def test_draws_have_the_density_that_log_density_says() -> None:
    """Means of draws against importance sampling, z-scores below 4.

    Twelve statistics: one false alarm in 1,300 runs (the seed is fixed). The standard errors of
    the means are below 0.009 sd, so a shift of 0.06 sd is found with probability 0.99.
    """
    prior, generator = PRIORS["cut"], np.random.default_rng(4)
    draws = prior.unconstrain(prior.draw(generator, 20_000))
    # Uniform in the box |z| < 5 does not work in six dimensions; a wide normal does.
    z = 1.3 * generator.standard_normal((200_000, prior.dimensions))
    log_weight = prior.constrain(z)[1] + np.sum((z / 1.3) ** 2, axis=1) / 2
    weight = np.exp(log_weight - logsumexp(log_weight))
    for power in (1, 2):
        expected = weight @ z**power
        spread = np.sum((weight[:, np.newaxis] * (z**power - expected)) ** 2, axis=0)
        error = np.sqrt(spread + np.var(draws**power, axis=0) / len(draws))
        scores = (np.mean(draws**power, axis=0) - expected) / error
        assert np.max(np.abs(scores)) < 4, scores


def test_bounds_truncate_the_prior() -> None:
    prior = single("offset", normal(0.0, 1.0), lower=0.5, upper=2.0)
    cut = stats.truncnorm(0.5, 2.0)
    draws = prior.draw(np.random.default_rng(6), 5000)
    assert stats.kstest(draws[:, 0], cut.cdf).pvalue > 1e-4
    z = np.linspace(-3, 3, 13)[:, np.newaxis]
    np.testing.assert_allclose(cut.ppf(stats.norm.cdf(z)), prior.constrain(z)[0], atol=1e-9)
    outside = prior.log_density(np.array([[0.4], [0.6], [2.1]]))
    assert [False, True, False] == np.isfinite(outside).tolist()


@pytest.mark.parametrize(
    ("name", "what", "says"),
    [
        ("offset", {}, "give either a prior or a fixed value"),
        ("offset", {"prior": normal(0, 1), "fixed": 1.0}, "give either a prior or a fixed value"),
        ("offset", {"fixed": np.nan}, "give a finite value"),
        ("offset", {"fixed": np.inf}, "give a finite value"),
        ("offset", {"fixed": 2.0, "upper": 1.0}, "in its bounds"),
        ("offset", {"prior": normal(0, 1), "lower": 1.0, "upper": 0.0}, "leave nothing"),
        ("offset", {"prior": normal(0, 1), "lower": 1.0, "upper": 1.0}, "leave nothing"),
        (
            "offset",
            {"prior": Distribution("uniform", {"lower": 0, "upper": 1}), "lower": 2.0},
            "leave nothing",
        ),
        ("d", {"prior": Distribution("uniform", {"lower": -2, "upper": -1})}, "leave nothing"),
        ("d", {"fixed": 0.0}, "must be above 0"),
        ("sensor_sd", {"fixed": -1.0}, "must be above 0"),
        ("exponent", {"fixed": 0.5}, "must be at least 1"),
    ],
)
def test_a_parameter_that_cannot_be_is_refused(name: str, what: Any, says: str) -> None:
    with pytest.raises(InputError, match=says) as refused:
        Parameter(name, "um", name, "", declared(name), **what)
    assert str(refused.value).startswith(f"{name}: ")


@pytest.mark.parametrize(
    ("fixed", "says"),
    [
        ({"d": 0.5, "alpha": 0.5}, "^priors: fixed values must have 0 < alpha < d"),
        ({"d": 0.5, "alpha": 0.6}, "^alpha: fixed at 0.6; must hold: 0 < alpha < d"),
        ({"beta": 0.01, "gamma": 0.02}, r"^gamma: fixed at 0.02; must hold: \|gamma\| <= beta"),
        ({"beta": 0.01, "gamma": -0.02}, r"^gamma: fixed at -0.02; must hold: \|gamma\| <= beta"),
    ],
)
def test_fixed_values_that_contradict_each_other_are_refused(
    fixed: dict[str, float], says: str
) -> None:
    with pytest.raises(InputError, match=says):
        joint_prior(HYSTERESIS, RANGES, fixed)


@pytest.mark.parametrize("fixed", [{"alpha": 50.0}, {"gamma": 9.0}])
def test_priors_that_meet_a_constraint_nowhere_are_refused(fixed: dict[str, float]) -> None:
    prior = joint_prior(HYSTERESIS, RANGES, fixed)
    with pytest.raises(InputError, match=r"^priors: hardly any draw"):
        prior.draw(np.random.default_rng(8), 10_000)


# Default priors: scales of the drive in its units, not of its sampling, and wide enough


NAMES = tuple(name for name in EVERY if name not in ("mass", "stiffness", "exponent"))


def drive(amplitude: float = 100.0, interval: float = 1e-3, bias: float = 0.0) -> FloatArray:
    """Return ten seconds of 1 Hz that decay to a half."""
    time = np.arange(0, 10, interval)
    voltage: FloatArray = bias + amplitude * np.sin(2 * np.pi * time) * (1 - 0.05 * time)
    return voltage


def displacement(voltage: FloatArray, interval: float = 1e-3) -> FloatArray:
    """Return that of the ring bender with a lag of 20 ms, um."""
    actuator = Actuator("lag", "first", interval)
    theta = [0.02 if n == "lag" else TABLE_1[n] for n in actuator.parameters]
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


def cut_draws(ranges: Ranges, exponent: float | Distribution) -> dict[str, FloatArray]:
    """Return draws of the cut prior by name; |gamma| <= beta and others cut it."""
    parameters = []
    for name in HYSTERESIS:
        known = exponent if name == "exponent" else prior(name, ranges, exponent)
        parameters.append(parameter(name, known))
    cut = joint(parameters)
    columns = cut.draw(np.random.default_rng(1), 4000).T
    return dict(zip(cut.free_names, columns, strict=True))


def assert_inside(draws: dict[str, FloatArray], **values: float) -> None:
    """Require values within the central 98% of the draws."""
    for name, value in values.items():
        assert 0.01 < np.mean(draws[name] < value) < 0.99, name


@pytest.mark.parametrize(
    ("amplitude", "bias"),
    [(a, b) for a in (2.0, 5.0, 20.0, 100.0, 200.0) for b in (0.0, 1.0)]
    + [(2.0, 20.0), (20.0, 4.0)],
)
def test_true_parameters_lie_well_inside_whatever_the_drive(amplitude: float, bias: float) -> None:
    """Within the central 98% of the cut prior, and 95% of the offset's."""
    voltage = drive(amplitude, bias=bias * amplitude)
    ranges = ranges_of(Inputs(voltage, interval=1e-3), displacement(voltage))
    draws = cut_draws(ranges, 1.0)
    assert_inside(draws, d=0.7, alpha=0.3575, beta=0.0272, gamma=0.0172)
    assert abs(score("offset", 0.0, ranges)) < 2


def test_scales_of_beta_and_gamma_follow_the_exponent() -> None:
    """A rate of 0.0272 / V at an h of 8 um lies inside, be the exponent known or free."""
    voltage = drive()
    ranges = ranges_of(Inputs(voltage, interval=1e-3), displacement(voltage))
    free = cut_draws(ranges, Distribution("uniform", {"lower": 1.0, "upper": 5.0}))
    for exponent in (1.0, 1.5, 2.0, 3.0):
        unit = 8.0 ** (1 - exponent)
        for draws in (free, cut_draws(ranges, exponent)):
            assert_inside(draws, beta=0.0272 * unit, gamma=0.0172 * unit)


@given(digits=st.integers(0, 3), scale=st.floats(0.1, 10), seed=st.integers(0, 9))
def test_readings_without_noise_have_that_of_rounding(digits: int, scale: float, seed: int) -> None:
    """It is q/√12 in multiples of q, 2⁻²⁴ of the range in others, and 0 in noisy readings.

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
