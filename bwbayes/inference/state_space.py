"""Noise as a state-space model: sensor noise, and a discrepancy that a Kalman filter follows.

The residual of a Bouc-Wen fit to a measured record is correlated over many samples: most of it is
what the model does not know about the actuator. Calling it white makes the parameters look several
times better known than they are. So the residual is the sum of two parts,

    r(t) = h · x(t) + e(t),   x the states of the discrepancy,   e white (sd s).

A noise states three things: the stationary covariance P of its states, by which matrix F they go
on over a time, and the row h that reads the discrepancy from them. The process covariance that
they gain over that time follows, Q = P − F P Fᵀ. A Kalman filter turns residuals into independent
innovations, whatever readings are missing; their log density is that of the residuals, exact in
O(readings). Two noises add up: ``first + second`` has the states of both. The sensor's noise e may
have heavier tails than a normal distribution, see :mod:`~bwbayes.inference.heavy_tails`.

R. E. Kalman, A new approach to linear filtering and prediction problems, Journal of Basic
Engineering 82, 35-45 (1960), doi:10.1115/1.3662552.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError
from bwbayes.inference import heavy_tails
from bwbayes.model.declaration import Declaration

LOG_TWO_PI = float(np.log(2 * np.pi))


class Filtered(NamedTuple):
    """Innovations of series, and what is known of the discrepancy after the last reading.

    ``white`` (models, series, readings) are the innovations over their sds, ``log_determinant``
    (models,) that of the covariance of the readings; ``mean`` (models, series, states) and
    ``covariance`` (models, states, states) are those of the states.
    """

    white: FloatArray
    log_determinant: FloatArray
    mean: FloatArray
    covariance: FloatArray


def powers(matrices: FloatArray, readings: float | FloatArray) -> FloatArray:
    """Return the transition over whole numbers of readings, of that over one.

    ``matrices`` are (models, states, states); shapes as of :meth:`Noise.transition`.
    """
    if np.ndim(readings) == 0:
        return np.asarray(np.linalg.matrix_power(matrices, round(float(readings))))
    return np.stack([powers(matrices, number) for number in np.asarray(readings).tolist()], axis=1)


@dataclass(frozen=True)
class Noise(ABC):
    """A Gaussian model of the residual between a reading and the forward model.

    Methods take θ (models, parameters), whose first column is the sd s of the sensor, um.

    Parameters
    ----------
    interval
        Interval Δ between readings, s.
    """

    interval: float = 1.0

    @property
    @abstractmethod
    def declarations(self) -> tuple[Declaration, ...]:
        """Its parameters, in the order of θ's columns."""

    @property
    @abstractmethod
    def observe(self) -> FloatArray:
        """The row h (states,) that reads the discrepancy, um, from the states."""

    @property
    def tailed(self) -> bool:
        """Whether the sensor's noise has a Student t distribution; by default it is normal."""
        return False

    def inverse_df(self, theta: FloatArray) -> FloatArray:
        """Return 1/ν (models,), ν the sensor noise's degrees of freedom; 0 if it is normal."""
        return np.zeros(len(theta))

    @property
    def paced(self) -> bool:
        """Whether the sensor's noise grows with the voltage's speed; by default it does not."""
        return False

    def sensor_variance(self, theta: FloatArray, speed: FloatArray) -> FloatArray:
        """Return the variance of the sensor's noise, um², (models, samples).

        Where the voltage moves at ``speed`` (samples,), V/s. By default s² wherever it is.
        """
        return np.repeat(theta[:, :1] ** 2, speed.size, axis=1)

    @abstractmethod
    def stationary(self, theta: FloatArray) -> FloatArray:
        """Return P, the covariance of the states at any time, (models, states, states)."""

    @abstractmethod
    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return F, by which the states go on over so many intervals, a whole number.

        (models, states, states) over one number of them, (models, numbers, states, states) over
        some (numbers,).
        """

    def process_covariance(self, theta: FloatArray, readings: float = 1.0) -> FloatArray:
        """Return Q = P − F P Fᵀ, the covariance that the states gain, (models, states, states).

        Where F is nearly one this is a difference of nearly equal numbers: a noise that is sampled
        far faster than it changes should have a formula of its own.

        Raises
        ------
        InputError
            Q is no covariance: P is not stationary under F.
        """
        stationary, transitions = self.stationary(theta), self.transition(theta, readings)
        gained = stationary - transitions @ stationary @ np.swapaxes(transitions, 1, 2)
        gained = (gained + np.swapaxes(gained, 1, 2)) / 2
        # Each state in its own unit.
        scale = np.sqrt(np.maximum(np.diagonal(stationary, axis1=1, axis2=2), 1e-300))
        relative = gained / (scale[:, :, np.newaxis] * scale[:, np.newaxis, :])
        if self.states and np.min(np.linalg.eigvalsh(relative)) < -1e-9:
            raise InputError(
                f"noise: {type(self).__name__}.stationary(theta) is not stationary under its "
                "transition(theta): P - F P F' has a negative eigenvalue; return the P that "
                "solves P = F P F' + Q"
            )
        return gained

    @property
    def states(self) -> int:
        """How many states the discrepancy has; none if the noise is white."""
        return self.observe.size

    def marginal_sd(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Stationary sd of the discrepancy and sd (or scale) of the sensor, each (models,), um."""
        variance = self.observe @ self.stationary(theta) @ self.observe
        return np.sqrt(variance), theta[:, 0]

    def correlation_time(self, theta: FloatArray) -> FloatArray:
        """Correlation time ∫₀^∞ ρ(t) dt of the discrepancy (models,), s; zero without one.

        By default the sum over the readings, Δ (h (1 − F)⁻¹ P hᵀ / (h P hᵀ) − ½).
        """
        stationary, observe = self.stationary(theta), self.observe
        total = np.linalg.solve(np.eye(self.states) - self.transition(theta), stationary)
        variance = np.maximum(observe @ stationary @ observe, np.finfo(float).tiny)
        return self.interval * np.maximum(observe @ total @ observe / variance - 0.5, 0.0)

    def for_new_readings(
        self,
        theta: FloatArray,
        missed: Callable[[], float],  # noqa: ARG002  # the kernel says the size
    ) -> FloatArray:
        """Return θ (models, parameters) with the discrepancy's size where nothing was fitted.

        ``missed`` returns the mean square, um², of what the models' mean misses of the fitted
        readings. By default θ as it is.
        """
        return theta

    def at(self, interval: float) -> Self:
        """Return the same noise for readings ``interval`` seconds apart."""
        return replace(self, interval=interval)

    def __add__(self, other: Noise) -> Noise:
        """Return the noise with both discrepancies, and one sensor."""
        terms = [t for n in (self, other) for t in (n.terms if isinstance(n, SumNoise) else (n,))]
        if sum(term.tailed or term.paced for term in terms) > 1:
            raise InputError(
                "noise: two terms with heavy tails or noise that grows with the speed, but one "
                "sensor; leave one out"
            )
        return SumNoise(self.interval, tuple(term.at(self.interval) for term in terms))

    def log_density(self, theta: FloatArray, residual: FloatArray) -> FloatArray:
        """Log density (models,) of residuals (models, samples) in um."""
        if self.tailed:
            nothing = np.empty((len(theta), 0))
            return heavy_tails.follow(self, theta, residual[:, np.newaxis], nothing).log_density
        white, log_determinant = self.whiten(theta, residual[:, np.newaxis])
        squares = np.sum(white**2, axis=(1, 2))
        density: FloatArray = -0.5 * (squares + log_determinant + residual.shape[1] * LOG_TWO_PI)
        return density

    def whiten(
        self, theta: FloatArray, series: FloatArray, skipped: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Turn series (models, series, readings) of each model into independent innovations.

        ``skipped`` (readings,) counts the readings that are missing just before each one, by
        default none, as in :class:`~bwbayes.inference.likelihood.Readings`. Returns the innovations
        over their sds, shaped as the series, and the log determinant (models,) of the covariance:
        with V = L Lᵀ these are L⁻¹ series and log det V.
        """
        filtered = self.filter(theta, series, skipped)
        return filtered.white, filtered.log_determinant

    def filter(
        self,
        theta: FloatArray,
        series: FloatArray,
        skipped: FloatArray | None = None,
        sensor: FloatArray | None = None,
    ) -> Filtered:
        """Whiten series, and return what is known of the states then; arguments as of `whiten`.

        ``sensor`` (models, readings), um², are variances of each reading's own, by default s²; if
        the sensor's noise has heavy tails, those in effect where the first series is the residual.
        Once the covariance of all models stays as it is, readings are taken in blocks.
        """
        observe, readings = self.observe, series.shape[2]
        if self.tailed and sensor is None:
            nothing = np.empty((len(theta), 0))
            sensor = heavy_tails.follow(self, theta, series[:, :1], nothing, skipped).sensor
        varies = sensor is not None
        sensors = np.broadcast_to(
            theta[:, :1] ** 2 if sensor is None else sensor, series[:, 0].shape
        )
        white, log_determinant = np.empty_like(series), np.zeros(len(series))
        mean = np.zeros((*series.shape[:2], self.states))
        predicted = self.stationary(theta)
        between = self.transition(theta), self.process_covariance(theta)
        gaps = [] if skipped is None else (1 + np.flatnonzero(skipped[1:])).tolist()
        for first, last in itertools.pairwise([0, *gaps, readings]):
            stays, t = False, first
            while t < last:
                shared = predicted @ observe
                variance = shared @ observe + sensors[:, t]
                if stays and t < last - 1:
                    # But for the last, after which the step may be another one.
                    ahead = slice(t, last - 1)
                    gain = shared / variance[:, np.newaxis]
                    mean, innovations = _filter_settled(
                        between[0], gain, observe, mean, series[..., ahead]
                    )
                    white[..., ahead] = innovations / np.sqrt(variance)[:, np.newaxis, np.newaxis]
                    log_determinant += (last - 1 - t) * np.log(variance)
                    t = last - 1
                innovation, sd = series[..., t] - mean @ observe, np.sqrt(sensors[:, t])
                white[..., t] = innovation / np.sqrt(variance)[:, np.newaxis]
                log_determinant += np.log(variance)
                t += 1
                transitions, gained = between
                if t == readings:
                    # Nothing is left to be predicted.
                    transitions, gained = np.eye(self.states)[np.newaxis], np.zeros_like(gained)
                elif t == last and skipped is not None:
                    over = 1.0 + float(skipped[t])
                    transitions = self.transition(theta, over)
                    gained = self.process_covariance(theta, over)
                forced = (shared / variance[:, np.newaxis])[:, np.newaxis] @ transitions.swapaxes(
                    1, 2
                )
                mean = mean @ transitions.swapaxes(1, 2) + innovation[..., np.newaxis] * forced
                # Joseph's form, which has no negative eigenvalue however it is rounded.
                forced = forced.swapaxes(1, 2)
                onwards = transitions - forced * observe
                forced = forced * sd[:, np.newaxis, np.newaxis]
                before, predicted = predicted, onwards @ predicted @ onwards.swapaxes(1, 2)
                predicted += forced * forced.swapaxes(1, 2) + gained
                stays = not varies and (t - first) % 8 == 0 and _stays(before, predicted)
        return Filtered(white, log_determinant, mean, predicted)

    def density(self, theta: FloatArray, frequency: FloatArray) -> FloatArray:
        """One-sided amplitude spectral density (frequencies,), um/√Hz, at one θ (1, parameters).

        √(2 Δ (g Q g* + s²)), g = h (z − F)⁻¹ with z = exp(2π i f Δ).
        """
        (transitions,), (gained,) = self.transition(theta), self.process_covariance(theta)
        z = np.exp(2j * np.pi * frequency * self.interval)[:, np.newaxis, np.newaxis]
        row = self.observe @ np.linalg.inv(z * np.eye(self.states) - transitions)
        power = np.einsum("fi,ij,fj->f", row, gained, row.conj()).real
        density: FloatArray = np.sqrt(2 * self.interval * (power + theta[0, 0] ** 2))
        return density

    def draw(
        self,
        theta: FloatArray,
        samples: int,
        generator: np.random.Generator,
        speed: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Draw the discrepancy and the sensor's noise, (samples,), um, at one θ (1, parameters).

        ``speed`` (samples,), V/s, is that of the voltage, by default at rest.
        """
        (discrepancy,), (sensor,) = self.draw_all(theta, samples, generator, speed)
        return discrepancy, sensor

    def draw_all(
        self,
        theta: FloatArray,
        samples: int,
        generator: np.random.Generator,
        speed: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Draw the same at each θ (models, parameters), (models, samples), as one by one."""
        transitions = self.transition(theta)
        scores = generator.standard_normal((len(theta), self.states + 1, samples))
        states = np.swapaxes(scores[:, :-1], 1, 2) @ root(self.process_covariance(theta))
        states[:, 0] = (scores[:, np.newaxis, :-1, 0] @ root(self.stationary(theta)))[:, 0]
        if self.states == 1:
            for model, (a,) in enumerate(transitions[:, 0]):
                states[model, :, 0] = scipy.signal.lfilter((1.0,), (1.0, -a), states[model, :, 0])
            return states @ self.observe, self.sensor_noise(theta, scores[:, -1], speed)
        for model, matrix in enumerate(transitions):
            # F = U T U* with T triangular: from the last one on, each is a recursion by itself.
            triangle, basis = scipy.linalg.schur(matrix, output="complex")
            parts = states[model] @ basis.conj()
            for row in reversed(range(self.states)):
                parts[1:, row] += parts[:-1, row + 1 :] @ triangle[row, row + 1 :]
                taps = (1.0, -triangle[row, row])
                parts[:, row] = scipy.signal.lfilter((1.0,), taps, parts[:, row])
            states[model] = (parts @ basis.T).real
        return states @ self.observe, self.sensor_noise(theta, scores[:, -1], speed)

    def sensor_noise(
        self, theta: FloatArray, scores: FloatArray, speed: FloatArray | None = None
    ) -> FloatArray:
        """Turn standard normal scores (models, samples) into the sensor's noise, um.

        ``speed`` (samples,), V/s, is that of the voltage, by default at rest.
        """
        if self.tailed:
            scores = heavy_tails.quantiles(self.inverse_df(theta), scores)
        if speed is not None and self.paced:
            return np.sqrt(self.sensor_variance(theta, speed)) * scores
        return theta[:, :1] * scores


@dataclass(frozen=True)
class SumNoise(Noise):
    """Several discrepancies beside one sensor: the states of all, one after the other.

    θ has the sensor's sd, then what each of the ``terms`` has besides. Where an earlier term has a
    parameter of the same name, the number of the term is added to it, as in ``discrepancy_sd_2``.
    """

    terms: tuple[Noise, ...] = ()

    @property
    def declarations(self) -> tuple[Declaration, ...]:
        """Those of the first term, then all but the sensor's of the others."""
        declared = list(self.terms[0].declarations)
        for number, term in enumerate(self.terms[1:], start=2):
            names_taken = {declaration.name for declaration in declared}
            for declaration in term.declarations[1:]:
                renamed = replace(
                    declaration,
                    name=f"{declaration.name}_{number}",
                    label=f"{declaration.label}_{{{number}}}",
                    description=f"{declaration.description}, term {number}",
                    aliases=(),
                )
                declared.append(renamed if declaration.name in names_taken else declaration)
        return tuple(declared)

    @property
    def tailed(self) -> bool:
        """Whether a term's is."""
        return any(term.tailed for term in self.terms)

    def inverse_df(self, theta: FloatArray) -> FloatArray:
        """Return that of the term that has heavy tails, if any."""
        degrees = [
            term.inverse_df(columns_of_term)
            for term, columns_of_term in self._split_terms(theta)
            if term.tailed
        ]
        return degrees[0] if degrees else np.zeros(len(theta))

    @property
    def paced(self) -> bool:
        """Whether a term's sensor noise grows with the speed."""
        return any(term.paced for term in self.terms)

    def sensor_variance(self, theta: FloatArray, speed: FloatArray) -> FloatArray:
        """Return that of the term whose noise grows, if any."""
        for term, columns_of_term in self._split_terms(theta):
            if term.paced:
                return term.sensor_variance(columns_of_term, speed)
        return super().sensor_variance(theta, speed)

    @property
    def observe(self) -> FloatArray:
        """The rows of all terms, one after the other."""
        return np.concatenate([term.observe for term in self.terms])

    def stationary(self, theta: FloatArray) -> FloatArray:
        """Return the covariances of all terms along the diagonal."""
        return self._along_diagonal(theta, lambda term, columns: term.stationary(columns))

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return the transitions of all terms along the diagonal."""
        return self._along_diagonal(theta, lambda term, columns: term.transition(columns, readings))

    def process_covariance(self, theta: FloatArray, readings: float = 1.0) -> FloatArray:
        """Return the process covariances of all terms along the diagonal."""
        return self._along_diagonal(
            theta, lambda term, columns: term.process_covariance(columns, readings)
        )

    def correlation_time(self, theta: FloatArray) -> FloatArray:
        """Return the mean of those of all terms, by their variances (models,), s."""
        times, variances = np.zeros(len(theta)), np.zeros(len(theta))
        for term, columns_of_term in self._split_terms(theta):
            variance = term.marginal_sd(columns_of_term)[0] ** 2
            times += variance * term.correlation_time(columns_of_term)
            variances += variance
        return times / np.maximum(variances, np.finfo(float).tiny)

    def at(self, interval: float) -> Self:
        """Return the same noise for readings ``interval`` seconds apart."""
        terms = tuple(term.at(interval) for term in self.terms)
        return replace(self, interval=interval, terms=terms)

    def _split_terms(self, theta: FloatArray) -> Iterator[tuple[Noise, FloatArray]]:
        """Yield each term with its own parameters."""
        first = 1
        for term in self.terms:
            last = first + len(term.declarations) - 1
            yield term, np.concatenate([theta[:, :1], theta[:, first:last]], axis=1)
            first = last

    def _along_diagonal(
        self, theta: FloatArray, block_of: Callable[[Noise, FloatArray], FloatArray]
    ) -> FloatArray:
        """Return matrices (..., states, states) with a block of each term along their diagonal."""
        blocks = [block_of(*term) for term in self._split_terms(theta)]
        matrices = np.zeros((*blocks[0].shape[:-2], self.states, self.states))
        first = 0
        for block in blocks:
            last = first + block.shape[-1]
            matrices[..., first:last, first:last] = block
            first = last
        return matrices


def root(covariance: FloatArray) -> FloatArray:
    """Return R with Rᵀ R = covariance, each (models, states, states)."""
    values, vectors = np.linalg.eigh(covariance)
    root: FloatArray = np.sqrt(np.maximum(values, 0))[..., np.newaxis] * np.swapaxes(vectors, 1, 2)
    return root


def _stays(before: FloatArray, after: FloatArray) -> bool:
    """Tell whether covariances (models, states, states) are the same to rounding."""
    sd = np.sqrt(np.maximum(np.diagonal(after, axis1=1, axis2=2), 0))
    scale = sd[:, :, np.newaxis] * sd[:, np.newaxis]
    return bool(np.all(np.abs(after - before) <= 2e-15 * scale))


def _filter_settled(
    transitions: FloatArray,
    gain: FloatArray,
    observe: FloatArray,
    mean: FloatArray,
    series: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Filter series (models, series, readings) whose gain K stays, a block of readings at once.

    The state m that is expected of a reading y goes on by A = F (1 − K h),

        m ← A m + F K y,   so that over a block   m ← Aᴮ m + Σⱼ A^(B−1−j) F K yⱼ,

    and the innovation of its reading i is yᵢ − h Aⁱ m − Σ_(j<i) h A^(i−1−j) F K yⱼ. Returns the
    state expected after all readings, (models, series, states), and the innovations, um.
    """
    models, n_series, readings = series.shape
    size = min(64, readings)  # that are taken at once
    n_blocks = readings // size
    forced = (transitions @ gain[..., np.newaxis])[..., 0]
    onwards = transitions - forced[..., np.newaxis] * observe
    # A^j F K and h A^j, (models, size, states).
    responses, rows = np.empty((2, models, size, observe.size))
    responses[:, 0], rows[:, 0] = forced, observe
    for j in range(1, size):
        responses[:, j] = (onwards @ responses[:, j - 1, :, np.newaxis])[..., 0]
        rows[:, j] = (rows[:, j - 1, np.newaxis] @ onwards)[:, 0]
    lags = np.subtract.outer(np.arange(size), np.arange(size)) - 1
    weights = np.where(lags >= 0, (responses @ observe)[:, np.maximum(lags, 0)], 0.0)
    blocks = series[..., : n_blocks * size].reshape(models, n_series * n_blocks, size)
    pushed = (blocks @ responses[:, ::-1]).reshape(models, n_series, n_blocks, observe.size)
    over_block = np.swapaxes(np.linalg.matrix_power(onwards, size), 1, 2)
    expected = np.empty_like(pushed)
    for block in range(n_blocks):
        expected[:, :, block] = mean
        mean = mean @ over_block + pushed[:, :, block]
    expected = expected.reshape(models, n_series * n_blocks, observe.size)
    innovations = blocks - expected @ np.swapaxes(rows, 1, 2) - blocks @ np.swapaxes(weights, 1, 2)
    innovations = innovations.reshape(models, n_series, n_blocks * size)
    if n_blocks * size < readings:
        tail = series[..., n_blocks * size :]
        mean, last = _filter_settled(transitions, gain, observe, mean, tail)
        innovations = np.concatenate([innovations, last], axis=2)
    return mean, innovations
