"""Where the posterior is known in closed form, the sampler's draws are draws from it.

The draws come by the normal path with sixteen ensembles, which are independent. So each expected
value (of every parameter its mean and variance, and the probability below its 5, 50 and 95%
quantiles; of every two their covariance) gets a t-score with 15 degrees of freedom. A score beyond
``ALARM`` = 6 is an alarm: a right sampler gives one in 1,400 tests of all 29 statistics. Variances
are known to about 1.3%, so one sd that is 5% wrong is found six times in seven, and one that is
7% wrong 998 times in a thousand.
"""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from bwbayes.arrays import FloatArray
from bwbayes.inference import map_estimate as pointfit, resolve_engine
from bwbayes.sampling.chain import draws
from bwbayes.sampling.plan import SamplingPlan
from tests.inference.linear import CASES, Linear, Normal, every_case
from tests.sampled import converged

PLAN = SamplingPlan(ess=4000, ensembles=16, walkers=12, block=25, min_pilot_steps=100)
ALARM = 6.0
LEVELS = (0.05, 0.5, 0.95)


def scores(known: Normal, result: FloatArray) -> dict[str, float]:
    """t-scores of draws (steps, ensembles, walkers, free) against what is known of them."""
    z = (result - known.mean) / known.sd
    correlation = known.covariance / np.outer(known.sd, known.sd)
    statistics: dict[str, tuple[FloatArray, float]] = {}
    for i in range(known.mean.size):
        statistics[f"mean {i}"] = (z[..., i], 0.0)
        statistics[f"variance {i}"] = (z[..., i] ** 2, 1.0)
        for level in LEVELS:
            below = (z[..., i] < stats.norm.ppf(level)).astype(np.float64)
            statistics[f"quantile {level} of {i}"] = (below, level)
    for i, j in combinations(range(known.mean.size), 2):
        statistics[f"covariance {i} {j}"] = (z[..., i] * z[..., j], correlation[i, j])
    off = {}
    for name, (values, expected) in statistics.items():
        means = np.mean(values, axis=(0, 2))
        off[name] = float((np.mean(means) - expected) / stats.sem(means))
    return off


def worst(known: Normal, result: FloatArray) -> float:
    return max(map(abs, scores(known, result).values()))


@pytest.mark.parametrize("noise", ["white", "discrepancy"])
@pytest.mark.parametrize("free", [("d", "offset"), ("d", "alpha", "offset")])
def test_the_log_density_is_that_of_the_normal(free: tuple[str, ...], noise: str) -> None:
    """But for a constant, at points up to ten sds from the mean."""
    model = Linear(free, noise)
    known, posterior = model.exact, model.posterior
    shifts = np.random.default_rng(2).standard_normal((40, len(free)))
    points = known.mean + 3 * known.sd * shifts
    got = posterior.log_density(posterior.prior.unconstrain(points))
    difference = got - stats.multivariate_normal(known.mean, known.covariance).logpdf(points)
    assert np.ptp(difference) < 1e-8


@every_case
def test_the_point_fit_is_the_normal(free: tuple[str, ...], noise: str) -> None:
    model = Linear(free, noise)
    known, posterior = model.exact, model.posterior
    point = pointfit.fit(posterior, np.random.default_rng(3))
    mode = posterior.prior.constrain(point.mode[np.newaxis])[0][0]
    assert np.max(np.abs(mode - known.mean) / known.sd) < 1e-3
    # The coordinates are the parameters in units of the prior.
    scaled = point.covariance * np.outer(model.sd, model.sd)
    np.testing.assert_allclose(known.covariance, scaled, rtol=1e-3)


@pytest.mark.parametrize(
    ("free", "noise"), [CASES[0], pytest.param(*CASES[1], marks=pytest.mark.slow)]
)
def test_the_draws_are_from_the_normal(free: tuple[str, ...], noise: str) -> None:
    model = Linear(free, noise)
    posterior = replace(model.posterior, engine=resolve_engine())
    known, result = model.exact, draws(posterior, converged(posterior, PLAN))
    off = scores(known, result)
    assert max(map(abs, off.values())) < ALARM, off
    # The twins: a likelihood that takes the noise for 0.8 times what it is ...
    assert worst(Linear(free, noise, 1.25).exact, result) > 2 * ALARM
    # ... and the same draws, 7% nearer to their mean.
    assert worst(known, known.mean + 0.93 * (result - known.mean)) > ALARM
