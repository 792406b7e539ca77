"""Reference displacements: samples from a file, usual shapes, and the signals that are tracked.

0 um is where the actuator stands at zero volts as the command begins, so that a command begins at
zero volts, where the actuator is, whatever the sensor's offset. The shapes begin at rest there, go
smoothly to their middle, and have their corners rounded: no actuator with a lag follows a jump, nor
a speed that jumps. A reference that begins elsewhere gets a smooth way there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from numbers import Real

import numpy as np
import scipy

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.errors import InputError, suggestion
from bwbayes.record.waveforms import triangle
from bwbayes.shown import brief

# Fewer samples make no reference, and more than a file or a screen could hold no shape.
SHORTEST, LONGEST = 10, 10**7

# How long the way from 0 um to a reference that begins elsewhere takes, s.
APPROACH = 1.0


_triangle = triangle(1.0, 1.0).voltage

# A raster writes its line in 0.9 of a period; the rest is the way back.
SHAPES: Mapping[str, Callable[[FloatArray, int], FloatArray]] = {
    "sine": lambda turns, _: np.sin(2 * np.pi * turns),
    "triangle": lambda turns, _: _triangle(turns),
    "staircase": lambda turns, levels: np.round(levels * _triangle(turns)) / levels,
    "raster": lambda turns, _: scipy.signal.sawtooth(2 * np.pi * (turns + 0.45), 0.9),
}

# The paper's signals, each with whether it jumps.
TRACKED: Mapping[str, bool] = {
    "sine": False,
    "decaying sine": False,
    "steps": True,
    "staircase": True,
}


@dataclass(frozen=True, eq=False)
class Reference:
    """The displacement that is asked for, (samples,), um, at a sampling interval, s.

    0 um is where the actuator stands at zero volts as the command begins. ``smoothed`` is the sd of
    the Gaussian that smooths it, s, which keeps the first value and the last; ``approach`` is the
    length of the way from 0 um that was put before it, s: see :meth:`from_zero`.

    Raises InputError: fewer than ten samples, one that is not finite, a constant, an interval that
    is not positive, or a negative smoothing.
    """

    __repr__ = brief

    displacement: ArrayLike
    interval: float
    name: str = "reference"
    smoothed: float = 0.0
    approach: float = 0.0
    given: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        values = np.array(self.displacement, dtype=np.float64)
        if values.ndim != 1 or values.size < SHORTEST:
            raise InputError(
                f"{self.name}: shape {values.shape}; give one row of {SHORTEST} samples or more"
            )
        if not np.isfinite(values).all():
            sample = int(np.argmin(np.isfinite(values)))
            raise InputError(f"{self.name}: sample {sample} is not a finite number; give all")
        if not np.ptp(values) > 0:
            raise InputError(f"{self.name}: is {values[0]:g} um all along; give one that moves")
        if not 0 < self.interval < math.inf or not 0 <= self.smoothed < math.inf:
            raise InputError(
                f"{self.name}: interval {self.interval:g} s, smoothed over {self.smoothed:g} s; "
                "give a positive interval, and a smoothing that is not negative"
            )
        smooth: FloatArray = values
        if self.smoothed > 0:
            sd = self.smoothed / self.interval
            # Turned about its ends, so that it begins and ends where it did.
            beyond = int(4 * sd) + 1
            turned = np.pad(values, beyond, "reflect", reflect_type="odd")
            smooth = scipy.ndimage.gaussian_filter1d(turned, sd, truncate=4.0)[beyond:-beyond]
        object.__setattr__(self, "given", values)
        object.__setattr__(self, "displacement", smooth)

    def from_zero(self) -> Reference:
        """Return the reference with a smooth way from 0 um before it, if it begins elsewhere."""
        first = float(self.given[0])
        if abs(first) <= 1e-9 * np.ptp(self.given):  # it may be off by rounding
            return self
        approach = _way(first, max(round(APPROACH / self.interval), SHORTEST))
        return Reference(
            np.concatenate([approach, self.given]),
            self.interval,
            self.name,
            self.smoothed,
            approach.size * self.interval,
        )

    @property
    def time(self) -> FloatArray:
        """Times of the samples, (samples,), s."""
        return np.asarray(self.interval * np.arange(np.size(self.displacement), dtype=np.float64))

    @property
    def moved(self) -> float:
        """How far the smoothing moves it at most, um."""
        return float(np.max(np.abs(np.asarray(self.displacement) - self.given)))


def _way(end: float, samples: int) -> FloatArray:
    """Return a smooth way (samples,) from 0 um to an end that comes after it, um."""
    return np.asarray(end * (1 - np.cos(np.pi * np.arange(samples) / samples)) / 2)


def build_reference(
    shape: str,
    interval: float,
    amplitude: float,
    frequency: float,
    *,
    middle: float = 0.0,
    periods: float = 3.0,
    levels: int = 5,
    smoothed: float | None = None,
) -> Reference:
    """Return one of the usual shapes: ``"sine"``, ``"triangle"``, ``"staircase"`` or ``"raster"``.

    A staircase has as many ``levels`` from the middle to either end; a raster are lines that are
    written slowly, with quick ways back, and ``periods`` counts them. The interval is in s,
    amplitude and middle in um, the frequency in Hz; ``smoothed`` is the sd of the smoothing, s, by
    default a hundredth of a period.

    Raises InputError: an unknown shape, or a number that makes no sense.
    """
    if shape not in SHAPES:
        raise InputError(f"reference: {shape!r} is unknown; {suggestion(shape, SHAPES)}")
    numbers = {"interval": interval, "amplitude": amplitude, "frequency": frequency}
    numbers |= {"periods": periods, "levels": levels}
    for name, value in (numbers | {"middle": middle}).items():
        if not isinstance(value, Real):
            raise InputError(f"{shape}: {name} {value!r}; must be a number")
    for name, value in numbers.items():
        if not 0 < value < math.inf:
            raise InputError(f"{shape}: {name} {value:g}; must be positive")
    if not math.isfinite(middle):
        raise InputError(f"{shape}: middle {middle:g} um; must be finite")
    if not 2 * frequency * interval < 1:
        raise InputError(
            f"{shape}: {frequency:g} Hz cannot be sampled every {interval:g} s; make it slower"
        )
    if periods / (frequency * interval) > LONGEST:
        raise InputError(f"{shape}: more than {LONGEST} samples; make it shorter")
    samples = round(periods / (frequency * interval)) + 1
    swung: FloatArray = amplitude * SHAPES[shape](
        frequency * interval * np.arange(samples, dtype=np.float64), levels
    )
    # A shape rests for a quarter of a period before it begins.
    still = np.zeros(max(round(0.25 / (frequency * interval)), 1))
    if middle:
        approach = _way(middle, round(1 / (frequency * interval)))
        still = np.concatenate([still, approach, np.full(still.size, middle)])
    sd = 0.01 / frequency if smoothed is None else smoothed
    return Reference(np.concatenate([still, middle + swung]), interval, shape, sd)


def tracking_signals(
    frequency: float, interval: float, center: float, amplitude: float, rise: int = 1
) -> tuple[FloatArray, int]:
    """Return the signals of ``TRACKED`` at a frequency, (signals, samples), um, and their begin.

    Frequency in Hz, interval in s. The signals swing by the amplitude about the center, um. Before
    they begin the displacement goes smoothly from zero, its rest, to the center. A jump takes
    ``rise`` samples: no actuator follows one that takes none. A signal has three periods, or as
    many as take a second, and a sample more than is judged.
    """
    periods = max(3, int(np.ceil(frequency)))
    samples = max(round(periods / (frequency * interval)), 2)
    turns = frequency * interval * np.arange(samples + 1, dtype=np.float64)
    sine = np.sin(2 * np.pi * turns)
    end = turns[-1] + (turns[-1] - turns[-2])
    steps = np.where((turns + 1e-9) % 1.0 < 0.5, 1.0, -1.0)
    shapes = (
        sine,
        sine * (1 - turns / end),
        steps,
        SHAPES["staircase"](turns, 5),
    )
    kernel = np.hanning(rise + 2)[1:-1]
    smoothed = [
        np.convolve(shape, kernel / kernel.sum())[: turns.size] if jumps else shape
        for shape, jumps in zip(shapes, TRACKED.values(), strict=True)
    ]
    signals = center + amplitude * np.stack(smoothed)
    if center == 0:
        return signals, 0
    approach = _way(center, round(APPROACH / interval))
    return np.hstack([np.tile(approach, (len(signals), 1)), signals]), approach.size
