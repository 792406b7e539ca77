"""Whether records that were fitted jointly agree: each under the joint fit, and under its own.

A joint fit takes its records for those of one actuator. If one of them was measured with another
gain, another mounting or another noise, the joint posterior lies between them and fits none. So
each record is fitted alone, by a point fit, and two things are compared with the joint one: its
residuals, and where the shared parameters are.

With the unconstrained coordinates of the shared parameters, in which the prior is nearly a standard
normal, m and C mean and covariance given all records, m_r and C_r those given record r alone,

    m_r − m ~ N(0, C_r − C)

if all records are those of one actuator that the prior draws: the covariance of a mean that was
learnt from more is larger by what the posterior's is smaller (the law of total variance). So

    H = (m_r − m)ᵀ (C_r − C)⁻¹ (m_r − m)

has a χ² distribution, with as many degrees of freedom as there are directions that the record
tells and that others tell more of. (Without a prior it is Hausman's test, Econometrica 46, 1978.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import linalg, stats

from bwbayes.arrays import FloatArray
from bwbayes.inference import pointfit
from bwbayes.inference.pointfit import PointFit
from bwbayes.inference.posterior import Posterior

__all__ = ["Agreement", "agreements", "numbers", "remarks"]

# A direction counts if the record leaves less than this part of the prior's variance, and if the
# others take away more than this part of what the record leaves: of what it tells by itself alone
# the difference is rounding.
TOLD, TAKEN = 0.5, 0.05

# Probability of a false alarm for a record, and the residual's growth below which a disagreement
# does not matter, however sure it is.
ALARM, GROWN = 1e-4, 1.02

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
    time, joint, own
        (readings,) in s and um: the residuals, thinned.
    """

    joint_um: float
    own_um: float
    distance: float
    degrees: int
    moved: tuple[str, float]
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
        own = pointfit.fit(alone, generator)
        best, _ = alone.prior.constrain(own.mode[np.newaxis])
        rows = alone.only.readings.rows
        joint_missed, own_missed = (_residuals(alone, one) for one in (its, best))
        distance, degrees, moved = _apart(posterior, point, name, own)
        some = slice(None, None, -(-rows.size // KEPT))
        first = (begin or {}).get(name, 0.0)
        compared[name] = Agreement(
            float(np.sqrt(np.mean(joint_missed**2))),
            float(np.sqrt(np.mean(own_missed**2))),
            distance,
            degrees,
            moved,
            first + alone.only.actuator.interval * rows[some].astype(np.float64),
            joint_missed[some],
            own_missed[some],
        )
    return compared


def _residuals(alone: Posterior, free: FloatArray) -> FloatArray:
    """Residuals (readings,) of a record at free parameters (1, free), um."""
    readings = alone.only.readings
    missed: FloatArray = readings.values - alone.simulate(alone.prior.theta(free), readings.rows)[0]
    return missed


def _apart(
    posterior: Posterior, point: PointFit, record: str, own: PointFit
) -> tuple[float, int, tuple[str, float]]:
    """Return H, its degrees of freedom, and the parameter that is farthest off."""
    alone = posterior.alone(record)
    names = [name for name in posterior.names if name in alone.names]
    here = [posterior.names.index(name) for name in names]
    there = [alone.names.index(name) for name in names]
    moved = own.mode[there] - point.mode[here]
    mine = own.covariance[np.ix_(there, there)]
    both = point.covariance[np.ix_(here, here)]
    # Principal directions of what the record tells, in the prior's sds.
    prior = np.sqrt(np.diag(own.prior_covariance)[there])
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
        }
        for name, one in every.items()
    }
