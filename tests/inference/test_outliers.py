"""Isolated outliers are found, all of them and nothing else, and what is left is as without them.

A good reading lies more than six sds from what the others predict once in 5e8, so a false alarm
among all readings here has a probability below 1e-5. A spike of 20 um is some forty sds.
"""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.errors import InputError
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.outliers import outliers, surprise
from bwbayes.inference.posterior import Posterior
from tests.inference.problems import short_posterior


def spoilt(posterior: Posterior, rows: list[int], size: float = 20.0) -> Posterior:
    displacement = posterior.only.displacement.copy()
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
    cleaned, missing = (p.only.displacement.copy() for p in (spiky, good))
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
