"""Rivals of a model: others that fit the same record, and by how much they disagree elsewhere.

Where what a model misses follows the drive (:mod:`bwbayes.diagnosis.drive_lock`), the record does
not say what it misses on another drive. Models of other families, which fit the record about as
well, say how far that may go: another operator, the nonlinearity elsewhere on the signal's path,
creep or none. Where all of them agree, the drive leaves no room for what they differ in.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.laplace import LocalFit, climb
from bwbayes.diagnosis.residual_analysis import READINGS
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Study
from bwbayes.inference.thinning import stride_of, thin, thin_posterior
from bwbayes.model.nonlinearity import TERMS
from bwbayes.model.spec import ModelSpec
from bwbayes.prediction.initial_state import InitialConditions
from bwbayes.prediction.prediction import predict_record
from bwbayes.record import Record

# Rivals miss at most so many times what the best of them misses.
MISSES = 3.0

# Draws of each model, whose mean is its prediction.
DRAWS = 40


def families(spec: ModelSpec) -> Iterator[ModelSpec]:
    """Yield models of other families than a model: one for each."""
    asymmetric = ("saturation", "sensor-curve")
    base = spec.without(*{*asymmetric, *TERMS, "creep"}.intersection(spec.chain))
    curved = base.with_stages(*TERMS)
    operators = {"bouc-wen", "duhem", "plays"} - {spec.operator.name}
    for rival in (
        curved,
        *(base.with_stages(name) for name in asymmetric),
        curved.with_stages("creep"),
        *(curved.with_stages(name) for name in sorted(operators)),
    ):
        if rival != spec:
            yield rival


def fit_rivals(study: Study, rng: np.random.Generator) -> tuple[LocalFit, ...]:
    """Fit a rival of each family to the record of a study, of long ones to some thousand readings.

    Each starts at what it has in common with the model, and at its own valley.
    """
    posterior_full = study.posterior
    origin = map_estimate.local_minima(posterior_full, rng, 1)[0]
    theta = posterior_full.prior.theta(posterior_full.prior.constrain(origin[np.newaxis])[0])
    stride = stride_of(thin_posterior(posterior_full, theta, READINGS), posterior_full)
    known_values = dict(zip(posterior_full.names, origin.tolist(), strict=True))
    fits = []
    for spec in families(study.spec):
        # One that needs a prior that is not stated is no rival.
        with suppress(InputError):
            posterior = study.with_model(spec).posterior
            posterior = replace(posterior, datasets=(thin(posterior.single_record, stride),))
            start = np.array([[known_values.get(name, 0.0) for name in posterior.names]])
            places = np.concatenate([start, map_estimate.local_minima(posterior, rng, 1)])
            fits.append(climb(posterior, places))
    return tuple(fit for fit in fits if fit.follows)


def disagreement(
    posterior: Posterior,
    draws: FloatArray,
    rivals: Sequence[LocalFit],
    record: Record,
    start: InitialConditions,
    rng: np.random.Generator,
) -> float:
    """Return by how much more rivals differ from a model on another record than in training, um.

    The root of the mean square over rivals and readings, less that in training, which the
    discrepancy has in it; of those rivals that fit the training about as well as the best.

    Parameters
    ----------
    posterior, draws
        The model: a posterior of one record, and draws (draws, free).
    rivals
        Other fits of that record.
    record, start
        The other record, and what is known of its start.
    rng
        Draws rivals' parameters and initial states.
    """
    draws = draws[rng.integers(len(draws), size=DRAWS)]
    trained = posterior.single_record
    theta = posterior.prior.theta(draws)
    fitted = np.mean(posterior.simulate(theta), axis=0)
    missed = trained.readings.values - fitted[trained.readings.rows]
    limit = MISSES * min([float(np.std(missed)), *(rival.rmse for rival in rivals)])
    predicted = predict_record(posterior, draws, record, start, rng)
    scored = slice(predicted.scored_from, None)
    excess = []
    for rival in rivals:
        if rival.rmse > limit:
            continue
        rows = rival.posterior.single_record.readings.rows * stride_of(rival.posterior, posterior)
        training = np.mean((rival.displacement - fitted[rows]) ** 2)
        other = predict_record(rival.posterior, _laplace(rival, rng), record, start, rng)
        difference = other.mean[scored] - predicted.mean[scored]
        excess.append(np.mean(difference**2) - training)
    return float(np.sqrt(max(np.mean(excess), 0.0))) if excess else 0.0


def _laplace(fit: LocalFit, rng: np.random.Generator) -> FloatArray:
    """Draw (draws, free) of a fit by Laplace's approximation; its mode if none is possible."""
    scores = rng.multivariate_normal(fit.coordinates, fit.covariance, DRAWS, method="eigh")
    free, density = fit.posterior.prior.constrain(scores)
    return free[np.isfinite(density)] if np.isfinite(density).any() else fit.free[np.newaxis]
