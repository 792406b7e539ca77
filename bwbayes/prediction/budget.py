"""The uncertainty budget: which source has which share of what is not known of a quantity.

By the law of total variance, linearized about the posterior's mean in coordinates z whose prior has
unit covariance. A quantity q varies with z by the slopes c that a regression of its draws on theirs
finds. With the readings' Fisher information F and H = F + I the posterior's variance of q is
cᵀ H⁻¹ c. Were the states that records start from known, all but the actuator's parameters a, it
would be

    c_aᵀ H_aa⁻¹ c_a = wᵀ F_w w + wᵀ F_d w + wᵀ w,   w = H_aa⁻¹ c_a,

which errors of the readings, of the model and of the prior's mean bring into an estimate that is
linear in them: F_w = F' R_w F'ᵀ with the weights F' of the readings and the covariance R_w of the
sensor's noise, F_d with that of the discrepancy. As F is of order -2 in the sds s of the noise,
these are -½ ∂F/∂log s. The difference of both variances is the initial state's. Shares of the
linear model are scaled to the variance of the draws, which holds more than it, so that all add up.
The scales of the instruments are independent of z and add (p r m)² to a mean m, with the powers p
in which um and V enter and their relative sds r.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from bwbayes.arrays import BoolArray, FloatArray, IntArray
from bwbayes.inference.mode_finding import Target
from bwbayes.inference.posterior import Posterior
from bwbayes.prediction.loops import driven, measures, steady_loop
from bwbayes.prediction.prediction import stratified_scores
from bwbayes.record.instruments import Instruments, Scales

NOISE, MODEL, STATE = "readings' noise", "model error", "initial state"
CHOICE = "choice of the model"
SENSOR, AMPLIFIER, CURVE = "sensor scale", "amplifier gain", "sensor linearity"
PRIOR, CREEP = "prior", "creep beyond the record"

# How each is evaluated, as JCGM 100 calls it: A from the readings, B from what else is known.
TYPES: Mapping[str, str] = {
    **dict.fromkeys((NOISE, MODEL, STATE, CHOICE), "A"),
    **dict.fromkeys((SENSOR, AMPLIFIER, CURVE, PRIOR, CREEP), "B"),
}


class Measurand(NamedTuple):
    """A quantity as the readings have it: ``values`` (draws,) in a ``unit`` of um and V.

    ``added`` are variances of sources beside the parameters, ``unexplained`` is the source of what
    the parameters do not explain; by default all of them in proportion. ``rows`` are the draws that
    the values are of.
    """

    name: str
    unit: str
    values: FloatArray
    added: Mapping[str, float] = {}
    unexplained: str = ""
    rows: IntArray | slice = slice(None)


@dataclass(frozen=True)
class Budget:
    """The uncertainty of a quantity, in its ``unit``, and where it comes from.

    ``shares`` are parts of the variance ``sd``², by source; they add up to 1. ``lower`` and
    ``upper`` are the ends of the probabilistically symmetric 95% coverage interval (JCGM 101, 5.3).
    """

    name: str
    unit: str
    mean: float
    sd: float
    lower: float
    upper: float
    shares: Mapping[str, float] = field(default_factory=dict)

    @property
    def numbers(self) -> dict[str, Any]:
        """The budget as a summary holds it."""
        estimate = {"quantity": self.name, "mean": self.mean, "sd": self.sd, "unit": self.unit}
        interval = {"lower_95": self.lower, "upper_95": self.upper}
        shares = {
            source: {"type": TYPES[source], "share": share} for source, share in self.shares.items()
        }
        return estimate | interval | {"sources": shares}


def loop_width(posterior: Posterior, draws: FloatArray) -> Measurand:
    """Return the largest width of the loop over the records' range of draws (draws, free)."""
    measured = measures(steady_loop(*driven(posterior, draws)))
    extent, percent = measured["range_um"], measured["max_width_percent"]
    assert extent is not None
    assert percent is not None
    return Measurand("max loop width", "um", np.abs(extent) * percent / 100)


def uncertainty_budgets(
    posterior: Posterior,
    draws: FloatArray,
    quantities: list[Measurand],
    instruments: Instruments,
    scales: Scales,
) -> tuple[Budget, ...]:
    """Return the budget of each quantity, whose values are those of draws (draws, free).

    ``scales`` are those that the ``instruments`` may have, of the same draws.
    """
    target = Target(posterior)
    places = posterior.prior.unconstrain(draws)
    information = _information(target, places.mean(axis=0))
    declared = {parameter.name: parameter.declared for parameter in posterior.prior.parameters}
    names = [posterior.names[column] for column in target.physical]
    is_actuator = np.array([declared[name].scope == "actuator" for name in names], dtype=np.bool_)
    budgets = []
    for quantity in quantities:
        away = quantity.values - np.mean(quantity.values)
        moved = places[quantity.rows][:, target.physical]
        moved = moved - moved.mean(axis=0)
        slopes = np.linalg.lstsq(moved, away, rcond=None)[0]
        shares = _shares(slopes, information, is_actuator)
        variance = float(np.mean(away**2))
        explained = variance
        if quantity.unexplained:
            explained = float(np.mean((moved @ slopes) ** 2))
            share = max(variance - explained, 0.0) / max(explained, 1e-300)
            shares[quantity.unexplained] = shares.get(quantity.unexplained, 0.0) + share
        variances = {source: share * explained for source, share in shares.items()}
        mean = float(np.mean(quantity.values))
        relative_sds = instruments.relative_sds(quantity.unit)
        for source, relative in zip((SENSOR, AMPLIFIER), relative_sds, strict=True):
            variances[source] = (relative * mean) ** 2
        for source, added in quantity.added.items():
            variances[source] = variances.get(source, 0.0) + added
        total = sum(variances.values())
        true = quantity.values * scales.factor(quantity.unit)
        if added := sum(quantity.added.values()):
            (scores,) = stratified_scores(1000, np.random.default_rng(0))
            true = np.add.outer(true, added**0.5 * scores)
        low, high = np.quantile(true, [0.025, 0.975]).tolist()
        ordered = {
            source: variances[source] / total for source in TYPES if variances.get(source, 0.0) > 0
        }
        budgets.append(Budget(quantity.name, quantity.unit, mean, total**0.5, low, high, ordered))
    return tuple(budgets)


def _information(target: Target, place: FloatArray) -> dict[str, FloatArray]:
    """Return the Fisher information in the physical coordinates at a place (free,), by source.

    Information from neither noise nor discrepancy is that of unknown starts of the dynamics.
    """
    posterior = target.posterior
    linear = target.linearize(place[np.newaxis])
    theta, _ = target.prior(place[np.newaxis])
    readings = np.concatenate([dataset.readings.values for dataset in posterior.datasets])
    parts = {
        NOISE: np.zeros_like(linear.fisher_information[0]),
        MODEL: np.zeros_like(linear.fisher_information[0]),
    }
    physical = posterior.table.physical
    for column, parameter in enumerate(posterior.prior.parameters):
        if parameter.name in physical or parameter.unit != "um":
            continue
        steps = np.repeat(theta, 2, axis=0)
        relative = 1e-3
        steps[:, column] *= 1 + relative * np.array([1.0, -1.0])
        informations = posterior.score(
            steps,
            np.repeat(linear.slopes, 2, axis=0),
            np.repeat(readings - linear.residual, 2, axis=0),
        ).fisher_information
        source = NOISE if parameter.plain == "sensor_sd" else MODEL
        parts[source] -= (informations[0] - informations[1]) / (4 * relative)
    parts[STATE] = linear.fisher_information[0] - parts[NOISE] - parts[MODEL]
    return parts


def _shares(
    slopes: FloatArray, information: Mapping[str, FloatArray], is_actuator: BoolArray
) -> dict[str, float]:
    """Return the shares of sources in the variance of what has these slopes, which add up to 1."""
    precision = sum(information.values()) + np.eye(slopes.size)
    weights = np.zeros_like(slopes)
    if is_actuator.any():
        block = precision[np.ix_(is_actuator, is_actuator)]
        weights[is_actuator] = np.linalg.solve(block, slopes[is_actuator])
    parts = {source: float(weights @ matrix @ weights) for source, matrix in information.items()}
    parts[PRIOR] = float(weights @ weights)
    variance = float(slopes @ np.linalg.solve(precision, slopes))
    parts[STATE] += variance - float(slopes @ weights)
    parts = {source: max(part, 0.0) for source, part in parts.items()}
    total = max(sum(parts.values()), 1e-300)
    return {source: part / total for source, part in parts.items()}
