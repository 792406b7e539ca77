"""The discrepancy that readings leave behind, carried on to what comes after them.

Where readings end, a part of the model discrepancy x is known: by the filter of the noise its mean
is m and its variance P, given a draw. A process of sd σ and correlation time τ goes on from there:
a time t later, with k = exp(−t/τ), it is normal with

    mean k m,   variance σ² − k² (σ² − P).

So a forecast is narrower than any other prediction at first, and after a few correlation times as
wide as ever. (An Ornstein-Uhlenbeck process; the filter is that of
:class:`~bwbayes.inference.noise.DiscrepancyNoise`.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.likelihood import Likelihood

__all__ = ["Carried", "carried"]


@dataclass(frozen=True)
class Carried:
    """What readings leave of the discrepancy, for each draw.

    Parameters
    ----------
    last
        Sample of the last reading.
    mean, gained
        (draws,) its mean there, um, and by how much its variance is less than σ², um².
    rate
        (draws,) 1/τ per sample.
    """

    last: int
    mean: FloatArray
    gained: FloatArray
    rate: FloatArray

    def means(self, first: int, samples: int) -> FloatArray:
        """Mean (draws, samples) from a sample on, um; before the last reading that there."""
        known: FloatArray = self.mean[:, np.newaxis] * self._kept(first, samples)
        return known

    def less(self, first: int, samples: int) -> FloatArray:
        """By how much the variance (draws, samples) is less than σ², um²."""
        known: FloatArray = self.gained[:, np.newaxis] * self._kept(first, samples) ** 2
        return known

    def _kept(self, first: int, samples: int) -> FloatArray:
        """Return k (draws, samples)."""
        after = np.maximum(first + np.arange(samples) - self.last, 0)
        return np.exp(-np.outer(self.rate, after))


def carried(likelihood: Likelihood, theta: FloatArray, simulated: FloatArray) -> Carried:
    """Return what the readings of a record leave at θ (draws, parameters).

    ``simulated`` (draws, readings), um, is the model's displacement at the readings. The filter
    goes through them, with the discrepancy's mean m̂ and variance V before each and the gain
    g = V/(V + s²) of the sensor's sd s: m̂ + g (r − m̂) and V s²/(V + s²) are those after it.
    """
    readings, steady = (
        likelihood.readings,
        likelihood.spaced.steady_state(likelihood.table.noise(theta)),
    )
    discrepancy, sensor = steady.predicted + steady.surplus, steady.variance - steady.predicted
    mean, unsure = np.zeros(len(theta)), discrepancy.copy()
    residual = readings.values - simulated
    for t, missing in enumerate(readings.skipped.tolist()):
        if t:
            kept = np.exp(-(1 + missing) * steady.rate)
            mean, unsure = kept * mean, discrepancy - kept**2 * (discrepancy - unsure)
        total = unsure + sensor
        gain = np.divide(unsure, total, out=np.zeros_like(total), where=total > 0)
        mean, unsure = mean + gain * (residual[:, t] - mean), gain * sensor
    last = int(readings.rows[-1])
    return Carried(last, mean, np.maximum(discrepancy - unsure, 0.0), steady.rate / readings.stride)
