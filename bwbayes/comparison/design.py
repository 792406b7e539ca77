"""Experimental design: the drive that would most reduce a parameter's SD or a band's width.

Each candidate is a voltage that the amplifier can make. At some posterior draws the model is made
linear in its parameters: the Fisher information of the readings that the candidate would bring,
with the noise of that draw, adds to what is known already. As in a fit of the new record, its
initial state and its offset are unknown. The score is the expected remaining share of a standard
deviation, averaged over the draws; their scatter gives its Monte Carlo error.

Every reading counts as often as a fit counts it, which trusts the noise model. The model's error
returns with every period of a steady drive; only the discrepancy's correlation time keeps it from
counting as new each time.

:func:`rank_by_rivals` ranks by what would tell a model from its rivals, other models that fit the
same record (:mod:`bwbayes.diagnosis.rivals`): by how much they differ along a candidate, and what
would be left of their differences if they were fitted to it, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.comparison.designed import DesignScore, RivalScore
from bwbayes.diagnosis.explanations import TIED
from bwbayes.diagnosis.rivals import DRAWS, Rival, close_rivals
from bwbayes.errors import InputError, suggestion
from bwbayes.inference.likelihood import batches
from bwbayes.inference.linearization import value_and_jacobian
from bwbayes.inference.mode_finding import Target
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Study
from bwbayes.model.limits import Limits
from bwbayes.prediction.initial_state import InitialConditions, estimate_initial_states
from bwbayes.record.record import Record
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
            for gradient, full_information in zip(gradients[batch], informations, strict=True):
                information = _left_open(
                    full_information,
                    *(np.searchsorted(planned.physical, c) for c in (columns, new)),
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
    nothing, windows = np.zeros(voltage.size), (slice(0, voltage.size),)
    return posterior.altered(voltage=voltage, displacement=nothing, training=windows)


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


# Samples of a candidate that are looked at, and the part of it that only sets the state.
SAMPLES, SETTLING = 1_000, 0.25


class _Paths:
    """Simulated draws of a model along candidates: deviations (draws, samples) from their mean."""

    def __init__(
        self,
        posterior: Posterior,
        free: FloatArray,
        candidates: Mapping[str, FloatArray],
        rng: np.random.Generator,
    ) -> None:
        dataset, theta = posterior.single_record, posterior.prior.theta(free)
        self.posterior, self.interval = posterior, dataset.actuator.interval
        self.noise = np.median(dataset.table.noise(theta), axis=0, keepdims=True)
        self.mean, self.deviations, self.stride = {}, {}, {}
        for name, voltage in candidates.items():
            record = Record(voltage, None, interval=self.interval, origin=name)
            start = InitialConditions(from_rest=True, hold=dataset.actuator.hold)
            states = estimate_initial_states(posterior, theta, record, start, rng)
            first = round(SETTLING * voltage.size)
            self.stride[name] = -(-(voltage.size - first) // SAMPLES)
            paths = states.displacement(record.inputs)[:, first :: self.stride[name]]
            # Where a record's sensor was set to zero, nothing says.
            paths -= paths.mean(axis=1, keepdims=True)
            self.mean[name] = paths.mean(axis=0)
            self.deviations[name] = (paths - self.mean[name]) / np.sqrt(max(len(paths) - 1, 1))

    def sd(self, name: str) -> float:
        """Return the sd of a reading, given what is known of the model, um."""
        sds = self.posterior.single_record.noise.marginal_sd(self.noise)
        return float(
            np.sqrt(
                np.mean(np.sum(self.deviations[name] ** 2, axis=0)) + sum(s[0] ** 2 for s in sds)
            )
        )

    def fit(self, name: str, readings: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fit readings (records, samples), um, along a candidate, linear in the draws' deviations.

        Returns the sizes (records, draws) of the deviations, and the nats (records,) that their
        evidence trails that of a model that makes the readings, but for what any fit takes up.
        """
        residual, deviations = readings - self.mean[name], self.deviations[name]
        constant = np.full((1, residual.shape[1]), self.posterior.single_record.extent)
        shapes = np.concatenate([deviations, constant])
        noise = self.posterior.single_record.noise.at(self.stride[name] * self.interval)
        series = np.concatenate([shapes, residual])[np.newaxis]
        white = noise.whiten(self.noise, series)[0][0]
        inside, outside = white[: len(shapes)], white[len(shapes) :]
        pull = inside @ outside.T
        sizes = np.linalg.solve(np.eye(len(shapes)) + inside @ inside.T, pull).T
        nats = (np.sum(outside**2, axis=1) - np.sum(sizes.T * pull, axis=0)) / 2
        return sizes[:, :-1], nats


def rank_by_rivals(
    posterior: Posterior,
    draws: FloatArray,
    study: Study,
    rivals: Sequence[Rival],
    candidates: Mapping[str, FloatArray],
    amplifier: Limits,
    rng: np.random.Generator,
    watch: Watch = unwatched,
) -> list[RivalScore]:
    """Rank candidates by what would be left of the rivals' differences, the best first.

    In turn each model, of those that fit the training record about as well as the best, makes the
    readings of a candidate, and the others are fitted to them, linear in their parameters about
    their fit of the training record. Those whose evidence trails by odds of more than twenty to one
    are told apart. The remaining difference is the root mean square, over all other pairs and all
    candidates, of that between a fitted model and the one that made the readings, as a part of
    their difference now.

    Parameters
    ----------
    posterior, draws
        The model: a posterior of one record, and draws (draws, free).
    study, rivals
        The study of that record, and other fits of it.
    candidates
        Voltages (samples,) by name, V, at the interval of the fitted record, from rest.
    amplifier
        Limits of the amplifier.
    rng
        Draws parameters and initial states.
    watch
        Called with the share that is done.

    Raises
    ------
    InputError
        No rival fits the record about as well.
    """
    refused = {
        name: amplifier.refuses(voltage, posterior.single_record.actuator.interval)
        for name, voltage in candidates.items()
    }
    possible = {name: voltage for name, voltage in candidates.items() if not refused[name]}
    scores = [RivalScore(name, np.nan, np.nan, why) for name, why in refused.items() if why]
    if not possible:
        return scores
    draws = draws[rng.integers(len(draws), size=DRAWS)]
    readings = posterior.single_record.readings
    fitted = np.mean(posterior.simulate(posterior.prior.theta(draws), readings.rows), axis=0)
    close = close_rivals(rivals, float(np.std(readings.values - fitted)))
    if not close:
        raise InputError("design: no other model fits the training record about as well")
    models = [(posterior, draws)]
    for rival in close:
        model = rival.posterior(study)
        models.append((model, rival.draw(model, rng)))
    paths = [_Paths(*model, possible, rng) for model in watched(models, watch)]
    truths = {name: np.stack([path.mean[name] for path in paths]) for name in possible}
    now = _pairs_mean_square(
        {name: [truths[name] - p.mean[name] for p in paths] for name in possible}
    )
    for name in possible:
        remaining: dict[str, list[FloatArray]] = {other: [] for other in possible}
        told_apart = 0
        for path in paths:
            sizes, nats = path.fit(name, truths[name])
            out = nats > TIED
            told_apart += int(np.sum(out))
            for other in possible:
                learned = path.mean[other] + sizes @ path.deviations[other]
                remaining[other].append(np.where(out[:, np.newaxis], 0.0, truths[other] - learned))
        difference = np.sqrt(np.mean((truths[name][1:] - truths[name][0]) ** 2))
        scores.append(
            RivalScore(
                name,
                float(np.sqrt(_pairs_mean_square(remaining) / now)),
                np.nan,
                difference_um=float(difference),
                sd_um=paths[0].sd(name),
                told_apart=told_apart / (len(paths) * (len(paths) - 1)),
            )
        )
    return sorted(scores, key=lambda score: (bool(score.refused), score.sd_ratio, score.name))


def _pairs_mean_square(differences: Mapping[str, Sequence[FloatArray]]) -> float:
    """Return the mean square over pairs of models, and over candidates, um².

    A model's own readings do not differ from it.
    """
    squares = [np.mean(np.square(of_model)) for all_ in differences.values() for of_model in all_]
    return float(np.mean(squares))
