"""Proposals propose what their density says, whatever they were fitted to, and bend along ridges.

That they leave a distribution as it is, :mod:`tests.sampling.test_moves` shows.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import stats
from scipy.special import logsumexp

from bwbayes.arrays import FloatArray
from bwbayes.inference.noise import DISCREPANCY_SD, SENSOR_SD
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.model.declaration import Declaration, lognormal
from bwbayes.model.linear import Lag
from bwbayes.model.stages.lags import AmplifierLag, SensorLag
from bwbayes.sampling import proposals
from bwbayes.sampling.curvature import (
    DEGREE,
    LONGEST,
    PolynomialMap,
    SkewMap,
    TotalRatioMap,
    fit_maps,
)
from bwbayes.sampling.proposals import StudentMixture

# Two components far apart, so that a draw shows which one it came from, and a wide one.
MIXTURE = StudentMixture(
    np.array([0.2, 0.7, 0.1]),
    np.array([[-40.0, 3.0], [40.0, 0.0], [0.0, 200.0]]),
    np.array([[[1.0, 0.0], [0.5, 2.0]], [[0.5, 0.0], [-1.0, 0.4]], [[3.0, 0.0], [0.0, 3.0]]]),
)


def test_the_density_is_that_of_scipys_mixture() -> None:
    """Near each component and far from all of them."""
    x = np.random.default_rng(2).uniform([-60, -20], [60, 220], (200, 2))
    parts = np.stack(
        [
            stats.multivariate_t(center, factor @ factor.T, df=12).logpdf(x)
            for center, factor in zip(MIXTURE.centers, MIXTURE.factors, strict=True)
        ]
    )
    expected = logsumexp(parts, axis=0, b=MIXTURE.weights[:, np.newaxis])
    np.testing.assert_allclose(expected, MIXTURE.log_density(x), atol=1e-10)


def test_draws_have_the_distribution() -> None:
    """Each coordinate, and one direction across, by Kolmogorov-Smirnov at one in 10,000."""
    draws, _ = MIXTURE.evaluate(MIXTURE.draw(np.random.RandomState(3), 20_000))  # emcee's generator
    for direction in np.array([[1.0, 0.0], [0.0, 1.0], [0.6, -0.8]]):

        def cdf(x: FloatArray, direction: FloatArray = direction) -> FloatArray:
            widths = np.linalg.norm(direction @ MIXTURE.factors, axis=1)
            return np.asarray(
                stats.t.cdf(x[:, np.newaxis], 12, MIXTURE.centers @ direction, widths)
                @ MIXTURE.weights
            )

        assert stats.kstest(draws @ direction, cdf).pvalue > 1e-4


GENERATOR = np.random.default_rng(12)
NORMAL = GENERATOR.standard_normal((1000, 3))
FLAT = {
    "all the same": np.zeros((100, 3)),
    "one coordinate the same": np.column_stack([NORMAL, np.full(1000, 0.1)]),
    "one parameter, the same": np.full((1000, 1), 0.1),
    "in a plane": np.column_stack([NORMAL, NORMAL @ [0.3, 0.7, -0.2]]),
    "fewer than coordinates": GENERATOR.standard_normal((5, 9)),
}


@pytest.mark.parametrize("name", FLAT)
def test_draws_that_do_not_span_the_space_give_no_proposal(name: str) -> None:
    with pytest.raises(np.linalg.LinAlgError, match="do not span the space"):
        StudentMixture.fitted(FLAT[name])


TINY = {
    "a few outliers": np.concatenate([NORMAL, 1e3 + NORMAL[:4]]),
    "far outliers": np.concatenate([NORMAL, 1e8 * (1 + NORMAL[:5])]),
    # Nine tenths do not move: body, flank and tail cannot be told apart.
    "stuck walkers": np.concatenate([NORMAL[:200], np.repeat(NORMAL[:1], 1800, axis=0)]),
    "units far apart": NORMAL * [1e-6, 1.0, 1e3],
}


@pytest.mark.parametrize("name", TINY)
def test_components_of_hardly_any_draws_give_no_nan(name: str) -> None:
    mixture = StudentMixture.fitted(TINY[name], np.zeros(len(TINY[name])))
    assert (4,) == mixture.weights.shape
    assert (mixture.weights > 0).all()
    assert np.isfinite(mixture.log_density(TINY[name])).all()
    proposed, log_density = mixture.evaluate(mixture.draw(np.random.RandomState(14), 500))
    assert np.isfinite(log_density).all()
    # With units far apart, rounding leaves fewer digits.
    np.testing.assert_allclose(mixture.log_density(proposed), log_density, atol=1e-3)


# A ridge a hundred times as long as wide, whose ends lie some twenty widths off its middle.
BEND, WIDTH = 20.0, 0.01


def banana(count: int, seed: int = 1, power: int = 2) -> FloatArray:
    """Draw from a bent ridge (count, 3): along, across, and beside it."""
    z = np.random.default_rng(seed).standard_normal((count, 3))
    across = WIDTH * (z[:, 1] + BEND * (z[:, 0] ** power - 1))
    return np.column_stack([z[:, 0], across, z[:, 2] + 0.5 * z[:, 0]])


def log_banana(x: FloatArray, power: int = 2) -> FloatArray:
    across = x[:, 1] / WIDTH - BEND * (x[:, 0] ** power - 1)
    beside = x[:, 2] - 0.5 * x[:, 0]
    return np.asarray(-0.5 * (x[:, 0] ** 2 + across**2 + beside**2))


def any_totals(free: int, generator: np.random.Generator) -> TotalRatioMap:
    rows = generator.permutation(free)[: free // 2 * 2].reshape(-1, 2)
    center, scale = generator.normal(0, 5, rows.shape), np.exp(generator.normal(0, 1, rows.shape))
    return TotalRatioMap(
        rows, center, scale, generator.integers(1, 3, len(rows)).astype(np.float64)
    )


def any_skew(free: int, generator: np.random.Generator) -> SkewMap:
    center, scale = generator.normal(0, 5, free), np.exp(generator.normal(0, 3, free))
    return SkewMap(center, scale, generator.uniform(0.1, 1.9, free))


def any_bend(free: int, generator: np.random.Generator) -> PolynomialMap:
    longest = min(free, LONGEST)
    terms = np.sort(generator.integers(-1, longest, (30, DEGREE)), axis=1)
    terms = terms[np.argsort(terms[:, -1])]
    bends = generator.normal(0, 0.1, (len(terms), free))
    bends[terms[:, -1:] >= np.arange(free)] = 0.0
    scales = np.triu(generator.normal(0, 0.1, (longest, free)), 1)
    factor = np.linalg.qr(generator.standard_normal((free, free)))[0] * np.geomspace(1, 0.1, free)
    return PolynomialMap(generator.standard_normal(free), factor, terms, bends, scales)


@pytest.mark.parametrize("any_map", [any_totals, any_skew, any_bend])
@given(free=st.integers(2, 15), seed=st.integers(0, 10**6))
def test_straight_undoes_bent_and_tells_how_much_it_stretches(
    any_map: Callable[[int, np.random.Generator], PolynomialMap | SkewMap | TotalRatioMap],
    free: int,
    seed: int,
) -> None:
    """The log determinant is that of differences over a millionth of a straight sd."""
    generator = np.random.default_rng(seed)
    map_, z = any_map(free, generator), generator.standard_normal((2, 3, free))
    x, log_stretch = map_.inverse(z)
    assert x.shape == z.shape
    straight, log_slope = map_.forward(x)
    np.testing.assert_allclose(straight, z, atol=1e-7)
    step = 1e-6 * np.eye(free)
    ahead, behind = (map_.inverse(z[..., np.newaxis, :] + sign * step)[0] for sign in (1, -1))
    _, stretched = np.linalg.slogdet((ahead - behind) / 2e-6)
    np.testing.assert_allclose(log_slope, -stretched, atol=1e-3)
    np.testing.assert_allclose(log_slope, -log_stretch, atol=1e-7)


@given(st.floats(0.1, 1.9), st.integers(0, 10**6))
def test_skewed_tails_are_scipys(power: float, seed: int) -> None:
    x = np.random.default_rng(seed).normal(0, 3, (20, 1))
    skew = SkewMap(np.array([1.0]), np.array([2.0]), np.array([power]))
    expected = 2 * stats.yeojohnson((x[:, 0] - 1) / 2, power)
    np.testing.assert_allclose(skew.forward(x)[0][:, 0], expected, rtol=1e-9, atol=1e-12)


def test_what_is_normal_is_neither_bent_nor_widened_nor_skewed() -> None:
    generator = np.random.default_rng(5)
    straight = generator.standard_normal((4000, 6)) @ generator.standard_normal((6, 6))
    assert PolynomialMap.fitted(straight) is None
    assert [] == fit_maps(straight)
    # Five errors of a power, which has one of 0.02.
    np.testing.assert_allclose(SkewMap.fitted(straight).powers, 1.0, atol=0.1)


def test_a_width_is_found_that_another_coordinate_tells() -> None:
    """As wide as exp(0.4 z), with an error of 0.012; a far outlier does not hide it."""
    z = np.random.default_rng(6).standard_normal((4000, 2)) * [3.0, 1.0]
    x = np.column_stack([z[:, 0], z[:, 1] * np.exp(0.4 * np.clip(z[:, 0] / 3, -5, 5))])
    x[7, 1] = 50.0
    for draws in (x[8:], x):
        bend = PolynomialMap.fitted(draws)
        assert bend is not None
        # The first axis may point either way; an outlier makes sds of others, not widths.
        assert abs(bend.scales[0, 1]) == pytest.approx(0.4, abs=0.06)


# Nine coordinates, of which four have a longer tail, and one is the wider the larger the first.
TAILS = np.array([4.0, 4.0, -4.0, -3.0])


def log_funnel(x: FloatArray) -> FloatArray:
    """Log density of coordinates (count, 9) of normal u: τ exp(u/τ), u exp(0.4 u₀), u."""
    u = x.copy()
    with np.errstate(invalid="ignore", divide="ignore"):
        u[:, :4] = TAILS * np.log(x[:, :4] / TAILS)
    u[:, 4] *= np.exp(-0.4 * u[:, 0])
    slope = np.sum(u[:, :4] / TAILS, axis=1) + 0.4 * u[:, 0]
    log_density = -0.5 * np.sum(u**2, axis=1) - slope - 4.5 * np.log(2 * np.pi)
    return np.where((x[:, :4] / TAILS > 0).all(axis=1), log_density, -np.inf)


def funnel(count: int, seed: int) -> FloatArray:
    x = np.random.default_rng(seed).standard_normal((count, 9))
    x[:, 4] *= np.exp(0.4 * x[:, 0])
    x[:, :4] = TAILS * np.exp(x[:, :4] / TAILS)
    return x


def taken(
    proposal: StudentMixture, draws: FloatArray, log_density: Callable[[FloatArray], FloatArray]
) -> float:
    """Return which part of an independence sampler's proposals is taken, of a known target."""
    places, proposed = proposal.evaluate(proposal.draw(np.random.RandomState(8), len(draws)))
    old, new = log_density(draws) - proposal.log_density(draws), log_density(places) - proposed
    return float(np.mean(np.exp(np.minimum(new - old, 0.0))))


def unstraightened(draws: FloatArray, log_density: FloatArray | None = None) -> StudentMixture:
    """Fit without what bends, widens and skews."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proposals, "fit_maps", lambda _: [])
        return StudentMixture.fitted(draws, log_density)


@pytest.mark.parametrize("power", [2, 3])
def test_places_on_a_ridge_are_taken_several_times_as_often(power: int) -> None:
    draws, others = banana(4000, power=power), banana(4000, 7, power)
    bent, unbent = StudentMixture.fitted(draws), unstraightened(draws)
    # The tail of one side is the bend's.
    assert [PolynomialMap] == [type(map_) for map_ in bent.maps]
    rate, plain_rate = (
        taken(fit, others, partial(log_banana, power=power)) for fit in (bent, unbent)
    )
    assert rate > 0.7
    assert plain_rate < rate / 3


def test_longer_tails_and_widths_are_proposed_as_often_as_they_are() -> None:
    """For twelve fits to 2,000 draws each: how many places are taken, and for how long one rests.

    The longest rests are those at the thousandth of all places that is proposed least: in half the
    fits they are half as long as without maps.
    """
    rates, rests, others = [], [], funnel(30_000, 99)
    for seed in range(12):
        draws = funnel(2000, seed)
        fits = [fit(draws, log_funnel(draws)) for fit in (StudentMixture.fitted, unstraightened)]
        assert [SkewMap, PolynomialMap] == [type(map_) for map_ in fits[0].maps]
        rates.append([taken(proposal, others, log_funnel) for proposal in fits])
        logs = [log_funnel(others) - proposal.log_density(others) for proposal in fits]
        rests.append([np.mean(np.sort(np.exp(weights))[-30:]) for weights in logs])
    rate, plain_rate = np.mean(rates, axis=0)
    rest, plain_rest = np.median(rests, axis=0)
    assert rate > plain_rate + 0.05
    assert rest < plain_rest / 1.5


@pytest.mark.parametrize(
    ("drawn", "log_target", "missing"),
    [
        (banana(4000), log_banana, -1.5 * np.log(2 * np.pi) - np.log(WIDTH)),
        (funnel(4000, 1), log_funnel, 0.0),
    ],
    ids=["banana", "funnel"],
)
def test_the_density_is_that_of_the_draws(
    drawn: FloatArray, log_target: Callable[[FloatArray], FloatArray], missing: float
) -> None:
    """A target's density over the mixture's has a mean of one, over the mixture's draws.

    Over 20,000 draws its error is 0.01.
    """
    proposal = StudentMixture.fitted(drawn)
    y, proposed = proposal.evaluate(proposal.draw(np.random.RandomState(10), 20_000))
    ratio = np.exp(log_target(y) + missing - proposed)
    assert np.std(ratio) / np.sqrt(ratio.size) < 0.02
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.06)


# Logarithms of two sds, of which 100 readings tell the sum of the squares, beside two others.
TOTAL = TotalRatioMap(
    np.array([[2, 1]]), np.array([[-1.0, -7.0]]), np.array([[2.0, 4.0]]), np.array([2.0])
)
READINGS = 100


def log_legs(x: FloatArray) -> FloatArray:
    """Log density of coordinates (count, 4), of which 1 and 2 are at a right angle's two legs."""
    variance = np.exp(2 * (-7.0 + 4.0 * x[:, 1])) + np.exp(2 * (-1.0 + 2.0 * x[:, 2]))
    likelihood = -0.5 * READINGS * (np.log(variance) + 0.25 / variance)
    return np.asarray(likelihood - 0.5 * np.sum(x**2, axis=1))


def legs(count: int, seed: int) -> FloatArray:
    """Draw from that, by importance resampling in the coordinates of total and ratio."""
    generator = np.random.default_rng(seed)
    y = generator.standard_normal((50 * count, 4)) * [1.0, 3.0, 0.1, 1.0]
    y[:, 2] += np.log(0.5) / 2
    x, _ = TOTAL.inverse(y)
    width = 0.5 * np.sum(((y - [0.0, 0.0, np.log(0.5) / 2, 0.0]) / [1.0, 3.0, 0.1, 1.0]) ** 2, 1)
    logs = log_legs(x) + width
    weights = np.exp(logs - np.max(logs))
    return np.asarray(x[generator.choice(len(x), count, p=weights / np.sum(weights))])


@given(st.integers(0, 10**6))
def test_total_and_ratio_are_those_of_sds_or_lags_and_change_no_volume(seed: int) -> None:
    generator = np.random.default_rng(seed)
    rows = generator.permutation(5)[:4].reshape(2, 2)
    center, scale = generator.normal(0, 5, (2, 2)), np.exp(generator.normal(0, 1, (2, 2)))
    map_ = TotalRatioMap(rows, center, scale, np.array([2.0, 1.0]))
    x = generator.normal(0, 2, (3, 5))
    y, log_slope = map_.forward(x)
    for (i, j), c, s, total in zip(rows, center, scale, (np.hypot, np.add), strict=True):
        a, b = np.exp(c[0] + s[0] * x[:, i]), np.exp(c[1] + s[1] * x[:, j])
        np.testing.assert_allclose(y[:, i], np.log(total(a, b)) / s[0], atol=1e-9)
        np.testing.assert_allclose(y[:, j], np.log(b / a) / s[1], atol=1e-9)
    np.testing.assert_array_equal(log_slope, 0.0)
    step = 1e-5 * np.eye(5)
    near = (map_.forward(x[:, np.newaxis] + sign * step)[0] for sign in (1, -1))
    slopes = np.subtract(*near).transpose(0, 2, 1) / 2e-5
    np.testing.assert_allclose(map_.slopes(x), slopes, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.linalg.det(map_.slopes(x))), 1.0, rtol=1e-9)


def test_places_on_two_legs_are_taken_more_often_and_have_their_density() -> None:
    """The target's density over the mixture's has one mean over draws of each (error 0.02)."""
    draws = legs(4000, 1)
    start = np.zeros((1, 4)), 0.04 * np.eye(4)[np.newaxis], np.ones(1)
    guess = StudentMixture.around(*start, TOTAL)
    fitted = StudentMixture.fitted(draws, None, guess), StudentMixture.fitted(draws)
    x, rates, spreads = legs(4000, 2), [], []
    for proposal in fitted:
        y, proposed = proposal.evaluate(proposal.draw(np.random.RandomState(3), 4000))
        old, new = log_legs(x) - proposal.log_density(x), log_legs(y) - proposed
        rates.append(float(np.mean(np.exp(np.minimum(new - old, 0.0)))))
        # Both are estimates of the constant that is missing to the target's density.
        constant = np.log(np.mean(np.exp(new))), -np.log(np.mean(np.exp(-old)))
        spreads.append(abs(constant[0] - constant[1]))
    assert rates[0] > 0.8
    assert rates[1] < rates[0] - 0.1
    assert spreads[0] < 0.1


def test_the_sds_of_each_record_are_put_in_line_where_both_are_free_and_lognormal() -> None:
    def free(declared: Declaration, record: str, upper: float = np.inf) -> Parameter:
        name = f"{declared.name}[{record}]"
        made = Parameter.of(declared, lognormal(0.5, 2.0))
        return replace(made, name=name, record=record, upper=upper)

    prior = JointPrior(
        (
            free(DISCREPANCY_SD, "a"),
            free(SENSOR_SD, "b"),
            free(SENSOR_SD, "a"),
            free(DISCREPANCY_SD, "b", upper=1.0),
            free(SENSOR_SD, "c"),
        )
    )
    map_ = TotalRatioMap.of_prior(prior)
    assert map_ is not None
    np.testing.assert_array_equal([[2, 0]], map_.rows)
    np.testing.assert_allclose(np.full((1, 2), np.log(0.5)), map_.center)
    np.testing.assert_array_equal([[2.0, 2.0]], map_.scale)
    np.testing.assert_array_equal([2.0], map_.powers)
    assert TotalRatioMap.of_prior(JointPrior((free(SENSOR_SD, "a"),))) is None


def test_the_first_two_lags_in_a_row_are_put_in_line() -> None:
    declared = Lag().parameters[0], SensorLag.parameters[0], AmplifierLag.parameters[0]
    prior = JointPrior(tuple(Parameter.of(each, lognormal(0.01, 1.0)) for each in declared))
    map_ = TotalRatioMap.of_prior(prior)
    assert map_ is not None
    np.testing.assert_array_equal([[0, 2]], map_.rows)
    np.testing.assert_array_equal([1.0], map_.powers)
