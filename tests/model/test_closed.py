"""Closed forms are scipy's functions, and a prior's map in them is the map in those."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bwbayes.model.closed import Frozen, closed
from bwbayes.model.distributions import Distribution

PRIORS = {
    "normal": {"mean": -3.0, "sd": 2.5},
    "lognormal": {"median": 0.7, "sigma": 1.4},
    "uniform": {"lower": -2.0, "upper": 5.0},
    "halfnormal": {"scale": 0.3},
}


def test_others_have_none() -> None:
    assert closed("beta", {"a": 2.0, "b": 3.0}) is None


@pytest.mark.parametrize("name", PRIORS)
def test_functions_are_scipys(name: str) -> None:
    prior = Distribution(name, PRIORS[name])
    form = closed(name, PRIORS[name])
    assert form is not None
    frozen = Frozen(prior.frozen)
    part = np.concatenate([[0, 1], np.linspace(0.001, 0.999, 101), np.geomspace(1e-9, 1e-3, 20)])
    middle = part[2:]
    x = frozen.ppf(middle)
    outside = np.array([-1e9, 1e9])
    for values in (x, outside):
        np.testing.assert_allclose(frozen.cdf(values), form.cdf(values), rtol=1e-12)
        np.testing.assert_allclose(frozen.sf(values), form.sf(values), rtol=1e-12, atol=1e-16)
    np.testing.assert_allclose(frozen.ppf(part), form.ppf(part), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(frozen.isf(part), form.isf(part), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", PRIORS)
@given(
    z=st.floats(-5, 5),
    low=st.floats(0.01, 0.4),
    high=st.floats(0.6, 0.99),
    cut=st.sampled_from(["neither", "lower", "both"]),
)
def test_a_map_is_the_one_in_scipys_functions(
    name: str, z: float, low: float, high: float, cut: str
) -> None:
    """As x = F⁻¹(F(l) + Φ(z) (F(u) − F(l))), and the probability between the bounds, to 1e-10."""
    prior = Distribution(name, PRIORS[name])
    lower, upper = prior.support
    if cut != "neither":
        lower = float(prior.frozen.ppf(low))
    if cut == "both":
        upper = float(prior.frozen.ppf(high))
    score = np.array([z])
    x, between = prior.from_normal(score, np.asarray(lower), np.asarray(upper))
    whole = prior.frozen.cdf(upper) - prior.frozen.cdf(lower)
    np.testing.assert_allclose(whole, between, rtol=1e-10)
    back = prior.to_normal(x, np.asarray(lower), np.asarray(upper))
    np.testing.assert_allclose(score, back, atol=1e-7)
    # Where probabilities near one keep their digits.
    if z < 0:
        below = (
            prior.frozen.cdf(lower)
            + Distribution("normal", {"mean": 0.0, "sd": 1.0}).form.cdf(score) * whole
        )
        np.testing.assert_allclose(prior.frozen.ppf(below), x, rtol=1e-9, atol=1e-10)
