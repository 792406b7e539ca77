"""Priors that the record contradicts, bounds leaned on and foreign units are said; good runs not.

Each kind of planted mistake is said, by name.
"""

from typing import Any

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.consistency import conflicts
from bwbayes.inference.parameters import JointPrior
from bwbayes.model.declaration import Distribution, Ranges
from tests.declared import context, declared, joint, parameter
from tests.inference.problems import joint_prior

RANGES = Ranges(voltage=100.0, displacement=60.0, middle=0.0, time=0.5)
NAMES = (
    "d", "alpha", "beta", "gamma", "exponent", "initial", "lag", "offset", "sensor_sd",
    "discrepancy_sd", "discrepancy_time",
)  # fmt: skip
DEFAULTS: Any = {name: declared(name).default(context(RANGES)) for name in NAMES}

# A good run's posterior: mean and sd.
GOOD = {
    "d": (0.7, 0.005), "alpha": (0.36, 0.01), "beta": (0.027, 0.001), "gamma": (0.017, 0.003),
    "initial": (0.5, 1.0), "lag": (0.004, 0.001), "offset": (0.3, 0.5), "sensor_sd": (0.5, 0.003),
    "discrepancy_sd": (1.5, 0.3), "discrepancy_time": (0.5, 0.2),
}  # fmt: skip


def normal(mean: float, sd: float) -> Distribution:
    return Distribution("normal", {"mean": mean, "sd": sd})


def lognormal(median: float, sigma: float) -> Distribution:
    return Distribution("lognormal", {"median": median, "sigma": sigma})


def with_prior(name: str, prior: Distribution | float, upper: float = np.inf) -> JointPrior:
    known = joint_prior(NAMES, RANGES, {})
    other = parameter(name, prior, upper=upper)
    return joint([other if p.name == name else p for p in known.parameters])


def posterior_draws(prior: JointPrior, **other: FloatArray) -> FloatArray:
    """Return draws (2000, free) of a good run, but for other columns."""
    generator = np.random.default_rng(1)
    columns = {
        name: np.abs(mean + sd * generator.standard_normal(2000))
        for name, (mean, sd) in GOOD.items()
    }
    return np.stack([(columns | other)[name] for name in prior.free_names], axis=1)


def said(prior: JointPrior, **other: FloatArray) -> list[str]:
    return [*map(str, conflicts(prior, posterior_draws(prior, **other), DEFAULTS))]


def test_good_run_raises_no_remark() -> None:
    assert [] == said(joint_prior(NAMES, RANGES, {}))


@pytest.mark.parametrize(("mean", "side"), [(0.5, "above"), (0.9, "below")])
def test_posterior_some_sds_from_its_prior_is_said_with_the_default_as_fix(
    mean: float, side: str
) -> None:
    (remark,) = said(with_prior("d", normal(mean, 0.04)))
    assert f"d: posterior mean 0.7 um/V is 5.0 SD {side} its prior normal(mean = {mean}" in remark
    assert 'give d = { prior = { distribution = "lognormal", median = 0.96, sigma = 0.6 } }' in (
        remark
    )
    assert [] == said(with_prior("d", normal(mean, 0.08)))


def test_a_prior_that_was_widened_is_not_to_be_narrowed_again() -> None:
    """Where the default would be in conflict too, the advice is a prior twice as wide."""
    prior = with_prior("d", lognormal(0.1, 0.4))
    draws = posterior_draws(prior)
    (finding,) = conflicts(prior, draws, {"d": lognormal(0.1, 0.2)})
    assert 'give d = { prior = { distribution = "lognormal", median = 0.1, sigma = 0.8 } }' in (
        finding.fix
    )


def test_a_prior_without_a_width_is_not_advised_again() -> None:
    uniform = Distribution("uniform", {"lower": 0.0, "upper": 0.7017})
    prior = with_prior("d", uniform)
    high = np.random.default_rng(1).normal(0.7012, 1e-4, 2000)
    findings = conflicts(prior, posterior_draws(prior, d=high), {"d": uniform})
    assert [] == [found for found in findings if "SD above its prior" in found.text]


@pytest.mark.parametrize(
    ("name", "given", "times"),
    [
        ("d", lognormal(700.0, 0.3), "7e+02"),
        ("lag", lognormal(4.0, 1.0), "2e+03"),
        ("sensor_sd", lognormal(500.0, 1.0), "1e+03"),
        ("beta", lognormal(27.0, 1.0), "2e+04"),
        ("discrepancy_sd", lognormal(1500.0, 0.5), "3e+06"),
        ("lag", 4.0, "2e+03"),
        ("d", 7e-7, "7e-07"),
    ],
)
def test_scale_that_is_off_by_powers_of_ten_may_be_another_unit(
    name: str, given: Distribution | float, times: str
) -> None:
    prior = with_prior(name, given)
    (remark,) = [r for r in said(prior) if r.startswith(f"{name}: its ")]
    assert f"{times} times what the record's ranges suggest" in remark
    assert "Fix: check its unit" in remark


def piled_up(bound: float, width: float) -> FloatArray:
    """Return draws (2000,) whose density is highest at a bound."""
    draws: FloatArray = bound + width * np.random.default_rng(2).exponential(size=2000)
    return draws


def test_a_bound_that_others_set_is_said_with_its_switch() -> None:
    prior = joint_prior(NAMES, RANGES, {})
    beta = np.random.default_rng(3).normal(0.02, 1e-3, 2000)
    (remark,) = said(prior, beta=beta, gamma=beta - piled_up(0, 2e-4))
    assert remark.startswith("gamma: lies on its upper bound of |gamma| <= beta")
    assert "passive = false" in remark
    (remark,) = said(prior, beta=beta, gamma=-beta + piled_up(0, 2e-4))
    assert remark.startswith("gamma: lies on its lower bound of |gamma| <= beta")
    d = np.full(2000, 0.7)
    (remark,) = said(prior, d=d, alpha=d - piled_up(0, 1e-3))
    assert remark.startswith("alpha: lies on its upper bound of 0 < alpha < d")


def test_gamma_anywhere_between_its_bounds_is_not_said() -> None:
    """The twin: a gamma of which the record tells nothing, and one that may pass beta."""
    prior = joint_prior(NAMES, RANGES, {})
    share = np.random.default_rng(3).uniform(-1, 1, 2000)
    assert [] == said(prior, beta=np.full(2000, 0.02), gamma=0.02 * share)
    assert [] == said(prior, gamma=np.random.default_rng(4).normal(0.03, 0.003, 2000))


def test_given_bounds_that_the_posterior_leans_on_are_said() -> None:
    upper = with_prior("lag", lognormal(0.005, 1.0), upper=0.003)
    (remark,) = said(upper, lag=0.003 - piled_up(0, 1e-4))
    assert remark == "lag: lies on its upper bound 0.003 s. Fix: move parameters.lag.upper."
    uniform = with_prior("d", Distribution("uniform", {"lower": 0.8, "upper": 2.0}))
    (remark,) = said(uniform, d=piled_up(0.8, 0.01))
    assert remark.startswith("d: lies on its lower bound 0.8 um/V. Fix: widen its prior uniform(")


def test_the_edge_of_a_default_prior_is_not_to_be_widened_where_it_is_the_models() -> None:
    prior = joint_prior((*NAMES, "discrepancy_quality"), RANGES, {})
    (remark,) = said(prior, discrepancy_quality=0.5**0.5 - piled_up(0, 0.02))
    advice = "Fix: try other parts of the model; what it misses oscillates."
    assert remark == f"discrepancy_quality: lies on its upper bound 0.7071. {advice}"
