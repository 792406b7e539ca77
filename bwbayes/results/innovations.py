"""Innovations: what each reading adds to those before it, and whether that is pure chance.

Where model and noise model are right, a residual less what the readings before it predict, over
its standard deviation, is an independent standard normal number. Three things can be seen in these
innovations that the residuals hide: whether they are white, whether something oscillates in them,
and whether their mean depends on the drive (its rate, its voltage, its direction). Heavy tails, and
noise that grows with the drive, are explanations (:mod:`bwbayes.diagnosis.noise`). A departure is
found where it is both beyond chance and large enough to matter; on a record that the model
describes this happens to fewer than one in a hundred.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.finding import Finding
from bwbayes.inference.noise import Noise
from bwbayes.inference.posterior import Posterior
from bwbayes.model.drive import rate
from bwbayes.results.spectrum import (
    ResidualSpectrum,
    SpectralLine,
    residual_spectrum,
    without_lines,
)
from bwbayes.shown import brief

__all__ = [
    "GROUPS",
    "LAGS",
    "Innovations",
    "departures",
    "innovations",
    "numbers",
]

# Lags of the autocorrelation that is looked at.
LAGS = 40

# Probability of a false alarm of each of the tests; there are about ten.
ALARM = 1e-4

# Smaller departures do not matter, however sure they are: an autocorrelation; a mean in sds.
CORRELATED, ONE_SIDED = 0.1, 0.15

# Parts of the drive that are compared.
GROUPS = 3

# Lines of the spectrum that are named.
NAMED = 3

# Fewer innovations show nothing.
FEWEST = 100


@dataclass(frozen=True)
class Innovations:
    """Normalized innovations of the readings that were fitted, and the drive there.

    All arrays are (readings,): ``time`` in s, ``white`` in sds, ``voltage`` in V, ``rate`` in V/s,
    ``residual`` in um. ``interval`` is that between readings, s; some may be missing. ``noise`` is
    the noise model for that interval, and ``parameters`` (parameters,) are its own.
    """

    __repr__ = brief

    time: FloatArray
    white: FloatArray
    voltage: FloatArray
    rate: FloatArray
    residual: FloatArray
    interval: float
    noise: Noise | None = None
    parameters: FloatArray = field(default_factory=lambda: np.empty(0))

    def noise_density(self, frequency: FloatArray) -> FloatArray | None:
        """Return the noise model's amplitude spectral density (frequencies,), um/√Hz, one-sided.

        None if it is not known.
        """
        if self.noise is None:
            return None
        return self.noise.density(self.parameters[np.newaxis], frequency)

    def spectrum(self) -> ResidualSpectrum:
        """Return the residual's spectrum, with its lines."""
        return residual_spectrum(self.time, self.interval, self.residual, self.white, self.voltage)

    @property
    def correlation(self) -> FloatArray:
        """Autocorrelation at lags 1 to LAGS, (lags,)."""
        centered = self.white - np.mean(self.white)
        total = float(np.sum(centered**2))
        lags = range(1, min(LAGS, centered.size - 1) + 1)
        return np.array([np.sum(centered[lag:] * centered[:-lag]) / total for lag in lags])

    @property
    def kurtosis(self) -> float:
        """Excess kurtosis: 0 of a normal distribution, positive with heavy tails."""
        return float(scipy.stats.kurtosis(self.white))

    def by(self, what: str) -> tuple[tuple[str, FloatArray], ...]:
        """Return innovations in parts of the drive, by its "rate", "voltage" or "direction"."""
        if what == "direction":
            return (
                ("falling", self.white[self.rate < 0]),
                ("rising", self.white[self.rate > 0]),
            )
        values, names = {
            "rate": (np.abs(self.rate), ("slow", "medium", "fast")),
            "voltage": (self.voltage, ("low", "middle", "high")),
        }[what]
        edges = np.quantile(values, np.linspace(0, 1, GROUPS + 1)[1:-1])
        bins = np.searchsorted(edges, values)
        return tuple((name, self.white[bins == i]) for i, name in enumerate(names))


def innovations(posterior: Posterior, free: FloatArray, begin: float = 0.0) -> Innovations:
    """Return the innovations of the fitted readings at one set of free parameters (free,).

    ``begin`` is the time of the record's first sample, s.
    """
    readings = posterior.only.readings
    theta = posterior.prior.theta(free[np.newaxis])
    simulated = posterior.simulate(theta, readings.rows)
    residual = readings.values - simulated
    parameters = posterior.only.table.noise(theta)
    noise = posterior.likelihood.spaced
    white, _ = noise.whiten(parameters, residual[:, np.newaxis], readings.skipped)
    interval = posterior.only.actuator.interval
    changes = rate(posterior.only.voltage, interval)[readings.rows]
    time = begin + interval * readings.rows.astype(np.float64)
    voltage = posterior.only.voltage[readings.rows]
    apart = interval * readings.stride
    series = time, white[0, 0], voltage, changes, residual[0]
    return Innovations(*series, apart, noise, parameters[0])


def departures(series: Innovations) -> tuple[Finding, ...]:
    """Return where the innovations depart from what the noise model assumes."""
    if series.white.size < FEWEST:
        return ()
    oscillations = series.spectrum().lines
    others = [line for line in oscillations if not line.at_drive]
    rest = without_lines(series.time, series.white, others)
    findings = [*_oscillating(oscillations)]
    # An oscillation correlates, and spoils the noise's parameters, as far as it is large.
    if np.var(rest) > (1 - CORRELATED) * np.var(series.white):
        findings += _correlated(series)
    for what in ("rate", "voltage", "direction"):
        findings += _one_sided(series, what)
    return tuple(findings)


def numbers(series: Innovations) -> dict[str, object]:
    """Return what ``summary.json`` says of the innovations."""
    correlation = series.correlation
    return {
        "readings": series.white.size,
        "sd": float(np.std(series.white)),
        "autocorrelation_1": float(correlation[0]) if correlation.size else None,
        "largest_autocorrelation": (
            float(correlation[np.argmax(np.abs(correlation))]) if correlation.size else None
        ),
        "excess_kurtosis": series.kurtosis,
        "lines": [asdict(line) for line in series.spectrum().lines],
        "by": {
            what: {
                name: {"mean": float(np.mean(part)), "sd": float(np.std(part))}
                for name, part in series.by(what)
                if part.size
            }
            for what in ("rate", "voltage", "direction")
        },
    }


def _oscillating(lines: Sequence[SpectralLine]) -> Iterator[Finding]:
    """Name the strongest lines of the residual's spectrum, those of the drive by themselves."""
    for at_drive, fix in (
        (False, "look for the source: a cable's shield and ground, a vibration"),
        (True, "try what explains it: bwbayes run --improve"),
    ):
        named = [line.description for line in lines if line.at_drive == at_drive][:NAMED]
        if named:
            plural = "a line" if len(named) == 1 else "lines"
            yield Finding("noise model", f"the residual has {plural} at {', '.join(named)}", fix)


def _correlated(series: Innovations) -> Iterator[Finding]:
    correlation = series.correlation
    bound = scipy.stats.norm.isf(ALARM / 2 / correlation.size) / np.sqrt(series.white.size)
    lag = int(np.argmax(np.abs(correlation)))
    if abs(correlation[lag]) > max(bound, CORRELATED):
        after = series.time[lag + 1] - series.time[0]
        yield Finding(
            "noise model",
            f"innovations {after:.3g} s apart correlate by {correlation[lag]:.2f}",
            "check whether the sensor filters; else the discrepancy does not forget exponentially",
        )


def _one_sided(series: Innovations, what: str) -> Iterator[Finding]:
    """Compare the means of the innovations in parts of the drive."""
    groups = [(name, values) for name, values in series.by(what) if values.size >= FEWEST // GROUPS]
    if len(groups) < 2:
        return
    means = [
        float(np.mean(values)) * np.sqrt(values.size) / max(float(np.std(values)), 1e-300)
        for _, values in groups
    ]
    worst = int(np.argmax(np.abs(means)))
    mean = float(np.mean(groups[worst][1]))
    if abs(means[worst]) > scipy.stats.norm.isf(ALARM / 6) and abs(mean) > ONE_SIDED:
        subject = "drive" if what == "rate" else "voltage"
        yield Finding(
            "noise model",
            f"the innovations average {mean:+.2f} SD where the {subject} is {groups[worst][0]}",
            "try what explains it: bwbayes run --improve",
        )
