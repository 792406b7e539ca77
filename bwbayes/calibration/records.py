"""Records made by the model itself: what a replicate is fitted to, and others that it predicts.

A record that is not fitted starts as :mod:`bwbayes.prediction.initial_state` takes it to: from a
hysteretic state that a running drive of some amplitude leaves, with the dynamics as far from rest
as their prior says, and with an offset of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple, Self

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.state_space import Noise
from bwbayes.model.reversals import rate
from bwbayes.prediction.bands import KINDS, LEVELS, Bands, Kind
from bwbayes.prediction.initial_state import InitialConditions, estimate_initial_states
from bwbayes.prediction.prediction import predict_record
from bwbayes.record.record import Record, Window


class Simulated(NamedTuple):
    """A record with its truth, and the displacement of its model (samples,), um."""

    record: Record
    model: FloatArray

    @classmethod
    def of(
        cls,
        record: Record,
        model: FloatArray,
        noise: Noise,
        parameters: FloatArray,
        generator: np.random.Generator,
    ) -> Self:
        """Add the noise of ``parameters`` (1, parameters); missing readings stay missing."""
        speed = np.abs(rate(record.inputs.voltage, record.interval))
        discrepancy, sensor = noise.draw(parameters, model.size, generator, speed)
        truth = model + discrepancy
        reading = truth + sensor
        if record.displacement is not None:
            reading[np.isnan(record.displacement)] = np.nan
        return cls(replace(record, displacement=reading, truth=truth), model)

    def target(self, kind: Kind) -> FloatArray:
        """Return what a kind of band is for, (samples,), um: model, truth or reading."""
        values = {
            "parameter": self.model,
            "displacement": self.record.truth,
            "sensor": self.record.displacement,
        }[kind]
        assert values is not None
        return values


@dataclass(frozen=True)
class OtherRecord:
    """Another record to be simulated, and predicted from the posterior of the one that is fitted.

    Parameters
    ----------
    record
        Its voltage and times. Its displacement only marks where there are readings; without
        any it is a planned voltage, whose start nothing tells.
    start
        Its initial conditions.
    window
        Part of it (start, stop) that is predicted, s; by default all.
    like
        The record that was fitted whose own parameters it takes where nothing tells its own; by
        default the first.
    """

    record: Record
    start: InitialConditions = field(default_factory=InitialConditions)
    window: Window | None = None
    like: str = ""

    def simulated(
        self, posterior: Posterior, theta: FloatArray, generator: np.random.Generator
    ) -> Simulated:
        """Simulate it with the true parameters (1, parameters).

        ``posterior`` is that of the record that was made with them, which tells the ranges of
        voltage and offset.
        """
        planned = replace(self.record, displacement=None, truth=None)
        start_states = estimate_initial_states(posterior, theta, planned, self.start, generator)
        model = start_states.displacement(planned.inputs)[0]
        if self.start.estimate_offset and self.record.displacement is not None:
            model = model + posterior.single_record.extent * generator.standard_normal()
        noise, parameters = (
            posterior.single_record.noise,
            posterior.single_record.table.noise(theta),
        )
        return Simulated.of(
            replace(self.record, truth=None),
            model,
            noise.at(planned.interval),
            parameters,
            generator,
        )

    def predicted(
        self,
        posterior: Posterior,
        draws: FloatArray,
        simulated: Simulated,
        generator: np.random.Generator,
    ) -> tuple[Bands, Simulated, slice]:
        """Predict it, once it is simulated; return that too, and the samples that are predicted."""
        record, window = simulated.record, slice(0, simulated.model.size)
        if self.record.displacement is None:
            record = replace(record, displacement=None)
        if self.window is not None:
            window = record.window_slice(*self.window)
        bands = predict_record(posterior, draws, record, self.start, generator, window=self.window)
        return bands, simulated, window


def band_coverage(
    predictions: Sequence[tuple[Bands, Simulated, slice]],
) -> Iterator[tuple[Kind, int, float]]:
    """Yield the part of simulated records' samples that lie inside each kind and level of band.

    The samples of the bands are those of the slice of the record that they come with. Those of a
    lead-in do not count, and those without a reading not for the sensor band.
    """
    for kind, level in product(KINDS, LEVELS):
        inside = []
        for bands, simulated, window in predictions:
            values = simulated.target(kind)[window]
            inside.append(bands.covers(kind, level, values)[bands.scored(values)])
        yield kind, level, float(np.mean(np.concatenate(inside)))
