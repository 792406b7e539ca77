"""Runs in short: records of a simulated stand, fitted, predicted and judged as a run does it.

The draws are those of a mixture around the point fit, weighted toward the posterior by
Pareto-smoothed importance sampling (Vehtari et al., "Pareto smoothed importance sampling", 2024)
and chosen again by their weights: a run in two seconds. All else is the run's own code.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from arviz_stats.base import array_stats  # not in an __all__

from bwbayes.app.config.config import Config, parse
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.predict import validate_predictions
from bwbayes.app.running.explaining import chosen_noise, explain_record
from bwbayes.app.study.resolve import resolve_config, with_noise
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.validation import BandValidation
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Study
from bwbayes.prediction.bands import Bands
from bwbayes.prediction.prediction import predict_record, predict_windows
from bwbayes.sampling.proposals import StudentMixture

# Draws of each round, to which the mixture of the next one is fitted; draws of the last; those that
# stay. Three rounds find a tail that is several times as long as the point fit's sd says.
PILOT, ROUNDS, DRAWS, KEPT = 1000, 4, 4000, 250

# No draw of the pilot weighs more than so many times the mean.
HEAVIEST = 10.0


@dataclass(frozen=True)
class Judged:
    """The result of a run: draws (draws, free), bands and verdicts by name."""

    study: Study
    draws: FloatArray
    bands: Mapping[str, Bands]
    validation: Mapping[str, BandValidation]

    def column(self, name: str) -> FloatArray:
        """Return the draws of one parameter."""
        return self.draws[:, self.study.posterior.names.index(name)]


def study_of(config: str | Config, folder: Path) -> Study:
    """Resolve a config or its text, files in ``folder``; its noise is chosen as a run does it."""
    config = config if isinstance(config, Config) else parse(config, "config")
    run = resolve_config(config, folder)
    if config.model.noise != "auto":
        return run.study
    point = pointfit.fit(run.study.posterior, run.study.generator("point fit"))
    return with_noise(run, chosen_noise(run.study, point)[0]).study


def posterior_draws(
    posterior: Posterior, source: np.random.Generator
) -> tuple[MAPEstimate, FloatArray]:
    """Fit, and draw (KEPT, free) in the parameters' own units."""
    point = pointfit.fit(posterior, source)
    draws, weights = weighted_draws(posterior, source, point)
    return point, draws[source.choice(len(draws), KEPT, p=weights)]


def weighted_draws(
    posterior: Posterior, source: np.random.Generator, point: MAPEstimate | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return draws (draws, free) in the parameters' own units and weights (draws,)."""
    if point is None:
        point = pointfit.fit(posterior, source)
    random = np.random.RandomState(source.bit_generator)
    proposal = StudentMixture.around(point.optima, *pointfit.mode_weights(posterior, point))
    for _ in range(ROUNDS):
        places, ratio = _tried(posterior, proposal, random, PILOT)
        if not np.isfinite(ratio).any():
            # A fit at the edge of what is possible, as a reversed record's: the point itself.
            places, ratio = point.mode[np.newaxis], np.zeros(1)
        weights = np.exp(np.clip(ratio - np.max(ratio), -30, 0)) * np.isfinite(ratio)
        weights = np.minimum(weights, HEAVIEST * np.mean(weights))
        weights /= np.sum(weights)
        chosen = places[source.choice(len(places), PILOT, p=weights)]
        try:
            proposal = StudentMixture.fitted(chosen)
        except np.linalg.LinAlgError:
            # The weight is all on a few draws: at such an edge too.
            return posterior.prior.constrain(places)[0], weights
    places, ratio = _tried(posterior, proposal, random, DRAWS)
    # A place that is not possible has a weight of next to none; arviz takes finite ones alone.
    lowest = np.min(ratio, where=np.isfinite(ratio), initial=0.0) - 100.0
    smoothed, _ = array_stats.psislw(-np.maximum(ratio, lowest))
    weights = np.exp(smoothed - np.max(smoothed)) * np.isfinite(ratio)
    return posterior.prior.constrain(places)[0], weights / np.sum(weights)


def _tried(
    posterior: Posterior, proposal: StudentMixture, random: np.random.RandomState, count: int
) -> tuple[FloatArray, FloatArray]:
    """Draw places (count, free) of a proposal; log density of the posterior over its (count,)."""
    places, proposed = proposal.evaluate(proposal.draw(random, count))
    ratio: FloatArray = posterior.log_density(places) - proposed
    return places, ratio


def judge(study: Study, source: np.random.Generator, *, again: bool = True) -> Judged:
    """Fit, predict all that the config names, and judge it.

    Without explanations (``again``) only the verdict on the training window is another one.
    """
    posterior, record = study.posterior, study.record
    point, draws = posterior_draws(posterior, source)
    windows = {"training": posterior.single_record.training}
    windows |= {name: v.windows for name, v in study.validations.items() if v.windows}
    bands = predict_windows(posterior, draws, record, windows, source)
    for name, other in study.validations.items():
        if other.record is not None:
            bands.append(
                predict_record(
                    posterior, draws, other.record, other.start, source, name, other.judged
                )
            )
    best = draws[int(np.argmax(posterior.log_density(posterior.prior.unconstrain(draws))))]
    # Validation asks its config what a search for stages left; here is none.
    config = parse('[record]\nfile = "record.h5"', "config")
    run = Run().with_cache(study=study, config=config, flat_draws=draws)
    validation = validate_predictions(run, bands, {})
    if again:
        places = posterior.prior.unconstrain(best[np.newaxis])
        places = np.concatenate([places, point.optima])
        found = explain_record(study, "record", places)
        validation = validate_predictions(run, bands, {"record": found})
    return Judged(study, draws, {one.name: one for one in bands}, validation)


def no_rivals(*_: object) -> None:
    """Return no rivals of a model whose error does not follow the drive."""


def covered(bands: Bands, level: int = 95) -> float:
    assert bands.measured is not None
    inside = bands.covers("sensor", level, bands.measured)
    return float(np.mean(inside[bands.scored(bands.measured)]))
