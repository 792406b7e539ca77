"""Whether records that were fitted jointly agree: each under the joint fit, and under its own.

A joint fit takes its records for those of one actuator. If one of them was measured with another
gain or another mounting, the joint posterior lies between them and fits none. So each record is
fitted alone, by a point fit with the joint fit's noise, and two things are compared with the joint
one: its residuals, and where the shared parameters of the actuator are.

With the unconstrained coordinates of these parameters, in which the prior is nearly a standard
normal, m and C mean and covariance given all records, m_r and C_r those given record r alone,

    m_r − m ~ N(0, C_r − C)

if all records are those of one actuator that the prior draws: the covariance of a mean that was
learnt from more is larger by what the posterior's is smaller (the law of total variance). So

    H = (m_r − m)ᵀ (C_r − C)⁻¹ (m_r − m)

has a χ² distribution, with as many degrees of freedom as there are directions that the record
tells and that others tell more of. (Without a prior it is Hausman's test, Econometrica 46, 1978.)

Another noise shows elsewhere: the innovations of a record at the joint mode have a root mean square
of 1 if the noise that the records share is its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, stats

from bwbayes.arrays import FloatArray
from bwbayes.inference import pointfit
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.posterior import Posterior
from bwbayes.results.innovations import innovations

__all__ = ["Agreement", "agreements", "numbers", "remarks"]

# A direction counts if the record leaves less than this part of the prior's variance, and if the
# others take away more than this part of what the record leaves: of what it tells by itself alone
# the difference is rounding.
TOLD, TAKEN = 0.5, 0.05

# Probability of a false alarm for a record, and the residual's growth below which a disagreement
# does not matter, however sure it is.
ALARM, GROWN = 1e-4, 1.02

# Ratio of its noise to that of all from which on a record's noise is called another one. The
# discrepancy of a short record may be this much smaller or larger by chance.
NOISIER = 1.25

# Readings along which residuals are kept, for pictures.
KEPT = 2000


@dataclass(frozen=True)
class Agreement:
    """How a record of a joint fit agrees with the others.

    Parameters
    ----------
    joint_um, own_um
        Root mean square of its residuals at the joint mode and at that of a fit of it alone, um.
    distance, degrees
        H and its degrees of freedom; both zero if nothing can be compared.
    moved
        The shared parameter that is farthest off, and by how many sds of the difference; empty if
        nothing can be compared.
    size
        Root mean square of its innovations at the joint mode, and ``readings`` how many there are.
    time, joint, own
        (readings,) in s and um: the residuals, thinned.
    """

    joint_um: float
    own_um: float
    distance: float
    degrees: int
    moved: tuple[str, float]
    size: float
    readings: int
    time: FloatArray
    joint: FloatArray
    own: FloatArray

    @property
    def p_value(self) -> float:
        """Probability of a larger distance if all records are of one actuator."""
        return float(stats.chi2.sf(self.distance, self.degrees)) if self.degrees else 1.0

    @property
    def disagrees(self) -> bool:
        """Whether the record does not go with the others, beyond chance and so that it matters."""
        return self.p_value < ALARM and self.joint_um > GROWN * self.own_um

    @property
    def noisier(self) -> bool:
        """Whether its noise is another one than the records share, beyond chance and by much."""
        squares = self.readings * self.size**2
        tails = stats.chi2.cdf(squares, self.readings), stats.chi2.sf(squares, self.readings)
        return min(tails) < ALARM / 2 and not 1 / NOISIER < self.size < NOISIER


def agreements(
    posterior: Posterior,
    point: PointFit,
    generator: np.random.Generator,
    begin: Mapping[str, float] | None = None,
) -> dict[str, Agreement]:
    """Compare each record of a joint posterior with all of them; nothing, if there is one alone.

    Parameters
    ----------
    posterior
        The joint posterior.
    point
        Its point fit.
    generator
        Starts the records' own point fits.
    begin
        Time of each record's first sample, s, by name; by default 0.
    """
    if len(posterior.datasets) == 1:
        return {}
    free, _ = posterior.prior.constrain(point.mode[np.newaxis])
    compared = {}
    for name, alone, its in posterior.each(free):
        known = _with_noise(alone, its)
        own = pointfit.fit(known, generator)
        best, _ = known.prior.constrain(own.mode[np.newaxis])
        rows = alone.only.readings.rows
        missed, own_missed = _residuals(alone, its), _residuals(known, best)
        distance, degrees, moved = _apart(posterior, point, known, own)
        white = innovations(alone, its[0]).white
        some = slice(None, None, -(-rows.size // KEPT))
        first = (begin or {}).get(name, 0.0)
        compared[name] = Agreement(
            float(np.sqrt(np.mean(missed**2))),
            float(np.sqrt(np.mean(own_missed**2))),
            distance,
            degrees,
            moved,
            float(np.sqrt(np.mean(white**2))),
            rows.size,
            first + alone.only.actuator.interval * rows[some].astype(np.float64),
            missed[some],
            own_missed[some],
        )
    return compared


def _with_noise(alone: Posterior, free: FloatArray) -> Posterior:
    """Return the posterior of a record with the noise of some free parameters (1, free) known."""
    theta, physical = alone.prior.theta(free)[0], alone.table.physical
    parameters = (
        p if p.name in physical else replace(p, prior=None, fixed=float(value))
        for p, value in zip(alone.prior.parameters, theta, strict=True)
    )
    return replace(alone, prior=JointPrior(parameters, alone.prior.constraint))


def _residuals(alone: Posterior, free: FloatArray) -> FloatArray:
    """Residuals (readings,) of a record at free parameters (1, free), um."""
    readings = alone.only.readings
    missed: FloatArray = readings.values - alone.simulate(alone.prior.theta(free), readings.rows)[0]
    return missed


def _apart(
    posterior: Posterior, point: PointFit, alone: Posterior, own: PointFit
) -> tuple[float, int, tuple[str, float]]:
    """Return H, its degrees of freedom, and the parameter that is farthest off."""
    names = [name for name in posterior.names if name in alone.names]
    physical = [i for i, name in enumerate(posterior.names) if name in posterior.table.physical]
    here = [physical.index(posterior.names.index(name)) for name in names]
    own_rows = [alone.names.index(name) for name in names]
    if not names:
        return 0.0, 0, ("", 0.0)
    moved = own.mode[own_rows] - point.mode[physical][here]
    mine = own.covariance[np.ix_(own_rows, own_rows)]
    # The covariance given the noise, as that of the record's own fit is.
    precision = linalg.inv(point.covariance)[np.ix_(physical, physical)]
    both = linalg.inv(precision)[np.ix_(here, here)]
    # Principal directions of what the record tells, in the prior's sds.
    prior = np.sqrt(np.diag(own.prior_covariance)[own_rows])
    variance, directions = linalg.eigh(mine / np.outer(prior, prior))
    told = directions[:, variance < TOLD] / prior[:, np.newaxis]
    if not told.shape[1]:
        return 0.0, 0, ("", 0.0)
    left, more = told.T @ mine @ told, told.T @ (mine - both) @ told
    part, axes = linalg.eigh((more + more.T) / 2, left)
    axes, part = axes[:, part > TAKEN], part[part > TAKEN]
    if not part.size:
        return 0.0, 0, ("", 0.0)
    scores = axes.T @ told.T @ moved / np.sqrt(part)
    spread = np.sqrt(np.maximum(np.diag(mine - both), TAKEN * np.diag(mine)))
    away = moved / spread
    worst = int(np.argmax(np.abs(away)))
    return float(scores @ scores), int(part.size), (names[worst], float(away[worst]))


def remarks(every: Mapping[str, Agreement]) -> list[str]:
    """Say, a line each, which records do not go with the others."""
    return [
        f"{name}: does not agree with the other records: its residual is {one.joint_um:.3g} um rms "
        f"in the joint fit and {one.own_um:.3g} um in a fit of its own, and {one.moved[0]} is "
        f"{abs(one.moved[1]):.1f} sds {'higher' if one.moved[1] > 0 else 'lower'} there "
        f"(chi-square {one.distance:.4g} with {one.degrees} degrees of freedom, "
        f"p = {one.p_value:.1g}): fit it alone, or give it what differs as its own with "
        f'model.per_record = ["{one.moved[0]}"]'
        for name, one in every.items()
        if one.disagrees
    ] + [
        f"{name}: has another noise than the records share: its innovations are {one.size:.2g} "
        "times as large as they should be; give it a noise of its own with model.per_record = "
        '["sensor_sd", "discrepancy_sd"]'
        for name, one in every.items()
        if one.noisier
    ]


def numbers(every: Mapping[str, Agreement]) -> dict[str, object]:
    """Return agreements as ``summary.json`` holds them."""
    return {
        name: {
            "residual_joint_um": one.joint_um,
            "residual_own_um": one.own_um,
            "chi_square": one.distance,
            "degrees_of_freedom": one.degrees,
            "p_value": one.p_value,
            "farthest": one.moved[0],
            "farthest_sds": one.moved[1],
            "agrees": not one.disagrees,
            "innovations_rms": one.size,
        }
        for name, one in every.items()
    }
