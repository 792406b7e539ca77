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

Priors may conflict with the posterior, too: they disagree, it presses against a bound, or its unit
is another. A finding's kind is the parameter, and its fix a line of config. The same findings come
from the point fit, before any sampling, by :func:`around`, and from the posterior's draws. The
score of a parameter that its prior describes exceeds three once in 400 times, and more rarely if
the posterior is wide; a posterior that is flat between its bounds or has its peak inside does not
press.
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
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.posterior import Posterior
from bwbayes.model.declaration import Distribution
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


# Number of draws that represent a prior, or a Gaussian posterior.
DRAWS = 4000


def effective(prior: JointPrior, generator: np.random.Generator) -> FloatArray:
    """Return the 2.5%, 50% and 97.5% quantiles of the joint prior, (3, free).

    The physical constraints cut the joint prior, so they are not those of the stated priors: where
    |γ| ≤ β, small β become less probable, and an initial state inside the hysteresis ceiling makes
    α larger.
    """
    quantiles: FloatArray = np.quantile(prior.draw(generator, DRAWS), [0.025, 0.5, 0.975], axis=0)
    return quantiles


def around(prior: JointPrior, point: MAPEstimate, generator: np.random.Generator) -> FloatArray:
    """Return draws (draws, free) of the Gaussian approximation around a point fit."""
    spread = np.linalg.cholesky(point.covariance)
    moves = generator.standard_normal((DRAWS, point.mode.size)) @ spread.T
    free, density = prior.constrain(point.mode + moves)
    return free[np.isfinite(density)]


def normal_scores(parameter: Parameter, values: FloatArray) -> FloatArray:
    """Return the normal scores of draws (draws,) under a parameter's own prior."""
    assert parameter.prior is not None
    low, high = (np.asarray(end) for end in parameter.support)
    # A float cannot hold the probability beyond a score of 37.
    return np.clip(parameter.prior.to_normal(values, low, high), -37.0, 37.0)


def conflicts(
    prior: JointPrior, draws: FloatArray, defaults: Mapping[str, Distribution]
) -> list[Finding]:
    """Return the conflicts of priors and posterior.

    Parameters
    ----------
    prior
        The priors of the run.
    draws
        (draws, free), of the posterior or from :func:`around`.
    defaults
        The default priors of the same record by name.
    """
    columns = dict(zip(prior.free_names, draws.T, strict=True))
    findings = []
    for parameter in prior.parameters:
        default = defaults.get(parameter.name)
        finding = default and _another_unit(parameter, default)
        if not finding and parameter.prior is not None:
            finding = _disagreement(parameter, columns[parameter.name], default)
        if finding:
            findings.append(finding)
    return [*findings, *_pressed_bounds(prior, columns)]


def _another_unit(parameter: Parameter, default: Distribution) -> Finding | None:
    """Find a positive parameter whose scale is far from the one the record's ranges suggest."""
    if not parameter.positive or parameter.prior == default:
        return None
    low, expected, high = default.frozen.ppf([0.16, 0.5, 0.84]).tolist()
    sd = float(np.log(high / low)) / 2
    label, value = "fixed value", parameter.fixed
    if parameter.prior is not None:
        label, value = "prior's median", float(parameter.prior.frozen.median())
    if value is None or value <= 0:
        return None
    distance = float(np.log(value / expected))
    # A factor of a hundred that is unlikely under the default prior is another unit.
    if abs(distance) < max(np.log(100), 2.5 * sd):
        return None
    return Finding(
        parameter.name,
        f"its {label}, {value:.3g} {parameter.unit}, is {np.exp(distance):.0e} times what the "
        f"record's ranges suggest ({expected:.3g})",
        f"check its unit; the default is {_line(parameter.name, default)}",
    )


def _disagreement(
    parameter: Parameter, values: FloatArray, default: Distribution | None
) -> Finding | None:
    """Find a parameter whose posterior mean is more than three sds from its prior."""
    assert parameter.prior is not None
    score = float(np.mean(normal_scores(parameter, values)))
    if abs(score) <= 3:
        return None
    side = "above" if score > 0 else "below"
    mean = f"{np.mean(values):.3g} {parameter.unit}".rstrip(" -")
    text = f"posterior mean {mean} is {abs(score):.1f} SD {side} its prior {parameter.prior}"
    wider = default or parameter.prior
    low, high = (np.asarray(end) for end in parameter.support)
    if abs(float(np.mean(wider.to_normal(values, low, high)))) > 3:
        widths, stated = ("sd", "sigma", "scale"), parameter.prior
        double = {k: 2 * v if k in widths else v for k, v in stated.arguments.items()}
        wider = Distribution(stated.name, double)
    if wider == parameter.prior:  # the prior ends at a bound; `_pressed_bounds` reports that
        return None
    return Finding(parameter.name, text, conflict_fix(parameter.name, wider))


def conflict_fix(name: str, wider: Distribution) -> str:
    """Return the fix for a record that conflicts with a parameter's prior."""
    line = _line(name, wider)
    return f"check the units of prior and record; if both are right, give {line}"


def _pressed_bounds(prior: JointPrior, columns: Mapping[str, FloatArray]) -> Iterator[Finding]:
    """Yield bounds that the posterior presses on: a parameter's own, and those others set."""
    fixed = {p.name: p.fixed for p in prior.parameters if p.fixed is not None}
    size = next(iter(columns.values())).size
    values = {**{n: np.full(size, v) for n, v in fixed.items()}, **columns}
    for parameter in prior.free:
        name, (low, high) = parameter.name, parameter.support
        # A bound that the stage itself declares is no choice of the prior.
        limits = parameter.declared.limits(prior.values_for_record(values, parameter.record))
        given_low, given_high = low > np.max(limits[0]), high < np.min(limits[1])
        if parameter.declared.reaches_floor and low == parameter.floor:
            if _near(values[name] - low):
                yield Finding(
                    name, f"lies on its bound {low:g}", f"give {name} = {{ fixed = {low:.1f} }}"
                )
        elif given_low and low != 0 and np.isfinite(low) and _near(values[name] - low):
            yield _given_bound(parameter, "lower", low)
        if given_high and np.isfinite(high) and _near(high - values[name]):
            yield _given_bound(parameter, "upper", high)
    for parameter in prior.parameters:
        declared = parameter.declared
        limits = declared.limits(prior.values_for_record(values, parameter.record))
        for side, bound in zip(("lower", "upper"), limits, strict=True):
            advice = declared.pressed.get(side)
            if advice is None or not np.isfinite(bound).all():
                continue
            x = values[parameter.name]
            gap = (bound - x if side == "upper" else x - bound) / np.abs(bound)
            # A bound that draws exceed does not hold here, and a ratio that the record hardly
            # determines presses on its bound by chance.
            if float(np.min(gap)) >= 0 and np.std(gap) < 0.05 and _near(gap):
                text = f"lies on its {side} bound of {declared.stated_bounds}"
                yield Finding(parameter.name, text, advice)


def _near(gap: FloatArray) -> bool:
    """Tell whether draws (draws,) of the distance to a bound pile up at zero.

    They do if more than 0.3 of them lie within half a posterior sd of it. That part is 0.14 for a
    flat posterior, 0.24 for half a normal one with its peak on the bound, 0.30 for a normal one cut
    off a sd from its peak beyond the bound, 0.39 for an exponential one.
    """
    sd = float(np.std(gap))
    return sd > 0 and float(np.mean(gap < 0.5 * sd)) > 0.3


def _given_bound(parameter: Parameter, side: str, bound: float) -> Finding:
    fix = f"move parameters.{parameter.name}.{side}"
    if bound not in (parameter.lower, parameter.upper):
        declared = parameter.declared
        advice = declared.pressed.get(side) if declared.bounds is None else None
        fix = advice or f"widen its prior {parameter.prior}, which ends there"
    text = f"lies on its {side} bound {bound:.4g} {parameter.unit}"
    return Finding(parameter.name, text.rstrip(), fix)


def _line(name: str, distribution: Distribution) -> str:
    """Write a prior as a config's line under ``[parameters]``."""
    arguments = "".join(f", {key} = {value:.6g}" for key, value in distribution.arguments.items())
    key = name if name.isidentifier() else f'"{name}"'
    return f'{key} = {{ prior = {{ distribution = "{distribution.name}"{arguments} }} }}'
