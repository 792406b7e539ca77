"""Records made by the model itself: what a replicate is fitted to, and others that it predicts.

A record that is not fitted starts as :mod:`bwbayes.results.start` takes it to: from a hysteretic
state that a running drive of some amplitude leaves, with the dynamics as far from rest as their
prior says, and with an offset of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.data.record import Record, Window
from bwbayes.inference.posterior import Posterior
from bwbayes.results.bands import KINDS, LEVELS, Bands, Kind
from bwbayes.results.prediction import predict_record
from bwbayes.results.start import Start, started

__all__ = ["OtherRecord", "Simulated", "covered"]


class Simulated(NamedTuple):
    """A record with its truth, and the displacement of its model (samples,), um."""

    record: Record
    model: FloatArray

    @property
    def reading(self) -> FloatArray:
        """What its sensor says, (samples,), um."""
        assert self.record.displacement is not None
        return self.record.displacement


@dataclass(frozen=True)
class OtherRecord:
    """Another record to be simulated, and predicted from the posterior of the one that is fitted.

    Parameters
    ----------
    record
        Its voltage and times. Of its displacement only counts where there are readings; without
        any it is a planned voltage, whose start nothing tells.
    start
        What is known of its start.
    window
        Part of it (start, stop) that is predicted, s; by default all.
    like
        The record that was fitted whose own parameters it takes where nothing tells its own; by
        default the first.
    """

    record: Record
    start: Start = field(default_factory=Start)
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
        start_states = started(posterior, theta, planned, self.start, generator)
        model = start_states.advance(planned.voltage)[0][0]
        if self.start.own_offset and self.record.displacement is not None:
            model = model + posterior.only.extent * generator.standard_normal()
        noise = posterior.only.noise.at(planned.interval)
        discrepancy, sensor = noise.draw(posterior.only.table.noise(theta), model.size, generator)
        truth = model + discrepancy
        reading = truth + sensor
        if self.record.displacement is not None:
            reading[np.isnan(self.record.displacement)] = np.nan
        return Simulated(replace(planned, displacement=reading, truth=truth), model)

    def predicted(
        self,
        posterior: Posterior,
        draws: FloatArray,
        record: Record,
        generator: np.random.Generator,
    ) -> tuple[Bands, slice]:
        """Predict it, once it is simulated; return the bands, and the samples that are judged."""
        if self.record.displacement is None:
            record = replace(record, displacement=None)
        bands = predict_record(posterior, draws, record, self.start, generator, window=self.window)
        judged_window = slice(0, record.samples)
        if self.window is not None:
            judged_window = record.window_slice(*self.window)
        return bands, slice(judged_window.start + bands.scored_from, judged_window.stop)


def covered(
    every: Sequence[tuple[Bands, Simulated, slice]],
) -> Iterator[tuple[Kind, int, float]]:
    """Yield the part of simulated records' samples that lie inside each kind and level of band.

    The last samples of the bands are those of the slice of the record that they come with. The
    parameter band is for the model's displacement, the displacement band for the simulated truth,
    which has the discrepancy, and the sensor band for the readings, where there are any.
    """
    for kind in KINDS:
        for level in LEVELS:
            inside = [
                _inside(bands, (kind, level), _target(kind, simulated)[window])
                for bands, simulated, window in every
            ]
            yield kind, level, float(np.mean(np.concatenate(inside)))


def _target(kind: Kind, made: Simulated) -> FloatArray:
    """Return what a kind of band is for, (samples,), um."""
    assert made.record.truth is not None
    targets: dict[Kind, FloatArray] = {
        "parameter": made.model,
        "displacement": made.record.truth,
        "sensor": made.reading,
    }
    return targets[kind]


def _inside(bands: Bands, band: tuple[Kind, int], values: FloatArray) -> FloatArray:
    """Tell which of the values (samples,) that there are lie inside the end of a band."""
    finite = np.isfinite(values)
    low, high = (edges[band][-values.size :] for edges in (bands.lower, bands.upper))
    inside: FloatArray = ((low <= values) & (values <= high))[finite].astype(np.float64)
    return inside
