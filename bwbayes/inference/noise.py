"""The residual's noise: sensor noise, and honest discrepancy.

The residual of a Bouc-Wen fit to a measured record is correlated over many samples: most of it is
what the model does not know about the actuator. Calling it white makes the parameters look several
times better known than they are. So the residual is the sum of two parts,

    r(t) = x(t) + e(t),   x the discrepancy (sd σ, correlation time τ),   e white (s),

and a Kalman filter turns it into independent innovations, whatever readings are missing. Its log
density is theirs. The discrepancy is rough (:mod:`bwbayes.inference.rough`), smooth
(:mod:`bwbayes.inference.smooth`), or there is none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.model.declaration import Declaration, lognormal

__all__ = [
    "DISCREPANCY_SD",
    "DISCREPANCY_TIME",
    "SENSOR_SD",
    "Noise",
    "WhiteNoise",
    "log_density",
]

LOG_TWO_PI = float(np.log(2 * np.pi))


@runtime_checkable
class Noise(Protocol):
    """A Gaussian model of the residual between a reading and the forward model."""

    @property
    def declarations(self) -> tuple[Declaration, ...]:
        """Its parameters, in the order of θ's columns."""

    def whiten(
        self, theta: FloatArray, series: FloatArray, skipped: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Turn series (models, series, readings) of each model into independent innovations.

        ``theta`` is (models, parameters); ``skipped`` (readings,) counts the readings that are
        missing just before each one, by default none, as in
        :class:`~bwbayes.inference.readings.Readings`. Returns the innovations over their sds,
        shaped as the series, and the log determinant (models,) of the covariance: with V = L Lᵀ
        these are L⁻¹ series and log det V.
        """

    def log_density(self, theta: FloatArray, residual: FloatArray) -> FloatArray:
        """Log density (models,) of residuals (models, samples) in um at θ (models, parameters)."""

    def marginal_sd(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sd of the discrepancy and of the sensor, each (models,), um."""

    def sized(
        self,
        theta: FloatArray,
        missed: Callable[[], float],
        readings: int,
        generator: np.random.Generator,
    ) -> FloatArray:
        """Return θ (models, parameters) with the discrepancy's size where nothing was fitted.

        ``missed`` returns the mean square, um², of what the models' mean misses of so many
        fitted readings.
        """

    def memory(self, theta: FloatArray) -> FloatArray:
        """Correlation time of the discrepancy (models,), s; zero without one."""

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Return F, what is left of the discrepancy after so many readings.

        It is the first of two states, both of the discrepancy's sd, and independent at one time.
        (models, 2, 2) after one number of readings, (models, numbers, 2, 2) after some (numbers,).
        """

    def log_decay(self, theta: FloatArray) -> FloatArray:
        """Return the logarithm of what the filter keeps over a reading, at most, (models,)."""

    def density(self, theta: FloatArray, frequency: FloatArray) -> FloatArray:
        """One-sided amplitude spectral density (frequencies,), um/√Hz, at one θ (1, parameters)."""

    def coefficients(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return the compiled filter's parameters (models,), by their names there."""

    def draw(
        self, theta: FloatArray, samples: int, generator: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Draw the discrepancy and the sensor's noise, (samples,), um, at one θ (1, parameters)."""

    def at(self, interval: float) -> Noise:
        """Return the same noise for readings ``interval`` seconds apart."""


SENSOR_SD = Declaration(
    "sensor_sd",
    "um",
    r"s",
    "sd of the sensor noise",
    lambda context: lognormal(0.006 * context.ranges.displacement, 2.0),
    floor=0.0,
    aliases=("noise",),
)
DISCREPANCY_SD = Declaration(
    "discrepancy_sd",
    "um",
    r"\sigma",
    "sd of the model discrepancy",
    # Not even its order of magnitude is known. A prior that is level down to zero would claim
    # some discrepancy where there is none, and make a right model's bands too wide.
    lambda context: lognormal(1e-5 * context.ranges.displacement, 4.0),
    floor=0.0,
    aliases=("sigma",),
)
DISCREPANCY_TIME = Declaration(
    "discrepancy_time",
    "s",
    r"\tau",
    "correlation time of the model discrepancy",
    lambda context: lognormal(0.5 * context.ranges.time, 0.8),
    floor=0.0,
)


def log_density(white: FloatArray, log_determinant: FloatArray) -> FloatArray:
    """Log density (models,) of what was whitened (models, 1, readings)."""
    readings = white.shape[2]
    squares = np.sum(white[:, 0] ** 2, axis=1)
    density: FloatArray = -0.5 * (squares + log_determinant + readings * LOG_TWO_PI)
    return density


@dataclass(frozen=True)
class WhiteNoise:
    """Sensor noise alone, independent normal errors of sd s. Right only if the model is."""

    interval: float = 1.0

    @property
    def declarations(self) -> tuple[Declaration, ...]:
        """The sensor's sd."""
        return (SENSOR_SD,)

    def whiten(
        self,
        theta: FloatArray,
        series: FloatArray,
        skipped: FloatArray | None = None,  # noqa: ARG002  # nothing is remembered over a gap
    ) -> tuple[FloatArray, FloatArray]:
        """Divide by the sensor's sd; shapes as in :class:`Noise`."""
        sensor = theta[:, 0]
        log_determinant: FloatArray = 2 * series.shape[2] * np.log(sensor)
        return series / sensor[:, np.newaxis, np.newaxis], log_determinant

    def log_density(self, theta: FloatArray, residual: FloatArray) -> FloatArray:
        """Return Σ log N(r; 0, s²); shapes as in :class:`Noise`."""
        return log_density(*self.whiten(theta, residual[:, np.newaxis]))

    def transition(self, theta: FloatArray, readings: float | FloatArray = 1.0) -> FloatArray:
        """Nothing is left."""
        return np.zeros((len(theta), *np.shape(readings), 2, 2))

    def log_decay(self, theta: FloatArray) -> FloatArray:
        """Nothing is kept."""
        return np.full(len(theta), -np.inf)

    def density(self, theta: FloatArray, frequency: FloatArray) -> FloatArray:
        """Return √(2 Δ) s at all frequencies."""
        return np.full(frequency.size, np.sqrt(2 * self.interval) * theta[0, 0])

    def coefficients(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Nothing is remembered: innovations are the residuals."""
        return {"variance": theta[:, 0] ** 2}

    def marginal_sd(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """No discrepancy; sd of the sensor."""
        return np.zeros(theta.shape[0]), theta[:, 0]

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
        """No memory."""
        return np.zeros(theta.shape[0])

    def draw(
        self, theta: FloatArray, samples: int, generator: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Draw no discrepancy, and independent normal errors."""
        return np.zeros(samples), theta[0, 0] * generator.standard_normal(samples)

    def at(self, interval: float) -> WhiteNoise:
        """Return the same noise for readings ``interval`` seconds apart."""
        return replace(self, interval=interval)
