"""The discrepancy that readings leave behind, carried on to what comes after them.

Where readings end, a part of the model discrepancy is known: by the filter of the noise its state
(:meth:`~bwbayes.inference.state_space.Noise.transition`) has the mean m and the covariance P, given
a draw. A process whose stationary covariance is P₀ goes on from there: a time t later it is normal
with

    mean F(t) m,   covariance P₀ − F(t) (P₀ − P) F(t)ᵀ.

So a forecast is narrower than any other prediction at first, and after a few correlation times as
wide as ever.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.likelihood import Likelihood
from bwbayes.inference.state_space import Noise
from bwbayes.watching import Watch, unwatched, watched


@dataclass(frozen=True)
class DiscrepancyState:
    """The discrepancy's state after the last reading, for each draw.

    ``last`` is the sample of the last reading; ``mean`` (draws, states) that of the states there,
    and ``gained`` (draws, states, states) by how much their covariance is less than the stationary
    one; ``noise`` is that for the interval between samples, and ``parameters`` (draws, parameters)
    are its own.
    """

    last: int
    mean: FloatArray
    gained: FloatArray
    noise: Noise
    parameters: FloatArray

    def after(self, first: int, samples: int) -> tuple[FloatArray, FloatArray]:
        """Return what is known of samples from one on, each (draws, samples).

        The discrepancy's mean, um, and the part of its variance that is known; before the last
        reading those there.
        """
        later = np.maximum(first + np.arange(samples) - self.last, 0).astype(np.float64)
        row = self.noise.observe @ self.noise.transition(self.parameters, later)
        known_variance = np.einsum("dtj,djk,dtk->dt", row, self.gained, row)
        always = self.noise.marginal_sd(self.parameters)[0][:, np.newaxis] ** 2
        share = np.divide(
            known_variance, always, out=np.zeros_like(known_variance), where=always > 0
        )
        return np.einsum("dtj,dj->dt", row, self.mean), np.minimum(share, 1.0)


def filter_discrepancy(
    likelihood: Likelihood, theta: FloatArray, simulated: FloatArray, watch: Watch = unwatched
) -> DiscrepancyState:
    """Return what the readings of a record leave at θ (draws, parameters).

    ``simulated`` (draws, readings), um, is the model's displacement at the readings. ``watch`` is
    called with the share that is done.
    """
    readings, noise = likelihood.readings, likelihood.spaced
    parameters = likelihood.table.noise(theta)
    mean, covariance = [], []
    # Some draws at a time: what is kept of all readings of all would not fit into memory.
    for rows in watched(np.array_split(np.arange(len(theta)), -(-len(theta) // 50)), watch):
        residual = (readings.values - simulated[rows])[:, np.newaxis]
        sensor = likelihood.sensor(parameters[rows])
        filtered = noise.filter(parameters[rows], residual, readings.skipped, sensor)
        mean.append(filtered.mean[:, 0])
        covariance.append(filtered.covariance)
    gained = noise.stationary(parameters) - np.concatenate(covariance)
    last = int(readings.rows[-1])
    return DiscrepancyState(last, np.concatenate(mean), gained, likelihood.noise, parameters)
