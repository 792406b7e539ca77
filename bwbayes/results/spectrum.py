"""The residual's spectrum, and the lines in it: mains hum, other vibrations, what the drive leaves.

A sensor's noise and a model's discrepancy have smooth spectra. A line is power at one frequency far
above its neighbors: an oscillation that no noise model here describes. Lines are looked for in the
innovations, which are white where the noise model is right, and sized in the residual, in um. One
at the frequency of the drive, or a multiple, is what the model leaves of it, not another source.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from bwbayes.arrays import FloatArray, IntArray

__all__ = ["ResidualSpectrum", "SpectralLine", "residual_spectrum", "without_lines"]

# Probability that a record without lines shows one.
ALARM = 1e-3

# Lines that are looked for, and what one must explain of the innovations' variance to matter.
MOST_LINES, LEAST_PART = 8, 0.01

# Periods that a record must hold of a line.
PERIODS = 5.0

# Frequencies of a periodogram to one that is independent.
FINER = 2

# Independent frequencies whose median is the level about a line: broad humps are no lines.
NEIGHBORS = 24

# Widths 1/T of a line within which no other line is looked for: an oscillation that grows or decays
# along the record is that wide.
APART = 4.0

# Harmonics of the drive that a hysteresis loop leaves, and of mains that power supplies do. Only up
# to the second an alias is taken for mains: of more, one or the other would fit any frequency.
DRIVE_HARMONICS, MAINS_HARMONICS, MAINS_ALIASES = 9, 10, 2

# Frequencies of mains, Hz, and the part that they, or a sampling clock, may be off.
MAINS, MAINS_OFF = (50.0, 60.0), 2e-3

# A voltage has power at a frequency if it is this part of that at its strongest: a triangle's
# ninth harmonic has more, hum on a measured voltage less.
DRIVEN = 1e-4

# Segments of the smooth spectrum, which overlap by half, and the most samples of one.
SEGMENTS, LONGEST = 4, 1 << 14


@dataclass(frozen=True)
class SpectralLine:
    """A line: its frequency, Hz, its amplitude in the residual, um, and what may be its source.

    ``at_drive`` says that it is at a frequency of the drive.
    """

    frequency: float
    amplitude: float
    source: str
    at_drive: bool = False

    @property
    def description(self) -> str:
        """Frequency, source and amplitude, as part of a line of text."""
        source = f"{self.source}, " if self.source else ""
        return f"{self.frequency:.4g} Hz ({source}{self.amplitude:.2g} um)"


@dataclass(frozen=True)
class ResidualSpectrum:
    """The spectrum of a fit's residual.

    ``frequency`` (frequencies,), Hz; ``density`` (frequencies,), its amplitude spectral density,
    um/√Hz, one-sided, by Welch's method; ``lines`` the strongest lines, the strongest first.
    """

    frequency: FloatArray
    density: FloatArray
    lines: tuple[SpectralLine, ...]


def residual_spectrum(
    time: FloatArray,
    interval: float,
    residual: FloatArray,
    white: FloatArray,
    voltage: FloatArray,
) -> ResidualSpectrum:
    """Return the spectrum of a residual, with its lines.

    A line is found where the innovations' periodogram over its median nearby is larger than chance
    allows: of white noise it is exponentially distributed at each frequency. Missing readings count
    as zero.

    Parameters
    ----------
    time
        Of the readings, (readings,), s.
    interval
        Between readings, s; some may be missing.
    residual
        (readings,), um.
    white
        Innovations, (readings,), in sds.
    voltage
        (readings,), V.
    """
    rows = np.rint((time - time[0]) / interval).astype(np.int64)
    grid = _TimeGrid(rows, interval)
    frequencies: list[float] = []
    left, level = white - np.mean(white), None
    for _ in range(MOST_LINES):
        power = grid.power(left)
        if level is None:
            size = FINER * NEIGHBORS + 1
            level = scipy.ndimage.median_filter(power, size, mode="reflect") / math.log(2)
        frequency = _strongest(grid, power / level, frequencies)
        if frequency is None:
            break
        shape = _oscillation(time, left, frequency)
        if np.sum(shape**2) < LEAST_PART * np.sum(white**2):
            break
        frequencies.append(frequency)
        left = left - shape
    drive = _Drive.of(grid, time, voltage)
    lines = [
        SpectralLine(
            frequency,
            math.sqrt(2 * float(np.mean(_oscillation(time, residual, frequency) ** 2))),
            *_source(grid, drive, frequency),
        )
        for frequency in frequencies
    ]
    lines.sort(key=lambda line: -line.amplitude)
    length = min(max(grid.samples // SEGMENTS, 1), LONGEST)
    centered = grid.filled(residual - np.mean(residual))
    welch, density = scipy.signal.welch(centered, 1 / interval, nperseg=length)
    density = np.sqrt(density * grid.samples / rows.size)
    return ResidualSpectrum(welch[1:], density[1:], tuple(lines))


def without_lines(
    time: FloatArray, values: FloatArray, lines: Sequence[SpectralLine]
) -> FloatArray:
    """Return values (readings,) less the oscillations at the frequencies of lines."""
    for line in lines:
        values = values - _oscillation(time, values, line.frequency)
    return values


@dataclass(frozen=True)
class _TimeGrid:
    """The uniform times on which readings lie: the sample of each, and the interval, s."""

    rows: IntArray
    interval: float

    @property
    def samples(self) -> int:
        return int(self.rows[-1]) + 1

    @property
    def width(self) -> float:
        """The width of a line, 1/T, Hz."""
        return 1 / (self.samples * self.interval)

    @property
    def length(self) -> int:
        """Of a Fourier transform."""
        return int(scipy.fft.next_fast_len(FINER * self.samples, real=True))

    @property
    def frequency(self) -> FloatArray:
        """Of a periodogram (frequencies,), Hz."""
        frequency: FloatArray = scipy.fft.rfftfreq(self.length, self.interval)
        return frequency

    def top(self, power: FloatArray, at: int) -> float:
        """Return the frequency of the top of a parabola through three logarithms of power."""
        here = float(self.frequency[at])
        if not 0 < at < power.size - 1:
            return here
        before, top, after = np.log(np.maximum(power[at - 1 : at + 2], 1e-300))
        bend = before - 2 * top + after
        shift = (before - after) / (2 * bend) if bend < 0 else 0.0
        return here + float(np.clip(shift, -0.5, 0.5)) / (self.length * self.interval)

    def filled(self, values: FloatArray) -> FloatArray:
        """Return values (readings,) on the grid (samples,), zero where a reading is missing."""
        filled = np.zeros(self.samples)
        filled[self.rows] = values
        return filled

    def power(self, values: FloatArray) -> FloatArray:
        """Return the periodogram of values (readings,)."""
        power: FloatArray = np.abs(scipy.fft.rfft(self.filled(values), self.length)) ** 2
        return power / self.rows.size


def _strongest(grid: _TimeGrid, power: FloatArray, known: list[float]) -> float | None:
    """Return the frequency of the largest power over its level, if it is too large for chance."""
    frequency = grid.frequency
    allowed = frequency > PERIODS * grid.width
    # Beside half the sampling rate only one phase shows: chance has twice the power there.
    power = np.where(frequency > frequency[-1] - grid.width, power / 2, power)
    for line in known:
        allowed &= np.abs(frequency - line) > APART * grid.width
    if not allowed.any():
        return None
    # P / level of white noise, where the median of m powers has the relative variance 1/m, is as
    # large as t with the probability (1 + t/m)^-m.
    chance = math.log(np.sum(allowed) / ALARM)
    limit = NEIGHBORS * math.expm1(chance / NEIGHBORS)
    at = int(np.argmax(np.where(allowed, power, 0.0)))
    return None if power[at] <= limit else grid.top(power, at)


def _oscillation(time: FloatArray, values: FloatArray, frequency: float) -> FloatArray:
    """Return the oscillation (readings,) of a frequency that explains most of values."""
    angle = 2 * np.pi * frequency * (time - time[0])
    basis = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)])
    # Sums, without the threads of a linear algebra library.
    products, pulls = np.einsum("in,jn->ij", basis, basis), np.einsum("in,n->i", basis, values)
    # At half the sampling rate the sine is zero.
    sizes = np.linalg.lstsq(products, pulls, rcond=1e-9)[0]
    shape: FloatArray = sizes[0] * basis[0] + sizes[1] * basis[1]
    return shape


@dataclass(frozen=True)
class _Drive:
    """The voltage's periodogram (frequencies,), and the frequency of its strongest line, Hz."""

    power: FloatArray
    main: float

    @classmethod
    def of(cls, grid: _TimeGrid, time: FloatArray, voltage: FloatArray) -> _Drive:
        whole = np.interp(grid.interval * np.arange(grid.samples), time - time[0], voltage)
        window = scipy.signal.windows.hann(grid.samples)
        centered = whole - np.sum(window * whole) / np.sum(window)
        power = np.abs(scipy.fft.rfft(window * centered, grid.length)) ** 2
        return cls(power, grid.top(power, int(np.argmax(power))))


def _source(grid: _TimeGrid, drive: _Drive, frequency: float) -> tuple[str, bool]:
    """Return what may be the source of a line, and whether that is the drive alone."""
    names = [name for name in (_at_drive(grid, drive, frequency), _mains(grid, frequency)) if name]
    return " or ".join(names), len(names) == 1 and "drive" in names[0]


def _at_drive(grid: _TimeGrid, drive: _Drive, frequency: float) -> str:
    near = np.abs(grid.frequency - frequency) <= 2 * grid.width
    if np.max(drive.power[near]) >= DRIVEN * np.max(drive.power):
        return "the drive's frequency"
    times = round(frequency / drive.main) if drive.main else 0
    off = abs(frequency - times * drive.main)
    if 2 <= times <= DRIVE_HARMONICS and off <= grid.width:
        return f"{times} times the drive's frequency"
    return ""


def _mains(grid: _TimeGrid, frequency: float) -> str:
    rate = 1 / grid.interval
    for mains in MAINS:
        for times in range(1, MAINS_HARMONICS + 1):
            true = times * mains
            seen = abs(true - round(true / rate) * rate)
            if abs(frequency - seen) > MAINS_OFF * true + grid.width:
                continue
            if true <= rate / 2:
                return "mains" if times == 1 else f"mains, {times} times {mains:g} Hz"
            if times <= MAINS_ALIASES:
                return f"alias of mains, {true:g} Hz"
    return ""
