"""Innovations: normalized one-step residuals of the readings, and tests whether they are white.

If model and noise model are right, a residual less its prediction from the readings before it, over
its standard deviation, is an independent standard normal number. Two things show in these
innovations that the residuals hide: whether they are white, and whether their mean depends on the
voltage (its rate, its level, its direction). A departure is reported where it is both beyond chance
and large enough to matter; of records that the model describes fewer than one in a hundred has one.

Posterior predictive checks compare the record with records that the model replicates. Some
posterior draws replicate the readings, each with its own noise. The statistics of the real readings
(their range, the area of their loops, the correlation and the spectrum of their residuals, their
place in the band) are worked out for the replicated ones, too. A statistic that hardly any
replicated record reaches shows an effect that the model, noise included, lacks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.inference.likelihood import batches
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.state_space import Noise
from bwbayes.inference.thinning import beginning
from bwbayes.model.inputs import rate
from bwbayes.shown import brief
from bwbayes.watching import Watch, unwatched

# Probability of a false alarm of each of the tests, of which there are about ten.
ALARM = 1e-4

# Fix for a departure.
EXPLAIN = "give the model what explains it better, if anything is named; else expect wider errors"


@dataclass(frozen=True)
class Innovations:
    """Normalized innovations of the readings that were fitted, and the voltage there.

    All arrays are (readings,): ``time`` in s, ``white`` in sds, ``voltage`` in V, ``rate`` in V/s,
    ``residual`` in um. ``interval`` is that between readings, s; some may be missing. ``noise`` is
    the noise model for that interval, and ``parameters`` (parameters,) are its parameters.
    ``followed`` is True if the residual is no larger than that of rounding, and shows nothing.
    """

    __repr__ = brief

    time: FloatArray
    white: FloatArray
    voltage: FloatArray
    rate: FloatArray
    residual: FloatArray
    interval: float
    noise: Noise
    parameters: FloatArray
    followed: bool = False

    def noise_density(self, frequency: FloatArray) -> FloatArray:
        """Return the noise model's amplitude spectral density (frequencies,), um/√Hz, one-sided."""
        return self.noise.density(self.parameters[np.newaxis], frequency)

    def residual_density(self) -> tuple[FloatArray, FloatArray]:
        """Return frequencies (frequencies,), Hz, and the residual's density there, um/√Hz.

        The density is one-sided, by Welch's method with four segments, of 2¹⁴ samples at most;
        missing readings count as zero.
        """
        rows = np.rint((self.time - self.time[0]) / self.interval).astype(np.int64)
        samples = int(rows[-1]) + 1
        residual = np.zeros(samples)
        residual[rows] = self.residual - np.mean(self.residual)
        length = min(max(samples // 4, 1), 1 << 14)
        frequency, power = scipy.signal.welch(residual, 1 / self.interval, nperseg=length)
        return frequency[1:], np.sqrt(power * samples / rows.size)[1:]

    @property
    def correlation(self) -> FloatArray:
        """Autocorrelation at lags 1 to 40, (lags,)."""
        centered = self.white - np.mean(self.white)
        total = float(np.sum(centered**2))
        lags = range(1, min(40, centered.size - 1) + 1)
        return np.array([np.sum(centered[lag:] * centered[:-lag]) / total for lag in lags])

    def octaves(self) -> tuple[FloatArray, FloatArray, float]:
        """Return the edges (octaves + 1,) of octaves, Hz, the innovations' power, and a p value.

        The power (octaves,) is relative to white innovations of the same variance. The p value of
        Bartlett's test is the probability of such unequal powers by chance; it is 1 for few
        readings.
        """
        count = self.white.size
        amplitude = np.fft.rfft(self.white - np.mean(self.white))[1 : (count + 1) // 2]
        # The lowest octave has eight frequencies; the last one includes the rest at the top.
        octaves = max(int(np.log2(max(amplitude.size, 1) / 6)), 0)
        cuts = 8 * 2 ** np.arange(octaves)
        parts = np.split(np.stack([amplitude.real, amplitude.imag]), cuts, axis=1)
        power = np.array([np.mean(block**2) for block in parts])
        edges = np.array([0, *cuts, amplitude.size]) / (count * self.interval)
        total = np.mean(amplitude.real**2 + amplitude.imag**2) / 2
        test = scipy.stats.bartlett(*map(np.ravel, parts)) if octaves else None
        return edges, power / total, 1.0 if test is None else float(test.pvalue)

    def by(self, quantity: str) -> tuple[tuple[str, FloatArray], ...]:
        """Return innovations by the voltage's "rate", "voltage" or "direction", each with a name.

        The direction gives two groups, the others give three of equal size.
        """
        if quantity == "direction":
            groups = self.rate < 0, self.rate > 0
            return tuple(
                (name, self.white[group])
                for name, group in zip(("falling", "rising"), groups, strict=True)
            )
        values, names = {
            "rate": (np.abs(self.rate), ("slow", "medium", "fast")),
            "voltage": (self.voltage, ("low", "middle", "high")),
        }[quantity]
        bins = np.searchsorted(np.quantile(values, [1 / 3, 2 / 3]), values)
        return tuple((name, self.white[bins == i]) for i, name in enumerate(names))

    @property
    def numbers(self) -> dict[str, object]:
        """Numbers for ``summary.json``."""
        correlation = self.correlation
        largest = correlation[np.argmax(np.abs(correlation))] if correlation.size else None
        return {
            "readings": self.white.size,
            "sd": float(np.std(self.white)),
            "autocorrelation_1": float(correlation[0]) if correlation.size else None,
            "largest_autocorrelation": None if largest is None else float(largest),
            "excess_kurtosis": float(scipy.stats.kurtosis(self.white)),
            "by": {
                quantity: {
                    name: {"mean": float(np.mean(group)), "sd": float(np.std(group))}
                    for name, group in self.by(quantity)
                    if group.size
                }
                for quantity in ("rate", "voltage", "direction")
            },
        }


def innovations(posterior: Posterior, free: FloatArray, begin: float = 0.0) -> Innovations:
    """Return the innovations of the fitted readings at one set of free parameters (free,).

    ``begin`` is the time of the record's first sample, s.
    """
    record, readings = posterior.single_record, posterior.single_record.readings
    theta = posterior.prior.theta(free[np.newaxis])
    residual = readings.values - posterior.simulate(theta, readings.rows)
    parameters = record.table.noise(theta)
    noise, interval = posterior.likelihood.spaced, record.actuator.interval
    white = posterior.likelihood.innovations(parameters, residual)
    return Innovations(
        begin + interval * readings.rows.astype(np.float64),
        white[0],
        record.voltage[readings.rows],
        rate(record.voltage, interval)[readings.rows],
        residual[0],
        interval * readings.stride,
        noise,
        parameters[0],
        record.is_followed(readings.values - residual[0]),
    )


def departures(series: Innovations) -> tuple[Finding, ...]:
    """Return findings where the innovations depart from the assumptions of the noise model."""
    if series.white.size < 100 or series.followed:  # such innovations show nothing
        return ()
    findings = []
    # Report the octave with most evidence against white noise, if its power is off by a fifth.
    frequency, power, p = series.octaves()
    octave = int(np.argmax(np.diff(frequency) * (power - 1 - np.log(power))))
    if p < ALARM and not 0.8 < power[octave] < 1.25:
        low, high = frequency[octave : octave + 2]
        text = (
            f"between {low:.3g} and {high:.3g} Hz the innovations have {power[octave]:.2g} times "
            "the power that white ones have"
        )
        fix = f"check whether the sensor filters; else {EXPLAIN}"
        findings.append(Finding("noise model", text, fix))
    for quantity, subject in (("rate", "drive"), ("voltage", "voltage"), ("direction", "voltage")):
        groups = [(name, white) for name, white in series.by(quantity) if white.size >= 33]
        if len(groups) < 2:
            continue
        # Report the group whose mean is most significant, if that is large enough.
        means = [float(np.mean(white)) for _, white in groups]
        errors = [max(float(np.std(w)), 1e-300) / np.sqrt(w.size) for _, w in groups]
        scores = np.abs(np.divide(means, errors))
        surest = int(np.argmax(scores))
        if scores[surest] > scipy.stats.norm.isf(ALARM / 6) and abs(means[surest]) > 0.15:
            where = f"where the {subject} is {groups[surest][0]}"
            text = f"the innovations average {means[surest]:+.2f} SD {where}"
            findings.append(Finding("noise model", text, EXPLAIN))
    return tuple(findings)


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
    posterior = beginning(posterior, 100_000)  # by then the voltage has been nearly everywhere
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
