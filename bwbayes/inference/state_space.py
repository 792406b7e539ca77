"""Noise as a state-space model: sensor noise, and a discrepancy that a Kalman filter follows.

The residual of a Bouc-Wen fit to a measured record is correlated over many samples: most of it is
what the model does not know about the actuator. Calling it white makes the parameters look several
times better known than they are. So the residual is the sum of two parts,

    r(t) = x(t) + e(t),   x the discrepancy (sd σ, correlation time τ),   e white (s).

x is the first of two states whose stationary covariance is σ² times the unit matrix. Over a time
they go on by a matrix F and gain the covariance Q = σ² (1 − F Fᵀ). A Kalman filter turns residuals
into independent innovations, whatever readings are missing; their log density is that of the
residuals, exact in O(readings).

R. E. Kalman, A new approach to linear filtering and prediction problems, Journal of Basic
Engineering 82, 35-45 (1960), doi:10.1115/1.3662552.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Self

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration

LOG_TWO_PI = float(np.log(2 * np.pi))

# Of the two states, (models, series) each, and three elements of their covariance, (models,).
_Mean = tuple[FloatArray, FloatArray]
_Covariance = tuple[FloatArray, FloatArray, FloatArray]


class Filtered(NamedTuple):
    """Innovations of series, and what is known of the discrepancy after the last reading.

    ``white`` (models, series, readings) are the innovations over their sds, ``log_determinant``
    (models,) that of the covariance of the readings; ``mean`` (models, series, 2), um, and
    ``covariance`` (models, 2, 2), um², are those of the states.
    """

    white: FloatArray
    log_determinant: FloatArray
    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class Noise(ABC):
    """A Gaussian model of the residual between a reading and the forward model.

    Methods take θ (models, parameters), the first two of which are the sds of sensor and
    discrepancy, the third the correlation time τ.

    Parameters
    ----------
    interval
        Interval Δ between readings, s.
    """

    interval: float = 1.0

    # How many of the two states there are; the others are zero.
    states: ClassVar[int]

    @property
    @abstractmethod
    def declarations(self) -> tuple[Declaration, ...]:
        """Its parameters, in the order of θ's columns."""

    @abstractmethod
    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return F = [[a, b], [−b, d]], what is left of the states after so many readings.

        (models, 2, 2) after one number of readings, (models, numbers, 2, 2) after some (numbers,).
        """

    @abstractmethod
    def fresh(self, theta: FloatArray, readings: float = 1.0) -> FloatArray:
        """Return Q (models, 2, 2), um², without taking differences of nearly equal numbers."""

    def marginal_sd(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Stationary sd of the discrepancy and sd of the sensor, each (models,), um."""
        return theta[:, 1], theta[:, 0]

    def correlation_time(self, theta: FloatArray) -> FloatArray:
        """Correlation time τ of the discrepancy (models,), s; zero without one."""
        return theta[:, 2]

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

    def log_density(self, theta: FloatArray, residual: FloatArray) -> FloatArray:
        """Log density (models,) of residuals (models, samples) in um."""
        white, log_determinant = self.whiten(theta, residual[:, np.newaxis])
        squares = np.sum(white**2, axis=(1, 2))
        density: FloatArray = -0.5 * (squares + log_determinant + residual.shape[1] * LOG_TWO_PI)
        return density

    def whiten(
        self, theta: FloatArray, series: FloatArray, skipped: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Turn series (models, series, readings) of each model into independent innovations.

        ``skipped`` (readings,) counts the readings that are missing just before each one, by
        default none, as in :class:`~bwbayes.inference.readings.Readings`. Returns the innovations
        over their sds, shaped as the series, and the log determinant (models,) of the covariance:
        with V = L Lᵀ these are L⁻¹ series and log det V.
        """
        filtered = self.filter(theta, series, skipped)
        return filtered.white, filtered.log_determinant

    def filter(
        self, theta: FloatArray, series: FloatArray, skipped: FloatArray | None = None
    ) -> Filtered:
        """Whiten series, and say what is known of the states then; arguments as of `whiten`.

        Once the covariance of all models stays as it is, only the means go on.
        """
        sd, sensor_sd = self.marginal_sd(theta)
        sensor, always, two = sensor_sd**2, sd**2, self.states > 1
        white, log_determinant = np.empty_like(series), np.zeros(len(series))
        mean: _Mean = np.zeros(series.shape[:2]), np.zeros(series.shape[:2])
        covariance: _Covariance = always, np.zeros_like(always), always
        predicted = covariance
        between = self.step(theta)
        gaps = [] if skipped is None else np.flatnonzero(skipped[1:]).tolist()
        starts = [0, *(gap + 1 for gap in gaps)]
        for first, last in zip(starts, [*starts[1:], series.shape[2]], strict=True):
            step = between
            if first and skipped is not None:
                step = self.step(theta, 1.0 + float(skipped[first]))
            for t in range(first, last):
                before = predicted
                expected, predicted = _predicted(step, mean, covariance, two=two)
                p, p_12, p_22 = predicted
                variance = p + sensor
                gain, rest = p / variance, sensor / variance
                gain_2 = p_12 / variance if two else p_12
                if t > first and t % 8 == 0 and _stays(before, predicted):
                    ahead = slice(t, last)
                    gains = gain, gain_2
                    mean = _settled(step, gains, mean, series[..., ahead], white[..., ahead], two)
                    white[..., ahead] /= np.sqrt(variance)[:, np.newaxis, np.newaxis]
                    log_determinant += (last - t) * np.log(variance)
                    break
                innovation = series[..., t] - expected[0]
                white[..., t] = innovation / np.sqrt(variance)[:, np.newaxis]
                log_determinant += np.log(variance)
                mean = expected[0] + gain[:, np.newaxis] * innovation, expected[1]
                covariance = p * rest, p_12, p_22
                if two:
                    mean = mean[0], expected[1] + gain_2[:, np.newaxis] * innovation
                    covariance = p * rest, p_12 * rest, p_22 - gain_2 * p_12
                step = between
        c, c_12, c_22 = covariance
        matrices = np.stack([c, c_12, c_12, c_22], axis=1).reshape(-1, 2, 2)
        return Filtered(white, log_determinant, np.stack(mean, axis=2), matrices)

    def step(self, theta: FloatArray, readings: float = 1.0) -> FloatArray:
        """Return a, b, d of F, and Q's first row and its last element, (6, models)."""
        parts = self.transition(theta, readings), self.fresh(theta, readings)
        return np.concatenate([part[:, [0, 0, 1], [0, 1, 1]] for part in parts], axis=1).T

    def density(self, theta: FloatArray, frequency: FloatArray) -> FloatArray:
        """One-sided amplitude spectral density (frequencies,), um/√Hz, at one θ (1, parameters).

        √(2 Δ (h Q h* + s²)), h the first row of (z − F)⁻¹ with z = exp(2π i f Δ).
        """
        (kept,), (fresh,), sensor = self.transition(theta), self.fresh(theta), theta[0, 0]
        z = np.exp(2j * np.pi * frequency * self.interval)[:, np.newaxis, np.newaxis]
        row = np.linalg.inv(z * np.eye(2) - kept)[:, 0]
        power = np.einsum("fi,ij,fj->f", row, fresh, row.conj()).real
        density: FloatArray = np.sqrt(2 * self.interval * (power + sensor**2))
        return density

    def draw(
        self, theta: FloatArray, samples: int, generator: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Draw the discrepancy and the sensor's noise, (samples,), um, at one θ (1, parameters)."""
        (discrepancy,), (sensor,) = self.draw_all(theta, samples, generator)
        return discrepancy, sensor

    def draw_all(
        self, theta: FloatArray, samples: int, generator: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Draw the same at each θ (models, parameters), (models, samples), as one by one."""
        kept, fresh = self.transition(theta), self.fresh(theta)
        states, sds = slice(0, self.states), self.marginal_sd(theta)[0]
        scores = generator.standard_normal((len(theta), self.states + 1, samples))
        values, vectors = np.linalg.eigh(fresh[:, states, states])
        shocks = np.zeros((len(theta), 2, samples))
        scales = np.sqrt(np.maximum(values, 0))[:, np.newaxis]
        shocks[:, states] = (vectors * scales) @ scores[:, states]
        shocks[:, states, 0] = sds[:, np.newaxis] * scores[:, states, 0]
        discrepancy = np.empty((len(theta), samples))
        for model, f in enumerate(kept):
            bottom = (1.0, -np.trace(f), np.linalg.det(f))
            first = scipy.signal.lfilter((1.0, -f[1, 1]), bottom, shocks[model, 0])
            second = scipy.signal.lfilter((0.0, f[0, 1]), bottom, shocks[model, 1])
            discrepancy[model] = first + second
        return discrepancy, theta[:, :1] * scores[:, -1]


def _predicted(
    step: FloatArray, mean: _Mean, covariance: _Covariance, *, two: bool
) -> tuple[_Mean, _Covariance]:
    """Return mean and covariance after a step; of one state alone, the other is not touched."""
    a, b, d, q, q_12, q_22 = step
    p, p_12, p_22 = covariance
    x, x_2 = mean
    if not two:
        return (a[:, np.newaxis] * x, x_2), (a * a * p + q, p_12, p_22)
    top, bottom = a * p + b * p_12, a * p_12 + b * p_22
    low, end = d * p_12 - b * p, d * p_22 - b * p_12
    after = a * top + b * bottom + q, d * bottom - b * top + q_12, d * end - b * low + q_22
    a, b, d = step[:3, :, np.newaxis]
    return (a * x + b * x_2, d * x_2 - b * x), after


def _stays(before: _Covariance, after: _Covariance) -> bool:
    """Tell whether covariances are the same, each for the size of its parts, to rounding."""
    scales = after[0], np.sqrt(after[0] * after[2]), after[2]
    triples = zip(before, after, scales, strict=True)
    return all(bool(np.all(np.abs(new - old) <= 2e-15 * size)) for old, new, size in triples)


def _settled(
    step: FloatArray,
    gains: tuple[FloatArray, FloatArray],
    mean: _Mean,
    series: FloatArray,
    innovations: FloatArray,
    two: bool,
) -> _Mean:
    """Follow series (models, series, readings) with gains that stay.

    Writes the innovations, um, and returns the states' mean after them.
    """
    after = np.empty_like(mean[0]), np.zeros_like(mean[1])
    for model, values in enumerate(series):
        a, b, d = step[:3, model]
        g, g_2 = gains[0][model], gains[1][model]
        x, x_2 = mean[0][model], mean[1][model]
        top: tuple[float, ...] = (1.0, -a)
        bottom: tuple[float, ...] = (1.0, a * g - a)
        # From the state that is predicted, as a filter in transposed form keeps it.
        first, second = a * x + b * x_2, d * x_2 - b * x
        delays = -first[:, np.newaxis]
        if two:
            determinant = a * d + b * b
            top = 1.0, -a - d, determinant
            bottom = 1.0, a * g + b * g_2 - a - d, determinant * (1 - g)
            delays = np.stack([-first, d * first - b * second], axis=1)
        innovation, _ = scipy.signal.lfilter(top, bottom, values, zi=delays)
        innovations[model] = innovation
        after[0][model] = values[:, -1] - (1 - g) * innovation[:, -1]
        if two:
            seen = values[:, :-1] - (1 - g) * innovation[:, :-1]
            pull = g_2 * innovation - b * np.concatenate([x[:, np.newaxis], seen], axis=1)
            other, _ = scipy.signal.lfilter((1.0,), (1.0, -d), pull, zi=d * x_2[:, np.newaxis])
            after[1][model] = other[:, -1]
    return after
