"""Distributions mean what their names say, and normal scores keep their precision."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from bwbayes.errors import InputError
from bwbayes.model.declaration import Distribution

FAMILIAR: list[tuple[Distribution, Any]] = [
    (Distribution("normal", {"mean": 1.0, "sd": 2.0}), stats.norm(1, 2)),
    (Distribution("lognormal", {"median": 2.0, "sigma": 0.7}), stats.lognorm(0.7, scale=2)),
    (Distribution("uniform", {"lower": -1.0, "upper": 3.0}), stats.uniform(-1, 4)),
    (Distribution("halfnormal", {"scale": 2.0}), stats.halfnorm(scale=2)),
    (Distribution("beta", {"a": 2.0, "b": 3.0}), stats.beta(2, 3)),
    (
        Distribution("beta", {"a": 2.0, "b": 3.0, "lower": -1.0, "upper": 4.0}),
        stats.beta(2, 3, loc=-1, scale=5),
    ),
    (Distribution("t", {"df": 4.0, "loc": 1.0, "scale": 2.0}), stats.t(4, 1, 2)),
    (Distribution("gumbel_r", {"loc": 0.1, "scale": 0.3}), stats.gumbel_r(0.1, 0.3)),
]

# How far out, in normal scores, a float can still hold the value: a uniform's lower end at −1 is
# known to 1e-16 only, while a halfnormal goes down to 1e-118 at a score of −27.
REPRESENTABLE = {
    "normal": (-30, 30),
    "lognormal": (-30, 30),
    "halfnormal": (-26, 30),
    "beta": (-6, 6),
    "uniform": (-6, 6),
    "t": (-30, 30),
    "gumbel_r": (-30, 30),
}

NORMAL = Distribution("normal", {"mean": 1.0, "sd": 2.0})


@pytest.mark.parametrize(("distribution", "scipys"), FAMILIAR, ids=[str(d) for d, _ in FAMILIAR])
def test_names_and_arguments_mean_scipys_distribution(
    distribution: Distribution, scipys: Any
) -> None:
    x = scipys.ppf(np.linspace(0.01, 0.99, 21))
    np.testing.assert_allclose(scipys.logpdf(x), distribution.frozen.logpdf(x), rtol=1e-12)
    np.testing.assert_allclose(scipys.cdf(x), distribution.frozen.cdf(x), rtol=1e-12)


@pytest.mark.parametrize("distribution", [d for d, _ in FAMILIAR], ids=str)
@pytest.mark.parametrize("cut", ["neither", "lower", "both"])
def test_a_map_is_the_one_in_scipys_functions(distribution: Distribution, cut: str) -> None:
    """As x = F⁻¹(F(l) + Φ(z) (F(u) − F(l))), and the probability between the bounds, to 1e-10."""
    scipys = distribution.frozen
    lower, upper = distribution.support
    if cut != "neither":
        lower = float(scipys.ppf(0.3))
    if cut == "both":
        upper = float(scipys.ppf(0.8))
    z = np.linspace(-5, 0, 11)  # where probabilities near one keep their digits
    x, between = distribution.from_normal(z, np.asarray(lower), np.asarray(upper))
    whole = scipys.cdf(upper) - scipys.cdf(lower)
    np.testing.assert_allclose(between, whole, rtol=1e-10)
    below = scipys.cdf(lower) + stats.norm.cdf(z) * whole
    np.testing.assert_allclose(x, scipys.ppf(below), rtol=1e-9, atol=1e-10)
    back = distribution.to_normal(x, np.asarray(lower), np.asarray(upper))
    np.testing.assert_allclose(back, z, atol=1e-7)


@pytest.mark.parametrize("distribution", [d for d, _ in FAMILIAR], ids=str)
def test_scores_round_trip_in_both_tails(distribution: Distribution) -> None:
    low, high = REPRESENTABLE[distribution.name]
    z = np.linspace(low, high, 121)
    bounds = [np.array(end) for end in distribution.frozen.support()]
    x, whole = distribution.from_normal(z, bounds[0], bounds[1])
    assert np.all(whole == 1)
    assert np.all(np.diff(x) >= 0)
    np.testing.assert_allclose(z, distribution.to_normal(x, bounds[0], bounds[1]), atol=1e-6)


@given(st.floats(-9, 9), st.floats(1e-3, 5), st.floats(-3, 3))
@settings(max_examples=200)
def test_scores_round_trip_between_bounds_in_either_tail(
    low: float, width: float, score: float
) -> None:
    """The cut keeps its precision nine sds away from the median, above as below."""
    bounds = np.array(1 + 2 * low), np.array(1 + 2 * (low + width))
    x, _ = NORMAL.from_normal(np.array([score]), *bounds)
    assert bounds[0] <= x[0] <= bounds[1]
    assert abs(score - NORMAL.to_normal(x, *bounds)[0]) < 1e-6


def test_bounds_that_leave_nothing_have_no_probability() -> None:
    x, whole = NORMAL.from_normal(np.zeros(1), np.array([3.0]), np.array([2.0]))
    assert (3.0, 0.0) == (x[0], whole[0])


@pytest.mark.parametrize(("wrong", "right"), [("log-normal", "lognormal"), ("cauchi", "cauchy")])
def test_an_unknown_name_gives_the_nearest(wrong: str, right: str) -> None:
    with pytest.raises(InputError, match=f"^{wrong}: unknown distribution; did you mean {right}"):
        Distribution(wrong, {})


@pytest.mark.parametrize("name", ["qqqqqq", "poisson", "", "rv_continuous", "kstest", "__name__"])
def test_what_is_no_continuous_distribution_is_unknown(name: str) -> None:
    with pytest.raises(InputError, match="unknown distribution"):
        Distribution(name, {})


@pytest.mark.parametrize(
    ("name", "arguments", "says"),
    [
        ("normal", {"mean": 1.0}, "sd is missing; it takes mean, sd"),
        ("normal", {"mean": 1.0, "sd": 1.0, "sigma": 1.0}, "sigma is unknown; it takes mean, sd"),
        ("normal", {"mean": 1.0, "sd": 0.0}, "check its arguments"),
        ("normal", {"mean": 1.0, "sd": np.inf}, "sd is inf; give a finite number"),
        ("normal", {"mean": "1", "sd": 1.0}, "mean is '1'; give a number"),
        ("normal", {"mean": True, "sd": 1.0}, "mean is True; give a number"),
        ("lognormal", {"median": -1.0, "sigma": 1.0}, "check its arguments"),
        ("uniform", {"lower": 2.0, "upper": 1.0}, "lower 2 is not below upper 1"),
        ("beta", {"a": 1.0, "b": 1.0, "lower": 1.0}, "lower 1 is not below upper 1"),
        ("gamma", {"a": 1.0, "b": 1.0}, "wrong arguments; scipy's takes a, loc, scale"),
        ("gamma", {"a": -1.0}, "check its arguments"),
        ("cauchy", {"mean": 1.0}, "wrong arguments; scipy's takes loc, scale"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(
    name: str, arguments: dict[str, Any], says: str
) -> None:
    with pytest.raises(InputError) as refused:
        Distribution(name, arguments)
    assert says in str(refused.value)
    assert str(refused.value).startswith(name)
    assert "\n" not in str(refused.value)
