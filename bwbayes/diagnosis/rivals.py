"""Rivals of a model: models of other families that fit the same record, and their disagreement.

They matter where the residual follows the drive: then its size on another drive may be larger. A
disturbance of the sensor or of the room is independent of the voltage; the residual of a wrong
model comes back wherever the drive repeats itself. Each residual, less its mean over a period of
the drive, is compared with the mean of those at other times where the drive was most alike. The
correlation of both is compared with that of residuals drawn from the fitted noise, which has the
residual's size and correlation time and is independent of the drive. For drives that hardly repeat,
a second test predicts parts of the record from others: plays, powers and lags of the voltage are
fitted to the whitened residual in all parts but one, and their prediction is tested on that one.

If a model's residual follows the drive, the record does not show its size on another drive. Models
of other families that fit the record about as well show how large it may be: another operator, the
nonlinearity elsewhere on the signal's path, with creep or without. If it does not, there may be
models still for which the record has as much evidence. If all of them agree on a drive, their
differences do not matter there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.diagnosis.finding import TELLING_DRIVE, Finding
from bwbayes.diagnosis.laplace import climb
from bwbayes.diagnosis.residual_analysis import READINGS
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate
from bwbayes.inference.defaults import rounding_sd
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.state_space import root
from bwbayes.inference.study import Study
from bwbayes.inference.thinning import stride_of, thin, thin_posterior
from bwbayes.model.inputs import monotone_stretches, rate, time_between_turns, turning_points
from bwbayes.model.nonlinearity import TERMS
from bwbayes.model.spec import ModelSpec
from bwbayes.prediction.bands import Bands
from bwbayes.shown import brief
from bwbayes.watching import Watch, unwatched, watched

# Probability of a false alarm for a residual that does not follow the drive; and the smallest
# relevant correlation, or part of its variance beyond the sensor's noise.
ALARM, MATTERS = 0.02, 0.1

# Number of the nearest states of the drive to compare a residual with, and of the readings used.
NEIGHBORS, COMPARED = 4, 1_500

# Number of residuals to draw, and of draws whose mean is the model's displacement.
DRAWN, MEAN_OF = 200, 40

# Thresholds of plays in parts of half the range, times of lags in parts of the time between
# reversals, and the number of parts of a record, each of which is predicted from the others.
PLAYS, LAGS, PARTS = (0.05, 0.1, 0.2, 0.4, 0.7), (0.1, 0.3, 1.0, 3.0, 10.0, 30.0), 8


@dataclass(frozen=True)
class DriveLock:
    """Correlation of the residual with that at like states of the drive, and its p value.

    ``p_value`` is the probability that noise independent of the drive has as large a correlation,
    or lets as much of one part be predicted from the others; ``share`` is the part of the
    residual's variance that is not the sensor's noise.
    """

    correlation: float
    p_value: float
    share: float = 1.0

    @property
    def locked(self) -> bool:
        """True if the residual follows the drive."""
        return self.p_value < ALARM and max(self.share, self.correlation) > MATTERS

    @property
    def numbers(self) -> dict[str, object]:
        """Numbers for ``summary.json``."""
        return {
            "correlation": self.correlation,
            "p_value": self.p_value,
            "follows_the_drive": self.locked,
        }

    @property
    def findings(self) -> tuple[Finding, ...]:
        """A finding if the residual follows the drive."""
        if not self.locked:
            return ()
        text = (
            "what the model misses follows the drive "
            f"(correlation {self.correlation:.2g}, p = {max(self.p_value, 1e-6):.1g}): the bands "
            "hold for drives like the training record's; those of others are widened"
        )
        return (Finding("model error", text, TELLING_DRIVE),)


def drive_locks(
    posterior: Posterior, draws: FloatArray, rng: np.random.Generator
) -> dict[str, DriveLock]:
    """Test for each record of a posterior whether the residual follows the drive."""
    views = posterior.each(draws)
    return {name: drive_lock(alone, own_draws, rng) for name, alone, own_draws in views}


def drive_lock(posterior: Posterior, draws: FloatArray, rng: np.random.Generator) -> DriveLock:
    """Test whether the residual of the model of a single-record posterior follows the drive.

    It uses some hundred of the ``draws`` (draws, free), parameters in their own units, and some
    thousand readings of a long record.
    """
    record, readings = posterior.single_record, posterior.single_record.readings
    if readings.rows.size <= 10 * NEIGHBORS:
        return DriveLock(0.0, 1.0)  # too few readings for a test
    theta = posterior.prior.theta(draws[rng.integers(len(draws), size=DRAWN)])
    missed = readings.values - np.mean(posterior.simulate(theta[:MEAN_OF], readings.rows), axis=0)
    if float(np.std(missed)) < rounding_sd(readings.values):
        return DriveLock(0.0, 1.0)  # the residual is rounding, which follows the drive as well
    stride = -(-missed.size // COMPARED)
    rows, parameters = readings.rows[::stride], record.table.noise(theta)
    # Draw the noise on a grid as coarse as the readings.
    step = int(np.gcd.reduce(np.diff(rows)))
    places = (rows - rows[0]) // step
    noise = record.noise.at(step * record.actuator.interval)
    at = rows[0] + step * np.arange(int(places[-1]) + 1)
    speed = np.abs(rate(record.voltage, record.actuator.interval))[at]
    discrepancy, sensor = noise.draw_all(parameters, at.size, rng, speed)
    like = compare(missed[::stride], (discrepancy + sensor)[:, places], record.voltage, rows)
    typical = np.median(parameters, axis=0, keepdims=True)
    series = np.concatenate([[missed], drive_features(record.voltage)[:, readings.rows]])
    white = posterior.likelihood.whiten(typical, series[np.newaxis])[0][0]
    white_sd = float(record.noise.marginal_sd(typical)[1][0]) if record.noise.states else 0.0
    p_value = min(1.0, 2 * min(like.p_value, predictability(white[0], white[1:], rng)))
    return DriveLock(like.correlation, p_value, 1 - white_sd**2 / float(np.var(missed)))


def compare(
    residual: FloatArray, drawn: FloatArray, voltage: FloatArray, rows: IntArray
) -> DriveLock:
    """Compare a residual's correlation with that at like states of the drive with chance.

    Parameters
    ----------
    residual
        Residual (readings,) of the model, um.
    drawn
        Residuals (draws, readings) of noise that is independent of the drive.
    voltage
        The drive (samples,), V.
    rows
        The samples (readings,) of the readings.
    """
    turn_time = time_between_turns(voltage[: rows[-1] + 1], 1.0)
    like = like_states(voltage, rows, turn_time)
    series = np.concatenate([residual[np.newaxis], drawn])
    # Subtract the part slower than a period of the drive, which may be a drift and hides the rest.
    first = np.searchsorted(rows, rows - turn_time)
    last = np.searchsorted(rows, rows + turn_time, side="right")
    sums = np.cumsum(np.pad(series, ((0, 0), (1, 0))), axis=1)
    series = series - (sums[:, last] - sums[:, first]) / (last - first)
    series -= series.mean(axis=1, keepdims=True)
    mean = series[:, like].mean(axis=2)
    mean -= mean.mean(axis=1, keepdims=True)
    norms = np.linalg.norm(series, axis=1) * np.linalg.norm(mean, axis=1)
    z, *chance = np.arctanh(np.sum(series * mean, axis=1) / np.maximum(norms, 1e-300))
    score = (z - np.mean(chance)) / np.std(chance)
    return DriveLock(float(np.tanh(z)), float(scipy.stats.norm.sf(score)))


def like_states(voltage: FloatArray, rows: IntArray, turn_time: float) -> IntArray:
    """Return the readings (readings, neighbors) where the drive was most alike.

    The drive's state is the voltage, its means over some times before, and its last reversal. The
    returned readings are at least ``turn_time``, in samples, away.
    """
    sums = np.concatenate([[0.0], np.cumsum(voltage)])
    columns = [voltage[rows]]
    # Times over which the voltage is averaged, in parts of the time between reversals.
    for block in (0.2, 0.6):
        first = np.maximum(rows + 1 - max(round(block * turn_time), 1), 0)
        columns.append((sums[rows + 1] - sums[first]) / (rows + 1 - first))
    turns = np.concatenate([[0], turning_points(voltage)])
    columns.append(voltage[turns[np.searchsorted(turns, rows, side="right") - 1]])
    state = np.stack(columns, axis=1)
    distance = scipy.spatial.distance.cdist(state, state)
    distance[np.abs(np.subtract.outer(rows, rows)) < turn_time] = np.inf
    like: IntArray = np.argpartition(distance, NEIGHBORS, axis=1)[:, :NEIGHBORS]
    return like


def drive_features(voltage: FloatArray) -> FloatArray:
    """Return functions of a drive that a residual may follow, (features, samples).

    These are 1, powers, plays and lags.
    """
    turn_time, center = time_between_turns(voltage, 1.0), (voltage.max() + voltage.min()) / 2
    level = (voltage - center) / max(float(np.ptp(voltage)) / 2, 1e-300)
    thresholds = np.array(PLAYS)[:, np.newaxis]
    plays = np.empty((thresholds.size, level.size))
    reached = np.full((thresholds.size, 1), level[0])
    for first, last, direction in monotone_stretches(level):
        along = level[first : last + 1] - direction * thresholds
        plays[:, first : last + 1] = (np.maximum if direction > 0 else np.minimum)(reached, along)
        reached = plays[:, last : last + 1]
    decays = np.exp(-1 / (np.array(LAGS) * turn_time))
    lags = [
        scipy.signal.lfilter([1 - a], [1.0, -a], level, zi=[a * level[0]])[0]
        for a in decays.tolist()
    ]
    return np.stack([np.ones(level.size), level, level**2, level**3, *plays, *lags])


def predictability(white: FloatArray, features: FloatArray, rng: np.random.Generator) -> float:
    """Return the p value of the prediction of parts of a residual from all the others.

    The prediction is a ridge regression of the whitened residual (readings,) on whitened
    ``features`` (features, readings), compared with that of independent normal numbers.
    """
    basis, sizes, _ = np.linalg.svd(features.T, full_matrices=False)
    basis = basis[:, sizes > 1e-6 * sizes[0]]
    parts = np.array_split(basis, PARTS)
    inside = np.stack([block.T @ block for block in parts])
    scaled = np.array_split(white / np.std(white), PARTS)
    products = np.stack([block.T @ values for block, values in zip(parts, scaled, strict=True)])
    scores = rng.standard_normal((DRAWN, *products.shape))
    drawn = np.einsum("pji,dpj->dpi", root(inside), scores)
    samples = np.concatenate([products[np.newaxis], drawn])
    others = samples.sum(axis=1, keepdims=True) - samples
    # The ridge has the weight of one part of the record.
    ridge = (1 + 1 / PARTS) * np.eye(basis.shape[1])
    weights = np.einsum("pij,dpj->dpi", np.linalg.inv(ridge - inside), others)
    spread = np.sqrt(np.einsum("dpi,pij,dpj->d", weights, inside, weights))
    z, *chance = np.sum(weights * samples, axis=(1, 2)) / spread
    return float(scipy.stats.norm.sf((z - np.mean(chance)) / np.std(chance)))


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
