"""What the sensor may add: a drift, a transient, a step, an oscillation, a sign, a moving gain."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.laplace import Simulate, climb
from bwbayes.diagnosis.record_checks import MOST_LEFT_OUT, SETTLE_FIRST
from bwbayes.diagnosis.scene import Explanation, Scene
from bwbayes.inference import pointfit

__all__ = ["drift", "moving_gain", "oscillation", "reversed_sign", "step", "transient"]

# Prior sd of an addition to the displacement, as a fraction of its range.
SIZE = 0.1

# A transient has ended where so much of it is left, as a fraction of the range.
FADED = 0.002


@dataclass(frozen=True)
class Addition:
    """An addition to the displacement, whatever the model does: ``shape(sizes)`` (samples,), um."""

    shape: Callable[[FloatArray], FloatArray]
    starts: FloatArray

    def apply(self, simulate: Simulate, voltage: FloatArray, sizes: FloatArray) -> FloatArray:
        """Add it to what the model does."""
        moved: FloatArray = simulate(voltage) + self.shape(sizes)[: voltage.size]
        return moved


def columns(shapes: FloatArray, size: float) -> Addition:
    """Add shapes (shapes, samples), each of a size whose prior sd is given, um."""
    return Addition(lambda sizes: size * (sizes @ shapes), np.zeros((1, len(shapes))))


def drift(scene: Scene) -> Iterator[Explanation]:
    """Try A₁ t/T + A₂ (t/T)²."""
    along = scene.time / scene.duration
    fit = scene.extended(columns(np.stack([along, along**2]), SIZE * scene.extent))
    size = SIZE * scene.extent * float(np.sum(fit.sizes))
    text = f"drift of the readings by {size:.2g} um"
    yield scene.explained("drift", text, "measure again after a longer warm-up", fit, foreign=True)


def transient(scene: Scene) -> Iterator[Explanation]:
    """Try A exp(−t/τ); τ is a thirtieth of the record, within a factor of three."""

    def decay(size: float) -> float:
        return float(scene.duration / 30 * np.exp(1.1 * size))

    def shape(sizes: FloatArray) -> FloatArray:
        faded: FloatArray = np.exp(-scene.time / decay(sizes[1]))
        sized: FloatArray = 2 * SIZE * scene.extent * sizes[0] * faded
        return sized

    fit = scene.extended(Addition(shape, np.array([[0.0, z] for z in (-1.2, 0.0, 1.2)])))
    size, time = 2 * SIZE * scene.extent * fit.sizes[0], decay(fit.sizes[1])
    until = time * np.log(max(abs(size) / (FADED * scene.extent), 1.0))
    text = f"transient of {size:.2g} um at the start that decays within {time:.2g} s"
    fix = f"set exclude = [[{scene.clock(0.0)}, {scene.clock(until)}]] in [record]"
    travel = np.abs(np.diff(scene.voltage, prepend=scene.voltage[0]))
    if travel[scene.time[: travel.size] < until].sum() > MOST_LEFT_OUT * travel.sum():
        fix = SETTLE_FIRST
    yield scene.explained("transient", text, fix, fit, removes=True, foreign=True)


def step(scene: Scene) -> Iterator[Explanation]:
    """Try A from a time on: that of the largest innovation, whose choice is paid for."""
    readings = scene.posterior.only.readings
    white = np.abs(scene.innovations)
    white[: max(white.size // 50, 1)] = 0.0
    row = int(readings.rows[int(np.argmax(white))])
    after = (np.arange(scene.time.size) >= row).astype(np.float64)
    fit = scene.extended(columns(after[np.newaxis], SIZE * scene.extent))
    size, time = SIZE * scene.extent * fit.sizes[0], scene.clock(scene.time[row])
    text = f"step of the offset by {size:.2g} um at {time} s"
    cost = float(np.log(readings.rows.size))
    yield scene.explained(
        "step", text, f"fit one side: set train to end or begin at {time}", fit, cost
    )


def oscillation(scene: Scene) -> Iterator[Explanation]:
    """Try A sin ωt + B cos ωt at the innovations' strongest frequency that the drive has not."""
    readings = scene.posterior.only.readings
    length = 4 * readings.samples
    values = np.zeros((2, readings.samples))
    values[0, readings.rows] = scene.innovations
    drive = scene.voltage[readings.rows]
    values[1, readings.rows] = drive - np.mean(drive)
    power = np.abs(np.fft.rfft(values * np.hanning(readings.samples), length)) ** 2
    frequency = np.fft.rfftfreq(length, scene.interval)
    # Not where the drive itself moves the displacement, at harmonics that a loop makes of it too.
    main = frequency[int(np.argmax(power[1]))]
    order = frequency / max(main, frequency[1])
    near = np.abs(order - np.rint(order)) * main < 6 / scene.duration
    power[0, near | (frequency < 3 * main)] = 0.0
    best = float(frequency[int(np.argmax(power[0]))])
    if not best:
        return
    phase = 2 * np.pi * best * scene.time
    shapes = np.stack([np.sin(phase), np.cos(phase)])
    fit = scene.extended(columns(shapes, SIZE * scene.extent / 10))
    size = SIZE * scene.extent / 10 * float(np.hypot(*fit.sizes))
    text = f"oscillation of {size:.2g} um at {best:.4g} Hz"
    fix = "look for the source: mains, ground loops, vibration"
    cost = float(np.log(readings.rows.size / 2))
    yield scene.explained("oscillation", text, fix, fit, cost)


@dataclass(frozen=True)
class MovingGain:
    """x (1 + a t/T), ``along`` (samples,) being t/T."""

    along: FloatArray
    starts: FloatArray

    def apply(self, simulate: Simulate, voltage: FloatArray, sizes: FloatArray) -> FloatArray:
        """Scale what the model does."""
        along = self.along[: voltage.size]
        moved: FloatArray = simulate(voltage) * (1 + SIZE * sizes[0] * along)
        return moved


def moving_gain(scene: Scene) -> Iterator[Explanation]:
    """X (1 + a t/T)."""
    fit = scene.extended(MovingGain(scene.time / scene.duration, np.zeros((1, 1))))
    text = f"gain that changes by {100 * SIZE * fit.sizes[0]:.2g}% along the record (temperature)"
    yield scene.explained("moving gain", text, "measure at a constant temperature", fit)


def reversed_sign(scene: Scene) -> Iterator[Explanation]:
    """Try −x, if the readings fall where the voltage rises."""
    record = scene.posterior.only
    readings, drive = record.readings, record.voltage[record.readings.rows]
    if float((drive - drive.mean()) @ (readings.values - readings.values.mean())) >= 0:
        return
    turned = scene.posterior.altered(displacement=-record.displacement)
    fit = climb(turned, pointfit.fit(turned, scene.generator).mode)
    text, fix = "reversed sign of the displacement", "change its sign in the file"
    yield scene.explained("sign", text, fix, fit)
