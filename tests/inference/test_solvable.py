"""Where the posterior is known in closed form, the sampler's draws are draws from it.

With the hysteresis' shape, the dynamics and the noise fixed, the displacement is linear in d and
the offset; for an exponent of one and a demagnetized start it is linear in α as well, because h is
α times a path that does not depend on it. With normal priors the posterior is then normal: its
precision is Gᵀ C⁻¹ G plus that of the prior, with G the model's columns (from the plain model in
``tests.reference``) and C the noise's dense covariance. Priors are about as wide as the likelihood,
so that both count.

The draws come by the normal path with sixteen ensembles, which are independent. So each expected
value (of every parameter its mean and variance, and the probability below its 5, 50 and 95 %
quantiles; of every two their covariance) gets a t-score with 15 degrees of freedom. A score beyond
``ALARM`` = 6 is an alarm: a right sampler gives one in 1,400 tests of all 29 statistics. Variances
are known to about 1.3 %, so one sd that is 5 % wrong is found six times in seven, and one that is
7 % wrong 998 times in a thousand.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import combinations
from types import MappingProxyType

import numpy as np
import pytest
from scipy import linalg, stats

from bwbayes.app.running.workers import one_thread
from bwbayes.arrays import FloatArray
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.distributions import Distribution
from bwbayes.record.teststand import RingBender
from bwbayes.sampling.chain import draws
from bwbayes.sampling.plan import SamplingPlan
from bwbayes.sampling.sampler import first_chain, sample
from tests.inference.problems import (
    INTERVAL,
    TRUE_LAG,
    TRUE_NOISE,
    decaying_sine,
    posterior_of,
    ring_bender,
)
from tests.reference.plain import Case, simulate

ENSEMBLES = 16
ALARM = 6.0
LEVELS = (0.05, 0.5, 0.95)

SAMPLES = 120
WINDOWS = (slice(8, 60), slice(75, 120))

TRUTH = MappingProxyType(asdict(RingBender()))

# About as wide as the likelihood; the means are an sd off the truth.
PRIOR_SDS: MappingProxyType[str, dict[str, float]] = MappingProxyType(
    {
        "white": {"d": 0.0008, "alpha": 0.0025, "offset": 0.03},
        "discrepancy": {"d": 0.005, "alpha": 0.01, "offset": 0.4},
    }
)

CASES: tuple[tuple[tuple[str, ...], str], ...] = (
    (("d", "offset"), "discrepancy"),
    (("d", "alpha", "offset"), "white"),
)
every_case = pytest.mark.parametrize(
    ("free", "noise"), CASES, ids=["offset and d, discrepancy", "alpha too, white"]
)


@dataclass(frozen=True)
class Normal:
    """Mean (free,) and covariance (free, free) of a posterior in closed form."""

    mean: FloatArray
    covariance: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Standard deviations (free,)."""
        return np.sqrt(np.diag(self.covariance))


def arguments(name: str, noise: str) -> dict[str, float]:
    sd = PRIOR_SDS[noise][name]
    return {"mean": TRUTH[name] + sd, "sd": sd}


def prior_moments(posterior: Posterior) -> tuple[FloatArray, FloatArray]:
    """Return means and sds (free,) of the priors."""
    given = [p.prior.arguments for p in posterior.prior.free if p.prior is not None]
    return np.array([g["mean"] for g in given]), np.array([g["sd"] for g in given])


def linear_posterior(free: tuple[str, ...], noise: str, noise_factor: float = 1.0) -> Posterior:
    """Return the posterior of a simulated record, its noise taken for that many times as large."""
    actuator = Actuator("lag", "first", INTERVAL)
    voltage = decaying_sine(SAMPLES, periods=2.0)
    displacement = ring_bender(actuator, noise, voltage, seed=1)
    fixed = {**TRUTH, "lag": TRUE_LAG, **TRUE_NOISE}
    for name in ("sensor_sd", "discrepancy_sd"):
        fixed[name] *= noise_factor
    return posterior_of(
        voltage,
        displacement,
        actuator,
        noise,
        {name: value for name, value in fixed.items() if name not in free},
        training=WINDOWS,
        priors={n: Distribution("normal", arguments(n, noise)) for n in free},
    )


def closed_form(posterior: Posterior) -> Normal:
    """Bayesian linear regression on the columns of the plain model."""
    prior_mean, prior_sd = prior_moments(posterior)
    known = {p.name: p.fixed for p in posterior.prior.parameters if p.fixed is not None}
    case = Case(
        posterior.only.voltage,
        posterior.only.displacement,
        INTERVAL,
        posterior.only.training,
        "lag",
        "first",
        posterior.prior.names,
        {},
        known,
    )

    def displacement(free: FloatArray) -> FloatArray:
        return simulate(case, {**known, **dict(zip(posterior.names, free, strict=True))})

    rows = np.concatenate([np.arange(window.start, window.stop) for window in WINDOWS])
    base = displacement(prior_mean)
    columns = [displacement(prior_mean + step) - base for step in np.eye(prior_mean.size)]
    design = np.stack(columns, axis=1)[rows]
    # One discrepancy goes through both windows.
    noise = covariance(known, posterior.only.voltage.size)[np.ix_(rows, rows)]
    weighted = linalg.solve(noise, design, assume_a="pos")
    precision = design.T @ weighted + np.diag(prior_sd**-2.0)
    shift = linalg.solve(precision, weighted.T @ (posterior.only.displacement - base)[rows])
    return Normal(prior_mean + shift, linalg.inv(precision))


def covariance(known: dict[str, float], samples: int) -> FloatArray:
    """Dense covariance (samples, samples) of the noise."""
    lags = np.zeros(samples)
    if "discrepancy_sd" in known:
        kept = np.exp(-INTERVAL * np.arange(samples) / known["discrepancy_time"])
        lags = known["discrepancy_sd"] ** 2 * kept
    lags[0] += known["sensor_sd"] ** 2
    dense: FloatArray = linalg.toeplitz(lags)
    return dense


def sampled(posterior: Posterior) -> FloatArray:
    """Draw by the normal path: (steps, ensembles, walkers, free)."""
    plan = SamplingPlan(ess=4000, ensembles=ENSEMBLES, walkers=12, block=25, least_pilot_steps=100)
    generator = np.random.default_rng(1)
    with ThreadPoolExecutor(1) as executor, one_thread():
        chain = first_chain(posterior, pointfit.fit(posterior, generator), plan, generator)
        outcome = sample(posterior, plan, chain, executor)
    assert outcome.converged, outcome.stop_reason
    return draws(posterior, chain)


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
    return {name: t_score(*pair) for name, pair in statistics.items()}


def t_score(values: FloatArray, expected: float) -> float:
    """Distance of the mean of values (steps, ensembles, walkers) from what is expected."""
    means = np.mean(values, axis=(0, 2))
    return float((np.mean(means) - expected) / (np.std(means, ddof=1) / means.size**0.5))


def worst(known: Normal, result: FloatArray) -> float:
    return max(map(abs, scores(known, result).values()))


@pytest.mark.parametrize("noise", ["white", "discrepancy"])
@pytest.mark.parametrize("free", [("d", "offset"), ("d", "alpha", "offset")])
def test_the_log_density_is_that_of_the_normal(free: tuple[str, ...], noise: str) -> None:
    """But for a constant, at points up to ten sds from the mean."""
    posterior = linear_posterior(free, noise)
    known = closed_form(posterior)
    shifts = np.random.default_rng(2).standard_normal((40, len(free)))
    points = known.mean + 3 * known.sd * shifts
    got = posterior.log_density(posterior.prior.unconstrain(points))
    difference = got - stats.multivariate_normal(known.mean, known.covariance).logpdf(points)
    assert np.ptp(difference) < 1e-8


@every_case
def test_the_point_fit_is_the_normal(free: tuple[str, ...], noise: str) -> None:
    posterior = linear_posterior(free, noise)
    known = closed_form(posterior)
    point = pointfit.fit(posterior, np.random.default_rng(3))
    mode = posterior.prior.constrain(point.mode[np.newaxis])[0][0]
    assert np.max(np.abs(mode - known.mean) / known.sd) < 1e-3
    # The coordinates are the parameters in units of the prior.
    unit = prior_moments(posterior)[1]
    np.testing.assert_allclose(known.covariance, point.covariance * np.outer(unit, unit), rtol=1e-3)


@pytest.mark.parametrize(
    ("free", "noise"), [CASES[0], pytest.param(*CASES[1], marks=pytest.mark.slow)]
)
def test_the_draws_are_from_the_normal(free: tuple[str, ...], noise: str) -> None:
    posterior = linear_posterior(free, noise)
    known, result = closed_form(posterior), sampled(posterior)
    off = scores(known, result)
    assert max(map(abs, off.values())) < ALARM, off
    # The twins: a likelihood that takes the noise for 0.8 times what it is ...
    wider = closed_form(linear_posterior(free, noise, noise_factor=1.25))
    assert worst(wider, result) > 2 * ALARM
    # ... and the same draws, 7 % nearer to their mean.
    assert worst(known, known.mean + 0.93 * (result - known.mean)) > ALARM
