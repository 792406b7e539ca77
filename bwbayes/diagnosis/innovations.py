"""Innovations: normalized one-step residuals of the readings, and tests whether they are white.

If model and noise model are right, a residual less its prediction from the readings before it, over
its standard deviation, is an independent standard normal number. Two things show in these
innovations that the residuals hide: whether they are white, and whether their mean depends on the
voltage (its rate, its level, its direction). A departure is reported where it is both beyond chance
and large enough to matter; of records that the model describes fewer than one in a hundred has one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.state_space import Noise
from bwbayes.model.inputs import rate
from bwbayes.shown import brief

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
