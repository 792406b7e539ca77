"""Path of a measured voltage: the voltage without the noise of its reading.

Rate-independent hysteresis, dh = α du − β |du| h − γ du |h|, remembers every reversal of its input.
White noise of the sd s on the reading of a voltage u adds a path of 2 s / √π per sample, and erases
memory that the actuator still has. The real reversals of a path and their heights have to be right,
and it has to be monotone between them:

1. The noise's sd comes from differences of rising order p, sd(Δᵖ u) = s √C(2p, p) for noise alone:
   the share of a smooth voltage dies out. While the estimates still fall, noise cannot be detected.
2. Given this sd, the real reversals and the path between them follow, see
   :mod:`bwbayes.record.monotone_path`.
3. Lines of the residual's spectrum, such as mains hum, move the actuator too: they are set aside
   before and added again. Hum of the monitor alone cannot be distinguished from them.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, log, sqrt

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.record.monotone_path import fit_path
from bwbayes.shown import brief

# Limits of the noise's sd as parts of the range: from the first on, the path is too uncertain for
# parameters; beyond the second, the voltage changes too fast for its sampling.
REPAIRABLE, LARGEST = 0.005, 0.03

# The same limit for a step to which the voltage is rounded: a hold is known to half of a step.
COARSE = 0.003

# Harmless excess of the path, as a part of the path, and the smallest clear excess, in sds.
HARMLESS, DOUBTFUL = 1e-3, 3.0

# Fewer samples show no noise.
FEWEST = 50

# Spectral lines that are set aside, and rounds to find them.
LINES, ROUNDS = 3, 8


@dataclass(frozen=True)
class VoltagePath:
    """Estimate of the voltage that moves the actuator, from its reading.

    ``voltage`` (samples,), V, is the measured one without noise of the sd ``noise_sd``, V; if that
    is 0, it is the measured one bit for bit. ``remark`` is a note for the user, or "".
    """

    __repr__ = brief

    voltage: FloatArray
    noise_sd: float = 0.0
    remark: str = ""

    def redrawn(self, generator: np.random.Generator) -> FloatArray:
        """Add new noise to this path and return the path (samples,), V, estimated from that."""
        if self.noise_sd == 0:
            return self.voltage
        noise = self.noise_sd * generator.standard_normal(self.voltage.size)
        return estimate_path(self.voltage + noise).voltage


def estimate_path(voltage: FloatArray) -> VoltagePath:
    """Estimate the path of a measured voltage (samples,), V, under white noise of unknown sd.

    A voltage whose reversals are all real comes back bit for bit, and so does one that changes too
    fast for its sampling, with a remark. The path of a u + b is a times that of u, plus b.
    """
    low, high = float(np.min(voltage)), float(np.max(voltage))
    extent, center = high - low, (high + low) / 2
    if voltage.size < FEWEST or extent == 0:
        return VoltagePath(voltage)
    u = voltage - center
    step = rounding_step(u)
    hum, frequencies, last = np.zeros_like(u), list[float](), 0.0
    for searched in range(ROUNDS):
        sd, settled = noise_sd(u - hum)
        # Rounding is monotone, so that it adds no reversal.
        if sd == 0 or (settled and sd < 1.1 * step / sqrt(12)):
            return VoltagePath(voltage)
        if not (settled or searched):
            remark = "voltage changes too fast for its sampling to tell its noise: none is removed"
            return VoltagePath(voltage, remark=remark)
        fitted = fit_path(u - hum, max(sd, step / 2))
        # The first and the last reversal may be real without enough evidence.
        if not searched and turns(u) <= fitted.reversals + 1:
            return VoltagePath(voltage)
        residual = u - hum - fitted.path
        frequency = _line(residual, sd)
        is_known = any(abs(frequency - other) < 6 / u.size for other in frequencies)
        if not frequency or (len(frequencies) == LINES and not is_known):
            break
        frequencies += [] if is_known else [frequency]
        phases = np.outer(np.arange(u.size), frequencies)
        waves = np.hstack([np.cos(phases), np.sin(phases)])
        more = waves @ np.linalg.lstsq(waves.T @ waves, waves.T @ residual)[0]
        size = float(np.std(more))
        if sqrt(2) * size < step / np.pi:  # the error of rounding a ramp has such a line
            break
        # The path follows a part of the hum, so that the rest falls by one factor each time.
        ratio = size / last if is_known and last else 0.0
        last = 0.0 if ratio else size
        hum = hum + (more / (1 - ratio) if ratio < 0.95 else more)
    path = fitted.path + hum
    shown = f"noise of {sd:.2g} V SD ({100 * sd / extent:.2g}% of its range)"
    length = _length(path)
    excess = _length(u) - length
    if excess <= max(HARMLESS * length, DOUBTFUL * fitted.length_sd):
        left_in = f"voltage may have {shown}, which cannot be told from the drive: none is removed"
        return VoltagePath(voltage, remark=left_in * (excess > HARMLESS * length))
    remark = (
        f"voltage has {shown}: the model is driven by its estimated path, with {fitted.reversals} "
        f"reversals for {turns(u)}"
    )
    if sd > REPAIRABLE * extent or step > COARSE * extent:
        remark = (
            f"voltage has {shown}, too much to repair: do not trust the parameters; measure the "
            'voltage with less noise, or give the command (voltage_is = "command")'
        )
    return VoltagePath(path + center, sd, remark)


def rounding_step(voltage: FloatArray) -> float:
    """Return the step, V, that divides all differences of a voltage, or 0."""
    gaps = np.diff(np.unique(voltage))
    gaps = gaps[gaps > 1e-6 * np.ptp(voltage)]  # not the rounding of doubles
    if not gaps.size:
        return 0.0
    multiples = gaps / gaps.min()
    return float(gaps.min()) if np.all(np.abs(multiples - np.rint(multiples)) < 0.02) else 0.0


def noise_sd(voltage: FloatArray) -> tuple[float, bool]:
    """Return the sd of the white noise on a voltage, V, and whether it is noise: see step 1.

    If it is not, the voltage changes too fast for its sampling, and the noise's sd may be less.
    """
    extent, orders, sds = float(np.ptp(voltage)), range(4, 11), list[float]()
    differences = np.diff(voltage, orders[0] - 1)
    for order in orders:
        differences = np.diff(differences)
        # Take the median, since corners and steps are few.
        sd = float(np.median(np.abs(differences))) / 0.6745 / sqrt(comb(2 * order, order))
        sds.append(sd)
    if sds[-1] < 1e-9 * extent:
        return 0.0, True
    if sds[-1] < 0.8 * sds[-3]:  # it still falls
        return (0.0, True) if sds[-1] < 1e-4 * extent else (sds[-1], False)
    return min(sds), min(sds) < LARGEST * extent


def turns(voltage: FloatArray) -> int:
    """Return the number of reversals of a voltage."""
    steps = np.diff(voltage)
    return int(np.count_nonzero(np.diff(np.sign(steps[steps != 0]))))


def _length(path: FloatArray) -> float:
    return float(np.sum(np.abs(np.diff(path))))


def _line(residual: FloatArray, noise_sd: float) -> float:
    """Return the frequency of a residual's strongest line, rad per sample, or 0 without any."""
    n = residual.size
    if n < 300:
        return 0.0
    power = np.abs(np.fft.rfft(residual * np.hanning(n))) ** 2 / (0.375 * n * noise_sd**2)
    first = n // 200 + 20
    k = first + int(np.argmax(power[first:]))
    near = np.median(power[max(k - 40, 1) : k + 41])
    if power[k] < max(12 + log(n), 20 * near):
        return 0.0
    # Refine between the bins, by sums over parts in which a wave of the bin stays nearly in phase.
    parts = np.arange(0, n, max(n // 256, 1))
    sums = np.add.reduceat(residual * np.exp(-2j * np.pi * k / n * np.arange(n)), parts)
    offsets = 2 * np.pi / n * np.linspace(-1, 1, 81)
    sizes = np.abs(np.exp(-1j * np.outer(offsets, parts)) @ sums)
    return float(2 * np.pi * k / n + offsets[int(np.argmax(sizes))])
