"""Rivals of a model: others that fit the same record, and by how much they disagree elsewhere.

Where what a model misses follows the drive (:mod:`bwbayes.diagnosis.drive_lock`), the record does
not say what it misses on another drive. Models of other families, which fit the record about as
well, say how far that may go: another operator, the nonlinearity elsewhere on the signal's path,
creep or none. Where all of them agree, the drive leaves no room for what they differ in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.laplace import climb
from bwbayes.diagnosis.residual_analysis import READINGS
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Study
from bwbayes.inference.thinning import stride_of, thin, thin_posterior
from bwbayes.model.nonlinearity import TERMS
from bwbayes.model.spec import ModelSpec
from bwbayes.prediction.bands import Bands
from bwbayes.shown import brief
from bwbayes.watching import Watch, unwatched, watched

# Rivals miss at most so many times what the best of them misses.
MISSES = 3.0

# Draws of each model, whose mean is its prediction.
DRAWS = 40


@dataclass(frozen=True)
class Rival:
    """A model of another family at its fit of a training record, by Laplace's approximation.

    Attributes
    ----------
    spec
        The model.
    coordinates, covariance
        Its mode (free,) and the covariance (free, free) about it, in the sampling's coordinates.
    rmse
        Root mean square of the training readings less its displacement, um.
    """

    __repr__ = brief

    spec: ModelSpec
    coordinates: FloatArray
    covariance: FloatArray
    rmse: float

    def posterior(self, study: Study) -> Posterior:
        """Return its posterior of the record that it was fitted to, which a ``study`` has."""
        return study.with_model(self.spec).posterior

    def draw(self, posterior: Posterior, rng: np.random.Generator) -> FloatArray:
        """Draw (draws, free) parameters in their own units; the mode if no draw is possible."""
        prior = posterior.prior
        scores = rng.multivariate_normal(self.coordinates, self.covariance, DRAWS, method="eigh")
        free, density = prior.constrain(scores)
        if not np.isfinite(density).any():
            return prior.constrain(self.coordinates[np.newaxis])[0]
        return free[np.isfinite(density)]


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


def fit_rivals(
    study: Study, rng: np.random.Generator, watch: Watch = unwatched
) -> tuple[Rival, ...]:
    """Fit a rival of each family to the record of a study, of long ones to some thousand readings.

    Each starts at what it has in common with the model, and at its own valley. ``watch`` is called
    with the share that is done.
    """
    posterior_full = study.posterior
    origin = map_estimate.local_minima(posterior_full, rng, 1)[0]
    theta = posterior_full.prior.theta(posterior_full.prior.constrain(origin[np.newaxis])[0])
    stride = stride_of(thin_posterior(posterior_full, theta, READINGS), posterior_full)
    known_values = dict(zip(posterior_full.names, origin.tolist(), strict=True))
    rivals = []
    for spec in watched([*families(study.spec)], watch):
        # One that needs a prior that is not stated is no rival.
        with suppress(InputError):
            posterior = study.with_model(spec).posterior
            posterior = replace(posterior, datasets=(thin(posterior.single_record, stride),))
            start = np.array([[known_values.get(name, 0.0) for name in posterior.names]])
            places = np.concatenate([start, map_estimate.local_minima(posterior, rng, 1)])
            fit = climb(posterior, places)
            # With the start that the readings tell: of creep that is much.
            readings, theta = (
                posterior.single_record.readings,
                posterior.prior.theta(fit.free[np.newaxis]),
            )
            missed = readings.values - posterior.simulate(theta, readings.rows)[0]
            rmse = float(np.sqrt(np.mean(missed**2)))
            if rmse < np.std(readings.values):
                rivals.append(Rival(spec, fit.coordinates, fit.covariance, rmse))
    return tuple(rivals)


def close_rivals(rivals: Sequence[Rival], rmse: float) -> list[Rival]:
    """Return those that fit the training about as well as the best, or as a model of that rmse."""
    limit = MISSES * min([rmse, *(rival.rmse for rival in rivals)])
    return [rival for rival in rivals if rival.rmse <= limit]


def disagreement(
    posterior: Posterior,
    draws: FloatArray,
    study: Study,
    rivals: Sequence[Rival],
    predict: Callable[[Posterior, FloatArray], Bands],
    rng: np.random.Generator,
) -> float:
    """Return by how much more rivals differ from a model on another drive than in training, um.

    The root of the mean square over rivals and readings, less that in training, which the
    discrepancy has in it; of those rivals that fit the training about as well as the best.

    Parameters
    ----------
    posterior, draws
        The model: a posterior of one record, and draws (draws, free).
    study, rivals
        The study of that record, and other fits of it.
    predict
        Returns the bands of the other drive, from a posterior and draws of it.
    rng
        Draws rivals' parameters.
    """
    draws = draws[rng.integers(len(draws), size=DRAWS)]
    readings = posterior.single_record.readings
    fitted = np.mean(posterior.simulate(posterior.prior.theta(draws), readings.rows), axis=0)
    predicted = predict(posterior, draws)
    scored = slice(predicted.scored_from, None)
    excess = []
    for rival in close_rivals(rivals, float(np.std(readings.values - fitted))):
        other = rival.posterior(study)
        free = other.prior.constrain(rival.coordinates[np.newaxis])[0]
        trained = other.simulate(other.prior.theta(free), readings.rows)[0]
        difference = (predict(other, rival.draw(other, rng)).mean - predicted.mean)[scored]
        excess.append(np.mean(difference**2) - np.mean((trained - fitted) ** 2))
    return float(np.sqrt(max(np.mean(excess), 0.0))) if excess else 0.0
