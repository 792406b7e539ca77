"""The posterior of a batch of models; :mod:`tests.test_reference_posteriors` has its numbers."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.noise import DiscrepancyNoise, WhiteNoise
from bwbayes.inference.outliers import outliers, surprise
from bwbayes.inference.posterior import Posterior
from tests.inference.problems import INTERVAL, short_posterior, single


@pytest.mark.parametrize("size", [1, 63, 64, 65, 130])
def test_a_batch_is_its_rows(size: int) -> None:
    posterior = short_posterior(samples=100, dynamics="lag", fixed={})
    z = posterior.prior.unconstrain(posterior.prior.draw(np.random.default_rng(2), size))
    z[0, 0] = 40.0  # one row is outside
    together = posterior.log_density(z)
    alone = np.concatenate([posterior.log_density(row[np.newaxis]) for row in z])
    assert -np.inf == together[0] == alone[0]
    np.testing.assert_allclose(alone[1:], together[1:], rtol=1e-12)


@dataclass(frozen=True)
class BrokenNoise(WhiteNoise):
    """A likelihood that fails for every other model."""

    value: float = np.nan

    def whiten(
        self, theta: FloatArray, series: FloatArray, skipped: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the white noise's innovations, with a hole in every other determinant."""
        white, log_determinant = super().whiten(theta, series, skipped)
        log_determinant[::2] = self.value
        return white, log_determinant


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_likelihood_that_is_not_finite_is_no_evidence(value: float) -> None:
    sound = short_posterior("white", 100)
    broken = sound.altered(noise=BrokenNoise(value=value))
    z = sound.prior.unconstrain(sound.prior.draw(np.random.default_rng(3), 6))
    expected = sound.log_density(z)
    expected[::2] = -np.inf
    np.testing.assert_array_equal(expected, broken.log_density(z))


@pytest.mark.parametrize(
    "windows",
    [(slice(20, 50), slice(0, 20)), (slice(0, 30), slice(20, 50))],
    ids=["order", "apart"],
)
def test_windows_must_be_in_order_and_apart(windows: tuple[slice, ...]) -> None:
    with pytest.raises(InputError, match="in order of time and must not overlap"):
        short_posterior("white", 50, training=windows)


def test_parameters_must_be_those_of_the_model() -> None:
    sound = short_posterior("white", 50)
    with pytest.raises(InputError, match=r"^prior: its parameters must be d, .*, in this order"):
        sound.altered(noise=DiscrepancyNoise(INTERVAL))
    offset = single("offset", sound.prior.free[-2].prior or pytest.fail("has a prior"))
    with pytest.raises(InputError, match="in this order"):
        replace(sound, prior=offset)


# Isolated outliers are found, all of them and nothing else, and what is left is as without them


def spoilt(posterior: Posterior, rows: list[int], size: float = 20.0) -> Posterior:
    displacement = posterior.single_record.displacement.copy()
    displacement[rows] += size * (-1.0) ** np.arange(len(rows))
    return posterior.altered(displacement=displacement)


def test_a_reading_is_set_aside_from_six_sds_on() -> None:
    """One that is moved to nine sds from what the others predict is, one at four is not."""
    good = short_posterior(samples=400)
    place = pointfit.fit(good, np.random.default_rng(9)).mode
    before, after = (surprise(p, place)[300] for p in (good, spoilt(good, [300], 1.0)))
    for sds, aside in ((9.0, [300]), (4.0, [])):
        moved = spoilt(good, [300], (sds - before) / (after - before))
        assert aside == outliers(moved.without, np.random.default_rng(9))["record"].tolist()


def test_what_is_left_is_the_posterior_without_those_readings() -> None:
    """The same posterior as that of the good record with these readings missing, exactly."""
    good = short_posterior(samples=600)
    rows = [40, 41, 300, 599]
    spiky = spoilt(good, rows)
    aside = outliers(spiky.without, np.random.default_rng(4))["record"]
    assert rows == aside.tolist()
    cleaned, missing = (p.single_record.displacement.copy() for p in (spiky, good))
    cleaned[aside] = missing[rows] = np.nan
    z = good.prior.unconstrain(good.prior.draw(np.random.default_rng(5), 5))
    np.testing.assert_array_equal(
        spiky.altered(displacement=cleaned).log_density(z),
        good.altered(displacement=missing).log_density(z),
    )


def test_a_record_full_of_outliers_is_refused() -> None:
    posterior = short_posterior(samples=400)
    noisy = spoilt(posterior, list(range(0, 400, 12)), 30.0)
    with pytest.raises(InputError, match="too many for isolated outliers"):
        outliers(noisy.without, np.random.default_rng(8))
