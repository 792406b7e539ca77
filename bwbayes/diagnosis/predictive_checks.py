"""Posterior predictive checks: a comparison of the record with records that the model replicates.

Some posterior draws replicate the readings, each with its own noise. The statistics of the real
readings (their range, the area of their loops, the correlation and the spectrum of their residuals,
their place in the band) are worked out for the replicated ones, too. A statistic that hardly any
replicated record reaches shows an effect that the model, noise included, lacks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.inference.likelihood import batches
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.thinning import beginning
from bwbayes.model.inputs import rate
from bwbayes.shown import brief
from bwbayes.watching import Watch, unwatched

# Samples of a long record that are replicated, after its voltage has been nearly everywhere.
SAMPLES = 100_000

# Statistics that are compared: title and unit for people.
STATISTICS: Mapping[str, tuple[str, str]] = {
    "range_um": ("Range of the readings", "um"),
    "loop_area_um_V": ("Area of the loops", "um V"),
    "residual_sd_um": ("Sd of the residuals", "um"),
    "residual_lag_1": ("Correlation of neighboring residuals", "-"),
    "residual_slow": ("Power of the residuals below 0.01 of the highest frequency", "-"),
    "residual_fast": ("Power of the residuals above 0.1 of the highest frequency", "-"),
    "pit_mean": ("Mean place in the band", "-"),
    "pit_outside": ("Readings outside of the 90% band", "-"),
}


@dataclass(frozen=True)
class Statistic:
    """A statistic of the real readings, among those of the replicated ones.

    ``lower`` and ``upper`` enclose 95% of the replicated values; ``p`` is the part of them that is
    larger, with equal ones counted half.
    """

    observed: float
    lower: float
    upper: float
    p: float

    @property
    def extreme(self) -> bool:
        """True if at most one in a hundred replicated records is as extreme, on either side."""
        return min(self.p, 1 - self.p) < 0.005

    @property
    def numbers(self) -> dict[str, float | bool]:
        """Numbers for ``summary.json``."""
        edges = {"lower_95": self.lower, "upper_95": self.upper}
        return {"observed": self.observed} | edges | {"p": self.p, "odd": self.extreme}


@dataclass(frozen=True)
class PredictiveChecks:
    """The statistics by name, and the number of replicated records."""

    __repr__ = brief

    statistics: Mapping[str, Statistic]
    records: int

    @property
    def numbers(self) -> dict[str, object]:
        """Numbers for ``replicated`` in ``summary.json``."""
        return {
            "records": self.records,
            "statistics": {name: statistic.numbers for name, statistic in self.statistics.items()},
        }


def check_predictions(
    posterior: Posterior,
    draws: FloatArray,
    generator: np.random.Generator,
    record: str | None = None,
    watch: Watch = unwatched,
) -> PredictiveChecks:
    """Check the training readings of a record against replicated ones.

    A long record's beginning is checked, see :func:`~bwbayes.inference.thinning.beginning`.

    Parameters
    ----------
    posterior
        The posterior that was sampled.
    draws
        (draws, free), parameters in their own units, of which 200 are used.
    generator
        Chooses draws, and draws their noise.
    record
        The record's name; it may be left out for a single record.
    watch
        Called with the share that is done.
    """
    posterior = beginning(posterior, SAMPLES)
    dataset = (
        posterior.single_record if record is None else posterior.for_record(record).single_record
    )
    count = min(200, len(draws))  # p-values come in steps of one over them
    chosen = draws[generator.choice(len(draws), count, replace=False)]
    theta = posterior.prior.theta(chosen)
    rows = dataset.readings.rows
    noise = dataset.table.noise(posterior.table.of(theta, dataset.name))
    # Simulate twice instead of keeping all: first for their mean and their spread about it.
    total, squares, origin = np.zeros(rows.size), np.zeros(rows.size), dataset.readings.values
    done = 0
    for simulated in posterior.simulations(theta, rows, record):
        total += np.sum(simulated - origin, axis=0)
        squares += np.sum((simulated - origin) ** 2, axis=0)
        done += len(simulated)
        watch(done / (2 * count))
    away = total / count
    variance = np.mean(np.sum(np.square(dataset.noise.marginal_sd(noise)), axis=0))
    sd = np.sqrt(variance + np.maximum(squares / count - away**2, 0.0))
    # Readings missing in the record are missing in all replicated ones.
    neighbors = np.flatnonzero(np.diff(rows) == dataset.readings.stride)
    work_out = partial(_statistics, dataset.voltage[rows], origin + away, sd, neighbors)
    speed = np.abs(rate(dataset.voltage, dataset.actuator.interval))[: int(rows[-1]) + 1]
    statistics, noises = [], iter(noise[:, np.newaxis])
    for simulated in posterior.simulations(theta, rows, record):
        # Process a few at a time.
        for batch in batches(len(simulated), rows.size, 1 << 18):
            readings = simulated[batch].copy()
            for i in range(len(readings)):
                drawn = dataset.noise.draw(next(noises), speed.size, generator, speed)
                readings[i] += np.sum(drawn, axis=0)[rows]
            statistics.append(work_out(readings))
            done += len(readings)
            watch(done / (2 * count))
    replicates = np.concatenate(statistics)
    observed = work_out(dataset.readings.values[np.newaxis])[0]
    lower, upper = np.quantile(replicates, [0.025, 0.975], axis=0)
    p = np.mean(replicates > observed, axis=0) + 0.5 * np.mean(replicates == observed, axis=0)
    values = np.stack([observed, lower, upper, p], axis=1).tolist()
    return PredictiveChecks(
        {name: Statistic(*row) for name, row in zip(STATISTICS, values, strict=True)}, count
    )


def _statistics(
    voltage: FloatArray,
    mean: FloatArray,
    sd: FloatArray,
    neighbors: IntArray,
    readings: FloatArray,
) -> FloatArray:
    """Work out all ``STATISTICS`` of readings (records, readings): (records, statistics)."""
    residual = readings - mean
    centered = residual - np.mean(residual, axis=1, keepdims=True)
    total = np.sum(centered**2, axis=1)
    lag = np.sum(centered[:, neighbors] * centered[:, neighbors + 1], axis=1)
    frequency, power = scipy.signal.periodogram(residual, detrend="constant")
    relative = frequency / frequency[-1]
    slow, fast = (np.sum(power[:, band], axis=1) for band in (relative <= 0.01, relative > 0.1))
    pit = scipy.special.ndtr(residual / sd)
    # ∮ y du, by trapezes; turns of either direction count with their sign.
    area = np.sum(0.5 * (readings[:, 1:] + readings[:, :-1]) * np.diff(voltage), axis=1)

    def share(selected: FloatArray, of: FloatArray) -> FloatArray:
        return np.divide(selected, of, out=np.zeros_like(selected), where=of > 0)

    columns = (
        np.ptp(readings, axis=1),
        np.abs(area),
        np.std(residual, axis=1),
        share(lag, total),
        share(slow, np.sum(power, axis=1)),
        share(fast, np.sum(power, axis=1)),
        np.mean(pit, axis=1),
        np.mean(np.abs(pit - 0.5) > 0.45, axis=1),
    )
    return np.stack(columns, axis=1)
