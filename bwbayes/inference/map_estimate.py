"""The point fit: where the posterior is, how wide it is, and what the data leave open.

Least squares from several prior draws finds the optima of the physical parameters, of residuals and
of their steps; from the best ones the posterior's own modes follow by Newton steps, with all noise
parameters. The curvature there is the Gaussian approximation: it starts the sampler and is never
the answer itself. The modes of a long record are looked for in a thinned one, or in its beginning.

The optima of least squares do not depend on the noise, and several starts side by side are cheap.

Where a voltage is noisy the model is driven by an estimated path
(:mod:`bwbayes.record.voltage_path`), and a posterior given this path does not know that it is an
estimate. How far the estimate is off is seen where it is made again: of the path with new noise on
it. Each such path moves the posterior's mode by one Newton step, and the mean square of these steps
adds to the posterior's covariance.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference.mode_finding import Mode, Target, climb, refine, value_and_jacobian
from bwbayes.inference.thinning import beginning, thin_posterior, with_residuals_of
from bwbayes.model.stages.lags import TIME_CONSTANTS
from bwbayes.shown import brief
from bwbayes.watching import Watch, part, parts, unwatched, watched

if TYPE_CHECKING:
    from bwbayes.inference.posterior import Posterior
    from bwbayes.record.voltage_path import VoltagePath

# Prior draws that are tried, and the best of them that each least squares starts from.
DRAWS, STARTS = 128, 5

# A mode that is less probable than the best one by so many nats holds nothing of the posterior, and
# an ensemble that starts there stays for hundreds of steps.
NEGLIGIBLE = 30.0

# Samples of a record in which modes are looked for, and prior draws that tell whether a longer one
# can be thinned to so many.
SAMPLES, PROBES = 20_000, 8

# Times that the path of a noisy voltage is made again.
COPIES = 16


@dataclass(frozen=True)
class MAPEstimate:
    """The posterior's mode and its Gaussian approximation, in unconstrained coordinates.

    ``mode`` (free,), ``covariance`` (free, free), ``log_density`` at the mode; ``optima``
    (modes, free) are the distinct local modes, the best first; ``prior_covariance`` (free, free)
    is that of the prior's draws.
    """

    __repr__ = brief

    mode: FloatArray
    covariance: FloatArray
    log_density: float
    optima: FloatArray
    prior_covariance: FloatArray


def fit(
    posterior: Posterior,
    generator: np.random.Generator,
    watch: Watch = unwatched,
    further: Iterable[FloatArray] = (),
) -> MAPEstimate:
    """Find the mode of a posterior and the Gaussian approximation there.

    ``further`` places (free,) are climbed from as well. ``watch`` is called with the share that is
    done.

    Raises
    ------
    InputError
        No prior draw has a finite posterior density.
    """
    # Drawn aside: what a short record is fitted from does not depend on them.
    probes = posterior.prior.theta(posterior.prior.draw(generator.spawn(1)[0], PROBES))
    thinned = thin_posterior(posterior, probes, SAMPLES)
    short = beginning(thinned, SAMPLES)
    modes: list[Mode] = []
    if short is posterior:
        places, noise, spread = _places(posterior, generator, watch=part(watch, 0.0, 0.5))
        for start_point in watched(places, part(watch, 0.5, 0.9)):
            _add_mode(posterior, modes, start_point)
        for start_point in _zero_noise_starts(posterior, modes[0].coordinates, noise[:DRAWS]):
            _add_mode(posterior, modes, start_point)
        (aside,) = generator.spawn(1)
        for start_point in _other_noise_starts(posterior, modes[0], noise, aside):
            _add_mode(posterior, modes, start_point)
        for start_point in _exchanged_starts(posterior, modes[0].coordinates):
            _add_mode(posterior, modes, start_point)
    else:
        point = fit(short, generator, part(watch, 0.0, 0.5))
        spread, places = point.prior_covariance, [*point.optima]
        if thinned is not posterior:
            # Thinning changes displacement and noise, and moves the modes by far more than a long
            # record leaves open: readings with the residuals of the whole one lead to its modes.
            prior = posterior.prior
            theta = prior.theta(prior.constrain(point.mode[np.newaxis])[0])
            target = Target(with_residuals_of(thinned, posterior, theta))
            first = beginning(posterior, SAMPLES)
            noise = prior.unconstrain(prior.draw(generator, DRAWS))[:, target.noise]
            climbed = [climb(target, position[np.newaxis]).coordinates for position in places]
            places = [_with_noise(first, position, noise, generator) for position in climbed]
        for start_point in watched(places, part(watch, 0.5, 1.0)):
            _add_mode(posterior, modes, start_point)
    for start_point in further:
        _add_mode(posterior, modes, start_point)
    watch(1.0)
    return _estimate(modes, spread)


def refit(posterior: Posterior, point: MAPEstimate, watch: Watch = unwatched) -> MAPEstimate:
    """Find the mode of a posterior from the point fit of another one with the same modes."""
    modes: list[Mode] = []
    for start_point in watched([*point.optima], watch):
        _add_mode(posterior, modes, start_point, point.covariance)
    return _estimate(modes, point.prior_covariance)


def _estimate(modes: list[Mode], spread: FloatArray) -> MAPEstimate:
    """Return the point fit of modes, the best first, without those that hold nothing."""
    best = modes[0]
    worth = [m.coordinates for m in modes if m.log_density > best.log_density - NEGLIGIBLE]
    optima = distinct(worth, best.covariance)
    return MAPEstimate(best.coordinates, best.covariance, best.log_density, optima, spread)


def local_minima(
    posterior: Posterior,
    generator: np.random.Generator,
    starts: int = STARTS,
    watch: Watch = unwatched,
) -> FloatArray:
    """Find coordinates (places, free) near every mode of a posterior: those of least squares.

    From so many starts: a few find the best of them, if not all. A long record is represented by
    its beginning. ``watch`` is called with the share that is done.

    Raises
    ------
    InputError
        As :func:`fit`.
    """
    posterior = beginning(posterior, SAMPLES)
    # A climb goes on from where least squares leaves this part of the sum of squares.
    return np.stack(_places(posterior, generator, starts, watch, tolerance=1e-4)[0])


def mode_weights(posterior: Posterior, point: MAPEstimate) -> tuple[FloatArray, FloatArray]:
    """Return covariances (modes, free, free) at a point fit's optima, and their shares (modes,).

    A mode's share of the posterior is guessed from its height and width (Laplace's approximation).
    """
    if len(point.optima) == 1:
        return point.covariance[np.newaxis], np.ones(1)
    # Climbed to once more: a chain's file keeps the covariance of the best alone.
    modes = [refine(posterior, start_point, point.covariance) for start_point in point.optima]
    covariances = np.stack([mode.covariance for mode in modes])
    log_evidence = np.array([mode.log_density for mode in modes])
    log_evidence += np.linalg.slogdet(covariances)[1] / 2
    return covariances, scipy.special.softmax(log_evidence)


def _places(
    posterior: Posterior,
    generator: np.random.Generator,
    starts: int = STARTS,
    watch: Watch = unwatched,
    tolerance: float = 1e-8,
) -> tuple[list[FloatArray], FloatArray, FloatArray]:
    """Return places (free,) to climb from; of prior draws, the noise and the covariance."""
    prior = posterior.prior
    draws = prior.unconstrain(prior.draw(generator, 4 * DRAWS))
    center, spread = np.median(draws, axis=0), np.atleast_2d(np.cov(draws, rowvar=False))
    density = posterior.log_density(draws[:DRAWS])
    if not np.isfinite(density).any():
        raise InputError("priors: no draw has a finite posterior density; check priors and record")
    optima = []
    for steps, of_steps in parts((False, True), watch):
        least_squares = LeastSquares(posterior, center, np.sqrt(np.diag(spread)), steps=steps)
        order = np.argsort(least_squares.costs(draws[:DRAWS]), kind="stable")
        optima += _distinct_minima(
            least_squares, least_squares.optima(draws[order[:starts]], tolerance, of_steps)
        )
    noise = draws[:, ~least_squares.physical]
    places = [_with_noise(posterior, optimum, noise[:DRAWS], generator) for optimum in optima]
    # A place that least squares allows may still have no density: the noise is another one there.
    possible = np.isfinite(posterior.log_density(np.stack(places)))
    likeliest = draws[int(np.argmax(density))]
    climbed = [position for position, is_so in zip(places, possible, strict=True) if is_so]
    return climbed or [likeliest], noise, spread


def _add_mode(
    posterior: Posterior,
    modes: list[Mode],
    start: FloatArray,
    covariance: FloatArray | None = None,
) -> None:
    """Add the mode that a start (free,) leads to, unless it is one of them; the best one first.

    A ``covariance`` (free, free) there is by default that of :meth:`Target.covariance`.
    """
    density = posterior.log_density(start[np.newaxis])[0]
    if modes and density < modes[0].log_density - 2 * NEGLIGIBLE:  # else it may yet climb
        return
    path = np.linspace(0.0, 1.0, 33)[:, np.newaxis]
    for mode in modes:
        # It leads there if the density rises all the way, but for dips of half a nat.
        density = posterior.log_density(start + path * (mode.coordinates - start))
        if np.all(density > np.maximum.accumulate(density) - 0.5):
            return
    if covariance is None:
        target = Target(posterior)
        # First in the noise's coordinates, which are guessed, so that all guesses lead to one mode.
        (state,) = target.step_noise(target.at(start[np.newaxis]))
        start, (covariance, _) = state.coordinates, target.covariance(state)
    modes.append(refine(posterior, start, covariance))
    modes.sort(key=lambda mode: -mode.log_density)


def _zero_noise_starts(
    posterior: Posterior, start_point: FloatArray, noise: FloatArray
) -> FloatArray:
    """Return starts (noise, free), each with one noise parameter at its prior's center.

    Few readings may leave open whether a discrepancy is there at all. Where it is next to nothing,
    as its prior's center is, all is the sensor's noise: another mode, which no step from the first
    one finds. The other noise parameters are the most probable of prior draws (draws, noise).
    """
    starts = np.empty((noise.shape[1], start_point.size))
    for column, start in enumerate(starts):
        resting = noise.copy()
        resting[:, column] = 0.0
        places = _beside(start_point, resting)
        start[:] = places[int(np.argmax(posterior.log_density(places)))]
    return starts


def _other_noise_starts(
    posterior: Posterior, mode: Mode, noise: FloatArray, generator: np.random.Generator
) -> FloatArray:
    """Return starts (any, free) with a mode's displacement and other noise, the likeliest first.

    Where the noise has several modes, it depends on chance to which of them prior draws
    (draws, noise) lead: so they are tried part by part.
    """
    target = Target(posterior)
    places = [
        _with_noise(posterior, mode.coordinates, few, generator)
        for few in np.split(noise, 2 * len(noise) // DRAWS)
    ]
    climbed = target.step_noise(target.at(np.stack(places)))
    likely = sorted(climbed, key=lambda one: -one.density)
    reached = [mode.coordinates, *(one.coordinates for one in likely)]
    return distinct(reached, mode.covariance, target.noise)[1:]


def _exchanged_starts(posterior: Posterior, start_point: FloatArray) -> list[FloatArray]:
    """Return starts (free,) with two time constants of lags in a row exchanged, where possible.

    If two lags differ, one is the actuator's and one the sensor's. The other way round they do
    nearly the same, in another mode, which no step from the first one finds.
    """
    prior, starts = posterior.prior, []
    (values,), _ = prior.constrain(start_point[np.newaxis])
    rows: dict[str, list[int]] = {}
    for row, parameter in enumerate(prior.free):
        if parameter.plain in TIME_CONSTANTS:
            rows.setdefault(parameter.record, []).append(row)
    for pair in (pair for lags in rows.values() for pair in combinations(lags, 2)):
        exchanged = values.copy()
        exchanged[[*pair]] = values[[*reversed(pair)]]
        starts.append(prior.unconstrain(exchanged[np.newaxis])[0])
    return [start for start in starts if np.isfinite(posterior.log_density(start[np.newaxis]))[0]]


def _beside(start_point: FloatArray, noise: FloatArray) -> FloatArray:
    """Return a place (free,) with each of some noise parameters (draws, noise)."""
    places = np.tile(start_point, (len(noise), 1))
    places[:, start_point.size - noise.shape[1] :] = noise
    return places


def _with_noise(
    posterior: Posterior, position: FloatArray, noise: FloatArray, generator: np.random.Generator
) -> FloatArray:
    """Give a place (free,) the most probable noise parameters, from prior draws (draws, noise).

    The best draw alone may lie next to a lesser mode, such as the one where all is the sensor's
    noise: so draws around the best few are tried, closer and closer.
    """
    size, retained = noise.shape[1], 8
    (state,) = Target(posterior).at(position[np.newaxis])
    best = np.empty((0, position.size))
    density = np.empty(0)
    for _ in range(4):
        best = np.concatenate([best, _beside(position, noise)])
        moved = state.displacement[np.newaxis]
        tried = Target(posterior).noise_density(best[-len(noise) :], moved)
        density = np.concatenate([density, tried])
        order = np.argsort(-density, kind="stable")[:retained]
        best, density = best[order], density[order]
        if not size:
            break
        top = best[:, -size:]
        chosen = top[generator.integers(retained, size=len(noise))]
        noise = chosen + np.std(top, axis=0) * generator.standard_normal(noise.shape)
    winner: FloatArray = best[0]
    return winner


def _distinct_minima(least_squares: LeastSquares, places: FloatArray) -> list[FloatArray]:
    """Keep one place for each distinct optimum of least squares, the best first."""
    same = 1e-2  # optima whose sums of squares and coordinates agree to this part are one
    costs = least_squares.costs(places)
    distinct: list[int] = []
    for i in np.argsort(costs, kind="stable").tolist():
        separate = [
            np.max(np.abs(places[i] - places[j]) / least_squares.spread) > same
            or costs[i] > (1 + same) * costs[j]
            for j in distinct
        ]
        if all(separate):
            distinct.append(i)
    return [places[i] for i in distinct]


def distinct(
    places: list[FloatArray], covariance: FloatArray, columns: IntArray | None = None
) -> FloatArray:
    """Keep the places (free,) that lie more than an sd or so from those before them.

    In all coordinates, or in some ``columns`` of them.
    """
    columns = np.arange(len(covariance)) if columns is None else columns
    with warnings.catch_warnings():
        # A discrepancy of which a record shows nothing is far less sure than a gain.
        warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)
        inverse = scipy.linalg.inv(covariance[np.ix_(columns, columns)])
    distinct: list[FloatArray] = []
    for position in places:
        away = [(position - other)[columns] for other in distinct]
        if all(distance @ inverse @ distance > columns.size for distance in away):
            distinct.append(position)
    return np.stack(distinct)


class LeastSquares:
    """Least squares in the coordinates of the physical parameters, with a weak pull to the prior.

    An impossible place has no residuals, and no step leads there. The noise parameters do not
    enter; they stay at the prior's median. Squares are those of the residuals, or of their
    ``steps`` from row to row: with a discrepancy that forgets slowly these are the ones that are
    independent, and where the first have one optimum they may have two.
    """

    def __init__(
        self, posterior: Posterior, center: FloatArray, spread: FloatArray, *, steps: bool
    ) -> None:
        self.posterior, self.center, self.spread, self.steps = posterior, center, spread, steps
        self.physical = np.array([n in posterior.table.physical for n in posterior.names])
        # More residuals would not move an optimum that is only to be found.
        stride = 1000 // len(posterior.datasets)
        training = [dataset.readings.rows for dataset in posterior.datasets]
        self.rows = [rows[:: max(rows.size // stride, 1)] for rows in training]
        total = sum(rows.size for rows in self.rows)
        self.size = total + np.count_nonzero(self.physical)
        self.targets, self.scales = [], []
        for dataset, rows in zip(posterior.datasets, self.rows, strict=True):
            self.targets.append(dataset.displacement[rows])
            # A hundredth of the range is about what a Bouc-Wen model misses.
            self.scales.append(0.01 * float(np.ptp(self.targets[-1])) * np.sqrt(total))

    def residuals(self, coordinates: FloatArray) -> FloatArray:
        """Residuals (models, rows + physical) at coordinates (models, free); nan if impossible."""
        free, density = self.posterior.prior.constrain(coordinates)
        possible = np.isfinite(density)
        if not possible.all():
            residuals = np.full((len(free), self.size), np.nan)
            if possible.any():
                residuals[possible] = self.residuals(coordinates[possible])
            return residuals
        theta = self.posterior.prior.theta(free)
        pull = ((coordinates - self.center) / self.spread)[:, self.physical]
        missed = [
            (self.posterior.simulate(theta, rows, dataset.name) - target) / scale
            for dataset, rows, target, scale in zip(
                self.posterior.datasets, self.rows, self.targets, self.scales, strict=True
            )
        ]
        if self.steps:
            missed = [np.diff(residual, axis=1, prepend=0.0) for residual in missed]
        return np.concatenate([*missed, 1e-2 * pull], axis=1)

    def costs(self, coordinates: FloatArray) -> FloatArray:
        """Sum of squares (models,)."""
        return np.sum(self.residuals(coordinates) ** 2, axis=1)

    def optima(
        self, starts: FloatArray, least: float = 1e-8, watch: Watch = unwatched
    ) -> FloatArray:
        """Return the coordinates (starts, free) of the optima that starts (starts, free) lead to.

        The last step is one that takes less than the ``least`` part of the sum of squares away.
        ``watch`` is called with the share of the most steps that is done.

        By Levenberg and Marquardt's steps, all starts side by side: to simulate a record for many
        models takes hardly longer than for one. Lengths are in spreads; the damping follows how
        much of the expected descent a step brings.

        Notes
        -----
        K. Madsen, H. B. Nielsen, O. Tingleff, Methods for Non-Linear Least Squares Problems,
        Technical University of Denmark (2004), algorithm 3.16.
        """
        optima = np.tile(self.center, (len(starts), 1))
        if not self.physical.any():
            return optima[:1]
        optima[:, self.physical] = starts[:, self.physical]
        residual, slopes = self._linearize(optima)
        costs = np.sum(residual**2, axis=1)
        curvature = slopes @ np.swapaxes(slopes, 1, 2)
        damping = 1e-3 * np.max(np.diagonal(curvature, axis1=1, axis2=2), axis=1)
        growth = np.full(len(starts), 2.0)
        moving = np.flatnonzero(np.isfinite(costs))
        unit, length = np.eye(slopes.shape[1]), self.spread[self.physical]
        for _ in watched(range(60), watch):
            if not moving.size:
                break
            gradient = slopes[moving] @ residual[moving, :, np.newaxis]
            damped = curvature[moving] + damping[moving, np.newaxis, np.newaxis] * unit
            step = -np.linalg.solve(damped, gradient)[:, :, 0]
            trial = optima[moving]
            trial[:, self.physical] += step * length
            tried, tried_slopes = self._linearize(trial)
            cost = np.sum(tried**2, axis=1)
            descent = costs[moving] - cost
            descends = descent > 0  # not where the place is impossible
            settled = np.linalg.norm(step, axis=1) < 1e-8
            settled |= descends & (descent < least * costs[moving])
            worse, better, step = moving[~descends], moving[descends], step[descends]
            damping[worse] *= growth[worse]
            growth[worse] *= 2.0
            expected = np.sum(
                step * (damping[better, np.newaxis] * step - gradient[descends, :, 0]), axis=1
            )
            gain = descent[descends] / expected
            damping[better] *= np.maximum(1 / 3, 1 - (2 * gain - 1) ** 3)
            growth[better] = 2.0
            optima[better], residual[better] = trial[descends], tried[descends]
            slopes[better], costs[better] = tried_slopes[descends], cost[descends]
            curvature[better] = slopes[better] @ np.swapaxes(slopes[better], 1, 2)
            moving = moving[~settled]
        return optima[np.isfinite(costs)]

    def _linearize(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (places, rows) and their slopes (places, physical, rows), per spread."""
        physical = np.flatnonzero(self.physical)
        residual, slopes = value_and_jacobian(self.residuals, places, physical)
        return residual, slopes * self.spread[physical, np.newaxis]


def path_covariance(
    posterior: Posterior,
    paths: Mapping[str, VoltagePath],
    point: MAPEstimate,
    generator: np.random.Generator,
    watch: Watch = unwatched,
) -> FloatArray:
    """Return the mean square (free, free) of what paths made again move the mode by.

    With C the posterior's covariance at the mode and ℓₖ its log density along path k, in
    unconstrained coordinates: mean of sₖ sₖᵀ, sₖ = C (∇ℓₖ − ∇ℓ), of the actuator's parameters. The
    ``paths`` are those of the records by name; ``watch`` is called with the share that is done.
    """
    physical = np.flatnonzero([name in posterior.table.physical for name in posterior.names])

    def gradient(along: Posterior) -> FloatArray:
        (slopes,) = value_and_jacobian(along.log_density, point.mode[np.newaxis], physical)[1]
        return np.asarray(slopes)

    here, steps = gradient(posterior), []
    for _ in watched(range(COPIES), watch):
        datasets = tuple(
            replace(
                dataset,
                inputs=replace(dataset.inputs, voltage=paths[dataset.name].redrawn(generator)),
            )
            for dataset in posterior.datasets
        )
        change = gradient(replace(posterior, datasets=datasets)) - here
        steps.append(point.covariance[np.ix_(physical, physical)] @ change)
    added = np.zeros_like(point.covariance)
    added[np.ix_(physical, physical)] = np.transpose(steps) @ np.stack(steps) / COPIES
    return added


def widen_draws(coordinates: FloatArray, covariance: FloatArray, more: FloatArray) -> FloatArray:
    """Return draws (..., free) of a posterior of a ``covariance`` C that has ``more`` now: C + M.

    Each moves linearly away from their mean, by L(C + M) L(C)⁻¹ with Cholesky's factors L, so that
    a chain stays one.
    """
    factor, wide = np.linalg.cholesky(covariance), np.linalg.cholesky(covariance + more)
    center = np.mean(coordinates.reshape(-1, coordinates.shape[-1]), axis=0)
    moved: FloatArray = center + (coordinates - center) @ np.linalg.solve(factor.T, wide.T)
    return moved
