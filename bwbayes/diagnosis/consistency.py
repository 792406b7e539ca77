"""Consistency of jointly fitted records: each under the joint fit, and under a single fit.

A joint fit assumes that all its records are of one actuator. If one of them was measured with
another gain or mounting, the joint posterior lies between them and fits none. So each record is
fitted alone, from the joint fit's mode and with its noise. With the mean m and the covariance C of
its parameters given all records, m_r and C_r given record r alone, and its log likelihood ℓ,

    D = 2 [ℓ(m_r) − ℓ(m) + ∇ℓ(m_r)ᵀ (m − m_r)]

is the cost of the joint fit for the record, less the cost of the prior at m_r. If all were normal,
D would be (m_r − m)ᵀ A (m_r − m), with the precision A that the record adds to its prior's.
If all records are those of one actuator that the prior draws, m_r − m ~ N(0, C_r − C) (the law of
total variance). So D is a sum of squares of standard normals, weighted by the eigenvalues of
A (C_r − C), nearly a multiple of a χ² variable with its mean and variance (Satterthwaite,
Biometrics Bulletin 2, 1946; at p = 1e-3 off by less than a factor of two). With
(m_r − m)ᵀ (C_r − C)⁻¹ (m_r − m) alone, as in Hausman's test, a curved posterior would count as a
disagreement: D is a difference of likelihoods, independent of the coordinates.

The innovations show whether a record has another noise: at the joint mode they have a root mean
square of 1 if the shared noise is that of the record.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.innovations import innovations
from bwbayes.diagnosis.laplace import LocalFit, climb
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.posterior import Posterior
from bwbayes.watching import Watch, unwatched, watched

# Probability of a false alarm for a record.
ALARM = 1e-3


@dataclass(frozen=True)
class Consistency:
    """Consistency of a record of a joint fit with the others.

    Parameters
    ----------
    joint_rms_um, single_rms_um
        Root mean square of its residuals at the joint mode and at the mode of its own fit, um.
    distance, degrees
        D in units in which it is a χ² variable, and its degrees of freedom; both zero if nothing
        can be compared.
    moved
        The shared parameter that is farthest off, and its distance in sds of the difference; empty
        if nothing can be compared.
    size, readings
        Root mean square of its innovations at the joint mode, and their number.
    time, joint, own
        (readings,) in s and um: the residuals, thinned.
    """

    joint_rms_um: float
    single_rms_um: float
    distance: float
    degrees: float
    moved: tuple[str, float]
    size: float
    readings: int
    time: FloatArray
    joint: FloatArray
    own: FloatArray

    @property
    def p_value(self) -> float:
        """Probability of a larger distance if all records are of one actuator."""
        return float(scipy.stats.chi2.sf(self.distance, self.degrees)) if self.degrees else 1.0

    @property
    def disagrees(self) -> bool:
        """True if the record differs from the others, beyond chance and by a relevant amount."""
        return self.p_value < ALARM and self.joint_rms_um > 1.02 * self.single_rms_um

    @property
    def noisier(self) -> bool:
        """True if its noise differs from the shared noise, beyond chance and by a relevant amount.

        The discrepancy of a short record may be a fifth smaller or larger by chance.
        """
        below = scipy.stats.chi2.cdf(self.readings * self.size**2, self.readings)
        return min(below, 1 - below) < ALARM / 2 and not 0.8 < self.size < 1.25

    @property
    def numbers(self) -> dict[str, object]:
        """Numbers for ``summary.json``."""
        return {
            "residual_joint_um": self.joint_rms_um,
            "residual_own_um": self.single_rms_um,
            "chi_square": self.distance,
            "degrees_of_freedom": self.degrees,
            "p_value": self.p_value,
            "farthest": self.moved[0],
            "farthest_sds": self.moved[1],
            "agrees": not self.disagrees,
            "innovations_rms": self.size,
        }


def agreements(
    posterior: Posterior,
    point: MAPEstimate,
    begin: Mapping[str, float] | None = None,
    watch: Watch = unwatched,
) -> dict[str, Consistency]:
    """Compare each record of a joint posterior with all of them; return {} for a single record.

    Parameters
    ----------
    posterior
        The joint posterior.
    point
        Its point fit.
    begin
        Time of each record's first sample, s, by name; by default 0.
    watch
        Called with the share that is done.
    """
    if len(posterior.datasets) == 1:
        return {}
    free, _ = posterior.prior.constrain(point.mode[np.newaxis])
    compared = {}
    for name, single, joint_free in watched([*posterior.each(free)], watch):
        # Fix its noise at that of the joint fit.
        theta, physical = single.prior.theta(joint_free)[0], single.table.physical
        parameters = (
            p if p.name in physical else replace(p, prior=None, fixed=float(value))
            for p, value in zip(single.prior.parameters, theta, strict=True)
        )
        with_noise = replace(single, prior=JointPrior(parameters, single.prior.constraint))
        names = (posterior.table.name_of(plain, name) for plain in with_noise.names)
        columns = [posterior.names.index(column) for column in names]
        own_fit = climb(with_noise, point.mode[columns])
        series = innovations(single, joint_free[0], (begin or {}).get(name, 0.0))
        own_residual = innovations(with_noise, own_fit.free).residual
        joint_rms_um, single_rms_um, size = (
            float(np.sqrt(np.mean(x**2))) for x in (series.residual, own_residual, series.white)
        )
        # Keep some 2,000 residuals, for pictures.
        step = slice(None, None, -(-series.time.size // 2000))
        compared[name] = Consistency(
            joint_rms_um,
            single_rms_um,
            *_distance(posterior, point, columns, own_fit),
            size,
            series.time.size,
            series.time[step],
            series.residual[step],
            own_residual[step],
        )
    return compared


def _distance(
    posterior: Posterior, point: MAPEstimate, columns: Sequence[int], own_fit: LocalFit
) -> tuple[float, float, tuple[str, float]]:
    """Return D as a χ², its degrees of freedom, and the shared parameter that is farthest off.

    ``columns`` are the joint posterior's coordinates of a record's own fit.
    """
    physical = [i for i, name in enumerate(posterior.names) if name in posterior.table.physical]
    rows = [physical.index(column) for column in columns]
    # Condition the covariance on the noise, as in the record's own fit.
    precision = scipy.linalg.inv(point.covariance)[np.ix_(physical, physical)]
    taken = own_fit.covariance - scipy.linalg.inv(precision)[np.ix_(rows, rows)]
    added = scipy.linalg.inv(own_fit.covariance) - np.eye(len(rows))
    weights = np.maximum(scipy.linalg.eigvals(added @ taken).real, 0.0)
    # Parameters that only one record determines differ by rounding alone: nothing can be compared.
    smallest = 0.05
    if not weights.sum() > smallest:
        return 0.0, 0.0, ("", 0.0)
    unit = float(np.sum(weights**2) / np.sum(weights))
    spread = np.sqrt(np.maximum(np.diag(taken), smallest * np.diag(own_fit.covariance)))
    away = own_fit.coordinates - point.mode[columns]
    shifts = {
        name: float(shift)
        for name, shift in zip(own_fit.posterior.names, away / spread, strict=True)
        if name in posterior.names
    }
    farthest = max(shifts, key=lambda name: abs(shifts[name]))
    fraction = 1e-3
    step = -fraction * away
    places = np.stack(
        [
            own_fit.coordinates,
            point.mode[columns],
            own_fit.coordinates + step,
            own_fit.coordinates - step,
        ]
    )
    _, log_prior = own_fit.posterior.prior.constrain(places)
    log_likelihood = own_fit.posterior.log_density(places[:2]) - log_prior[:2]
    # At the mode, the gradients of likelihood and prior add up to zero.
    slope = (log_prior[3] - log_prior[2]) / (2 * fraction)
    cost = max(float(2 * (log_likelihood[0] - log_likelihood[1] + slope)), 0.0)
    return cost / unit, float(np.sum(weights)) / unit, (farthest, shifts[farthest])


def disagreements(compared: Mapping[str, Consistency]) -> Iterator[Finding]:
    """Yield a finding for each record that is inconsistent with the others or has another noise."""
    for name, record in compared.items():
        parameter, away = record.moved
        if record.disagrees:
            yield Finding(
                name,
                "is inconsistent with the other records: its residual is "
                f"{record.joint_rms_um:.3g} um rms in the joint fit and "
                f"{record.single_rms_um:.3g} um in a fit of its own, where "
                f"{parameter} is {abs(away):.1f} SD {'higher' if away > 0 else 'lower'} "
                f"(chi-square {record.distance:.4g} with {record.degrees:.3g} degrees of freedom, "
                f"p = {record.p_value:.1g})",
                f'fit it alone, or set model.per_record = ["{parameter}"]',
            )
        if record.noisier:
            yield Finding(
                name,
                f"has another noise than the records share: its innovations are {record.size:.2g} "
                "times as large as they should be",
                'set model.per_record = ["sensor_sd", "discrepancy_sd"]',
            )
