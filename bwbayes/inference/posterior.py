"""The posterior: forward model, noise and prior put together around one record.

A :class:`Posterior` gives the log density of a batch of models in the unconstrained coordinates
in which everything downstream works: the point fit, the sampler, the diagnostics. The model is
simulated from the record's first sample; only the training windows enter the likelihood.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference.engine import Engine
from bwbayes.inference.noise import Noise
from bwbayes.inference.parameters import JointPrior
from bwbayes.model.actuator import Actuator

__all__ = ["Posterior"]

# Models simulated together: enough to share the loop over turns, few enough for the memory.
BATCH = 64
ELEMENTS = 1 << 23


@dataclass(frozen=True)
class Posterior:
    """The posterior of an actuator's parameters, given a record.

    Parameters
    ----------
    voltage
        (samples,), V, from the record's first sample on.
    displacement
        (samples,), um.
    training
        Slices of the samples that enter the likelihood, in order of time and apart. The discrepancy
        of one window is taken as independent of that of the next, so windows should lie several
        correlation times apart.
    actuator, noise, prior
        The model; the prior's parameters are those of the actuator followed by those of the noise.
    engine
        What computes the likelihood; see :mod:`bwbayes.inference.engine`.

    Raises
    ------
    InputError
        The prior is another model's, or the windows are out of order.
    """

    voltage: FloatArray
    displacement: FloatArray
    training: tuple[slice, ...]
    actuator: Actuator
    noise: Noise
    prior: JointPrior
    engine: Engine = "numpy"

    def __post_init__(self) -> None:
        expected = (*self.actuator.parameters, *self.noise.parameters)
        if self.prior.names != expected:
            raise InputError(f"prior: its parameters must be {', '.join(expected)}, in this order")
        edges = [edge for window in self.training for edge in (window.start, window.stop)]
        if edges != sorted(edges):
            raise InputError("training: windows must be in order of time and must not overlap")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order of the coordinates."""
        return self.prior.free_names

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Log density (models,) at coordinates (models, free): likelihood and prior.

        −∞ where the prior is zero. A likelihood that is not a number, or infinite, is no evidence
        for a model: there the density is −∞ too.
        """
        free, result = self.prior.constrain(coordinates)
        possible = np.isfinite(result)
        if possible.any():
            result[possible] += self.log_likelihood(self.prior.theta(free[possible]))
        return np.where(np.isfinite(result), result, -np.inf)

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log likelihood (models,) at θ (models, parameters), fixed parameters included."""
        if self.engine == "numba":
            # Here, because numba may not be installed, and takes half a second to load.
            from bwbayes.inference import compiled  # noqa: PLC0415

            return compiled.log_likelihood(
                theta, self.voltage, self.displacement, self.training, self.actuator, self.noise
            )
        return np.concatenate([self._piece(theta[piece]) for piece in self._pieces(theta)])

    def _pieces(self, theta: FloatArray) -> Iterator[slice]:
        size = min(max(ELEMENTS // self.voltage.size, 1), BATCH)
        return (slice(i, i + size) for i in range(0, theta.shape[0], size))

    def simulate(self, theta: FloatArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        """Displacement (models, rows), um, at samples up to the last training sample."""
        pieces = self._pieces(theta)
        return np.concatenate([self._simulated(theta[piece])[:, rows] for piece in pieces])

    def _simulated(self, theta: FloatArray) -> FloatArray:
        """Displacement (models, samples) up to the last training sample."""
        end = max(window.stop for window in self.training)
        model = theta[:, : len(self.actuator.parameters)]
        return self.actuator.displacement(model, self.voltage[:end])

    def _piece(self, theta: FloatArray) -> FloatArray:
        simulated = self._simulated(theta)
        residual = self.displacement[: simulated.shape[1]] - simulated
        noise = theta[:, len(self.actuator.parameters) :]
        parts = [self.noise.log_density(noise, residual[:, window]) for window in self.training]
        total: FloatArray = np.sum(parts, axis=0)
        return total
