"""What to measure next: which drive would teach most about a parameter, or narrow a band most.

Each candidate is a voltage that the amplifier can make. At some posterior draws the model is made
linear in its parameters: the Fisher information of the readings that the candidate would bring,
with the noise of that draw and an offset of the new record's own, adds to what is known already.
What would be left of a standard deviation, averaged over the draws, is the promise; how far the
draws scatter is its Monte Carlo error.

What the model is wrong about returns whenever the voltage takes the same way again, so a stretch
that is driven several times counts once: a hundred periods of one sine show one loop, not a
hundred. A fit, which trusts the noise model, may look surer than was promised of a steady drive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from bwbayes.arrays import FloatArray
from bwbayes.comparison.designed import Promise
from bwbayes.diagnosis.identifiability import stretches_once
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.posterior import Posterior
from bwbayes.model.inverse.limits import Limits

__all__ = ["promises"]


def promises(
    posterior: Posterior,
    draws: FloatArray,
    candidates: Mapping[str, FloatArray],
    target: str | FloatArray,
    amplifier: Limits,
    generator: np.random.Generator,
) -> list[Promise]:
    """Rank candidates by what they would teach, the best first.

    With Σ the covariance of the actuator's parameters among the draws, in the coordinates of the
    sampling, J the derivatives of the candidate's displacements there and C the noise's covariance,

        Σ' = (Σ⁻¹ + Jᵀ C⁻¹ J)⁻¹,

    the new record's offset integrated out, and each sample weighted by one over how often its
    stretch is driven. A target's sd goes from √(gᵀ Σ g) to √(gᵀ Σ' g), g its
    gradient; along a drive the mean over its samples counts.

    Parameters
    ----------
    posterior
        The posterior that was sampled.
    draws
        (draws, free), parameters in their own units.
    candidates
        Voltages (samples,) by name, V, at the interval of the fitted record, from a demagnetized
        actuator at rest.
    target
        The name of a free parameter of the actuator, or a drive (samples,), V, whose parameter band
        is to be narrow.
    amplifier
        What can be driven.
    generator
        Chooses draws.

    Raises
    ------
    InputError
        The target is not a free parameter of the actuator.

    Notes
    -----
    K. Chaloner and I. Verdinelli, Bayesian experimental design: a review, Statistical Science 10
    (1995) 273-304: c-optimality, averaged over the posterior.
    """
    asker = _Asker.of(posterior, draws, generator)
    if isinstance(target, str) and target not in asker.names:
        hint = suggestion(target, asker.names)
        raise InputError(f"design: {target!r} is not a free parameter of the actuator; {hint}")
    before, gradients = asker.known(target)
    scores: list[Promise] = []
    for name, voltage in candidates.items():
        why = amplifier.refuses(voltage, posterior.only.actuator.interval)
        if why:
            scores.append(Promise(name, np.nan, np.nan, why))
            continue
        remaining = np.array(
            [
                _spread(gradient, asker.after(information)) / sd
                for gradient, information, sd in zip(
                    gradients, asker.information(voltage), before, strict=True
                )
            ]
        )
        error = (
            float(np.std(remaining, ddof=1) / np.sqrt(remaining.size))
            if remaining.size > 1
            else np.inf
        )
        scores.append(Promise(name, float(np.mean(remaining)), error))
    return sorted(scores, key=lambda promise: (bool(promise.refused), promise.left, promise.name))


def _spread(gradient: FloatArray, covariance: FloatArray) -> float:
    """Mean over columns g of √(gᵀ Σ g), for gradients (coordinates, targets)."""
    variances = np.einsum("it,ij,jt->t", gradient, covariance, gradient)
    return float(np.mean(np.sqrt(np.maximum(variances, 0))))


@dataclass(frozen=True)
class _Asker:
    """A posterior made linear at some draws.

    ``places`` (draws, free) are their coordinates, ``columns`` those of the actuator's parameters
    among them, ``names`` their names, ``covariance`` what is known of them, ``steps`` those of
    their derivatives, ``offset_sd`` the prior sd of the new record's offset, um.
    """

    posterior: Posterior
    places: FloatArray
    columns: tuple[int, ...]
    names: tuple[str, ...]
    covariance: FloatArray
    steps: FloatArray
    offset_sd: float

    @classmethod
    def of(cls, posterior: Posterior, draws: FloatArray, generator: np.random.Generator) -> _Asker:
        """Choose the draws, and see what is known."""
        dataset, prior = posterior.only, posterior.prior
        names = [
            d.name
            for d in dataset.actuator.declarations
            if d.scope == "actuator" and d.name in prior.free_names
        ]
        columns = tuple(prior.free_names.index(name) for name in names)
        coordinates = prior.unconstrain(draws[:: max(len(draws) // 4000, 1)])
        covariance = np.atleast_2d(np.cov(coordinates[:, columns], rowvar=False))
        chosen = generator.choice(len(coordinates), min(40, len(coordinates)), replace=False)
        offset_sd = 0.0
        for parameter in prior.free:
            if parameter.name == "offset" and parameter.prior is not None:
                offset_sd = float(parameter.prior.frozen.std())
        steps = 0.01 * np.sqrt(np.diag(covariance))
        return cls(
            posterior, coordinates[chosen], columns, tuple(names), covariance, steps, offset_sd
        )

    def _theta(self, position: FloatArray) -> FloatArray:
        """Return θ (2 coordinates, parameters), steps to either side of a place (free,)."""
        count = len(self.columns)
        moved = np.repeat(position[np.newaxis], 2 * count, axis=0)
        rows = np.arange(count)
        moved[rows, self.columns] += self.steps
        moved[count + rows, self.columns] -= self.steps
        prior, table = self.posterior.prior, self.posterior.only.table
        theta = prior.theta(prior.constrain(moved)[0])
        return table.replaced(theta, "initial", np.zeros(len(theta)))

    def _slopes(self, values: FloatArray) -> FloatArray:
        """Return derivatives (coordinates, ...) from values (2 coordinates, ...) at either side."""
        plus, minus = np.split(values, 2)
        slopes: FloatArray = ((plus - minus).T / (2 * self.steps)).T
        return slopes

    def _displacement(self, position: FloatArray, voltage: FloatArray) -> FloatArray:
        """Return derivatives (coordinates, samples) of the displacement along a voltage."""
        dataset = self.posterior.only
        model = dataset.table.actuator(self._theta(position))
        actuator = self.posterior.likelihood.actuator
        return self._slopes(actuator.displacement(model, voltage, from_rest=True))

    def known(self, target: str | FloatArray) -> tuple[list[float], list[FloatArray]]:
        """Return the spread before, and the target's gradients, at each draw."""
        if isinstance(target, str):
            column = self.posterior.only.table.names.index(target)
            gradients = [
                self._slopes(self._theta(position)[:, [column]]) for position in self.places
            ]
        else:
            gradients = [self._displacement(position, target) for position in self.places]
        return [_spread(gradient, self.covariance) for gradient in gradients], gradients

    def information(self, voltage: FloatArray) -> list[FloatArray]:
        """Return the Fisher information (coordinates, coordinates) of a candidate, at each draw."""
        dataset, prior = self.posterior.only, self.posterior.prior
        noise = dataset.table.noise(prior.theta(prior.constrain(self.places)[0]))
        once, _ = stretches_once(voltage, np.arange(voltage.size))
        matrices = []
        for position, sd in zip(self.places, noise, strict=True):
            slopes = self._displacement(position, voltage)
            series = np.concatenate([slopes, np.ones((1, voltage.size))])
            (white,), _ = dataset.noise.whiten(sd[np.newaxis], series[np.newaxis])
            products = (white * once) @ white.T
            if self.offset_sd:
                offset_row, level = products[:-1, -1], products[-1, -1] + self.offset_sd**-2
                matrices.append(products[:-1, :-1] - np.outer(offset_row, offset_row) / level)
            else:
                matrices.append(products[:-1, :-1])
        return matrices

    def after(self, information: FloatArray) -> FloatArray:
        """Return the covariance that would be left."""
        # With Σ = L Lᵀ, which is never inverted: L (1 + Lᵀ I L)⁻¹ Lᵀ.
        factor = np.linalg.cholesky(self.covariance)
        inner = np.eye(len(factor)) + factor.T @ information @ factor
        covariance: FloatArray = factor @ linalg.solve(inner, factor.T, assume_a="pos")
        return covariance
