"""What the model leaves over: sensor noise, and honest discrepancy.

The residual of a Bouc-Wen fit to a measured record is correlated over many samples: most of it is
what the model does not know about the actuator. Calling it white makes the parameters look several
times better known than they are. So the residual is the sum of two parts,

    r(t) = x(t) + e(t),   x an Ornstein-Uhlenbeck process (sd σ, correlation time τ),   e white (s),

and its exact log density costs one recursion over the samples: the innovations of the steady-state
Kalman filter, which has constant coefficients, and one scalar correction for the start, where the
filter is less sure than in the steady state.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
from scipy.signal import lfilter

from bwbayes.arrays import FloatArray

__all__ = ["DiscrepancyNoise", "Noise", "NoiseKind", "SteadyState", "WhiteNoise", "noise_model"]

NoiseKind = Literal["white", "discrepancy"]

LOG_TWO_PI = float(np.log(2 * np.pi))


class SteadyState(NamedTuple):
    """The steady-state filter of a noise model; each (models,), names as in DiscrepancyNoise.

    ``kept`` is φ, ``predicted`` p, ``variance`` S, ``surplus`` δ (um²) and ``log_decay`` log a.
    """

    kept: FloatArray
    predicted: FloatArray
    variance: FloatArray
    surplus: FloatArray
    log_decay: FloatArray

    def start_gain(self, samples: int) -> FloatArray:
        """Return 1 + δ A (models,): how much the start's surplus counts over that many samples."""
        powers = np.expm1(2 * samples * self.log_decay) / np.expm1(2 * self.log_decay)
        return 1 + self.surplus / self.variance * powers


class Noise(Protocol):
    """A Gaussian model of the residual between a reading and the forward model."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of θ's columns."""

    def log_density(self, theta: FloatArray, residual: FloatArray) -> FloatArray:
        """Log density (models,) of residuals (models, samples) in um at θ (models, parameters)."""

    def steady_state(self, theta: FloatArray) -> SteadyState:
        """Return the filter that turns residuals into independent innovations in the long run."""

    def marginal_sd(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sd of the discrepancy and of the sensor, each (models,), um."""

    def at(self, interval: float) -> Noise:
        """Return the same noise for samples ``interval`` seconds apart."""


def noise_model(kind: NoiseKind, interval: float) -> Noise:
    """Return the noise model of that name for samples ``interval`` seconds apart."""
    return WhiteNoise() if kind == "white" else DiscrepancyNoise(interval)


@dataclass(frozen=True)
class WhiteNoise:
    """Sensor noise alone: independent normal errors. Right only if the model is."""

    parameters: tuple[str, ...] = ("sensor_sd",)

    def log_density(self, theta: FloatArray, residual: FloatArray) -> FloatArray:
        """Return Σ log N(r; 0, s²); shapes as in :class:`Noise`."""
        sensor = theta[:, 0]
        squares = np.sum((residual / sensor[:, np.newaxis]) ** 2, axis=1)
        samples = residual.shape[1]
        density: FloatArray = -0.5 * squares - samples * (np.log(sensor) + 0.5 * LOG_TWO_PI)
        return density

    def steady_state(self, theta: FloatArray) -> SteadyState:
        """Nothing is remembered: innovations are the residuals."""
        none = np.zeros(theta.shape[0])
        return SteadyState(none, none, theta[:, 0] ** 2, none, none - np.inf)

    def marginal_sd(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """No discrepancy; sd of the sensor."""
        return np.zeros(theta.shape[0]), theta[:, 0]

    def at(self, interval: float) -> WhiteNoise:  # noqa: ARG002  # it has no memory
        """Return the same noise."""
        return self


@dataclass(frozen=True)
class DiscrepancyNoise:
    """Ornstein-Uhlenbeck discrepancy plus white sensor noise, exact in O(samples).

    With φ = exp(−Δ/τ), q = σ² (1 − φ²): the predicted variance of x in the steady state is the
    positive root p of p² + p (1 − φ²)(s² − σ²) = q s², an innovation has variance S = p + s², and
    errors of the prediction die out by a = φ s²/S a sample. The steady-state innovations are

        η[t] = r[t] − x̂[t],   x̂[t+1] = a x̂[t] + (φ − a) r[t],   x̂[0] = 0.

    At the start x has its stationary variance, larger than p by δ = σ² − p. Put this surplus into
    an unknown mean ξ ~ N(0, δ) of x[0]: it shifts η[t] by −aᵗ ξ, and integrating ξ out gives

        log p(r) = Σ log N(η[t] − aᵗ ξ̂; 0, S) − ½ log(1 + δ A) − ½ ξ̂² / δ,
        ξ̂ = δ B / (1 + δ A),   A = Σ a²ᵗ / S,   B = Σ aᵗ η[t] / S.

    Exact, and well behaved for σ → 0, s → 0 and any τ.

    Parameters
    ----------
    interval
        Sampling interval Δ, s.
    """

    interval: float
    parameters: tuple[str, ...] = ("sensor_sd", "discrepancy_sd", "discrepancy_time")

    def log_density(self, theta: FloatArray, residual: FloatArray) -> FloatArray:
        """Return the exact log density; shapes as in :class:`Noise`."""
        samples = residual.shape[1]
        steady = self.steady_state(theta)
        phi, variance, log_a = steady.kept, steady.variance, steady.log_decay
        a = np.exp(log_a)
        unsure, gain = steady.surplus / variance, steady.start_gain(samples)
        squares = np.empty_like(a)
        for row, values in enumerate(residual):
            eta = lfilter((1.0, -phi[row]), (1.0, -a[row]), values)
            # Powers of a below exp(-40) add nothing.
            memory = int(min(samples, 1 - 40 / log_a[row]))
            powers = np.power(a[row], np.arange(memory))
            # Sums, not dot products: a linear algebra library may split those over threads.
            pull = np.sum(powers * eta[:memory]) / gain[row]
            eta[:memory] -= unsure[row] * pull * powers
            squares[row] = np.sum(eta * eta) + unsure[row] * pull**2
        squares /= variance
        logs = samples * (np.log(variance) + LOG_TWO_PI) + np.log(gain)
        density: FloatArray = -0.5 * (squares + logs)
        return density

    def whiten(self, theta: FloatArray, series: FloatArray) -> FloatArray:
        """Return steady-state innovations of series (rows, samples) over their sd, at one θ."""
        steady = self.steady_state(theta)
        filters = (1.0, -steady.kept[0]), (1.0, -np.exp(steady.log_decay[0]))
        white: FloatArray = lfilter(*filters, series, axis=1) / np.sqrt(steady.variance[0])
        return white

    def marginal_sd(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Stationary sd of the discrepancy; sd of the sensor."""
        return theta[:, 1], theta[:, 0]

    def at(self, interval: float) -> DiscrepancyNoise:
        """Return the same noise for samples ``interval`` seconds apart."""
        return DiscrepancyNoise(interval)

    def steady_state(self, theta: FloatArray) -> SteadyState:
        """Return the filter without cancellation at either extreme."""
        sensor, process = theta[:, 0] ** 2, theta[:, 1] ** 2
        log_phi = -self.interval / theta[:, 2]
        fresh = -np.expm1(2 * log_phi)
        half = fresh * (process - sensor) / 2
        root = np.sqrt(half**2 + fresh * process * sensor)
        apart = np.where(half > 0, 1, root - half)
        predicted = np.where(half > 0, half + root, fresh * process * sensor / apart)
        with np.errstate(divide="ignore", over="ignore"):
            log_a = np.minimum(log_phi - np.log1p(predicted / sensor), -1e-300)
        phi, variance = np.exp(log_phi), predicted + sensor
        return SteadyState(phi, predicted, variance, process - predicted, log_a)
