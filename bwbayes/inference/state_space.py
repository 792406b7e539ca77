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

__all__ = ["LOG_TWO_PI", "Filtered", "Noise"]

LOG_TWO_PI = float(np.log(2 * np.pi))

# A covariance that changes by less of itself from reading to reading has settled.
SETTLED = 2e-15


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

    def decay(self, theta: FloatArray) -> FloatArray:
        """Return what the filter keeps of an error over a reading, at most, (models,).

        By default what the discrepancy keeps of itself.
        """
        kept: FloatArray = np.abs(np.linalg.eigvals(self.transition(theta))).max(axis=1)
        return kept

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
        readings: int,  # noqa: ARG002
        generator: np.random.Generator,  # noqa: ARG002
    ) -> FloatArray:
        """Return θ (models, parameters) with the discrepancy's size where nothing was fitted.

        ``missed`` returns the mean square, um², of what the models' mean misses of so many
        fitted readings. By default θ as it is.
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
        sensor = sensor_sd**2
        mean = np.zeros((*series.shape[:2], 2))
        covariance = (sd**2)[:, np.newaxis, np.newaxis] * np.eye(2)
        usual = self.transition(theta), self.fresh(theta)
        white, log_determinant = np.empty_like(series), np.zeros(len(series))
        gaps = [] if skipped is None else np.flatnonzero(skipped[1:]).tolist()
        starts = [0, *(gap + 1 for gap in gaps)]
        for first, last in zip(starts, [*starts[1:], series.shape[2]], strict=True):
            kept, fresh = usual
            if first and skipped is not None:
                readings = 1.0 + float(skipped[first])
                kept, fresh = self.transition(theta, readings), self.fresh(theta, readings)
            before = np.full_like(covariance, np.inf)
            for t in range(first, last):
                forward = np.swapaxes(kept, 1, 2)
                predicted = kept @ covariance @ forward + fresh
                variance = predicted[:, 0, 0] + sensor
                gain = predicted[:, :, 0] / variance[:, np.newaxis]
                if _stays(before, predicted):
                    rest = slice(t, last)
                    mean = _settled(kept, gain, mean, series[..., rest], white[..., rest])
                    white[..., rest] /= np.sqrt(variance)[:, np.newaxis, np.newaxis]
                    log_determinant += (last - t) * np.log(variance)
                    break
                mean = mean @ forward
                innovation = series[..., t] - mean[..., 0]
                mean += gain[:, np.newaxis] * innovation[..., np.newaxis]
                white[..., t] = innovation / np.sqrt(variance)[:, np.newaxis]
                log_determinant += np.log(variance)
                covariance = predicted * (sensor / variance)[:, np.newaxis, np.newaxis]
                covariance[:, 1, 1] = predicted[:, 1, 1] - gain[:, 1] * predicted[:, 0, 1]
                before = predicted
                kept, fresh = usual
        return Filtered(white, log_determinant, mean, covariance)

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
        (kept,), (fresh,) = self.transition(theta), self.fresh(theta)
        values, vectors = np.linalg.eigh(fresh[: self.states, : self.states])
        scores = generator.standard_normal((self.states, samples))
        shocks = np.zeros((2, samples))
        shocks[: self.states] = (vectors * np.sqrt(np.maximum(values, 0))) @ scores
        shocks[: self.states, 0] = self.marginal_sd(theta)[0] * scores[:, 0]
        bottom = (1.0, -np.trace(kept), np.linalg.det(kept))
        discrepancy = scipy.signal.lfilter((1.0, -kept[1, 1]), bottom, shocks[0])
        discrepancy += scipy.signal.lfilter((0.0, kept[0, 1]), bottom, shocks[1])
        return discrepancy, theta[0, 0] * generator.standard_normal(samples)


def _stays(before: FloatArray, after: FloatArray) -> bool:
    """Tell whether covariances (models, 2, 2) are the same, each for the size of its parts."""
    size = np.sqrt(np.einsum("mii->mi", after))
    scale = size[:, :, np.newaxis] * size[:, np.newaxis]
    return bool(np.all(np.abs(after - before) <= SETTLED * scale))


def _settled(
    kept: FloatArray, gain: FloatArray, mean: FloatArray, series: FloatArray, white: FloatArray
) -> FloatArray:
    """Follow series (models, series, readings) with a gain (models, 2) that stays.

    Writes the innovations, um, and returns the states' mean (models, series, 2) after them.
    """
    after = np.empty_like(mean)
    for model, values in enumerate(series):
        (a, b), (_, d) = kept[model]
        trace, determinant = a + d, a * d + b * b
        g, g_2 = gain[model]
        # From the state that is predicted; z for a filter in transposed form.
        first, second = mean[model] @ kept[model].T[:, 0], mean[model] @ kept[model].T[:, 1]
        delays = np.stack([-first, d * first - b * second], axis=1)
        bottom = (1.0, a * g + b * g_2 - trace, determinant * (1 - g))
        top = (1.0, -trace, determinant)
        innovation, _ = scipy.signal.lfilter(top, bottom, values, zi=delays)
        seen = values - (1 - g) * innovation
        earlier = np.concatenate([mean[model, :, :1], seen[:, :-1]], axis=1)
        pull, before = g_2 * innovation - b * earlier, d * mean[model, :, 1:]
        other, _ = scipy.signal.lfilter((1.0,), (1.0, -d), pull, zi=before)
        white[model], after[model] = innovation, np.stack([seen[:, -1], other[:, -1]], axis=1)
    return after
