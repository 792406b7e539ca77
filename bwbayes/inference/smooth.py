"""A smooth discrepancy: what a model misses of a real actuator has no corners.

An Ornstein-Uhlenbeck process is rough at every scale, so that at high sampling rates it takes slow
misfit for something unlikely, and the answer depends on the rate. The process here is an oscillator
driven by white noise, with sd σ, correlation time τ and quality Q:

    ẍ + (ω/Q) ẋ + ω² x = white noise,   ω = 1/(τ Q),   τ = ∫₀^∞ ρ(t) dt.

Q = 1/2 is a Matérn process of order 3/2; for Q → 0 it becomes an Ornstein-Uhlenbeck process of the
same σ and τ, and beyond 1/2 it swings. With its velocity it is a Markov process of two states.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.inference.noise import DISCREPANCY_SD, DISCREPANCY_TIME, SENSOR_SD, log_density
from bwbayes.model.declaration import Declaration
from bwbayes.model.distributions import Distribution

__all__ = ["SmoothNoise"]

# The integral over an interval, by Gauss and Legendre, where the fast rate times it is below this.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
SHORT = 1.0

# A covariance that changes by less of itself from reading to reading stays as it is.
SETTLED = 2e-15

# What swings knows hardly anything at low frequencies: it takes a slow misfit for the parameters'.
DISCREPANCY_QUALITY = Declaration(
    "discrepancy_quality",
    "",
    "Q",
    "quality of the model discrepancy, 0.5 for Matérn 3/2, less if it is rougher",
    lambda _: Distribution("uniform", {"lower": 0.0, "upper": 0.5}),
    floor=0.0,
)


@dataclass(frozen=True)
class SmoothNoise:
    """A driven oscillator as discrepancy plus white sensor noise, exact in O(readings).

    The state is (x, ẋ/ω), whose stationary covariance is σ² times the unit matrix. Over a time t it
    goes on by F(t), and gains the covariance σ² (1 − F Fᵀ). With the rates a ≤ b that solve
    λ² − λ ω/Q + ω² = 0, and S(t) = (e^(−a t) − e^(−b t))/(b − a):

        F(t) = [[e^(−a t) + a S,  ω S], [−ω S,  e^(−b t) − a S]].

    A Kalman filter turns residuals into independent innovations, over missing readings too.

    Parameters
    ----------
    interval
        Interval Δ between readings, s.

    Notes
    -----
    G. E. Uhlenbeck, L. S. Ornstein, On the theory of the Brownian motion, Physical Review 36,
    823-841 (1930), doi:10.1103/PhysRev.36.823, for the oscillator too; as a kernel in
    D. Foreman-Mackey, E. Agol, S. Ambikasaran, R. Angus, Fast and scalable Gaussian process
    modeling with applications to astronomical time series, The Astronomical Journal 154, 220
    (2017), doi:10.3847/1538-3881/aa9332.
    """

    interval: float

    @property
    def declarations(self) -> tuple[Declaration, ...]:
        """Sds of sensor and discrepancy, the discrepancy's correlation time and quality."""
        return (SENSOR_SD, DISCREPANCY_SD, DISCREPANCY_TIME, DISCREPANCY_QUALITY)

    def whiten(
        self, theta: FloatArray, series: FloatArray, skipped: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the exact innovations; shapes as in :class:`~bwbayes.inference.noise.Noise`."""
        sensor, process = theta[:, 0] ** 2, theta[:, 1] ** 2
        kept, fresh = self.transition(theta), self.fresh(theta)
        white = np.empty_like(series)
        log_determinant = np.zeros(series.shape[0])
        mean = np.zeros((*series.shape[:2], 2))
        unsure = process[:, np.newaxis, np.newaxis] * np.eye(2)
        gaps = [] if skipped is None else np.flatnonzero(skipped).tolist()
        for first, last in zip([0, *gaps], [*gaps, series.shape[2]], strict=True):
            if first:
                assert skipped is not None
                over = self.transition(theta, float(skipped[first]))
                mean = mean @ np.swapaxes(over, 1, 2)
                gained = np.eye(2) - over @ np.swapaxes(over, 1, 2)
                unsure = _through(over, unsure) + process[:, np.newaxis, np.newaxis] * gained
            for t in range(first, last):
                variance = unsure[:, 0, 0] + sensor
                gain = (unsure[:, :, 0] / variance[:, np.newaxis])[:, np.newaxis]
                innovation = series[..., t] - mean[..., 0]
                white[..., t] = innovation / np.sqrt(variance)[:, np.newaxis]
                log_determinant += np.log(variance)
                mean = (mean + gain * innovation[..., np.newaxis]) @ np.swapaxes(kept, 1, 2)
                before, unsure = unsure, _through(kept, _seen(unsure, sensor)) + fresh
                if t + 1 < last and _stays(before, unsure):
                    rest = slice(t + 1, last)
                    log_determinant += (last - t - 1) * np.log(variance)
                    mean = _settled(kept, gain, mean, series[..., rest], white[..., rest])
                    white[..., rest] /= np.sqrt(variance)[:, np.newaxis, np.newaxis]
                    break
        return white, log_determinant

    def log_density(self, theta: FloatArray, residual: FloatArray) -> FloatArray:
        """Return the exact log density; shapes as in :class:`~bwbayes.inference.noise.Noise`."""
        return log_density(*self.whiten(theta, residual[:, np.newaxis]))

    def marginal_sd(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Stationary sd of the discrepancy; sd of the sensor."""
        return theta[:, 1], theta[:, 0]

    def sized(
        self,
        theta: FloatArray,
        missed: Callable[[], float],
        readings: int,
        generator: np.random.Generator,
    ) -> FloatArray:
        """Take the discrepancy's size from the residuals, not from the kernel.

        Readings fix how the process moves at high frequencies, σ²/τ³; what σ adds at low ones is an
        extrapolation, often of several times what was seen. So a draw's variance is the mean
        square of the residuals less the sensor's, times ν/χ²(ν): over a time T they are worth
        ν = T/∫ρ² = T/(τ (1 + Q²)) independent ones, or two at least.
        """
        _, _, time, quality = theta.T
        worth = np.maximum(readings * self.interval / (time * (1 + quality**2)), 2.0)
        seen = np.maximum(missed() - theta[:, 0] ** 2, 0.0)
        sized = theta.copy()
        sized[:, 1] = np.sqrt(seen * worth / generator.chisquare(worth))
        return sized

    def memory(self, theta: FloatArray) -> FloatArray:
        """Return the correlation time τ."""
        return theta[:, 2]

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return F over the time of so many readings; shapes as in the protocol."""
        return _transition(theta, readings * self.interval)

    def fresh(self, theta: FloatArray) -> FloatArray:
        """Return what an interval adds to the state's covariance, (models, 2, 2), um².

        σ² (1 − F Fᵀ), where the interval is short as the integral over it of what the noise, which
        drives the second state, becomes: a difference of nearly equal numbers would be lost.
        """
        _, process, time, quality = theta.T
        fast = (1 + np.sqrt(np.maximum(1 - 4 * quality**2, 0))) / (2 * time * quality**2)
        fast = np.maximum(fast, 1 / (time * quality))
        kept = self.transition(theta)
        fresh = np.eye(2) - kept @ np.swapaxes(kept, 1, 2)
        short = fast * self.interval < SHORT
        if short.any():
            times = self.interval * (1 + NODES) / 2
            pushed = _transition(theta[short], times)[..., 1]
            total = np.einsum("mti,mtj,t->mij", pushed, pushed, WEIGHTS)
            scale = self.interval / (time * quality**2)[short]
            fresh[short] = scale[:, np.newaxis, np.newaxis] * total
        fresh *= (process**2)[:, np.newaxis, np.newaxis]
        return fresh

    def log_decay(self, theta: FloatArray) -> FloatArray:
        """Return the logarithm of what is left of the state after a reading, at most, (models,)."""
        _, _, time, quality = theta.T
        # Of the slow rate; what swings dies out by half of ω/Q.
        root = np.sqrt(np.maximum(1 - 4 * quality**2, 0))
        doubled = np.where(quality > 0.5, 1 / quality**2, 4 / (1 + root))
        decay: FloatArray = -self.interval * doubled / (2 * time)
        return decay

    def density(self, theta: FloatArray, frequency: FloatArray) -> FloatArray:
        """Amplitude spectral density (frequencies,), um/√Hz, one-sided, at one θ (1, parameters).

        The oscillator's own, 4 σ² τ / ((1 − ν²)² + ν²/Q²) with ν = 2π f/ω, beside the sensor's.
        """
        sensor, process, time, quality = theta[0]
        ratio = (2 * np.pi * frequency * time * quality) ** 2
        smooth = 4 * process**2 * time / ((1 - ratio) ** 2 + ratio / quality**2)
        density: FloatArray = np.sqrt(smooth + 2 * self.interval * sensor**2)
        return density

    def draw(
        self, theta: FloatArray, samples: int, generator: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Draw the stationary process and independent normal errors."""
        kept, process = self.transition(theta)[0], theta[0, 1]
        values, vectors = np.linalg.eigh(self.fresh(theta)[0])
        root = vectors * np.sqrt(np.maximum(values, 0))
        shocks = root @ generator.standard_normal((2, samples))
        shocks[:, 0] = process * generator.standard_normal(2)
        bottom = (1.0, -np.trace(kept), np.linalg.det(kept))
        discrepancy = scipy.signal.lfilter((1.0, -kept[1, 1]), bottom, shocks[0])
        discrepancy += scipy.signal.lfilter((0.0, kept[0, 1]), bottom, shocks[1])
        return discrepancy, theta[0, 0] * generator.standard_normal(samples)

    def at(self, interval: float) -> SmoothNoise:
        """Return the same noise for readings ``interval`` seconds apart."""
        return replace(self, interval=interval)

    def coefficients(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return the compiled filter's parameters (models,), by their names there."""
        kept, fresh = self.transition(theta), self.fresh(theta)
        sensor, process = theta[:, 0] ** 2, theta[:, 1] ** 2
        return {
            "kept": kept[:, 0, 0],
            "kept_12": kept[:, 0, 1],
            "kept_22": kept[:, 1, 1],
            "fresh_11": fresh[:, 0, 0],
            "fresh_12": fresh[:, 0, 1],
            "fresh_22": fresh[:, 1, 1],
            "sensor": sensor,
            "surplus": process,
            "variance": sensor + process,
        }


def _transition(theta: FloatArray, time: float | FloatArray) -> FloatArray:
    """Return F (models, times, 2, 2) over times (times,), s; (models, 2, 2) over one."""
    shape = (-1, *[1] * np.ndim(time))
    memory, quality = (theta[:, column].reshape(shape) for column in (2, 3))
    frequency = 1 / (memory * quality)
    middle = frequency / (2 * quality)
    # At Q = 1/2 both rates are the same.
    apart = np.maximum(np.sqrt(np.abs(1 - 4 * quality**2)) * middle, 1e-150)
    fast = middle + apart
    slow = frequency**2 / fast
    lasting = np.exp(-slow * time)
    swelled = -lasting * np.expm1(-2 * apart * time) / (2 * apart)
    first, last = lasting + slow * swelled, np.exp(-fast * time) - slow * swelled
    swings = quality > 0.5
    if swings.any():
        decay, angle = np.exp(-middle * time), apart * time
        sine, cosine = decay * np.sin(angle) / apart, decay * np.cos(angle)
        first = np.where(swings, cosine + middle * sine, first)
        last = np.where(swings, cosine - middle * sine, last)
        swelled = np.where(swings, sine, swelled)
    across = frequency * swelled
    rows = np.stack([first, across, -across, last], axis=-1)
    return rows.reshape(*first.shape, 2, 2)


def _through(kept: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return F P Fᵀ (models, 2, 2)."""
    result: FloatArray = kept @ covariance @ np.swapaxes(kept, 1, 2)
    return result


def _seen(unsure: FloatArray, sensor: FloatArray) -> FloatArray:
    """Return the state's covariance (models, 2, 2) after a reading of its first part."""
    variance = unsure[:, 0, 0] + sensor
    left = unsure * (sensor / variance)[:, np.newaxis, np.newaxis]
    left[:, 1, 1] = unsure[:, 1, 1] - unsure[:, 0, 1] ** 2 / variance
    return left


def _stays(before: FloatArray, after: FloatArray) -> bool:
    """Tell whether covariances (models, 2, 2) are the same, each for the size of its parts."""
    size = np.sqrt(np.einsum("mii->mi", after))
    scale = size[:, :, np.newaxis] * size[:, np.newaxis]
    return bool(np.all(np.abs(after - before) <= SETTLED * scale))


def _settled(
    kept: FloatArray, gain: FloatArray, mean: FloatArray, series: FloatArray, white: FloatArray
) -> FloatArray:
    """Follow series (models, series, readings) with a gain (models, 1, 2) that stays.

    Writes the innovations, um, and returns the state's mean (models, series, 2) after them.
    """
    after = np.empty_like(mean)
    for model, values in enumerate(series):
        pull = kept[model] @ gain[model, 0]
        closed = kept[model] - np.outer(pull, (1.0, 0.0))
        bottom = (1.0, -np.trace(closed), np.linalg.det(closed))
        now = mean[model]
        later = now @ closed.T
        # What the filter's delays hold is that of the state at hand; x̂ first, then its velocity.
        for part in (0, 1):
            other = (
                closed[part, 1 - part] * pull[1 - part] - closed[1 - part, 1 - part] * pull[part]
            )
            delays = np.stack([now[:, part], later[:, part] + bottom[1] * now[:, part]], axis=1)
            top = (0.0, pull[part], other)
            expected, delays = scipy.signal.lfilter(top, bottom, values, zi=delays)
            if part == 0:
                white[model] = values - expected
            after[model, :, part] = delays[:, 0]
    return after
