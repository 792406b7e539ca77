"""A rough discrepancy: an Ornstein-Uhlenbeck process, which forgets exponentially.

It claims the least of what a model misses: that two readings have less in common the farther they
are apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.inference.noise import DISCREPANCY_SD, DISCREPANCY_TIME, SENSOR_SD, log_density
from bwbayes.model.declaration import Declaration

__all__ = ["DiscrepancyNoise", "SteadyState"]

# Stretches of evenly spaced readings from this length on go through the closed form, model by
# model; shorter ones reading by reading, all models at once.
LONG = 64


class SteadyState(NamedTuple):
    """The filter of a noise model in the long run; each (models,), names as in DiscrepancyNoise.

    ``kept`` is φ, ``predicted`` p, ``variance`` S, ``surplus`` δ = σ² − p, what the discrepancy's
    own variance has beyond it (um²), ``log_decay`` log a, and ``rate`` is Δ/τ.
    """

    kept: FloatArray
    predicted: FloatArray
    variance: FloatArray
    surplus: FloatArray
    log_decay: FloatArray
    rate: FloatArray


@dataclass(frozen=True)
class DiscrepancyNoise:
    """Ornstein-Uhlenbeck discrepancy plus white sensor noise, exact in O(readings).

    The discrepancy x has sd σ, and a correlation of exp(−t/τ) between readings t apart; the
    sensor's noise has sd s. With φ = exp(−Δ/τ), q = σ² (1 − φ²): the predicted variance of x in
    the long run is the positive root p of p² + p (1 − φ²)(s² − σ²) = q s², an innovation has
    variance S = p + s², and errors of the prediction die out by a = φ s²/S a reading. The variance
    at hand is p + D, with

        D → a² D S / (S + D)           after a reading,
        D → ρ² D + (1 − ρ²)(σ² − p)    over missing ones, ρ = φ to the power of their number,

    and D = σ² − p before the first. From one reading to the next the prediction follows
    x̂ → φ (x̂ + (p + D)/(S + D) (r − x̂)). Along evenly spaced readings this has a closed form on top
    of the innovations η[t] of the steady state, D = 0: with

        A[t] = Σ a²ʲ/S,   B[t] = Σ aʲ η[j]/S   (j < t),   ξ[t] = D₀ B[t] / (1 + D₀ A[t]),

    the innovations are η[t] − aᵗ ξ[t], of variance S + a²ᵗ D₀ / (1 + D₀ A[t]). Nothing here takes
    differences of nearly equal numbers: it is well behaved for σ → 0, s → 0 and any τ.

    Parameters
    ----------
    interval
        Interval Δ between readings, s.

    Notes
    -----
    G. E. Uhlenbeck, L. S. Ornstein, On the theory of the Brownian motion, Physical Review 36,
    823-841 (1930), doi:10.1103/PhysRev.36.823; the recursion is a Kalman filter, R. E. Kalman, A
    new approach to linear filtering and prediction problems, Journal of Basic Engineering 82,
    35-45 (1960), doi:10.1115/1.3662552.
    """

    interval: float

    @property
    def declarations(self) -> tuple[Declaration, ...]:
        """Sds of sensor and discrepancy, and the discrepancy's correlation time."""
        return (SENSOR_SD, DISCREPANCY_SD, DISCREPANCY_TIME)

    def whiten(
        self, theta: FloatArray, series: FloatArray, skipped: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the exact innovations; shapes as in :class:`Noise`."""
        steady = self.steady_state(theta)
        filter_ = _Filter(steady, np.zeros(series.shape[:2]), steady.surplus.copy())
        white = np.empty_like(series)
        log_determinant = np.zeros(series.shape[0])
        gaps = [] if skipped is None else np.flatnonzero(skipped).tolist()
        for first, last in zip([0, *gaps], [*gaps, series.shape[2]], strict=True):
            if first:
                assert skipped is not None
                filter_.skip(float(skipped[first]))
            stretch = slice(first, last)
            follow = filter_.run if last - first >= LONG else filter_.step
            log_determinant += follow(series[..., stretch], white[..., stretch])
        return white, log_determinant

    def log_density(self, theta: FloatArray, residual: FloatArray) -> FloatArray:
        """Return the exact log density; shapes as in :class:`Noise`."""
        return log_density(*self.whiten(theta, residual[:, np.newaxis]))

    def marginal_sd(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Stationary sd of the discrepancy; sd of the sensor."""
        return theta[:, 1], theta[:, 0]

    def sized(
        self,
        theta: FloatArray,
        missed: Callable[[], float],  # noqa: ARG002
        readings: int,  # noqa: ARG002
        generator: np.random.Generator,  # noqa: ARG002
    ) -> FloatArray:
        """Return θ as it is."""
        return theta

    def memory(self, theta: FloatArray) -> FloatArray:
        """Return the correlation time."""
        return theta[:, 2]

    def draw(
        self, theta: FloatArray, samples: int, generator: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Draw a stationary Ornstein-Uhlenbeck process and independent normal errors."""
        sensor, sd, time = theta[0]
        rate = self.interval / time
        shocks = sd * generator.standard_normal(samples)
        shocks[1:] *= np.sqrt(-np.expm1(-2 * rate))
        discrepancy = np.asarray(
            scipy.signal.lfilter([1.0], [1.0, -np.exp(-rate)], shocks), dtype=np.float64
        )
        return discrepancy, sensor * generator.standard_normal(samples)

    def at(self, interval: float) -> DiscrepancyNoise:
        """Return the same noise for readings ``interval`` seconds apart."""
        return replace(self, interval=interval)

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return φ to the power of the readings; the second state is not needed."""
        kept = np.zeros((len(theta), *np.shape(readings), 2, 2))
        kept[..., 0, 0] = np.exp(-np.multiply.outer(self.interval / theta[:, 2], readings))
        return kept

    def log_decay(self, theta: FloatArray) -> FloatArray:
        """Return log a."""
        return self.steady_state(theta).log_decay

    def density(self, theta: FloatArray, frequency: FloatArray) -> FloatArray:
        """Return that of white innovations of variance S that pass (1 − a z⁻¹)/(1 − φ z⁻¹)."""
        kept, _, variance, _, log_decay, _ = self.steady_state(theta)
        later = np.exp(-2j * np.pi * frequency * self.interval)
        passed = np.abs((1 - np.exp(log_decay) * later) / (1 - kept * later))
        density: FloatArray = np.sqrt(2 * self.interval * variance) * passed
        return density

    def coefficients(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return the steady state, and what an innovation adds to the next prediction, φ − a."""
        steady = self.steady_state(theta)
        return {
            "kept": steady.kept,
            "decay": np.exp(steady.log_decay),
            # Without the cancellation.
            "gain": steady.kept * steady.predicted / steady.variance,
            "predicted": steady.predicted,
            "variance": steady.variance,
            "surplus": steady.surplus,
            "rate": steady.rate,
        }

    def steady_state(self, theta: FloatArray) -> SteadyState:
        """Return the filter in the long run, without cancellation at either extreme."""
        sensor, process = theta[:, 0] ** 2, theta[:, 1] ** 2
        rate = self.interval / theta[:, 2]
        fresh = -np.expm1(-2 * rate)
        half = fresh * (process - sensor) / 2
        root = np.sqrt(half**2 + fresh * process * sensor)
        divisor = np.where(half > 0, 1, root - half)
        predicted = np.where(half > 0, half + root, fresh * process * sensor / divisor)
        with np.errstate(divide="ignore", over="ignore"):
            log_a = np.minimum(-rate - np.log1p(predicted / sensor), -1e-300)
        surplus = np.maximum(process - predicted, 0.0)
        return SteadyState(np.exp(-rate), predicted, predicted + sensor, surplus, log_a, rate)


@dataclass
class _Filter:
    """The Kalman filter of all models on its way through the readings.

    ``mean`` (models, series) is x̂, the prediction of the next reading of each series, um;
    ``unsure`` (models,) is D, um².
    """

    steady: SteadyState
    mean: FloatArray
    unsure: FloatArray

    def skip(self, readings: float) -> None:
        """Pass over that many missing readings."""
        decay = np.exp(-readings * self.steady.rate)
        self.mean *= decay[:, np.newaxis]
        self.unsure = decay**2 * self.unsure - np.expm1(-2 * readings * self.steady.rate) * (
            self.steady.surplus
        )

    def step(self, series: FloatArray, white: FloatArray) -> FloatArray:
        """Whiten evenly spaced series reading by reading; return the log determinant (models,)."""
        steady = self.steady
        decay = np.exp(2 * steady.log_decay)
        log_determinant = np.zeros(len(self.unsure))
        for t in range(series.shape[2]):
            variance = steady.variance + self.unsure
            innovation = series[..., t] - self.mean
            white[..., t] = innovation / np.sqrt(variance)[:, np.newaxis]
            log_determinant += np.log(variance)
            gain = (steady.predicted + self.unsure) / variance
            self.mean = steady.kept[:, np.newaxis] * (self.mean + gain[:, np.newaxis] * innovation)
            self.unsure = decay * self.unsure * (steady.variance / variance)
        return log_determinant

    def run(self, series: FloatArray, white: FloatArray) -> FloatArray:
        """Do the same as :meth:`step` by the closed form."""
        readings = series.shape[2]
        log_determinant: FloatArray = readings * np.log(self.steady.variance)
        for row, values in enumerate(series):
            phi, variance = self.steady.kept[row], self.steady.variance[row]
            log_a, unsure = self.steady.log_decay[row], self.unsure[row]
            a = np.exp(log_a)
            # Innovations over their sd in the long run.
            scale = 1 / np.sqrt(variance)
            before = -scale * self.mean[row][:, np.newaxis]
            eta, after = scipy.signal.lfilter(
                (scale, -scale * phi), (1.0, -a), values, axis=-1, zi=before
            )
            # Powers of a below exp(-40) add nothing.
            memory = int(min(readings, 1 - 40 / log_a))
            powers = np.power(a, np.arange(memory + 1))
            squares = np.concatenate([[0.0], np.cumsum(powers[:-1] ** 2)])
            pull = np.zeros((len(values), memory + 1))
            np.cumsum(powers[:-1] * eta[:, :memory], axis=1, out=pull[:, 1:])
            ratio = unsure / variance / (1 + unsure / variance * squares)
            shift = powers * ratio * pull
            ratio *= powers**2
            white[row] = eta
            white[row, :, :memory] -= shift[:, :-1]
            white[row, :, :memory] /= np.sqrt(1 + ratio[:-1])
            log_determinant[row] += np.sum(np.log1p(ratio[:-1]))
            # What is past the memory is forgotten.
            self.mean[row] = -after[:, 0] / scale
            if memory == readings:
                self.mean[row] += shift[:, -1] / scale
            self.unsure[row] = ratio[-1] * variance if memory == readings else 0.0
        return log_determinant
