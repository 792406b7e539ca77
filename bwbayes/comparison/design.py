"""Experimental design: the drive that would most reduce a parameter's SD or a band's width.

Each candidate is a voltage that the amplifier can make. At some posterior draws the model is made
linear in its parameters: the Fisher information of the readings that the candidate would bring,
with the noise of that draw, adds to what is known already. What a fit of the new record would not
know of its start and its offset is not known here either. What would be left of a standard
deviation, averaged over the draws, is the promise; how far the draws scatter is its Monte Carlo
error.

Every reading counts as often as a fit counts it, which trusts the noise model: what the model is
wrong about returns with every period of a steady drive, and is not taken for new each time only as
far as the discrepancy's correlation time says so.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.comparison.designed import DesignScore
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.likelihood import batches
from bwbayes.inference.linearization import value_and_jacobian
from bwbayes.inference.mode_finding import Target
from bwbayes.inference.posterior import Posterior
from bwbayes.model.limits import Limits
from bwbayes.watching import Watch, part, unwatched, watched


def rank_designs(
    posterior: Posterior,
    draws: FloatArray,
    candidates: Mapping[str, FloatArray],
    target: str | FloatArray,
    amplifier: Limits,
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> list[DesignScore]:
    """Rank candidates by what they would teach, the best first.

    With Σ the covariance of the actuator's parameters among the draws, in the coordinates of the
    sampling, and I the information of the candidate's readings about them and about the initial
    state and offset of its record, whose prior is standard normal there
    (:meth:`~bwbayes.inference.mode_finding.Target.linearize`),

        Σ' = (Σ⁻¹ + Iₐₐ − Iₐᵣ (1 + Iᵣᵣ)⁻¹ Iᵣₐ)⁻¹.

    A target's sd goes from √(gᵀ Σ g) to √(gᵀ Σ' g), g its gradient; along a drive the mean over its
    samples counts.

    Parameters
    ----------
    posterior
        The posterior that was sampled.
    draws
        (draws, free), parameters in their own units.
    candidates
        Voltages (samples,) by name, V, at the interval of the fitted record. Their records start
        as that one did: demagnetized and at rest, or in a state that nothing tells.
    target
        The name of a free parameter of the actuator, or a drive (samples,), V, whose parameter band
        is to be narrow.
    amplifier
        Limits of the amplifier.
    generator
        Chooses draws, and draws the starts of the candidates' records.
    watch
        Called with the share that is done.

    Raises
    ------
    InputError
        The target is not a free parameter of the actuator.

    Notes
    -----
    K. Chaloner and I. Verdinelli, Bayesian experimental design: a review, Statistical Science 10
    (1995) 273-304: c-optimality, averaged over the posterior.
    """
    dataset, prior = posterior.single_record, posterior.prior
    scopes = {d.name: d.scope for d in dataset.actuator.declarations if d.name in prior.free_names}
    names = [name for name, scope in scopes.items() if scope == "actuator"]
    if isinstance(target, str) and target not in names:
        hint = suggestion(target, names)
        raise InputError(f"design: {target!r} is not a free parameter of the actuator; {hint}")
    columns, new = (
        np.array([prior.free_names.index(n) for n in scopes if (n in names) is shared], dtype=int)
        for shared in (True, False)
    )
    coordinates = prior.unconstrain(draws[:: max(len(draws) // 4000, 1)])
    covariance = np.atleast_2d(np.cov(coordinates[:, columns], rowvar=False))
    chosen = coordinates[
        generator.choice(len(coordinates), min(40, len(coordinates)), replace=False)
    ]
    proposed = chosen.copy()
    proposed[:, new] = generator.standard_normal((len(chosen), new.size))
    possible = np.isfinite(prior.constrain(proposed)[1])
    chosen[possible] = proposed[possible]

    def targeted(places: FloatArray) -> FloatArray:
        if isinstance(target, str):
            return prior.constrain(places)[0][:, [prior.free_names.index(target)]]
        return band.displacement(*prior.theta_at(places))

    band = _planned(
        posterior, posterior.single_record.voltage if isinstance(target, str) else target
    )
    factor = np.linalg.cholesky(covariance)
    gradients = [value_and_jacobian(targeted, point[np.newaxis], columns)[1][0] for point in chosen]
    before = [_mean_sd(gradient, covariance) for gradient in gradients]
    scores, count = [], len(candidates)
    for number, (name, voltage) in enumerate(candidates.items()):
        refused = amplifier.refuses(voltage, dataset.actuator.interval)
        if refused:
            scores.append(DesignScore(name, np.nan, np.nan, refused))
            continue
        planned, remaining = Target(_planned(posterior, voltage)), []
        this = part(watch, number / count, (number + 1) / count)
        for batch in watched([*batches(len(chosen), 2 * len(scopes) * voltage.size)], this):
            informations = planned.linearize(chosen[batch], expected=True).fisher_information
            for gradient, whole in zip(gradients[batch], informations, strict=True):
                information = _left_open(
                    whole, *(np.searchsorted(planned.physical, c) for c in (columns, new))
                )
                # With Σ = L Lᵀ, which is never inverted: L (1 + Lᵀ I L)⁻¹ Lᵀ.
                inner = np.eye(len(factor)) + factor.T @ information @ factor
                after = factor @ scipy.linalg.solve(inner, factor.T, assume_a="pos")
                remaining.append(_mean_sd(gradient, after))
        shares = np.array(remaining) / before
        error = float(np.std(shares, ddof=1) / np.sqrt(shares.size)) if shares.size > 1 else np.inf
        scores.append(DesignScore(name, float(np.mean(shares)), error))
    return sorted(scores, key=lambda score: (bool(score.refused), score.sd_ratio, score.name))


def _planned(posterior: Posterior, voltage: FloatArray) -> Posterior:
    """Return the posterior of another record of one actuator, of which only readings are missing.

    It starts as the one that was fitted.
    """
    nothing, whole = np.zeros(voltage.size), (slice(0, voltage.size),)
    return posterior.altered(voltage=voltage, displacement=nothing, training=whole)


def _left_open(information: FloatArray, columns: IntArray, new: IntArray) -> FloatArray:
    """Return a record's information about ``columns``, its ``new`` unknowns integrated out.

    These have standard normal priors.
    """
    across = information[np.ix_(columns, new)]
    start = information[np.ix_(new, new)] + np.eye(new.size)
    remaining: FloatArray = information[np.ix_(columns, columns)]
    return remaining - across @ np.linalg.solve(start, across.T)


def _mean_sd(gradient: FloatArray, covariance: FloatArray) -> float:
    """Mean over columns g of √(gᵀ Σ g), for gradients (coordinates, targets)."""
    variances = np.einsum("it,ij,jt->t", gradient, covariance, gradient)
    return float(np.mean(np.sqrt(np.maximum(variances, 0))))
