"""The joint prior: one density in two sets of coordinates, draws that follow it, constraints."""

from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.model.declaration import Distribution, Ranges
from bwbayes.model.operators.bouc_wen import ceiling
from tests.declared import declared, joint
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
