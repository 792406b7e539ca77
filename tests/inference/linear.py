"""A model that is linear in its free parameters, and all that is to be known of it in closed form.

With the hysteresis' shape, the dynamics and the noise fixed, the displacement is linear in d and
the offset; for an exponent of one and a demagnetized start it is linear in α as well, because h is
α times a path that does not depend on it. With normal priors all is then jointly normal, with the
model's columns from the plain model in ``tests.reference`` and the noise's dense covariance. Priors
are about as wide as the likelihood, so that both count, and their means are an sd off the truth.
"""

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import pytest
from scipy import linalg, stats

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.posterior import Posterior
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Distribution
from bwbayes.record.teststand import TABLE_1
from tests.inference.problems import (
    INTERVAL,
    TRUE_LAG,
    TRUE_NOISE,
    decaying_sine,
    posterior_of,
    ring_bender,
)
from tests.reference.plain import Case, simulate

SAMPLES = 120
WINDOWS = (slice(8, 60), slice(75, 120))
TRUTH = MappingProxyType(dict(TABLE_1) | {"lag": TRUE_LAG} | TRUE_NOISE)

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

    def draw(self, count: int, seed: int) -> FloatArray:
        """Draw (count, free)."""
        source = np.random.default_rng(seed)
        return source.multivariate_normal(self.mean, self.covariance, size=count)


class Linear:
    """The posterior of a simulated record, its noise taken for ``factor`` times as large.

    Reading by reading N(level + design (θ − mean), noise), with a prior N(mean, sd²).
    """

    def __init__(self, free: tuple[str, ...], noise: str, factor: float = 1.0) -> None:
        actuator = Actuator("lag", "first", INTERVAL)
        voltage = decaying_sine(SAMPLES, periods=2.0)
        fixed = {name: value for name, value in TRUTH.items() if name not in free}
        for name in ("sensor_sd", "discrepancy_sd"):
            fixed[name] *= factor
        self.sd = np.array([PRIOR_SDS[noise][name] for name in free])
        self.mean = np.array([TRUTH[name] for name in free]) + self.sd
        moments = zip(free, self.mean.tolist(), self.sd.tolist(), strict=True)
        self.readings = ring_bender(actuator, noise, voltage, seed=1)
        self.posterior: Posterior = posterior_of(
            voltage,
            self.readings,
            actuator,
            noise,
            fixed,
            training=WINDOWS,
            priors={n: Distribution("normal", {"mean": m, "sd": s}) for n, m, s in moments},
        )
        names = self.posterior.prior.names
        assert self.posterior.names == free
        record = voltage, self.readings, INTERVAL, WINDOWS
        case = Case(*record, "lag", "first", names, {}, fixed)

        def displacement(place: FloatArray) -> FloatArray:
            return simulate(case, {**fixed, **dict(zip(free, place, strict=True))})

        self.level = displacement(self.mean)
        columns = [displacement(self.mean + step) - self.level for step in np.eye(len(free))]
        self.design = np.stack(columns, axis=1)
        self.noise = self.covariance(SAMPLES)

    @property
    def rows(self) -> IntArray:
        """The readings that are fitted."""
        return self.posterior.single_record.readings.rows

    def covariance(self, samples: int) -> FloatArray:
        """Dense covariance (samples, samples) of the noise; one goes through all windows."""
        known = {p.name: p.fixed for p in self.posterior.prior.parameters if p.fixed is not None}
        lags = np.zeros(samples)
        if "discrepancy_sd" in known:
            kept = np.exp(-INTERVAL * np.arange(samples) / known["discrepancy_time"])
            lags = known["discrepancy_sd"] ** 2 * kept
        lags[0] += known["sensor_sd"] ** 2
        dense: FloatArray = linalg.toeplitz(lags)
        return dense

    def given(self, rows: IntArray) -> Normal:
        """Return the posterior of some readings: Bayesian linear regression."""
        design = self.design[rows]
        weighted = linalg.solve(self.noise[np.ix_(rows, rows)], design, assume_a="pos")
        precision = design.T @ weighted + np.diag(self.sd**-2.0)
        shift = linalg.solve(precision, weighted.T @ (self.readings - self.level)[rows])
        return Normal(self.mean + shift, linalg.inv(precision))

    @property
    def exact(self) -> Normal:
        """The posterior."""
        return self.given(self.rows)

    def marginal(self) -> FloatArray:
        """Covariance of all readings, parameters integrated out."""
        whole: FloatArray = self.noise + (self.design * self.sd**2) @ self.design.T
        return whole

    def log_density(self, rows: IntArray) -> float:
        """Log density of some readings, parameters integrated out."""
        normal = stats.multivariate_normal(self.level[rows], self.marginal()[np.ix_(rows, rows)])
        return float(normal.logpdf(self.readings[rows]))
