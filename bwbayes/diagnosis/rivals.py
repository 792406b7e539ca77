"""Rivals of a model: models of other families that fit the same record, and their disagreement.

If a model's residual follows the drive (:mod:`bwbayes.diagnosis.drive_lock`), the record does not
show its size on another drive. Models of other families that fit the record about as well show how
large it may be: another operator, the nonlinearity elsewhere on the signal's path, with creep or
without. If it does not, there may be models still for which the record has as much evidence. If all
of them agree on a drive, their differences do not matter there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
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

# Number of draws of each model, whose mean is its prediction.
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
        """Return this model's posterior of its training record, that of the ``study``."""
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
    """Yield a model of each other family."""
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
    study: Study,
    specs: Iterable[ModelSpec],
    rng: np.random.Generator,
    watch: Watch = unwatched,
) -> tuple[Rival, ...]:
    """Fit rivals to a study's record, or to some thousand readings of a long one.

    Each starts from the values of the parameters that it shares with the model, and from its own
    local minimum. ``watch`` is called with the share that is done.
    """
    posterior_full = study.posterior
    origin = map_estimate.local_minima(posterior_full, rng, 1)[0]
    theta = posterior_full.prior.theta(posterior_full.prior.constrain(origin[np.newaxis])[0])
    stride = stride_of(thin_posterior(posterior_full, theta, READINGS), posterior_full)
    known_values = dict(zip(posterior_full.names, origin.tolist(), strict=True))
    rivals = []
    for spec in watched([*specs], watch):
        # Leave out a model that needs a prior that is not stated.
        with suppress(InputError):
            posterior = study.with_model(spec).posterior
            posterior = replace(posterior, datasets=(thin(posterior.single_record, stride),))
            start = np.array([[known_values.get(name, 0.0) for name in posterior.names]])
            places = np.concatenate([start, map_estimate.local_minima(posterior, rng, 1)])
            fit = climb(posterior, places)
            if fit.follows:
                rivals.append(Rival(spec, fit.coordinates, fit.covariance, fit.rmse))
    return tuple(rivals)


def close_rivals(rivals: Sequence[Rival], rmse: float) -> list[Rival]:
    """Return rivals that fit about as well as the best of them, or as a model of this RMSE."""
    limit = 3.0 * min([rmse, *(rival.rmse for rival in rivals)])
    return [rival for rival in rivals if rival.rmse <= limit]


def disagreement(
    posterior: Posterior,
    draws: FloatArray,
    study: Study,
    rivals: Sequence[Rival],
    predict: Callable[[Posterior, FloatArray], Bands],
    rng: np.random.Generator,
) -> float:
    """Return the excess of the rivals' differences on another drive over those in training, um.

    It is the root of the mean square difference over rivals and readings, less that in training,
    which the discrepancy includes. Only rivals count that fit the training about as well as the
    best.

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
