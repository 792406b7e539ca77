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

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.comparison.designed import Promise
from bwbayes.diagnosis.identifiability import stretches_once
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.posterior import Posterior
from bwbayes.model.limits import Limits


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
    dataset, prior = posterior.only, posterior.prior
    declared = [d.name for d in dataset.actuator.declarations if d.scope == "actuator"]
    names = [name for name in declared if name in prior.free_names]
    if isinstance(target, str) and target not in names:
        hint = suggestion(target, names)
        raise InputError(f"design: {target!r} is not a free parameter of the actuator; {hint}")
    columns = [prior.free_names.index(name) for name in names]
    coordinates = prior.unconstrain(draws[:: max(len(draws) // 4000, 1)])
    covariance = np.atleast_2d(np.cov(coordinates[:, columns], rowvar=False))
    chosen = coordinates[
        generator.choice(len(coordinates), min(40, len(coordinates)), replace=False)
    ]
    noise = dataset.table.noise(prior.theta(prior.constrain(chosen)[0]))
    steps = 0.01 * np.sqrt(np.diag(covariance))

    def derivatives(position: FloatArray, quantity: str | FloatArray) -> FloatArray:
        """Return those (coordinates, ...) of a parameter, or of the displacement on a voltage."""
        moved = np.tile(position, (2 * len(columns), 1))
        rows = np.arange(len(columns))
        moved[rows, columns] += steps
        moved[len(columns) + rows, columns] -= steps
        theta = prior.theta(prior.constrain(moved)[0])
        theta = dataset.table.replaced(theta, "initial", np.zeros(len(theta)))
        if isinstance(quantity, str):
            values = theta[:, [dataset.table.names.index(quantity)]]
        else:
            models = dataset.table.actuator(theta)
            values = posterior.likelihood.actuator.displacement(models, quantity, from_rest=True)
        above, below = np.split(values, 2)
        return np.asarray((above - below) / (2 * steps[:, np.newaxis]))

    factor = np.linalg.cholesky(covariance)
    gradients = [derivatives(position, target) for position in chosen]
    before = [_mean_sd(gradient, covariance) for gradient in gradients]
    offset_sd = next(
        (
            float(p.prior.frozen.std())
            for p in prior.free
            if p.name == "offset" and p.prior is not None
        ),
        0.0,
    )
    scores = []
    for name, voltage in candidates.items():
        refused = amplifier.refuses(voltage, dataset.actuator.interval)
        if refused:
            scores.append(Promise(name, np.nan, np.nan, refused))
            continue
        once, _ = stretches_once(voltage, np.arange(voltage.size))
        remaining = []
        for position, sd, gradient in zip(chosen, noise, gradients, strict=True):
            series = np.concatenate([derivatives(position, voltage), np.ones((1, voltage.size))])
            (white,), _ = dataset.noise.whiten(sd[np.newaxis], series[np.newaxis])
            products = (white * once) @ white.T
            # The last row is the offset's, which is integrated out.
            information, offset = products[:-1, :-1], products[:-1, -1:]
            if offset_sd:
                information = information - offset @ offset.T / (products[-1, -1] + offset_sd**-2)
            # With Σ = L Lᵀ, which is never inverted: L (1 + Lᵀ I L)⁻¹ Lᵀ.
            inner = np.eye(len(factor)) + factor.T @ information @ factor
            after = factor @ scipy.linalg.solve(inner, factor.T, assume_a="pos")
            remaining.append(_mean_sd(gradient, after))
        shares = np.array(remaining) / before
        error = float(np.std(shares, ddof=1) / np.sqrt(shares.size)) if shares.size > 1 else np.inf
        scores.append(Promise(name, float(np.mean(shares)), error))
    return sorted(scores, key=lambda promise: (bool(promise.refused), promise.left, promise.name))


def _mean_sd(gradient: FloatArray, covariance: FloatArray) -> float:
    """Mean over columns g of √(gᵀ Σ g), for gradients (coordinates, targets)."""
    variances = np.einsum("it,ij,jt->t", gradient, covariance, gradient)
    return float(np.mean(np.sqrt(np.maximum(variances, 0))))
