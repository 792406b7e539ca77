"""The posterior: forward model, noise and prior put together around one record.

A :class:`Posterior` gives the log density of a batch of models in the unconstrained coordinates
in which everything downstream works: the point fit, the sampler, the diagnostics. The model is
simulated from the record's first sample; only readings in the training windows enter the
likelihood (:mod:`bwbayes.inference.likelihood`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference.engine import Engine
from bwbayes.inference.likelihood import Likelihood, batches
from bwbayes.inference.noise import Noise
from bwbayes.inference.parameters import JointPrior
from bwbayes.inference.readings import Readings
from bwbayes.inference.table import Table
from bwbayes.model.actuator import Actuator

__all__ = ["Posterior"]


@dataclass(frozen=True)
class Posterior:
    """The posterior of an actuator's parameters, given a record.

    Parameters
    ----------
    voltage
        (samples,), V, from the record's first sample on.
    displacement
        (samples,), um; nan where a reading is missing.
    training
        Slices of the samples that enter the likelihood, in order of time and apart. One discrepancy
        goes through all of them.
    actuator, noise, prior
        The model; the prior's parameters are those of the actuator followed by those of the noise.
    engine
        What computes the likelihood; see :mod:`bwbayes.inference.engine`.
    from_rest
        The record starts with a demagnetised actuator at rest, and ``initial`` is h at zero volts
        before. Otherwise the state of the dynamics at the first sample is unknown.

    Raises
    ------
    InputError
        The prior is another model's, the windows are out of order, or no reading is in them.
    """

    voltage: FloatArray
    displacement: FloatArray
    training: tuple[slice, ...]
    actuator: Actuator
    noise: Noise
    prior: JointPrior
    engine: Engine = "numpy"
    from_rest: bool = False

    def __post_init__(self) -> None:
        expected = self.table.names
        if self.prior.names != expected:
            raise InputError(f"prior: its parameters must be {', '.join(expected)}, in this order")
        edges = [edge for window in self.training for edge in (window.start, window.stop)]
        if edges != sorted(edges):
            raise InputError("training: windows must be in order of time and must not overlap")

    @cached_property
    def table(self) -> Table:
        """The parameters in the order of θ's columns."""
        return Table(self.actuator, self.noise)

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
        return self.likelihood.log_density(theta)

    @cached_property
    def readings(self) -> Readings:
        """The readings that enter the likelihood."""
        return Readings.of(self.displacement, self.training)

    @cached_property
    def likelihood(self) -> Likelihood:
        """The likelihood of the record."""
        return Likelihood(
            self.voltage,
            self.readings,
            self.actuator.within(self.voltage),
            self.noise,
            self.engine,
            self.from_rest,
            float(np.ptp(self.voltage)) / 2,
        )

    def simulate(self, theta: FloatArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        """Displacement (models, rows), um, at samples up to the last training sample.

        Where the start of the dynamics is unknown, it is the most probable one.
        """
        likelihood, model = self.likelihood, self.table.actuator(theta)
        unrest = likelihood.start(theta).mean if likelihood.unknown else None
        voltage = self.voltage[: self.training[-1].stop]
        return np.concatenate(
            [
                likelihood.actuator.advance(
                    model[part],
                    voltage,
                    unrest=None if unrest is None else unrest[part],
                    from_rest=self.from_rest,
                )[0][:, rows]
                for part in batches(len(theta), voltage.size)
            ]
        )
