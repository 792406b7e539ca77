"""Ranks are judged at the level that is stated, and with the power that is stated.

The simulations here have 400 to 4,000 trials each; limits are four binomial standard errors, so
that one comparison is wrong by chance once in 16,000 times. Defects are planted on draws of a
normal posterior in the twins.
"""

import numpy as np
import pytest
from scipy.special import ndtr

from bwbayes.arrays import FloatArray
from bwbayes.calibration.calibration import (
    FAMILY_LEVEL,
    RANKED,
    Calibration,
    Entry,
    evaluate_calibration,
    holm,
    smooth_power,
    smooth_test,
)
from bwbayes.errors import InputError

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
    return evaluate_calibration(made, np.random.default_rng(2))


def assert_near(expected: float, got: float, trials: int) -> None:
    """Compare a frequency with its probability, to four standard errors."""
    assert abs(got - expected) < 4 * np.sqrt(expected * (1 - expected) / trials), got


@pytest.mark.parametrize("count", [20, 500])
def test_smooth_test_has_its_level(count: int) -> None:
    uniform = np.random.default_rng(count).uniform(size=(count, 4_000))
    assert_near(0.05, float(np.mean(smooth_test(uniform) < 0.05)), 4_000)


@pytest.mark.parametrize(("count", "width"), [(150, 0.8), (500, 0.9), (500, 1.2)])
def test_smooth_test_has_the_power_that_is_stated(count: int, width: float) -> None:
    z = np.random.default_rng(count).standard_normal((count, 4_000))
    expected = smooth_power(count, 1e-3, width)
    result = float(np.mean(smooth_test(ndtr(z / width)) < 1e-3))
    # Means of b1 and b2 are only nearly normal.
    assert abs(result - expected) < 0.02 + 4 * np.sqrt(0.25 / 4_000)


def test_holm_is_the_textbooks() -> None:
    p = np.array([0.01, 0.04, 0.03, 0.005])
    np.testing.assert_allclose([0.03, 0.06, 0.06, 0.02], holm(p))


def test_sound_calibrations_pass_but_for_the_family_level() -> None:
    """Both tests of all statistics together, over 400 calibrations of 60 replicates."""
    failed = [not judged(entries(scores(60, seed))).passed for seed in range(400)]
    # The smooth test's tail is a little too long with so few replicates.
    assert np.mean(failed) < 1.3 * FAMILY_LEVEL + 4 * np.sqrt(FAMILY_LEVEL / 400)


@pytest.mark.parametrize("defect", ["sds a fifth too small", "a bias of 0.3 sd", "two peaks"])
def test_twin_defects_are_found(defect: str) -> None:
    """The last one by the distribution function, too."""
    for seed in range(3):
        z = scores(500, seed)
        spoiled = {
            "sds a fifth too small": z / 0.8,
            "a bias of 0.3 sd": z + 0.3,
            "two peaks": np.where(np.abs(z) > 1, z, np.sign(z) * 0.68),
        }[defect]
        result = judged(entries(spoiled))
        assert not result.passed
        assert result.telling
        assert result.power["20% too small"] > 0.98
        if defect == "two peaks":
            assert any("leaves its band" in text for text in result.failures)


def test_defect_of_one_statistic_is_told_by_its_name() -> None:
    z = scores(500)
    z[:, 4] /= 0.6
    result = judged(entries(z))
    assert all(text.startswith("e: ") for text in result.failures), result.failures
    assert result.statistics["e"].adjusted < FAMILY_LEVEL / 2
    assert result.statistics["e"].outside


def test_unconverged_replicates_are_counted_and_fail_beyond_one_per_cent() -> None:
    """They are ranked all the same, if they have draws."""
    for unconverged, passed in ((0, True), (2, True), (3, False)):
        made = entries(scores(200))
        for entry in made[:unconverged]:
            entry["converged"] = False
        result = judged(made)
        assert (passed, 200) == (result.passed, result.replicates)
        assert tuple(range(unconverged)) == result.unconverged
        assert 200 == result.positions.shape[0]
    made[5] = {**made[5], "converged": False, "ranks": {}}
    assert 199 == judged(made).positions.shape[0]
    for entry in made:
        entry["ranks"], entry["stop_reason"] = {}, "no luck"
    with pytest.raises(InputError, match="none of the 200 replicates could be fitted: no luck"):
        judged(made)


@pytest.mark.parametrize(("mean", "passed"), [(0.95, True), (0.91, False), (0.99, False)])
def test_bands_must_cover_within_three_standard_errors(mean: float, passed: bool) -> None:
    """With few replicates it is shown and not judged."""
    covered = mean + 0.1 * np.random.default_rng(1).standard_normal(500)
    covered += mean - np.mean(covered)
    result = judged(entries(scores(500), covered))
    assert result.bands["sensor 95"].mean == pytest.approx(mean)
    assert result.bands["sensor 95"].error == pytest.approx(0.1 / np.sqrt(500), rel=0.2)
    assert passed == result.passed
    assert judged(entries(scores(20), covered[:20])).passed
