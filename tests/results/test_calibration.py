"""Ranks are judged at the level that is stated, and with the power that is stated.

The simulations here have 2,000 to 40,000 trials each; limits are four binomial standard errors, so
that one comparison is wrong by chance once in 16,000 times. Defects are planted on draws of a
normal posterior in the twins: sds that are a fifth too small, and a bias of 0.3 sd, are found with
500 replicates, and hardly with 20, as the power says.
"""

# mypy: allow-untyped-calls
# arviz_stats says that it has types, but its functions have none.

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.results.calibration import (
    FAMILY_LEVEL,
    Calibration,
    ecdf_band,
    holm,
    judge,
    smooth_power,
    smooth_test,
)
from bwbayes.results.replicates import RANKED, Entry

NAMES = tuple("abcdefghijkl")


def entries(z: FloatArray, covered: FloatArray | None = None) -> list[Entry]:
    """Make replicates up whose truths lie at normal scores z (replicates, statistics)."""
    ranks = np.floor(ndtr(z) * (RANKED + 1)).astype(int)
    return [
        Entry(
            number=i,
            converged=True,
            stop_reason="",
            steps=100,
            spacing=3,
            truth=dict.fromkeys(NAMES, 0.0),
            ranks=dict(zip(NAMES, row, strict=False)),
            covered={} if covered is None else {"sensor 95": float(covered[i])},
        )
        for i, row in enumerate(ranks.tolist())
    ]


def scores(count: int, seed: int = 1) -> FloatArray:
    """Return the normal scores of a sound calibration, (count, statistics)."""
    return np.random.default_rng(seed).standard_normal((count, len(NAMES)))


def judged(made: list[Entry]) -> Calibration:
    return judge(made, np.random.default_rng(2))


def assert_near(expected: float, got: float, trials: int) -> None:
    """Compare a frequency with its probability, to four standard errors."""
    assert abs(got - expected) < 4 * np.sqrt(expected * (1 - expected) / trials), got


# The smooth test


@pytest.mark.parametrize("count", [20, 150, 500])
def test_smooth_test_has_its_level(count: int) -> None:
    uniform = np.random.default_rng(count).uniform(size=(count, 4_000))
    assert_near(0.05, float(np.mean(smooth_test(uniform) < 0.05)), 4_000)


@pytest.mark.parametrize(("count", "width"), [(500, 0.8), (150, 0.8), (500, 0.9), (500, 1.2)])
def test_smooth_test_has_the_power_that_is_stated(count: int, width: float) -> None:
    z = np.random.default_rng(count).standard_normal((count, 4_000))
    expected = smooth_power(count, 1e-3, width)
    result = float(np.mean(smooth_test(ndtr(z / width)) < 1e-3))
    # Means of b1 and b2 are only nearly normal.
    assert abs(result - expected) < 0.02 + 4 * np.sqrt(0.25 / 4_000)


def test_power_is_known_for_five_hundred_replicates() -> None:
    """Of sds a fifth too small; a Kolmogorov-Smirnov test has 0.63 and 0.20 at these levels."""
    result = [smooth_power(500, level, 0.8) for level in (0.01, 0.001)]
    np.testing.assert_allclose(result, [0.999, 0.993], atol=0.003)


def test_power_without_a_defect_is_the_level() -> None:
    assert smooth_power(300, 0.01, 1.0) == pytest.approx(0.01, rel=1e-3)


def test_smooth_test_of_one_value_is_its_formula() -> None:
    u = 0.3
    b1, b2 = np.sqrt(3) * (2 * u - 1), np.sqrt(5) * (6 * u**2 - 6 * u + 1)
    result = smooth_test(np.array([[u]]))
    np.testing.assert_allclose(np.exp(-0.5 * (b1**2 + b2**2)), result[0], rtol=1e-12)


def test_holm_is_the_textbooks() -> None:
    p = np.array([0.01, 0.04, 0.03, 0.005])
    np.testing.assert_allclose([0.03, 0.06, 0.06, 0.02], holm(p))


# The band


@pytest.mark.parametrize("count", [4, 150, 500])
@pytest.mark.parametrize("level", [0.05, 0.001])
def test_band_is_left_as_often_as_its_level_says(count: int, level: float) -> None:
    """Counts are whole, so a band of few replicates keeps below its level."""
    uniform = np.random.default_rng(count).uniform(size=(count, 4_000))
    left = float(np.mean(ecdf_band(count, level).left(uniform)))
    assert left < level + 4 * np.sqrt(level / 4_000)
    if count > 100:
        assert left > 0.5 * level - 4 * np.sqrt(level / 4_000)


# The verdict


def test_sound_calibrations_pass_but_for_the_family_level() -> None:
    """Both tests of all statistics together, over 2,000 calibrations of 60 replicates."""
    each = FAMILY_LEVEL / 2 / len(NAMES)
    uniform = np.random.default_rng(1).uniform(size=(60, 2_000 * len(NAMES)))
    alarms = (smooth_test(uniform) < each) | ecdf_band(60, each).left(uniform)
    family = float(np.mean(alarms.reshape(2_000, len(NAMES)).any(axis=1)))
    # The smooth test's tail is a little too long with so few replicates.
    assert family < 1.3 * FAMILY_LEVEL + 4 * np.sqrt(FAMILY_LEVEL / 2_000)
    assert judged(entries(scores(60))).passed


@pytest.mark.parametrize("seed", range(3))
def test_twin_sds_a_fifth_too_small_are_found(seed: int) -> None:
    result = judged(entries(scores(500, seed) / 0.8))
    assert not result.passed
    assert min(result.power.values()) > 0.2
    assert result.telling
    assert result.power["20 % too small"] > 0.98


@pytest.mark.parametrize("seed", range(3))
def test_twin_bias_of_a_third_of_an_sd_is_found(seed: int) -> None:
    assert not judged(entries(scores(500, seed) + 0.3)).passed


def test_defect_of_one_statistic_is_told_by_its_name() -> None:
    z = scores(500)
    z[:, 4] /= 0.6
    result = judged(entries(z))
    assert all(text.startswith("e: ") for text in result.shortcomings), result.shortcomings
    assert result.statistics["e"].adjusted < FAMILY_LEVEL / 2
    assert result.statistics["e"].outside


def test_ranks_among_199_draws_have_200_places() -> None:
    """The lowest and the highest rank lie inside (0, 1) too, each over a 200th of it."""
    made = entries(scores(RANKED + 1))
    for rank, entry in enumerate(made):
        entry["ranks"] = dict.fromkeys(NAMES, rank)
    places = judged(made).positions * (RANKED + 1)
    np.testing.assert_array_equal(np.arange(200)[:, np.newaxis] * np.ones(len(NAMES)), places // 1)


def test_all_tests_together_share_the_family_level() -> None:
    """Each of two tests of twelve statistics has a 24th of one in a hundred."""
    result = judged(entries(scores(500)))
    each = 0.01 / (2 * len(NAMES))
    expected = ecdf_band(500, each)
    np.testing.assert_array_equal(expected.lower, result.ecdf.lower)
    np.testing.assert_array_equal(expected.upper, result.ecdf.upper)
    assert smooth_power(500, each, 0.9) == result.power["10 % too small"]
    # Twice the level is another band: counts are whole, and it could have been the same.
    assert (ecdf_band(500, 2 * each).lower != result.ecdf.lower).any()


def test_too_few_replicates_say_that_they_have_no_power() -> None:
    assert judged(entries(scores(20) / 0.8)).power["20 % too small"] < 0.05


def test_intervals_cover_within_their_binomial_limits() -> None:
    """99 % limits, 36 comparisons: five outside come by chance once in 10⁵ times."""
    result = judged(entries(scores(400)))
    outside = [
        not result.limits[level][0] <= part <= result.limits[level][1]
        for one in result.statistics.values()
        for level, part in one.covered.items()
    ]
    assert len(outside) == 3 * len(NAMES)
    assert sum(outside) < 5


def test_unconverged_replicates_are_counted_and_fail_beyond_one_per_cent() -> None:
    for unconverged, passed in ((0, True), (2, True), (3, False)):
        made = entries(scores(200))
        for entry in made[:unconverged]:
            entry["converged"] = False
        result = judged(made)
        assert (passed, 200) == (result.passed, result.replicates)
        assert tuple(range(unconverged)) == result.unconverged
        assert 200 == result.positions.shape[0]  # they take part all the same


def test_replicate_without_a_fit_is_counted() -> None:
    made = entries(scores(150))
    made[5] = {**made[5], "converged": False, "ranks": {}}
    result = judged(made)
    assert (150, (5,), 149) == (result.replicates, result.unconverged, result.positions.shape[0])


def test_nothing_fitted_is_said() -> None:
    made = entries(scores(2))
    for entry in made:
        entry["ranks"], entry["stop_reason"] = {}, "no luck"
    with pytest.raises(InputError, match="none of the 2 replicates could be fitted: no luck"):
        judged(made)


@pytest.mark.parametrize(("mean", "passed"), [(0.95, True), (0.91, False), (0.99, False)])
def test_bands_must_cover_within_three_standard_errors(mean: float, passed: bool) -> None:
    covered = mean + 0.1 * np.random.default_rng(1).standard_normal(500)
    covered += mean - np.mean(covered)
    result = judged(entries(scores(500), covered))
    assert result.bands["sensor 95"].mean == pytest.approx(mean)
    assert result.bands["sensor 95"].error == pytest.approx(0.1 / np.sqrt(500), rel=0.2)
    assert passed == result.passed


def test_bands_of_few_replicates_are_shown_and_not_judged() -> None:
    assert judged(entries(scores(20), np.ones(20))).passed
