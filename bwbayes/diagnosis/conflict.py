"""Conflicts of priors and posterior: disagreement, pressure against a bound, another unit.

A finding's kind is the parameter, and its fix a line of config. The same findings come from the
point fit, before any sampling, by :func:`around`, and from the posterior's draws. The score of a
parameter that its prior describes exceeds three once in 400 times, and more rarely if the posterior
is wide; a posterior that is flat between its bounds or has its peak inside does not press.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.model.declaration import Distribution

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
    return [*findings, *_pressed(prior, columns)]


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
    if wider == parameter.prior:  # the prior ends at a bound; `_pressed` reports that
        return None
    return Finding(parameter.name, text, conflict_fix(parameter.name, wider))


def conflict_fix(name: str, wider: Distribution) -> str:
    """Return the fix for a record that conflicts with a parameter's prior."""
    line = _line(name, wider)
    return f"check the units of prior and record; if both are right, give {line}"


def _pressed(prior: JointPrior, columns: Mapping[str, FloatArray]) -> Iterator[Finding]:
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
