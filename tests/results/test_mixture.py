"""The mixture against double sums, numerical integration, scipy's Gaussian and bisection."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import logsumexp, ndtr
from scipy.stats import norm

from bwbayes.arrays import FloatArray
from bwbayes.results import mixture

LEVELS = np.array([0.025, 0.05, 0.25, 0.75, 0.95, 0.975])


def quantiles(means: FloatArray, sds: FloatArray, probabilities: FloatArray) -> FloatArray:
    return mixture.quantiles_and_spread(means, sds, probabilities)[0]


def distribution(means: FloatArray, sds: FloatArray, values: FloatArray) -> FloatArray:
    return mixture.judged(means, sds, values)[0]


def crps(means: FloatArray, sds: FloatArray, values: FloatArray) -> FloatArray:
    spread = mixture.quantiles_and_spread(means, sds, LEVELS)[1]
    return mixture.judged(means, sds, values)[1] - spread


def mixture_sd(means: FloatArray, sds: FloatArray) -> FloatArray:
    sd: FloatArray = np.sqrt(means.var(axis=0) + (sds**2).mean())
    return sd


def distance(m: FloatArray, s: FloatArray) -> FloatArray:
    """E|X| of a Gaussian, with scipy's functions; s may be zero."""
    z = np.divide(m, s, out=np.zeros(np.broadcast(m, s).shape), where=s > 0)
    smooth: FloatArray = m * (2 * norm.cdf(z) - 1) + 2 * s * norm.pdf(z)
    return np.where(s > 0, smooth, np.abs(m))


def slow_distribution(means: FloatArray, sds: FloatArray, values: FloatArray) -> FloatArray:
    z = (values - means) / np.maximum(sds, 1e-100)[:, None]
    probability: FloatArray = ndtr(z).mean(axis=0)
    return probability


def slow_crps(means: FloatArray, sds: FloatArray, values: FloatArray) -> FloatArray:
    pair_sds = np.hypot(sds[:, None], sds)
    pairs = [distance(m[:, None] - m, pair_sds).mean() for m in means.T]
    return distance(values - means, sds[:, None]).mean(axis=0) - 0.5 * np.array(pairs)


def draws(name: str, number: int = 400, samples: int = 7) -> tuple[FloatArray, FloatArray]:
    """Draws of every kind that posteriors come in, and some that they do not."""
    generator = np.random.default_rng(3)
    normal = generator.normal(size=number)
    means = 10 * np.sin(np.arange(samples)) + 0.3 * generator.normal(size=(number, samples))
    far = 8.0 * (generator.random((number, 1)) < 0.4)
    uniform = generator.uniform(-6, 0, number)
    return {
        "usual": (means, np.exp(0.2 * normal)),
        "equal draws": (np.tile(means[0], (number, 1)), np.full(number, 0.7)),
        "one draw": (means[:1], np.array([0.7])),
        "two draws": (means[:2], np.array([0.7, 0.1])),
        "two modes": (means + far, np.full(number, 0.4)),
        "two needles": (np.sign(far - 1) + 0 * means, np.full(number, 1e-7)),
        "skewed": (means + np.exp(normal)[:, None], 0.5 * np.exp(0.3 * normal)),
        "small discrepancy": (0.1 * means, np.abs(0.3 * normal)),
        "sds from 1e-6 to 1": (means, 10**uniform),
        "tiny sds": (means, np.full(number, 1e-9)),
        "some zero sds": (means, np.where(normal < -1, 0.0, 0.5)),
        "all but one zero": (means, np.where(normal == normal.max(), 0.5, 0.0)),
        "one far draw": (means + 1e4 * (normal == normal.max())[:, None], np.full(number, 0.5)),
        "large numbers": (1e6 + 1e3 * means, 1e3 * np.exp(0.2 * normal)),
    }[name]


KINDS = [
    "usual",
    "equal draws",
    "one draw",
    "two draws",
    "two modes",
    "two needles",
    "skewed",
    "small discrepancy",
    "sds from 1e-6 to 1",
    "tiny sds",
    "some zero sds",
    "all but one zero",
    "one far draw",
    "large numbers",
]


@pytest.mark.parametrize("kind", KINDS)
def test_quantiles_solve_the_distribution_to_1e_6_of_the_sd(kind: str) -> None:
    """F a millionth of the sd below and above a quantile must enclose its probability."""
    means, sds = draws(kind)
    margin = 1e-6 * mixture_sd(means, sds)
    probabilities = np.concatenate([LEVELS, [0.5, 1e-3, 0.999, 1e-7]])
    for p, x in zip(probabilities, quantiles(means, sds, probabilities), strict=True):
        below = slow_distribution(means, sds, x - margin)
        above = slow_distribution(means, sds, x + margin)
        assert (below <= p + 1e-13).all()
        assert (above >= p - 1e-13).all()


def test_a_quantile_off_by_a_hundred_thousandth_of_the_sd_would_be_noticed() -> None:
    """The enclosure above is sharp: shifted quantiles fail it."""
    means, sds = draws("usual")
    x = quantiles(means, sds, LEVELS)[5] + 1e-5 * mixture_sd(means, sds)
    below = distribution(means, sds, x - 1e-6 * mixture_sd(means, sds))
    assert (below > 0.975 + 1e-13).all()


def test_quantiles_of_one_gaussian_are_scipys() -> None:
    means, sds = draws("one draw")
    expected = norm.ppf(LEVELS[:, None], means, sds)
    assert expected == pytest.approx(quantiles(means, sds, LEVELS), abs=7e-7, rel=0)


def test_without_sds_the_quantiles_are_those_of_the_draws() -> None:
    means, sds = draws("usual")
    expected = np.quantile(means, LEVELS, axis=0)
    assert np.array_equal(expected, quantiles(means, 0 * sds, LEVELS))


@pytest.mark.parametrize("kind", KINDS)
def test_quantiles_keep_the_order_of_the_probabilities(kind: str) -> None:
    probabilities = np.concatenate([np.linspace(0.995, 0.005, 41), 0.4 + np.arange(9) * 1e-9])
    got = quantiles(*draws(kind), probabilities)
    assert (np.diff(got[np.argsort(probabilities)], axis=0) >= 0).all()


def test_many_samples_and_strided_means_are_cut_into_the_same_pieces() -> None:
    means, sds = draws("usual", samples=300)
    expected = quantiles(means, sds, LEVELS)
    wide = np.repeat(means, 2, axis=1)[:, ::2]
    assert np.array_equal(expected, quantiles(wide, sds, LEVELS))


def test_a_sample_does_not_depend_on_its_neighbours_beyond_the_accuracy() -> None:
    means, sds = draws("skewed", samples=300)
    alone = np.hstack([quantiles(means[:, [t]], sds, LEVELS) for t in range(0, 300, 50)])
    together = quantiles(means, sds, LEVELS)[:, ::50]
    assert np.abs(alone - together).max() < 1e-6


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    number=st.integers(1, 60),
    spread=st.floats(-4, 3),
    narrow=st.floats(-9, 0),
    p=st.floats(1e-4, 1 - 1e-4),
)
def test_distribution_undoes_quantiles(
    seed: int, number: int, spread: float, narrow: float, p: float
) -> None:
    generator = np.random.default_rng(seed)
    means = 10**spread * generator.standard_t(2, size=(number, 3))
    sds = 10 ** generator.uniform(narrow, 0, number)
    x = quantiles(means, sds, np.array([p]))[0]
    margin = 1e-6 * mixture_sd(means, sds)
    assert (distribution(means, sds, x - margin) <= p + 1e-13).all()
    assert (distribution(means, sds, x + margin) >= p - 1e-13).all()


def test_distribution_is_the_mean_of_the_draws_distributions() -> None:
    means, sds = draws("usual", samples=500)
    values = means[0] + 0.3
    expected = np.mean(norm.cdf(values, means, sds[:, None]), axis=0)
    assert expected == pytest.approx(distribution(means, sds, values), abs=1e-14)


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_the_draws_are_left_as_they_are(scale: float) -> None:
    means, sds = draws("usual")
    before = means.copy()
    quantiles(means, scale * sds, LEVELS)
    crps(means, scale * sds, means[0])
    assert np.array_equal(before, means)


def test_a_draw_without_sd_is_a_step_of_the_distribution() -> None:
    means = np.array([[0.0], [1.0], [2.0], [3.0]])
    expected = (1 + 1 + 0.5 + 0) / 4
    assert expected == distribution(means, np.zeros(4), np.array([2.0]))[0]


@pytest.mark.parametrize("number", [1, 64, 65])
def test_crps_of_one_gaussian_is_the_closed_form(number: int) -> None:
    """One draw, or many equal ones: by pairs up to 64, by the series above."""
    y = np.linspace(-3, 5, 9)
    z = (y - 0.4) / 1.7
    expected = 1.7 * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / np.sqrt(np.pi))
    got = crps(np.full((number, 9), 0.4), np.full(number, 1.7), y)
    assert expected == pytest.approx(got, abs=1e-6 * 1.7)


@pytest.mark.parametrize(
    ("kind", "error"),
    [
        ("usual", 1e-6),
        ("equal draws", 1e-6),
        ("two draws", 1e-12),
        ("two modes", 1e-6),
        ("skewed", 1e-6),
        ("large numbers", 1e-6),
        ("small discrepancy", 1e-4),
        ("sds from 1e-6 to 1", 1e-4),
        ("tiny sds", 1e-4),
        ("some zero sds", 1e-4),
        ("all but one zero", 1e-4),
        ("two needles", 1e-2),
        ("one far draw", 3e-2),
    ],
)
def test_crps_is_the_double_sum_over_draws(kind: str, error: float) -> None:
    means, sds = draws(kind)
    sd = mixture_sd(means, sds)
    for values in (means[0], means.mean(axis=0) + 4 * sd):
        difference = slow_crps(means, sds, values) - crps(means, sds, values)
        assert (np.abs(difference) < error * sd).all()


def test_crps_without_sds_is_the_double_sum_over_draws() -> None:
    means, sds = draws("skewed")
    expected = slow_crps(means, 0 * sds, means[3])
    assert expected == pytest.approx(crps(means, 0 * sds, means[3]), abs=1e-12)


def test_crps_is_the_integral_of_the_squared_distance_to_the_step() -> None:
    means, sds = draws("two modes", number=100, samples=1)
    y = 3.0

    def squared(x: float) -> float:
        return float((np.mean(norm.cdf(x, means[:, 0], sds)) - (x >= y)) ** 2)

    below, above = (quad(squared, a, b, limit=200, epsabs=1e-9)[0] for a, b in ((-9, y), (y, 20)))
    expected = below + above
    assert expected == pytest.approx(crps(means, sds, np.array([y]))[0], abs=1e-6)


def test_the_log_density_is_that_of_all_components() -> None:
    """Also where none of them is anything that a float can hold."""
    means = np.random.default_rng(1).normal(size=(300, 5))
    widths = np.random.default_rng(2).uniform(0.1, 2.0, 300)
    values = np.array([0.0, 1.0, -3.0, 40.0, 1e4])
    expected = logsumexp(norm.logpdf(values, means, widths[:, None]), axis=0) - np.log(300)
    got = mixture.log_density(means, widths, values)
    np.testing.assert_allclose(got, expected, rtol=1e-12)
